"""Linearisation of an episode along a run, and the backward pass within limits of the inputs.

Source: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA 2014.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ...envs.numerics.jit import as_python, jit
from ...envs.numerics.primitives import ARRAYS, Matrix, Vector
from ...envs.record import Array
from ...envs.vehicle.actuators import limit_angle
from .plant import (
    advance,
    compute_node_cost,
    compute_node_errors,
    get_state_scales,
    list_active_states,
)
from .preview import Forecast, PlanParams, PlanState, PreviewStep

N_INPUTS = 2  # in a sweep: fractions of moment and added steering; the latter is 0 if unused


@dataclass(frozen=True)
class Trajectory:
    """A run of an episode."""

    states: Array  # `PlanState` at the start of every period and at the end, shape (K + 1, n)
    actions: Array  # fractions of full scale, shape (K, width)


class Linearisation(NamedTuple):
    """The derivatives along a run by n = size + N_INPUTS variables: scaled states, then inputs."""

    F: Array  # derivative of the state after each period, shape (K, size, n)
    g: Array  # gradient of the cost, shape (K + 1, n); the last one is of the episode's end
    H: Array  # Gauss-Newton's Hessian of the cost, shape (K + 1, n, n), likewise


class Limits(NamedTuple):
    """The limits of the inputs in every period."""

    low: Array  # lower limits, shape (K, N_INPUTS)
    high: Array  # upper limits, shape (K, N_INPUTS)
    rate_low: Array  # lower limit of the steering by its rate, shape (K,)
    rate_high: Array  # upper limit of the steering by its rate, shape (K,)
    column: int  # scaled state that moves the rate's limits: the last command of added steering
    slope: float  # rise of both rate limits per unit of the scaled state `column`


@dataclass(frozen=True)
class IlqrProblem:
    """The functions that all episodes with the same `PlanParams` share."""

    fixed: PlanParams
    names: tuple[str, ...]  # of the active states
    scale: Array  # unit of each active state, shape (size,)
    differentiate: Any  # CasADi's function of the derivatives, for all nodes at once

    @property
    def state_indices(self) -> list[int]:
        """Indices of the active states in a `PlanState`."""
        return [PlanState._fields.index(name) for name in self.names]


@functools.lru_cache(maxsize=8)
def make_problem(fixed: PlanParams) -> IlqrProblem:
    """Make the functions, cached for the newest few kinds of episode.

    Args:
        fixed: Parameters of the episode.

    Returns:
        Functions of the episode.
    """
    names = list_active_states(fixed)
    scale, size = np.array(get_state_scales(fixed, names)), len(names)
    w, known = ca.SX.sym("w", size + fixed.width), ca.SX.sym("known", len(PreviewStep._fields))
    zero = PlanState(*(0.0,) * len(PlanState._fields))
    x = zero._replace(**{name: scale[i] * w[i] for i, name in enumerate(names)})
    step_inputs = PreviewStep(*ca.vertsplit(known))
    step = advance(fixed, x, ca.vertsplit(w[size:]), step_inputs)
    next_state = ca.vertcat(*(getattr(step.state, name) for name in names)) / scale
    e, errors = ca.SX.sym("e", 2), ca.vertcat(*compute_node_errors(fixed, x, step_inputs))
    node_cost = compute_node_cost(fixed, (e[0], e[1]), step_inputs)
    error_hessian, error_gradient = ca.hessian(node_cost, e)
    error_jacobian = ca.jacobian(errors, w)
    # the effort is a sum of squares of nearly linear terms
    effort_hessian, effort_gradient = ca.hessian(step.effort, w)
    gradient = error_jacobian.T @ ca.substitute(error_gradient, e, errors) + effort_gradient
    hessian = error_jacobian.T @ error_hessian @ error_jacobian + effort_hessian
    derivatives = [ca.jacobian(next_state, w), gradient, hessian]
    node = ca.Function("node", [w, known], derivatives, {"cse": True})
    return IlqrProblem(fixed, names, scale, node.map(fixed.periods + 1))


def linearise_run(problem: IlqrProblem, known: Array, run: Trajectory) -> Linearisation:
    """Linearise every period of a run; an input that the action lacks has a unit Hessian alone.

    Args:
        problem: Functions of the episode.
        known: Columns of `PreviewStep`, shape (len(PreviewStep), K + 1).
        run: States and actions.

    Returns:
        Derivatives along the run, in scaled states and fractions of full scale.
    """
    size, K, width = len(problem.names), problem.fixed.periods, problem.fixed.width
    points = np.zeros((size + width, K + 1))
    points[:size] = (run.states[:, problem.state_indices] / problem.scale).T
    points[size:, :K] = run.actions.T
    n_used, n = size + width, size + N_INPUTS
    F, g, H = (np.nan_to_num(value.full()) for value in problem.differentiate(points, known))
    identities = np.tile(np.eye(n), (K + 1, 1, 1))
    result = Linearisation(np.zeros((K, size, n)), np.zeros((K + 1, n)), identities)
    result.F[:, :, :n_used] = F.reshape(size, K + 1, n_used).transpose(1, 0, 2)[:K]
    result.g[:, :n_used] = g.T
    result.H[:, :n_used, :n_used] = H.reshape(n_used, K + 1, n_used).transpose(1, 0, 2)
    return result


def compute_limits(problem: IlqrProblem, forecast: Forecast, run: Trajectory) -> Limits:
    """Compute limits by full scale, the wheels' stop, and the steering's rate from a run's angle.

    Args:
        problem: Functions of the episode.
        forecast: Forecast with the driver's command.
        run: States and actions.

    Returns:
        Limits in fractions of full scale, shape (K, `N_INPUTS`), and those by the rate, (K,).
    """
    fixed, K = problem.fixed, problem.fixed.periods
    low, high, zero = np.zeros((K, N_INPUTS)), np.zeros((K, N_INPUTS)), np.zeros(K)
    low[:, : fixed.width], high[:, : fixed.width] = -1.0, 1.0
    if fixed.width < N_INPUTS:
        return Limits(low, high, zero, zero, 0, 0.0)
    task, column = fixed.task, problem.names.index("slewing")
    clip_angle = as_python(limit_angle, ARRAYS)
    low[:, 1] = clip_angle(-task.authority, forecast.driver, task.stop).max(axis=1) / task.authority
    high[:, 1] = clip_angle(task.authority, forecast.driver, task.stop).min(axis=1) / task.authority
    position = run.states[:K, PlanState._fields.index("slewing")] / task.authority
    max_change = task.slew * fixed.ticks / task.authority
    slope = problem.scale[column] / task.authority
    return Limits(low, high, position - max_change, position + max_change, column, slope)


@jit
def solve_input_qp(Q: Matrix, q: Vector, low: Vector, high: Vector) -> Any:
    """Minimise q'd + d'Qd / 2 with low <= d <= high.

    Args:
        Q: Positive definite matrix, shape (2, 2).
        q: Gradient, shape (2,).
        low: Lower limits, shape (2,).
        high: Upper limits, shape (2,).

    Returns:
        d_0, d_1, and whether each is free of its limits.
    """
    det = Q[0, 0] * Q[1, 1] - Q[0, 1] * Q[0, 1]
    x = (Q[0, 1] * q[1] - Q[1, 1] * q[0]) / det
    y = (Q[0, 1] * q[0] - Q[0, 0] * q[1]) / det
    if low[0] < x < high[0] and low[1] < y < high[1]:
        return x, y, True, True
    min_cost, best, free = math.inf, np.zeros(2), np.zeros(2, np.bool_)
    d = np.zeros(2)
    for i in range(2):
        for side in range(2):
            other = 1 - i
            d[i] = high[i] if side else low[i]
            interior = -(q[other] + Q[0, 1] * d[i]) / Q[other, other]
            d[other] = min(max(interior, low[other]), high[other])
            cost = q @ d + 0.5 * (d @ (Q @ d))
            if cost < min_cost:
                min_cost = cost
                best[:], free[:] = d, False
                free[other] = d[other] == interior
    return best[0], best[1], free[0], free[1]


@jit
def run_backward_pass(
    linearisation: Linearisation,
    limits: Limits,
    inputs: Matrix,
    length: int,
    damping: float,
    d: Matrix,
    G: Matrix,
) -> None:
    """Run the backward pass over a run's linearisation.

    An input u of the run becomes u + d + G dx, with dx the scaled state less the run's;
    G = -Quu^-1 Qux where both inputs are free. Where the rate limits the steering, the limit moves
    with the last command: so does the gain.

    Args:
        linearisation: `Linearisation` of the run.
        limits: `Limits` of the run.
        inputs: Inputs of the run, shape (K, 2).
        length: Periods of the run; later ones get zeros.
        damping: Number added to the diagonal of Quu, the Hessian in the inputs.
        d: Changes of the inputs, shape (K, 2), filled.
        G: Gains on the state, shape (K, 2, size), filled.
    """
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
        d[k, 0], d[k, 1], free_0, free_1 = solve_input_qp(damped, q[size:], low, high)
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
