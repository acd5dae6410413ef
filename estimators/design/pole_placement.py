"""Gains by pole placement: the observers that the papers compare with."""

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import place_poles

Array = npt.NDArray[np.float64]


def whole(f: Any, G: Array) -> Array:
    """F (n, n): G on the dense states, the others decay."""
    n, dense = int(f.n), len(G)
    F = np.zeros((n, n))
    F[:dense] = G
    F[range(dense, n), range(dense, n)] = f.decay[dense:n]
    return F


def observer_gain(F: Array, C: Array, poles: Array) -> Array:
    """K (n, p) that gives (I - K C) F the poles (n,) of the z-plane.

    Raises ValueError where that is impossible: not observable, or more equal poles than outputs.
    """
    try:
        K: Array = place_poles(F.T, (C @ F).T, poles).gain_matrix.T
    except ValueError as error:
        raise ValueError(f"the poles {np.round(poles, 6)} cannot be placed: {error}") from None
    reached = np.linalg.eigvals((np.eye(len(F)) - K @ C) @ F)
    if np.abs(np.sort_complex(reached) - np.sort_complex(poles)).max() > 1e-6:
        raise ValueError(f"the poles {np.round(poles, 6)} cannot be placed: not observable")
    return K


def place(f: Any, G: Array, poles: tuple[float, ...], table: Array) -> None:
    """Write the gains of the fast rows and the error's covariance into a table of gains.

    poles: (n,) in rad/s, negative real. Raises ValueError as `observer_gain`.
    """
    n, m = int(f.n), int(f.fasts)
    if len(poles) != n:
        raise ValueError(f"{n} states need {n} poles, got {len(poles)}")
    F, C = whole(f, G), f.y_row[:m, :n]
    K = observer_gain(F, C, np.exp(np.array(poles) * float(f.step)))
    rest = np.eye(n) - K @ C
    noise = rest @ f.Q[:n, :n] @ rest.T + K @ np.diag(f.r_fast[:m]) @ K.T
    P = solve_discrete_lyapunov(rest @ F, noise)
    table[1 : 1 + m, :n] = K.T
    table[1, int(f.total) :] = P[np.triu_indices(n)]
