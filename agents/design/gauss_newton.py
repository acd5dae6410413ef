"""Gauss-Newton on plans of `prediction`: slopes by differences, steps by trial, both in lanes."""

import math
from typing import Any, NamedTuple

import numpy as np

from ...envs.backend.arrays import lane_count
from ...envs.backend.decorators import jit
from .prediction import RESIDUALS, TERMINAL, roll_out
from .prediction_model import Model, Start

PLANS = 16  # that are tried at once
MOST_VARIABLES = PLANS - 1  # one is the plan itself
LIMIT = 2.0  # of a variable: from one limit of an input to the other
DIFFERENCE = 0.01  # of a variable, for slopes
LEAST_DAMPING = 1e-4  # Levenberg and Marquardt's, of the first of the steps that are tried
LENGTHS = (1.0, 0.3)  # each step is tried whole and in part


class Lanes(NamedTuple):
    """Plans side by side, and what came of them: a column for each."""

    plans: Any  # (variables, count)
    pokes: Any
    limits: Any
    residuals: Any
    first: Any  # (2, count), share of the moment and rad of steering


@jit
def lanes_of(variables: int, blocks: Any, count: int) -> Lanes:
    """So many columns, of zeros."""
    return Lanes(
        np.zeros((variables, count)),
        np.zeros((variables, count)),
        np.zeros((variables, count)),
        np.zeros((RESIDUALS * blocks.sum() + TERMINAL, count)),
        np.zeros((2, count)),
    )


@jit
def roll_all(model: Model, start: Start, K: Any, terminal: Any, blocks: Any, all: Lanes) -> None:
    """`roll_out` of any number of plans, as many at a time as there are lanes."""
    width, (variables, count) = lane_count(), all.plans.shape
    some = lanes_of(variables, blocks, width)
    for c in range(0, count, width):
        n = min(width, count - c)
        some.plans[:, :n], some.pokes[:, :n] = all.plans[:, c : c + n], all.pokes[:, c : c + n]
        roll_out(
            model, start, K, terminal, blocks,
            some.plans, some.pokes, some.residuals, some.limits, some.first,
        )  # fmt: skip
        all.residuals[:, c : c + n] = some.residuals[:, :n]
        all.limits[:, c : c + n], all.first[:, c : c + n] = some.limits[:, :n], some.first[:, :n]


@jit
def _costs(seen: Any, J: Any) -> None:
    """Fill J (count,) with the sums of the squared residuals."""
    J[:] = 0.0
    for r in range(len(seen)):
        for c in range(len(J)):
            J[c] += seen[r, c] * seen[r, c]


@jit
def _normal_equations(all: Lanes, A: Any, g: Any) -> None:
    """Fill A = J'J and g = J'r; column i + 1 pokes variable i of the plan in the first.

    A variable that is at a limit, and would be cheaper beyond it, is left where it is.
    """
    n, seen = len(g), all.residuals
    slope = np.empty(n)
    A[:], g[:] = 0.0, 0.0
    for r in range(len(seen)):
        for i in range(n):
            slope[i] = (seen[r, i + 1] - seen[r, 0]) / DIFFERENCE
        for i in range(n):
            g[i] += slope[i] * seen[r, 0]
            for j in range(n):
                A[i, j] += slope[i] * slope[j]
    for i in range(n):
        if all.limits[i, 0] * g[i] < 0.0:
            A[i, :], A[:, i], g[i] = 0.0, 0.0, 0.0


@jit
def damped_step(A: Any, g: Any, damping: float, L: Any, d: Any) -> None:
    """Fill d with the solution of (A + damping diag A) d = -g; zeros where there is none.

    A: positive semidefinite; a variable without an effect stays. L: (n, n) to work in.
    """
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
def _poke(plan: Any, all: Lanes) -> None:
    """Fill every column with the plan; a column pokes one variable, the first none."""
    for i in range(len(plan)):
        all.plans[i, :] = plan[i]
        all.pokes[i, i + 1] = DIFFERENCE


@jit
def _propose(plan: Any, A: Any, g: Any, plans: Any) -> None:
    """Fill plans with the plan, the regulator's own (zeros), and steps of growing damping."""
    n, damping = len(plan), LEAST_DAMPING
    L, d = np.empty((n, n)), np.empty(n)
    plans[:, 0], plans[:, 1] = plan, 0.0
    for c in range(2, plans.shape[1], len(LENGTHS)):
        damped_step(A, g, damping, L, d)
        damping *= 10.0
        for k in range(len(LENGTHS)):
            for i in range(n):
                plans[i, c + k] = min(max(plan[i] + LENGTHS[k] * d[i], -LIMIT), LIMIT)


@jit
def improved(
    model: Model, start: Start, K: Any, terminal: Any, blocks: Any, plan: Any, iterations: int
) -> Any:
    """(J, share, rad of added steering): the cost of the improved plan and its first commands.

    plan: (variables,), improved in place: never dearer, as predicted, than it was or than zeros.
    J is not finite where no plan was; then the plan is as it was.
    """
    n = len(plan)
    all, A, g, J = lanes_of(n, blocks, PLANS), np.empty((n, n)), np.empty(n), np.empty(PLANS)
    least, share, wheel = math.inf, 0.0, 0.0
    for _ in range(iterations):
        _poke(plan, all)
        roll_all(model, start, K, terminal, blocks, all)
        _normal_equations(all, A, g)
        _propose(plan, A, g, all.plans)
        all.pokes[:] = 0.0
        roll_all(model, start, K, terminal, blocks, all)
        _costs(all.residuals, J)
        best, least = 0, math.inf
        for c in range(PLANS):
            if J[c] < least:
                best, least = c, J[c]
        if least < math.inf:
            plan[:] = all.plans[:, best]
            share, wheel = all.first[0, best], all.first[1, best]
    return least, share, wheel
