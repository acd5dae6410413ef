"""The clairvoyant oracle: the best actions for a known car, road and all future disturbances.

Iterative LQR on the env itself: linearisation of the plant along a run, a backward pass within
the limits, and runs of the env that try the new actions with the pass's gains. A result costs what
the env computes, failures included. It is a local optimum, sought from several starts.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

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
    PlanRun,
    compute_limits,
    linearise_run,
    make_problem,
    run_backward_pass,
)

if TYPE_CHECKING:
    from ...envs.stability import StabilityEnv

Actions = npt.NDArray[np.float32]

STEP_LENGTHS = (1.0, 0.4, 0.1)  # fractions of the step d that are tried in turn
_FIRST_DAMPING = 1e-2  # damping of the first sweep, as for `run_backward_pass`
_DAMPING_LIMITS = (1e-8, 1e4)  # the least, and the one at which no step is left to try
_DAMPING_FACTOR = 4.0  # from one damping to the next
MAX_ITERATIONS = 60
_STALL_RULE = (1e-3, 3)  # settled: a smaller fraction of the cost gained in so many steps in a row


def _simulate_run(
    env: gym.Env[Actions, Actions],
    seed: int,
    actions: Array | Actions,
    feedback: tuple[Array, Array] | None = None,
) -> PlanRun:
    """Simulate an episode; feedback: states (K + 1, n) and gains (K, width, n) for corrections."""
    env.reset(seed=seed)
    base = _get_base(env)
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
    return PlanRun(states, applied.astype(np.float64), cost, length)


def _solve_ilqr(
    env: gym.Env[Actions, Actions], seed: int, start: npt.ArrayLike | None = None
) -> tuple[PlanRun, str]:
    """Return the best run that the steps from a start lead to, and how they ended.

    It is "settled", "stuck" (no step was cheaper) or "stopped" (after `MAX_ITERATIONS`).
    """
    env.reset(seed=seed)
    forecast = make_forecast(_get_base(env))
    shape = (forecast.fixed.periods, forecast.fixed.width)
    actions = np.zeros(shape) if start is None else np.asarray(start, np.float64)
    if actions.shape != shape:
        raise ValueError(f"a plan of this episode has shape {shape}, got {actions.shape}")
    problem, best = make_problem(forecast.fixed), _simulate_run(env, seed, actions)
    damping, n_stalled = _FIRST_DAMPING, 0
    for iteration in range(MAX_ITERATIONS):
        if forecast.fixed.kind.has_driver:  # the driver answers to the newest run
            env.reset(seed=seed)
            forecast = make_forecast(_get_base(env), best.actions)
        previous_cost = best.cost
        best, damping = _run_line_search(env, seed, problem, forecast, best, damping)
        if best.cost >= previous_cost:
            return best, "settled" if iteration else "stuck"
        n_stalled = n_stalled + 1 if best.cost > previous_cost * (1.0 - _STALL_RULE[0]) else 0
        if n_stalled == _STALL_RULE[1]:
            return best, "settled"
    return best, "stopped"


def _run_line_search(
    env: gym.Env[Actions, Actions],
    seed: int,
    problem: IlqrProblem,
    forecast: Forecast,
    run: PlanRun,
    damping: float,
) -> tuple[PlanRun, float]:
    """Return the first cheaper run, else the run itself, and the damping for the next step."""
    fixed, size = problem.fixed, len(problem.names)
    nominal_run = _use_achieved_steering(problem, run)
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
            trial = _simulate_run(env, seed, candidate, (nominal_run.states, gains))
            if trial.cost < run.cost:
                whole, short = STEP_LENGTHS[0], STEP_LENGTHS[-1]
                factors = {whole: 1.0 / _DAMPING_FACTOR, short: _DAMPING_FACTOR}
                factor = factors.get(length, 1.0)
                return trial, max(damping * factor, _DAMPING_LIMITS[0])
        damping *= _DAMPING_FACTOR
    return run, damping


def _use_achieved_steering(problem: IlqrProblem, run: PlanRun) -> PlanRun:
    """Replace a run's steering by what its rate achieved: the linearisation has no rate limit."""
    if run.actions.shape[1] < N_INPUTS:
        return run
    actions, column = run.actions.copy(), PlanState._fields.index("slewing")
    actions[:, 1] = run.states[1:, column] / problem.fixed.task.authority
    return replace(run, actions=actions)


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
    env: gym.Env[Actions, Actions], seed: int, starts: Mapping[str, npt.ArrayLike] | None = None
) -> ClairvoyantResult:
    """Compute the best of the plans from other methods' runs, and of those runs themselves.

    Args:
        env: Single env.
        seed: Seed of the episode.
        starts: Actions, shape (K, width), by method; without any the plan starts from zeros.

    Returns:
        Actions of the least cost, and the costs of all candidates.
    """
    start_time, base = time.process_time(), _get_base(env)
    env.reset(seed=seed)
    shape = (_count_periods(base), *(base.action_space.shape or ()))
    candidates: dict[str, Actions] = {"none": np.zeros(shape, np.float32)}
    candidates |= {name: np.asarray(run, np.float32) for name, run in (starts or {}).items()}
    costs = {name: _simulate_run(env, seed, run).cost for name, run in candidates.items()}
    plans = {name: _solve_ilqr(env, seed, candidates[name]) for name in starts or candidates}
    for name, (run, _) in plans.items():
        candidates[f"from {name}"] = run.actions.astype(np.float32)
        costs[f"from {name}"] = run.cost
    winner = min(costs, key=lambda label: costs[label])
    statuses = {name: status for name, (_, status) in plans.items()}
    actions, cost, seconds = candidates[winner], costs[winner], time.process_time() - start_time
    return ClairvoyantResult(actions, cost, winner, costs, statuses, seconds)


def record_actions(env: gym.Env[Actions, Actions], agent: Any, seed: int) -> Actions:
    """Record an agent's actions in an episode.

    Args:
        env: Single env.
        agent: Agent, as for `iterate_steps`.
        seed: Seed of the episode.

    Returns:
        Actions in fractions of full scale, shape (K, width), zeros after a failure.
    """
    base = _get_base(env)
    _, *steps = iterate_steps(env, agent, seed)
    actions = np.zeros((_count_periods(base), *(base.action_space.shape or ())), np.float32)
    actions[: len(steps)] = [step.action for step in steps]
    return actions


def _get_base(env: gym.Env[Actions, Actions]) -> "StabilityEnv":
    return cast("StabilityEnv", env.unwrapped)


def _count_periods(base: "StabilityEnv") -> int:
    """Count the control periods of the episode that was last reset."""
    return -int(-base.get_state()["params"][P.task.duration] // base.control_period)
