"""The quadratic program of a linear predictive controller, states eliminated."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from ...envs.record import Array
from .sampled_model import DesignModel, compute_cost_to_go


@dataclass(frozen=True)
class QuadraticProgram:
    """Minimise a'P a / 2 + (F x)'a over the inputs a (h m,) of h steps from the state x (n,).

    Inputs stand step by step, as fractions of their limits. The cost is scaled so that the mean of
    P's diagonal is 1.

    Attributes:
        P: Hessian, shape (h m, h m).
        F: Effect of the state on the gradient, shape (h m, n).
        A: Constrained combinations, shape (rows, h m): the inputs themselves, then, where the car
            steers, the change of the steering fraction in each step.
    """

    P: Array
    F: Array
    A: Array


def condense_qp(model: DesignModel, horizon: int, limits: Array) -> QuadraticProgram:
    """Condense a model's steps into a program, with the regulator's cost to go at its end.

    Args:
        model: Design model.
        horizon: Number of steps.
        limits: Inputs at a fraction of 1, shape (m,).

    Returns:
        Program in the inputs over `limits`.
    """
    n, m = model.H.shape
    Sx, Su = np.zeros(((horizon + 1) * n, n)), np.zeros(((horizon + 1) * n, horizon * m))
    Sx[:n] = np.eye(n)
    for i in range(horizon):  # x = Sx x_0 + Su u, row by row of steps
        rows, next_rows = slice(i * n, (i + 1) * n), slice((i + 1) * n, (i + 2) * n)
        Sx[next_rows], Su[next_rows] = model.G @ Sx[rows], model.G @ Su[rows]
        Su[next_rows, i * m : (i + 1) * m] += model.H
    Q = block_diag(*[model.Q] * horizon, compute_cost_to_go(model)[1])
    R = block_diag(*[model.R] * horizon)
    N = np.vstack([block_diag(*[model.N] * horizon), np.zeros((n, horizon * m))])
    scale = np.tile(limits, horizon)
    P = scale[:, None] * (Su.T @ Q @ Su + Su.T @ N + N.T @ Su + R) * scale
    F = scale[:, None] * ((Su.T @ Q + N.T) @ Sx)
    size = float(np.diag(P).mean())
    A = np.eye(horizon * m)
    if m > 1:
        changes = np.eye(horizon) - np.eye(horizon, k=-1)
        A = np.vstack([A, np.kron(changes, [[0.0, 1.0]])])
    return QuadraticProgram(0.5 * (P + P.T) / size, F / size, A)
