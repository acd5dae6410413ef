"""The clairvoyant oracle: the best actions for a known car, road and all future disturbances.

Iterative LQR on the env itself: linearisation of the plant along a run, a backward pass within the
limits, and runs of the env with the pass's gains. A result costs what the env computes. It is a
local optimum, sought from several starts. Source: Tassa, Mansard, Todorov, ICRA 2014.

Args:
    env: Single env.
    seed: Seed of the episode.
    starts: Actions after the lead-in, shape (K, width), by method; None: zeros alone.
    agent: Agent, as for `iterate_steps`.
"""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import P
from ...envs.numerics.jit import as_python, jit
from ...envs.numerics.primitives import ARRAYS, Matrix, Vector
from ...envs.record import Array
from ...envs.vehicle.actuators import limit_angle
from ..env_info import CarEnv
from ..rollout import iterate_steps
from .forecast import (
    N_INPUTS,
    Forecast,
    IlqrProblem,
    Linearisation,
    PlanParams,
    PlanRun,
    PlanState,
    linearise,
    make_forecast,
    make_problem,
    read_plan_state,
)

if TYPE_CHECKING:
    from ...envs.stability import StabilityEnv

Actions = npt.NDArray[np.float32]

STEP_LENGTHS = (1.0, 0.4, 0.1)  # fractions of the step d that are tried in turn
_FIRST_DAMPING = 1e-2  # damping of the first pass, as for `_run_backward_pass`
_DAMPING_LIMITS = (1e-8, 1e4)  # the least, and the one at which no step is left to try
_DAMPING_FACTOR = 4.0  # from one damping to the next
MAX_ITERATIONS = 60
_STALL_RULE = (1e-3, 3)  # settled: a smaller fraction of the cost gained in so many steps in a row


class _ManoeuvreEnv(gym.Wrapper[Actions, Actions, Actions, Actions]):
    """An episode from its lead-in's end on, which is computed once; `lost` is what losing cost."""

    snapshot: Mapping[str, object] | None = None
    lost: float = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[Actions, dict[str, object]]:
        """Return to the start of the manoeuvre; the first reset's seed holds."""
        base = _get_base(self)
        if self.snapshot is not None:
            base.set_state(self.snapshot)
            return np.zeros(0, np.float32), {}
        result = self.env.reset(seed=seed, options=options)
        nothing = np.zeros(base.action_space.shape or (), np.float32)
        for _ in range(_count_lead_steps(base)):
            _, reward, terminated, _, _ = self.env.step(nothing)
            self.lost -= float(reward)
            if terminated:
                break
        self.snapshot = base.get_state()
        return result


class Limits(NamedTuple):
    """The limits of the inputs in every period."""

    low: Array  # lower limits, shape (K, N_INPUTS)
    high: Array  # upper limits, shape (K, N_INPUTS)
    rate_low: Array  # lower limit of the steering by its rate, shape (K,)
    rate_high: Array  # upper limit of the steering by its rate, shape (K,)
    column: int  # scaled state that moves the rate's limits: the last command of added steering
    slope: float  # rise of both rate limits per unit of the scaled state `column`


def _compute_limits(problem: IlqrProblem, forecast: Forecast, run: PlanRun) -> Limits:
    """Compute limits by full scale, the wheels' stop, and the steering's rate along a run."""
    fixed, K = problem.fixed, problem.fixed.periods
    low, high, zero = np.zeros((K, N_INPUTS)), np.zeros((K, N_INPUTS)), np.zeros(K)
    low[:, : fixed.width], high[:, : fixed.width] = -1.0, 1.0
    task = fixed.task
    if task.torque_slew:  # of the run's commands: they move from iteration to iteration
        share = _compute_commanded_share(fixed, run.states[:K])
        max_change = task.torque_slew * fixed.ticks * fixed.car.d_r / (fixed.car.r * task.yaw_scale)
        low[:, 0] = np.maximum(low[:, 0], share - max_change)
        high[:, 0] = np.minimum(high[:, 0], share + max_change)
    if fixed.width < N_INPUTS:
        return Limits(low, high, zero, zero, 0, 0.0)
    column = problem.names.index("slewing")
    clip_angle = as_python(limit_angle, ARRAYS)
    low[:, 1] = clip_angle(-task.authority, forecast.driver, task.stop).max(axis=1) / task.authority
    high[:, 1] = clip_angle(task.authority, forecast.driver, task.stop).min(axis=1) / task.authority
    position = PlanState(*run.states[:K].T).slewing / task.authority
    max_change = task.slew * fixed.ticks / task.authority
    slope = problem.scale[column] / task.authority
    return Limits(low, high, position - max_change, position + max_change, column, slope)


def _compute_commanded_share(fixed: PlanParams, states: Array) -> Array:
    """Compute the motors' commanded yaw moment as a fraction of full scale, shape (K,)."""
    x = PlanState(*states.T)
    share = 0.5 * (x.command_r - x.command_l) * fixed.car.d_r / (fixed.car.r * fixed.task.yaw_scale)
    return np.asarray(np.clip(share, -1.0, 1.0))


@jit
def _solve_input_qp(Q: Matrix, q: Vector, low: Vector, high: Vector) -> Any:
    """Minimise q'd + d'Qd / 2 with low <= d <= high: d, and whether each part is free of limits."""
    det = Q[0, 0] * Q[1, 1] - Q[0, 1] * Q[0, 1]
    x = (Q[0, 1] * q[1] - Q[1, 1] * q[0]) / det
    y = (Q[0, 1] * q[0] - Q[0, 0] * q[1]) / det
    if low[0] < x < high[0] and low[1] < y < high[1]:
        return x, y, True, True
    min_cost, best, free, d = math.inf, np.zeros(2), np.zeros(2, np.bool_), np.zeros(2)
    for i in range(2):
        for side in range(2):
            other = 1 - i
            d[i] = high[i] if side else low[i]
            interior = -(q[other] + Q[0, 1] * d[i]) / Q[other, other]
            d[other] = min(max(interior, low[other]), high[other])
            cost = q @ d + 0.5 * (d @ (Q @ d))
            if cost < min_cost:
                min_cost, best[:], free[:] = cost, d, False
                free[other] = d[other] == interior
    return best[0], best[1], free[0], free[1]


@jit
def _run_backward_pass(
    linearisation: Linearisation, limits: Limits, inputs: Matrix, length: int, damping: float,
    d: Matrix, G: Matrix,
) -> None:  # fmt: skip
    """Run the backward pass over a run's linearisation, with damping on the diagonal of Quu."""
    # Fills d (K, 2) and G (K, 2, size), with zeros behind the run's length: an input u of the run
    # becomes u + d + G dx, with dx the scaled state less the run's. G = -Quu^-1 Qux where both are
    # free. Where the rate limits the steering, the limit moves with the last command: so does G.
    # The cost to go from the next period's state is v'dx + dx'V dx / 2. With this period's cost,
    # in the state and the inputs, it is q'(dx, du) + (dx, du)'Q (dx, du) / 2.
    size = linearisation.F.shape[1]
    V, v = linearisation.H[length][:size, :size].copy(), linearisation.g[length][:size].copy()
    d[:], G[:] = 0.0, 0.0
    low, high = np.empty(2), np.empty(2)
    for k in range(length - 1, -1, -1):
        F = linearisation.F[k]
        q, Q = linearisation.g[k] + F.T @ v, linearisation.H[k] + F.T @ (V @ F)
        Qxx, Qux, Quu = Q[:size, :size], Q[size:, :size].copy(), Q[size:, size:].copy()
        low[:], high[:] = limits.low[k] - inputs[k], limits.high[k] - inputs[k]
        low_1, high_1 = low[1], high[1]
        if limits.slope > 0.0:  # the rate's limits, moved into the others
            low[1] = min(max(limits.rate_low[k] - inputs[k, 1], low_1), high_1)
            high[1] = max(min(limits.rate_high[k] - inputs[k, 1], high_1), low_1)
        damped = Quu + damping * np.eye(2)
        d[k, 0], d[k, 1], free_0, free_1 = _solve_input_qp(damped, q[size:], low, high)
        gain = G[k]
        if not free_1 and low_1 < d[k, 1] < high_1:
            gain[1, limits.column] = limits.slope
        if free_0 and free_1:
            gain[:] = -np.linalg.solve(damped, Qux)
        elif free_0:
            gain[0] = -(Qux[0] + damped[0, 1] * gain[1]) / damped[0, 0]
        elif free_1:
            gain[1] = -(Qux[1] + damped[0, 1] * gain[0]) / damped[1, 1]
        v = q[:size] + gain.T @ (Quu @ d[k] + q[size:]) + Qux.T @ d[k]
        cross = gain.T @ Qux
        V = Qxx + gain.T @ (Quu @ gain) + cross + cross.T
        V = 0.5 * (V + V.T)


def _simulate_run(
    env: CarEnv, seed: int, actions: Array | Actions, feedback: tuple[Array, Array] | None = None,
) -> PlanRun:  # fmt: skip
    """Simulate an episode; feedback: states (K + 1, n), gains (K, width, n) on the miss."""
    env.reset(seed=seed)
    base = _get_base(env)
    applied = np.array(actions, np.float32)
    states, cost, length = np.empty((len(actions) + 1, len(PlanState._fields))), 0.0, 0
    states[0] = read_plan_state(base.packed_state)
    for k in range(len(applied)):
        if feedback is not None:
            planned, gains = feedback
            applied[k] = np.clip(actions[k] - gains[k] @ (states[k] - planned[k]), -1.0, 1.0)
        _, reward, terminated, truncated, _ = env.step(applied[k])
        cost, length = cost - float(reward), k + 1
        states[length] = read_plan_state(base.packed_state)
        if terminated or truncated:
            break
    states[length:] = states[length]
    return PlanRun(states, applied.astype(np.float64), cost, length)


def _solve_ilqr(env: CarEnv, seed: int, start: npt.ArrayLike | None = None) -> tuple[PlanRun, str]:
    """Return the best run of the steps from a start: "settled", "stuck" at first, or "stopped"."""
    env.reset(seed=seed)
    forecast = make_forecast(_get_base(env))
    shape = (forecast.fixed.periods, forecast.fixed.width)
    actions = np.zeros(shape) if start is None else np.asarray(start, np.float64)
    if actions.shape != shape:
        raise ValueError(f"a plan of this episode has shape {shape}, got {actions.shape}")
    problem, best = make_problem(forecast.fixed), _simulate_run(env, seed, actions)
    damping, n_stalled, kind = _FIRST_DAMPING, 0, forecast.fixed.kind
    for iteration in range(MAX_ITERATIONS):
        if kind.has_driver or kind.has_errors:  # what answers to the newest run
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
    env: CarEnv, seed: int, problem: IlqrProblem, forecast: Forecast, run: PlanRun, damping: float,
) -> tuple[PlanRun, float]:  # fmt: skip
    """Return the first cheaper run, else the run itself, and the damping for the next step."""
    fixed, size = problem.fixed, len(problem.names)
    nominal_run = _use_achieved_inputs(problem, run)
    linearisation = linearise(problem, forecast.known, nominal_run)
    limits = _compute_limits(problem, forecast, nominal_run)
    inputs = np.zeros((fixed.periods, N_INPUTS))
    inputs[:, : fixed.width] = nominal_run.actions
    d, G = np.empty_like(inputs), np.empty((*inputs.shape, size))
    gains = np.zeros((fixed.periods, fixed.width, len(PlanState._fields)))
    while damping < _DAMPING_LIMITS[1]:
        _run_backward_pass(linearisation, limits, inputs, run.length, damping, d, G)
        gains[:, :, problem.state_indices] = -G[:, : fixed.width] / problem.scale
        for length in STEP_LENGTHS:
            candidate = nominal_run.actions + length * d[:, : fixed.width]
            trial = _simulate_run(env, seed, candidate, (nominal_run.states, gains))
            if trial.cost < run.cost:
                first, *_, last = STEP_LENGTHS
                factors = {first: 1.0 / _DAMPING_FACTOR, last: _DAMPING_FACTOR}
                return trial, max(damping * factors.get(length, 1.0), _DAMPING_LIMITS[0])
        damping *= _DAMPING_FACTOR
    return run, damping


def _use_achieved_inputs(problem: IlqrProblem, run: PlanRun) -> PlanRun:
    """Replace a run's inputs by what their rates achieved: the linearisation has no rate limit."""
    actions, fixed = run.actions.copy(), problem.fixed
    if fixed.task.torque_slew:
        actions[:, 0] = _compute_commanded_share(fixed, run.states[1:])
    if fixed.width == N_INPUTS:
        actions[:, 1] = PlanState(*run.states[1:].T).slewing / fixed.task.authority
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
    env: CarEnv, seed: int, starts: Mapping[str, npt.ArrayLike] | None = None
) -> ClairvoyantResult:
    """Compute the best of the plans from other methods' runs, and of those runs themselves."""
    start_time, base, env = time.process_time(), _get_base(env), _ManoeuvreEnv(env)
    env.reset(seed=seed)
    shape = (_count_periods(base), *(base.action_space.shape or ()))
    if env.lost:  # before an action has acted
        costs, seconds = {"none": env.lost}, time.process_time() - start_time
        return ClairvoyantResult(np.zeros(shape, np.float32), env.lost, "none", costs, {}, seconds)
    candidates: dict[str, Actions] = {"none": np.zeros(shape, np.float32)}
    candidates |= {name: np.asarray(run, np.float32) for name, run in (starts or {}).items()}
    costs = {name: _simulate_run(env, seed, run).cost for name, run in candidates.items()}
    plans = {name: _solve_ilqr(env, seed, candidates[name]) for name in starts or candidates}
    for name, (run, _) in plans.items():
        candidates[f"from {name}"] = run.actions.astype(np.float32)
        costs[f"from {name}"] = run.cost
    winner = min(costs, key=lambda label: costs[label])
    statuses = {name: status for name, (_, status) in plans.items()}
    best, seconds = (candidates[winner], costs[winner]), time.process_time() - start_time
    return ClairvoyantResult(*best, winner, costs, statuses, seconds)


def record_actions(env: CarEnv, agent: Any, seed: int) -> Actions:
    """Record actions after the lead-in (of full scale), shape (K, width), zeros after a failure."""
    base, (_, *steps) = _get_base(env), iterate_steps(env, agent, seed)
    actions = np.zeros((_count_periods(base), *(base.action_space.shape or ())), np.float32)
    for k, step in enumerate(steps[_count_lead_steps(base) :]):
        actions[k] = step.action
    return actions


def _get_base(env: CarEnv) -> "StabilityEnv":
    return cast("StabilityEnv", env.unwrapped)


def _count_periods(base: "StabilityEnv") -> int:
    """Count the control periods of the episode that was last reset, after the lead-in."""
    duration = base.get_state()["params"][P.task.duration]
    return -int(-duration // base.control_period) - _count_lead_steps(base)


def _count_lead_steps(base: "StabilityEnv") -> int:
    """Count the control periods of the lead-in of the episode that was last reset."""
    return int(base.get_state()["params"][P.task.lead_in]) // base.control_period
