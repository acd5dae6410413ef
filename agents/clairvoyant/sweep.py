"""The backward pass of differential dynamic programming within limits of the inputs.

Source: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA 2014.
"""

import math
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit


@jit
def solve_input_qp(Q: Any, q: Any, low: Any, high: Any) -> Any:
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
    slopes: Any, limits: Any, inputs: Any, length: int, damping: float, d: Any, G: Any
) -> None:
    """Run the backward pass over a run's linearisation.

    Where the steering's rate is at its limit, its gain follows the state that it came from.

    Args:
        slopes: `Linearisation` of the run.
        limits: `Limits` of the run.
        inputs: Inputs of the run, shape (K, 2).
        length: Periods of the run; later ones get zeros.
        damping: Number added to the inputs' curvature.
        d: Changes of the inputs, shape (K, 2), filled.
        G: Gains on the state, shape (K, 2, size), filled.
    """
    size = slopes.F.shape[1]
    V, v = slopes.H[length][:size, :size].copy(), slopes.g[length][:size].copy()
    d[:], G[:] = 0.0, 0.0
    low, high = np.empty(2), np.empty(2)
    for k in range(length - 1, -1, -1):
        F = slopes.F[k]
        q, Q = slopes.g[k] + F.T @ v, slopes.H[k] + F.T @ (V @ F)
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
