"""The ceiling: the best actions for a known car, road and every disturbance ahead.

A plan is solved for the whole episode and scored by the cost of its actions in the real env, not by
its own objective. On the nonlinear plant it is a local optimum, solved from several starts.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import P
from ...envs.task.reference import reference
from ...envs.vehicle.vehicle import GRAVITY
from ..controllers.base import Controller
from ..rollout import steps_of
from .foresight import Forecast, Known, State, forecast_of, state_of
from .qp import is_linear, solve_linear
from .shooting import Solution, Trajectory, solve, tracking_gains

Array = npt.NDArray[np.float64]
Actions = npt.NDArray[np.float32]

GRIPS = (3.0, 1.5, 1.0)  # times the true friction, on the way to a hard episode's plan
REFINEMENTS = 3  # plans from the newest run, while they still gain
GAIN = 1e-3  # of the cost, below which another refinement is not worth its seconds
AGREEMENT = 5e-3  # between a solved plan's cost and objective: nothing is left to refine


@dataclass(frozen=True)
class Plan:
    """Actions (K, width) for an episode, the best run that a start led to.

    cost: of the run in the env. objective: the solver's, without the cap on the cost
    rate. status: the solver's return text. seconds: of CPU time.
    """

    actions: Actions
    cost: float
    objective: float
    status: str
    seconds: float


@dataclass(frozen=True)
class Run:
    """The env's run of actions."""

    trajectory: Trajectory
    cost: float
    failed: bool


def drive(
    env: gym.Env[Any, Any], seed: int, actions: Array, follow: tuple[Array, Array] | None = None
) -> Run:
    """One episode in the env. follow: (states, gains) to which the actions are corrected."""
    env.reset(seed=seed)
    base: Any = env.unwrapped
    taken = np.array(actions, np.float32)
    states, cost, failed = np.empty((len(actions) + 1, len(State._fields))), 0.0, False
    states[0] = state_of(base.get_state()["state"])
    for k in range(len(taken)):
        if follow is not None:
            planned, gains = follow
            corrected = actions[k] - gains[k] @ (states[k] - planned[k])
            taken[k] = np.clip(corrected, -1.0, 1.0)
        _, reward, terminated, truncated, _ = env.step(taken[k])
        cost -= float(reward)
        states[k + 1 :] = state_of(base.get_state()["state"])
        if terminated or truncated:
            failed = terminated
            break
    return Run(Trajectory(states, taken.astype(np.float64)), cost, failed)


def replay(env: gym.Env[Any, Any], seed: int, actions: npt.ArrayLike) -> float:
    """The cost of actions (K, width) in an episode of the env."""
    return drive(env, seed, np.asarray(actions, np.float64)).cost


def plan(env: gym.Env[Any, Any], seed: int, start: npt.ArrayLike | None = None) -> Plan:
    """The best that can be found for an episode from a start.

    start: actions (K, width), None: zero. Raises ModuleNotFoundError without the extra `mpc`.
    """
    began = time.process_time()
    env.reset(seed=seed)
    base: Any = env.unwrapped
    linear = is_linear(base)
    forecast = forecast_of(base, base.control_period if linear else 1)
    shape = (forecast.fixed.periods, forecast.fixed.width)
    actions = np.zeros(shape) if start is None else np.asarray(start, np.float64)
    if actions.shape != shape:
        raise ValueError(f"a plan of this episode has shape {shape}, got {actions.shape}")
    if forecast.fixed.kind.follows and start is not None:
        forecast = forecast_of(base, 1, actions)
    if linear:
        made, objective, status = solve_linear(forecast)
        best = drive(env, seed, made)
    else:
        best, objective, status = _search(env, seed, forecast, actions, start is None)
    taken = best.trajectory.actions.astype(np.float32)
    return Plan(taken, best.cost, objective, status, time.process_time() - began)


def _search(
    env: gym.Env[Any, Any], seed: int, forecast: Forecast, actions: Array, free: bool
) -> tuple[Run, float, str]:
    """The best run of the plans from a start, with the objective and status of its plan.

    free: whether the plan may start elsewhere where IPOPT does not finish from the actions' run.
    """
    found = solve(forecast, drive(env, seed, actions).trajectory)
    if free and not found.solved:
        found = _from_grip(forecast)
    best, objective, status = _follow(env, seed, forecast, found), found.objective, found.status
    if found.solved and abs(best.cost - objective) <= AGREEMENT * best.cost:
        return best, objective, status
    for _ in range(REFINEMENTS):
        if forecast.fixed.kind.follows:  # the driver answers to the newest run
            env.reset(seed=seed)
            forecast = forecast_of(env.unwrapped, 1, best.trajectory.actions)
        before, found = best.cost, solve(forecast, best.trajectory)
        run = _follow(env, seed, forecast, found)
        if run.cost < best.cost:
            best, objective, status = run, found.objective, found.status
        if best.cost > before * (1.0 - GAIN):
            break
    return best, objective, status


def _follow(env: gym.Env[Any, Any], seed: int, forecast: Forecast, found: Solution) -> Run:
    """The better run of a solution: as it stands, or regulated along its course."""
    plan = found.trajectory
    gains = tracking_gains(forecast, plan)
    runs = drive(env, seed, plan.actions), drive(env, seed, plan.actions, (plan.states, gains))
    return min(runs, key=lambda run: run.cost)


def _from_grip(forecast: Forecast) -> Solution:
    """A plan that starts on the reference with much friction and comes down to the true one."""
    fixed, known = forecast.fixed, Known(*forecast.known)
    v = np.full(len(known.command), forecast.start.v_x)
    refs = [
        reference(command, speed, fixed.target, fixed.kind.reference)
        for command, speed in zip(known.command, v, strict=True)
    ]
    beta, gamma = np.array(refs).T
    mu = 0.5 * (known.mu + known.mu_r)
    share = np.minimum(1.0, 0.8 * mu * GRAVITY / np.maximum(v * np.abs(gamma), 1e-9))
    states = np.tile(np.array(forecast.start), (len(v), 1))
    states[:, State._fields.index("v_y")] = share * beta * v
    states[:, State._fields.index("gamma")] = share * gamma
    at = Trajectory(states, np.zeros((fixed.periods, fixed.width)))
    for grip in GRIPS:
        found = solve(forecast, at, grip)
        at = found.trajectory
    return found


@dataclass(frozen=True)
class Ceiling:
    """The best run found of an episode.

    winner: a label of costs. costs: of every start's own run ("two-dof") and of the plan from it
    ("from two-dof"). statuses: of the plans.
    """

    actions: Actions
    cost: float
    winner: str
    costs: dict[str, float]
    statuses: dict[str, str]
    seconds: float


def ceiling(
    env: gym.Env[Any, Any], seed: int, starts: Mapping[str, npt.ArrayLike] | None = None
) -> Ceiling:
    """The best of the plans from zero and from other methods' runs, and of those runs themselves.

    starts: actions (K, width) by method. A method that no plan beats is the ceiling.
    """
    began = time.process_time()
    first = plan(env, seed)
    tried: dict[str, Actions] = {"none": np.zeros_like(first.actions)}
    tried |= {name: np.asarray(actions, np.float32) for name, actions in (starts or {}).items()}
    costs = {name: replay(env, seed, actions) for name, actions in tried.items()}
    plans = {"none": first}
    plans |= {name: plan(env, seed, tried[name]) for name in starts or {}}
    for name, made in plans.items():
        tried[f"from {name}"], costs[f"from {name}"] = made.actions, made.cost
    winner = min(costs, key=lambda label: costs[label])
    return Ceiling(
        tried[winner],
        costs[winner],
        winner,
        costs,
        {name: made.status for name, made in plans.items()},
        time.process_time() - began,
    )


def actions_of(env: gym.Env[Any, Any], agent: Any, seed: int) -> Actions:
    """(K, width): the actions of an agent in an episode; zeros after a failure."""
    base: Any = env.unwrapped
    _, *steps = steps_of(env, agent, seed)
    periods = -int(-base.get_state()["params"][P.task.duration] // base.control_period)
    taken = np.zeros((periods, *base.action_space.shape), np.float32)
    taken[: len(steps)] = [step.action for step in steps]
    return taken


class Replay(Controller):
    """A plan as an agent: the actions of one episode, whatever is observed; zeros after them.

    actions: (K, width) shares of full scale.
    """

    memory = 1

    def __init__(self, env: gym.Env[Any, Any], actions: npt.ArrayLike) -> None:
        super().__init__(env)
        planned = np.asarray(actions, np.float64)
        if planned.ndim != 2 or planned.shape[1] != self.width or not np.isfinite(planned).all():
            raise ValueError(
                f"a plan is finite numbers (K, {self.width}), got shape {planned.shape}"
            )
        self._actions = np.vstack([planned, np.zeros((1, self.width))])

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        step = state[:, 0].astype(int)
        action[:] = self._actions[np.minimum(step, len(self._actions) - 1)]
        state[:, 0] += 1.0
