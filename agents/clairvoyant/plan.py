"""The ceiling: the best actions for a known car, road and every disturbance ahead.

Iterative LQR on the env itself: slopes of the plant's text along a run, a backward sweep within the
limits, and runs of the env that try the new actions with the sweep's gains. What is found is a run
and costs what the env says, cap and failures included; it is a local optimum, sought from several
starts.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import P
from ..controllers.base import Controller
from ..rollout import steps_of
from .foresight import Forecast, State, forecast_of, state_of
from .slopes import INPUTS, Problem, Trajectory, limits_along, problem_of, slopes_along
from .sweep import sweep

Array = npt.NDArray[np.float64]
Actions = npt.NDArray[np.float32]

LENGTHS = (1.0, 0.4, 0.1)  # of a step, tried in turn
DAMPING = 1e-2  # of the first sweep
DAMPINGS = (1e-8, 1e4)  # the least, and the one at which no step is left to try
FACTOR = 4.0  # between dampings
MOST_SWEEPS = 60
SLOW = (1e-3, 3)  # so little gained, relative, in so many steps in a row: settled


@dataclass(frozen=True)
class Plan:
    """Actions (K, width) for an episode, the best run that a start led to.

    cost: of the run in the env. status: "settled", "stuck" (no step was cheaper) or "stopped"
    (after `MOST_SWEEPS` steps). seconds: of CPU time.
    """

    actions: Actions
    cost: float
    status: str
    seconds: float


@dataclass(frozen=True)
class Run:
    """The env's run of actions; length: periods until it ended."""

    trajectory: Trajectory
    cost: float
    length: int


def drive(
    env: gym.Env[Any, Any], seed: int, actions: Array, follow: tuple[Array, Array] | None = None
) -> Run:
    """One episode in the env. follow: (states, gains) to which the actions are corrected."""
    env.reset(seed=seed)
    base: Any = env.unwrapped
    taken = np.array(actions, np.float32)
    states, cost, length = np.empty((len(actions) + 1, len(State._fields))), 0.0, 0
    states[0] = state_of(base.get_state()["state"])
    for k in range(len(taken)):
        if follow is not None:
            planned, gains = follow
            corrected = actions[k] - gains[k] @ (states[k] - planned[k])
            taken[k] = np.clip(corrected, -1.0, 1.0)
        _, reward, terminated, truncated, _ = env.step(taken[k])
        cost -= float(reward)
        states[k + 1 :] = state_of(base.get_state()["state"])
        length = k + 1
        if terminated or truncated:
            break
    return Run(Trajectory(states, taken.astype(np.float64)), cost, length)


def replay(env: gym.Env[Any, Any], seed: int, actions: npt.ArrayLike) -> float:
    """The cost of actions (K, width) in an episode of the env."""
    return drive(env, seed, np.asarray(actions, np.float64)).cost


def plan(env: gym.Env[Any, Any], seed: int, start: npt.ArrayLike | None = None) -> Plan:
    """The best that can be found for an episode from a start.

    start: actions (K, width), None: zero. Raises ModuleNotFoundError without the extra `mpc`.
    """
    began = time.process_time()
    env.reset(seed=seed)
    forecast = forecast_of(env.unwrapped)
    shape = (forecast.fixed.periods, forecast.fixed.width)
    actions = np.zeros(shape) if start is None else np.asarray(start, np.float64)
    if actions.shape != shape:
        raise ValueError(f"a plan of this episode has shape {shape}, got {actions.shape}")
    best, status = _search(env, seed, forecast, actions)
    taken = best.trajectory.actions.astype(np.float32)
    return Plan(taken, best.cost, status, time.process_time() - began)


def _search(
    env: gym.Env[Any, Any], seed: int, forecast: Forecast, actions: Array
) -> tuple[Run, str]:
    """The best run that the steps from a start lead to, and how they ended."""
    problem, best, damping, slow = problem_of(forecast.fixed), drive(env, seed, actions), DAMPING, 0
    for sweeps in range(MOST_SWEEPS):
        if forecast.fixed.kind.follows:  # the driver answers to the newest run
            env.reset(seed=seed)
            forecast = forecast_of(env.unwrapped, best.trajectory.actions)
        before = best.cost
        best, damping = _improve(env, seed, problem, forecast, best, damping)
        if best.cost >= before:
            return best, "settled" if sweeps else "stuck"
        slow = slow + 1 if best.cost > before * (1.0 - SLOW[0]) else 0
        if slow == SLOW[1]:
            return best, "settled"
    return best, "stopped"


def _improve(
    env: gym.Env[Any, Any],
    seed: int,
    problem: Problem,
    forecast: Forecast,
    run: Run,
    damping: float,
) -> tuple[Run, float]:
    """(the first cheaper run, the damping for the next step); the run itself where none is."""
    fixed, size = problem.fixed, len(problem.names)
    at = _realised(problem, run.trajectory)
    slopes = slopes_along(problem, forecast.known, at)
    limits = limits_along(problem, forecast, at)
    inputs = np.zeros((fixed.periods, INPUTS))
    inputs[:, : fixed.width] = at.actions
    d, G = np.empty_like(inputs), np.empty((*inputs.shape, size))
    gains = np.zeros((fixed.periods, fixed.width, len(State._fields)))
    while damping < DAMPINGS[1]:
        sweep(slopes, limits, inputs, run.length, damping, d, G)
        gains[:, :, problem.at] = -G[:, : fixed.width] / problem.scale
        for length in LENGTHS:
            wanted = at.actions + length * d[:, : fixed.width]
            tried = drive(env, seed, wanted, (at.states, gains))
            if tried.cost < run.cost:
                factor = {LENGTHS[0]: 1.0 / FACTOR, LENGTHS[-1]: FACTOR}.get(length, 1.0)
                return tried, max(damping * factor, DAMPINGS[0])
        damping *= FACTOR
    return run, damping


def _realised(problem: Problem, run: Trajectory) -> Trajectory:
    """A run whose steering asks for no more than it got: the slopes know no limit of its rate."""
    if run.actions.shape[1] < INPUTS:
        return run
    actions, column = run.actions.copy(), State._fields.index("slewing")
    actions[:, 1] = run.states[1:, column] / problem.fixed.task.authority
    return Trajectory(run.states, actions)


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
    """The best of the plans from other methods' runs, and of those runs themselves.

    starts: actions (K, width) by method; without any the plan starts from zero. A method that no
    plan beats is the ceiling.
    """
    began, base = time.process_time(), env.unwrapped
    env.reset(seed=seed)
    shape = (_periods(base), *(base.action_space.shape or ()))
    tried: dict[str, Actions] = {"none": np.zeros(shape, np.float32)}
    tried |= {name: np.asarray(actions, np.float32) for name, actions in (starts or {}).items()}
    costs = {name: replay(env, seed, actions) for name, actions in tried.items()}
    plans = {name: plan(env, seed, tried[name]) for name in starts or tried}
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
    taken = np.zeros((_periods(base), *base.action_space.shape), np.float32)
    taken[: len(steps)] = [step.action for step in steps]
    return taken


def _periods(base: Any) -> int:
    """Control periods of the episode that was last reset."""
    return -int(-base.get_state()["params"][P.task.duration] // base.control_period)


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
