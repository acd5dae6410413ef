"""The clairvoyant oracle: the best actions for a known car, road and all future disturbances.

Iterative LQR on the env itself: linearisation of the plant along a run, a backward pass within
the limits, and runs of the env that try the new actions with the pass's gains. A result costs what
the env computes, failures included. It is a local optimum, sought from several starts.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import P
from ...envs.record import Array
from ..rollout import iterate_steps
from .preview import Forecast, PlanState, make_forecast, read_plan_state
from .sweep import (
    N_INPUTS,
    IlqrProblem,
    Trajectory,
    compute_limits,
    linearise_run,
    make_problem,
    run_backward_pass,
)

Actions = npt.NDArray[np.float32]

STEP_LENGTHS = (1.0, 0.4, 0.1)  # fractions of the step d that are tried in turn
_FIRST_DAMPING = 1e-2  # damping of the first sweep, as for `run_backward_pass`
_DAMPING_LIMITS = (1e-8, 1e4)  # the least, and the one at which no step is left to try
_DAMPING_FACTOR = 4.0  # from one damping to the next
MAX_ITERATIONS = 60
_STALL_RULE = (1e-3, 3)  # settled: a smaller fraction of the cost gained in so many steps in a row


@dataclass(frozen=True)
class Plan:
    """Actions for an episode: the best run that a start led to."""

    actions: Actions  # actions, shape (K, width)
    cost: float  # cost of the run in the env
    status: str  # "settled", "stuck" (no step was cheaper) or "stopped" (after `MAX_ITERATIONS`)
    seconds: float  # CPU time (s)


@dataclass(frozen=True)
class _PlanRun:
    """The env's run of actions."""

    trajectory: Trajectory  # states and applied actions
    cost: float  # cost J
    length: int  # periods until it ended


def simulate_run(
    env: gym.Env[Any, Any], seed: int, actions: Array, feedback: tuple[Array, Array] | None = None
) -> _PlanRun:
    """Simulate one episode in the env.

    Args:
        env: Single env.
        seed: Seed of the episode.
        actions: Actions, shape (K, width).
        feedback: States (K + 1, n) and gains (K, width, n) by which the actions are corrected.

    Returns:
        Trajectory, cost and number of control periods of the run.
    """
    env.reset(seed=seed)
    base: Any = env.unwrapped
    applied = np.array(actions, np.float32)
    states, cost, length = np.empty((len(actions) + 1, len(PlanState._fields))), 0.0, 0
    states[0] = read_plan_state(base.get_state()["state"])
    for k in range(len(applied)):
        if feedback is not None:
            planned, gains = feedback
            corrected = actions[k] - gains[k] @ (states[k] - planned[k])
            applied[k] = np.clip(corrected, -1.0, 1.0)
        _, reward, terminated, truncated, _ = env.step(applied[k])
        cost -= float(reward)
        states[k + 1 :] = read_plan_state(base.get_state()["state"])
        length = k + 1
        if terminated or truncated:
            break
    return _PlanRun(Trajectory(states, applied.astype(np.float64)), cost, length)


def evaluate_actions(env: gym.Env[Any, Any], seed: int, actions: npt.ArrayLike) -> float:
    """Evaluate the cost of actions in an episode of the env.

    Args:
        env: Single env.
        seed: Seed of the episode.
        actions: Actions, shape (K, width).

    Returns:
        Cost J of the episode.
    """
    return simulate_run(env, seed, np.asarray(actions, np.float64)).cost


def solve_ilqr(env: gym.Env[Any, Any], seed: int, start: npt.ArrayLike | None = None) -> Plan:
    """Solve for the best plan of an episode that a start leads to.

    Args:
        env: Single env.
        seed: Seed of the episode.
        start: Actions, shape (K, width); None: zeros.

    Returns:
        Best actions in the env, their cost and the solver's status.

    Raises:
        ModuleNotFoundError: The extra `mpc` is not installed.
        ValueError: The start has another shape.
    """
    start_time = time.process_time()
    env.reset(seed=seed)
    forecast = make_forecast(env.unwrapped)
    shape = (forecast.fixed.periods, forecast.fixed.width)
    actions = np.zeros(shape) if start is None else np.asarray(start, np.float64)
    if actions.shape != shape:
        raise ValueError(f"a plan of this episode has shape {shape}, got {actions.shape}")
    best, status = _search(env, seed, forecast, actions)
    applied = best.trajectory.actions.astype(np.float32)
    return Plan(applied, best.cost, status, time.process_time() - start_time)


def _search(
    env: gym.Env[Any, Any], seed: int, forecast: Forecast, actions: Array
) -> tuple[_PlanRun, str]:
    """Search the best run that the steps from a start lead to, and return how they ended."""
    problem, best = make_problem(forecast.fixed), simulate_run(env, seed, actions)
    damping, n_stalled = _FIRST_DAMPING, 0
    for iteration in range(MAX_ITERATIONS):
        if forecast.fixed.kind.has_driver:  # the driver answers to the newest run
            env.reset(seed=seed)
            forecast = make_forecast(env.unwrapped, best.trajectory.actions)
        previous_cost = best.cost
        best, damping = _run_line_search(env, seed, problem, forecast, best, damping)
        if best.cost >= previous_cost:
            return best, "settled" if iteration else "stuck"
        n_stalled = n_stalled + 1 if best.cost > previous_cost * (1.0 - _STALL_RULE[0]) else 0
        if n_stalled == _STALL_RULE[1]:
            return best, "settled"
    return best, "stopped"


def _run_line_search(
    env: gym.Env[Any, Any],
    seed: int,
    problem: IlqrProblem,
    forecast: Forecast,
    run: _PlanRun,
    damping: float,
) -> tuple[_PlanRun, float]:
    """Return the first cheaper run, else the run itself, and the damping for the next step."""
    fixed, size = problem.fixed, len(problem.names)
    nominal_run = _use_achieved_steering(problem, run.trajectory)
    linearisation = linearise_run(problem, forecast.known, nominal_run)
    limits = compute_limits(problem, forecast, nominal_run)
    inputs = np.zeros((fixed.periods, N_INPUTS))
    inputs[:, : fixed.width] = nominal_run.actions
    d, G = np.empty_like(inputs), np.empty((*inputs.shape, size))
    gains = np.zeros((fixed.periods, fixed.width, len(PlanState._fields)))
    while damping < _DAMPING_LIMITS[1]:
        run_backward_pass(linearisation, limits, inputs, run.length, damping, d, G)
        gains[:, :, problem.state_indices] = -G[:, : fixed.width] / problem.scale
        for length in STEP_LENGTHS:
            candidate = nominal_run.actions + length * d[:, : fixed.width]
            trial = simulate_run(env, seed, candidate, (nominal_run.states, gains))
            if trial.cost < run.cost:
                whole, short = STEP_LENGTHS[0], STEP_LENGTHS[-1]
                factors = {whole: 1.0 / _DAMPING_FACTOR, short: _DAMPING_FACTOR}
                factor = factors.get(length, 1.0)
                return trial, max(damping * factor, _DAMPING_LIMITS[0])
        damping *= _DAMPING_FACTOR
    return run, damping


def _use_achieved_steering(problem: IlqrProblem, run: Trajectory) -> Trajectory:
    """Replace a run's steering by what its rate achieved: the linearisation has no rate limit."""
    if run.actions.shape[1] < N_INPUTS:
        return run
    actions, column = run.actions.copy(), PlanState._fields.index("slewing")
    actions[:, 1] = run.states[1:, column] / problem.fixed.task.authority
    return Trajectory(run.states, actions)


@dataclass(frozen=True)
class ClairvoyantResult:
    """The best run of an episode."""

    actions: Actions  # shape (K, width)
    cost: float  # of the run in the env
    winner: str  # label in `costs`
    costs: dict[str, float]  # of each start's own run ("two-dof") and its plan ("from two-dof")
    statuses: dict[str, str]  # of the plans by start
    seconds: float  # CPU time


def compute_clairvoyant(
    env: gym.Env[Any, Any], seed: int, starts: Mapping[str, npt.ArrayLike] | None = None
) -> ClairvoyantResult:
    """Compute the best of the plans from other methods' runs, and of those runs themselves.

    Args:
        env: Single env.
        seed: Seed of the episode.
        starts: Actions, shape (K, width), by method; without any the plan starts from zeros.

    Returns:
        Actions of the least cost, and the costs of all candidates.
    """
    start_time, base = time.process_time(), env.unwrapped
    env.reset(seed=seed)
    shape = (_count_periods(base), *(base.action_space.shape or ()))
    candidates: dict[str, Actions] = {"none": np.zeros(shape, np.float32)}
    candidates |= {name: np.asarray(run, np.float32) for name, run in (starts or {}).items()}
    costs = {name: evaluate_actions(env, seed, actions) for name, actions in candidates.items()}
    plans = {name: solve_ilqr(env, seed, candidates[name]) for name in starts or candidates}
    for name, solved in plans.items():
        candidates[f"from {name}"], costs[f"from {name}"] = solved.actions, solved.cost
    winner = min(costs, key=lambda label: costs[label])
    statuses = {name: solved.status for name, solved in plans.items()}
    actions, cost, seconds = candidates[winner], costs[winner], time.process_time() - start_time
    return ClairvoyantResult(actions, cost, winner, costs, statuses, seconds)


def record_actions(env: gym.Env[Any, Any], agent: Any, seed: int) -> Actions:
    """Record an agent's actions in an episode.

    Args:
        env: Single env.
        agent: Agent, as for `iterate_steps`.
        seed: Seed of the episode.

    Returns:
        Actions in fractions of full scale, shape (K, width), zeros after a failure.
    """
    base: Any = env.unwrapped
    _, *steps = iterate_steps(env, agent, seed)
    actions = np.zeros((_count_periods(base), *base.action_space.shape), np.float32)
    actions[: len(steps)] = [step.action for step in steps]
    return actions


def _count_periods(base: Any) -> int:
    """Count the control periods of the episode that was last reset."""
    return -int(-base.get_state()["params"][P.task.duration] // base.control_period)
