"""Gauss-Newton on plans of `prediction`: gradients by differences, steps by trial, in lanes."""

import math

import numpy as np

from ...envs.numerics.jit import jit
from ...envs.numerics.packed import count_lanes
from ...envs.numerics.primitives import Matrix, Scalar, Vector
from .prediction import N_RESIDUALS, N_TERMINAL, PlanBatch, PredictionTask, simulate_plans

# A variable of a plan is a fraction of the full yaw moment or of the steering's authority, which is
# added to the regulator's action.
_N_CANDIDATES = 16  # plans tried at once: the old one, zeros, and steps of seven dampings, two each
MAX_VARIABLES = _N_CANDIDATES - 1  # of a plan: its batch of perturbed plans begins with itself
LIMIT = 2.0  # of a variable's magnitude: from one limit of an input to the other
_DIFFERENCE = 0.01  # perturbation of a variable, for finite differences
_MIN_DAMPING = 1e-4  # Levenberg and Marquardt's, of the first candidate; later ones: tenfold each
_STEP_LENGTHS = (1.0, 0.3)  # each step is tried whole and in part


@jit
def _make_plan_batch(task: PredictionTask, variables: int, count: int) -> PlanBatch:
    """Make a batch of so many plans of zeros, with one column for each."""
    n_terminal = len(task.terminal)
    n_step = N_RESIDUALS + n_terminal - N_TERMINAL
    shape, n_residuals = (variables, count), n_step * task.blocks.sum() + n_terminal
    plans, perturbations, limits = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    residuals, first = np.zeros((n_residuals, count)), np.zeros((2, count))
    return PlanBatch(plans, perturbations, limits, residuals, first)


@jit
def _simulate_batch(task: PredictionTask, batch: PlanBatch) -> None:
    """Simulate any number of plans, as many at a time as there are lanes."""
    width, (variables, count) = count_lanes(), batch.plans.shape
    chunk = _make_plan_batch(task, variables, width)
    for c in range(0, count, width):
        n = min(width, count - c)
        chunk.plans[:, :n] = batch.plans[:, c : c + n]
        chunk.perturbations[:, :n] = batch.perturbations[:, c : c + n]
        simulate_plans(task, chunk)
        batch.residuals[:, c : c + n] = chunk.residuals[:, :n]
        batch.limits[:, c : c + n] = chunk.limits[:, :n]
        batch.first[:, c : c + n] = chunk.first[:, :n]


@jit
def _compute_normal_equations(batch: PlanBatch, A: Matrix, g: Vector) -> None:
    """Fill A = D'D and g = D'r, D the Jacobian of the residuals r by forward differences."""
    # column 0 of the batch is the plan itself; in column i + 1 its variable i is perturbed
    n, residuals = len(g), batch.residuals
    slope = np.empty(n)  # a row of D
    A[:], g[:] = 0.0, 0.0
    for r in range(len(residuals)):
        for i in range(n):
            slope[i] = (residuals[r, i + 1] - residuals[r, 0]) / _DIFFERENCE
        for i in range(n):
            g[i] += slope[i] * residuals[r, 0]
            for j in range(n):
                A[i, j] += slope[i] * slope[j]
    for i in range(n):  # a variable at a limit, cheaper beyond it, does not move
        if batch.limits[i, 0] * g[i] < 0.0:
            A[i, :], A[:, i], g[i] = 0.0, 0.0, 0.0


@jit
def _solve_damped_step(A: Matrix, g: Vector, damping: float, L: Matrix, d: Vector) -> None:
    """Solve (A + damping diag A + 1e-9 I) d = -g by Cholesky's factors; zero where they fail."""
    # a variable without an effect does not move; L (n, n) is scratch for the lower factor
    n = len(g)
    d[:] = 0.0
    for i in range(n):
        for j in range(i + 1):
            value = A[i, j] * (1.0 + damping) + 1e-9 if i == j else A[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = value / L[j, j]
            elif value > 0.0:
                L[i, i] = math.sqrt(value)
            else:
                return
    for i in range(n):
        value = -g[i]
        for k in range(i):
            value -= L[i, k] * d[k]
        d[i] = value / L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            d[i] -= L[k, i] * d[k]
        d[i] /= L[i, i]


@jit
def _fill_candidates(plan: Vector, A: Matrix, g: Vector, plans: Matrix) -> None:
    """Fill plans with the plan, the regulator's own (zeros), and steps of growing damping."""
    n, damping = len(plan), _MIN_DAMPING
    L, d = np.empty((n, n)), np.empty(n)
    plans[:, 0], plans[:, 1] = plan, 0.0
    for c in range(2, plans.shape[1], len(_STEP_LENGTHS)):
        _solve_damped_step(A, g, damping, L, d)
        damping *= 10.0
        for k in range(len(_STEP_LENGTHS)):
            for i in range(n):
                plans[i, c + k] = min(max(plan[i] + _STEP_LENGTHS[k] * d[i], -LIMIT), LIMIT)


@jit
def update_plan(task: PredictionTask, plan: Vector, iterations: int) -> tuple[Scalar, ...]:
    """Improve a plan, which is never costlier, as predicted, than it was or than zeros.

    Args:
        task: Model, start, regulator and blocks.
        plan: Plan, shape (variables,), improved in place.
        iterations: Number of iterations.

    Returns:
        Cost J of the improved plan, not finite where no plan's was and the plan is unchanged; its
        first yaw moment (fraction of full scale) and added steering (rad).
    """
    n = len(plan)
    batch = _make_plan_batch(task, n, _N_CANDIDATES)
    A, g, J = np.empty((n, n)), np.empty(n), np.empty(_N_CANDIDATES)
    min_cost, share, added_command = math.inf, 0.0, 0.0
    for _ in range(iterations):
        for i in range(n):  # a column perturbs one variable, the first none
            batch.plans[i, :] = plan[i]
            batch.perturbations[i, i + 1] = _DIFFERENCE
        _simulate_batch(task, batch)
        _compute_normal_equations(batch, A, g)
        _fill_candidates(plan, A, g, batch.plans)
        batch.perturbations[:] = 0.0
        _simulate_batch(task, batch)
        J[:] = 0.0
        for r in range(len(batch.residuals)):
            for c in range(len(J)):
                J[c] += batch.residuals[r, c] * batch.residuals[r, c]
        best, min_cost = 0, math.inf
        for c in range(_N_CANDIDATES):
            if J[c] < min_cost:
                best, min_cost = c, J[c]
        if min_cost < math.inf:
            plan[:] = batch.plans[:, best]
            share, added_command = batch.first[0, best], batch.first[1, best]
    return min_cost, share, added_command
