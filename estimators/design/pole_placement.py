"""Gains by pole placement: the observers that the papers compare with."""

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from ..core.memory import FilterRecord
from .kalman import Array


def transition_matrix(f: FilterRecord, G: Array) -> Array:
    """F (n, n) of a step: G (dense, n) on the dense states, the others decay."""
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
        from scipy.signal import place_poles  # slow to load

        K: Array = place_poles(F.T, (C @ F).T, poles).gain_matrix.T
    except ValueError as error:
        raise ValueError(f"the poles {np.round(poles, 6)} cannot be placed: {error}") from None
    placed = np.linalg.eigvals((np.eye(len(F)) - K @ C) @ F)
    if np.abs(np.sort_complex(placed) - np.sort_complex(poles)).max() > 1e-6:
        raise ValueError(f"the poles {np.round(poles, 6)} cannot be placed: not observable")
    return K


def write_placed_gains(f: FilterRecord, G: Array, poles: tuple[float, ...], table: Array) -> None:
    """Write the gains of the fast rows and the error's covariance into a table of gains.

    G: (dense, n). poles: (n,) in rad/s, negative real. table: (rows, columns), as in `periodic`.
    Raises ValueError as `observer_gain`.
    """
    n, m = int(f.n), int(f.fasts)
    F, C = transition_matrix(f, G), f.C_fast[:m, :n]
    K = observer_gain(F, C, np.exp(np.array(poles) * float(f.step)))
    rest = np.eye(n) - K @ C
    noise = rest @ f.Q[:n, :n] @ rest.T + K @ np.diag(f.r_fast[:m]) @ K.T
    P = solve_discrete_lyapunov(rest @ F, noise)
    table[1 : 1 + m, :n] = K.T
    table[1, int(f.total) :] = P[np.triu_indices(n)]
