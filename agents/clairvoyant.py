"""The ceiling: what a driver who knows the car, the road and every disturbance ahead would do.

A plan is solved for the whole episode and scored by what its actions cost in the real env, not by
its own objective. On the nonlinear plant it is a local optimum, solved from several starts.
"""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ..envs.vehicle import GRAVITY
from ..envs.reference import reference
from .clairvoyant_nonlinear import Solution, Trajectory, solve, tracking_gains
from .controller import Controller
from .foreseen import Foreseen, Known, State, foresee, state_of

Array = npt.NDArray[np.float64]
Actions = npt.NDArray[np.float32]

GRIPS = (3.0, 1.7, 1.3, 1.1, 1.0)  # times the true friction, on the way to a hard episode's plan
REFINEMENTS = 3  # plans from the newest run, while they still gain
GAIN = 1e-3  # of the cost, below which another refinement is not worth its seconds
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """Actions (K, width) for an episode, the best run that a start led to.

    cost: of the run in the env. objective: what the solver expected of it, without the cap on the
    cost rate. status: the solver's return text. seconds: of CPU time.
    """

    actions: Actions
    cost: float
    objective: float
    status: str
    seconds: float


@dataclass(frozen=True)
class Run:
    """What the env made of actions."""

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
            wish = actions[k] - gains[k] @ (states[k] - planned[k])
            taken[k] = np.clip(wish, -1.0, 1.0)
        _, reward, terminated, truncated, _ = env.step(taken[k])
        cost -= float(reward)
        states[k + 1 :] = state_of(base.get_state()["state"])
        if terminated or truncated:
            failed = terminated
            break
    return Run(Trajectory(states, taken.astype(np.float64)), cost, failed)


def replay(env: gym.Env[Any, Any], seed: int, actions: npt.ArrayLike) -> float:
    """The cost of an episode with given actions (K, width) in the env."""
    return drive(env, seed, np.asarray(actions, np.float64)).cost


def plan(env: gym.Env[Any, Any], seed: int, start: npt.ArrayLike | None = None) -> Plan:
    """The best that can be found for an episode from a start.

    start: actions (K, width), None: zero. Raises ModuleNotFoundError without the extra `mpc`.
    """
    began = time.process_time()
    env.reset(seed=seed)
    foreseen = foresee(env.unwrapped)
    shape = (foreseen.fixed.periods, foreseen.fixed.width)
    actions = np.zeros(shape) if start is None else np.asarray(start, np.float64)
    if actions.shape != shape:
        raise ValueError(f"a plan of this episode has shape {shape}, got {actions.shape}")
    found = solve(foreseen, drive(env, seed, actions).trajectory)
    if not found.solved and start is None:
        found = _from_grip(foreseen)
    best, objective, status = _follow(env, seed, foreseen, found), found.objective, found.status
    for _ in range(REFINEMENTS):
        found = solve(foreseen, best.trajectory)
        run = _follow(env, seed, foreseen, found)
        better = run.cost < best.cost * (1.0 - GAIN)
        if run.cost < best.cost:
            best, objective, status = run, found.objective, found.status
        if not better:
            break
    taken = best.trajectory.actions.astype(np.float32)
    return Plan(taken, best.cost, objective, status, time.process_time() - began)


def _follow(env: gym.Env[Any, Any], seed: int, foreseen: Foreseen, found: Solution) -> Run:
    """The better run of a solution: as it stands, or kept on its course."""
    plan = found.trajectory
    gains = tracking_gains(foreseen, plan)
    runs = drive(env, seed, plan.actions), drive(env, seed, plan.actions, (plan.states, gains))
    return min(runs, key=lambda run: run.cost)


def _from_grip(foreseen: Foreseen) -> Solution:
    """A plan that starts on the reference with much friction and comes down to the true one."""
    fixed, known = foreseen.fixed, Known(*foreseen.known)
    v = np.full(len(known.command), foreseen.start.v_x)
    refs = [
        reference(command, speed, fixed.target, fixed.switches.reference)
        for command, speed in zip(known.command, v, strict=True)
    ]
    beta, gamma = np.array(refs).T
    share = np.minimum(1.0, 0.8 * known.mu * GRAVITY / np.maximum(v * np.abs(gamma), 1e-9))
    states = np.tile(np.array(foreseen.start), (len(v), 1))
    states[:, State._fields.index("v_y")] = share * beta * v
    states[:, State._fields.index("gamma")] = share * gamma
    at = Trajectory(states, np.zeros((fixed.periods, fixed.width)))
    for grip in GRIPS:
        found = solve(foreseen, at, grip)
        at = found.trajectory
    return found
