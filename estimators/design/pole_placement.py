"""Gains by pole placement: the observers that the papers compare with."""

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from ...envs.record import Array
from ..core.memory import FilterRecord


def transition_matrix(f: FilterRecord, G: Array) -> Array:
    """Compute F of a step: G on the dense states, the others decay.

    Args:
        f: Memory of the filter.
        G: Transition of the dense states, shape (dense, n).

    Returns:
        Transition matrix, shape (n, n).
    """
    n, dense = int(f.n), len(G)
    F = np.zeros((n, n))
    F[:dense] = G
    F[range(dense, n), range(dense, n)] = f.decay[dense:n]
    return F


def observer_gain(F: Array, C: Array, poles: Array) -> Array:
    """Compute the gain K that gives (I - K C) F its poles.

    Args:
        F: Transition matrix, shape (n, n).
        C: Measurement matrix, shape (p, n).
        poles: Poles in the z-plane, shape (n,).

    Returns:
        Gain, shape (n, p).

    Raises:
        ValueError: It is not observable, or more poles are equal than there are outputs.
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

    Errors are those of `observer_gain`.

    Args:
        f: Memory of the filter.
        G: Transition of the dense states, shape (dense, n).
        poles: Poles (rad/s), negative real, n of them.
        table: Output, shape (rows, columns), see `periodic`.
    """
    n, m = int(f.n), int(f.fasts)
    F, C = transition_matrix(f, G), f.C_fast[:m, :n]
    K = observer_gain(F, C, np.exp(np.array(poles) * float(f.step)))
    rest = np.eye(n) - K @ C
    noise = rest @ f.Q[:n, :n] @ rest.T + K @ np.diag(f.r_fast[:m]) @ K.T
    P = solve_discrete_lyapunov(rest @ F, noise)
    table[1 : 1 + m, :n] = K.T
    table[1, int(f.total) :] = P[np.triu_indices(n)]
