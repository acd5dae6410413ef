"""The Kalman filter in textbook letters, generalised inverses and gains by pole placement."""

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ..core.record import FilterRecord


def check_covariance(name: str, M: Array, definite: bool = False) -> None:
    """Check that a matrix is a covariance: finite, symmetric, semidefinite; else ValueError.

    Args:
        name: Name for messages.
        M: Matrix, shape (n, n).
        definite: Whether it must be positive definite.
    """
    if not np.isfinite(M).all():
        raise ValueError(f"{name} is not finite")
    if not np.allclose(M, M.T, rtol=1e-9, atol=0.0):
        raise ValueError(f"{name} is not symmetric")
    lowest = np.linalg.eigvalsh(M).min(initial=np.inf)
    if lowest < -1e-12 * np.abs(M).max(initial=1e-300):
        raise ValueError(f"{name} is indefinite: its least eigenvalue is {lowest:.3g}")
    if definite and not lowest > 0.0:
        raise ValueError(f"{name} must be positive definite: its least eigenvalue is {lowest:.3g}")


_RIDGE = 1e-3  # lambda of Tikhonov's inverse, in the square of a row's SI unit
Poles = Array | npt.NDArray[np.complex128]
INVERSES = ("moore-penrose", "p-weighted", "tikhonov", "bayes")


def kalman_gain(P: Array, C: Array, R: Array) -> Array:
    """Compute the Kalman gain K = P C^T (C P C^T + R)^-1.

    With R = 0 it is a generalised inverse of C: the Moore-Penrose one for P = I, the P-weighted
    one for a covariance P; with P = I, R = lambda I it is Tikhonov's.

    Args:
        P: Covariance of the state, shape (n, n).
        C: Measurement matrix, shape (p, n).
        R: Covariance of the measurement noise, shape (p, p).

    Returns:
        Gain, shape (n, p).
    """
    PC = P @ C.T
    return np.asarray(np.linalg.solve((C @ PC + R).T, PC.T).T, np.float64)


def joseph_form(P: Array, K: Array, C: Array, R: Array) -> Array:
    """Compute the covariance after a correction: (I - K C) P (I - K C)^T + K R K^T.

    A sum of two squares stays symmetric and positive semidefinite under rounding.

    Args:
        P: Covariance before it, shape (n, n).
        K: Any gain, shape (n, p).
        C: Measurement matrix, shape (p, n).
        R: Covariance of the measurement noise, shape (p, p).

    Returns:
        Covariance, shape (n, n).
    """
    rest = np.eye(len(P)) - K @ C
    return np.asarray(rest @ P @ rest.T + K @ R @ K.T)


def compute_inverse(kind: str, C: Array, P: Array, R: Array) -> Array:
    """Compute the generalised inverse of C that tie-vision (20) needs.

    C has full row rank only, so C^T C of the printed (20) is singular; the Moore-Penrose inverse is
    C^T (C C^T)^-1. "bayes" is the mean of the error given the residual, P C^T (C P C^T + R)^-1: for
    an optimal gain it leaves nothing to correct between the samples.

    Args:
        kind: Name of `INVERSES`; "p-weighted" weighs by P, "tikhonov" is regularised by `_RIDGE`.
        C: Measurement matrix, shape (p, n).
        P: Covariance of the state, shape (n, n).
        R: Covariance of the measurement noise, shape (p, p).

    Returns:
        Inverse, shape (n, p).
    """
    zero, ridge = np.zeros((len(C), len(C))), _RIDGE * np.eye(len(C))
    noises = {"moore-penrose": zero, "p-weighted": zero, "tikhonov": ridge, "bayes": R}
    return kalman_gain(P if kind in ("p-weighted", "bayes") else np.eye(len(P)), C, noises[kind])


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


def observer_gain(F: Array, C: Array, poles: Poles) -> Array:
    """Compute the gain K that gives (I - K C) F its poles.

    Args:
        F: Transition matrix, shape (n, n).
        C: Measurement matrix, shape (p, n).
        poles: Poles in the z-plane, shape (n,), no more equal ones than there are outputs.

    Returns:
        Gain, shape (n, p); ValueError where the poles cannot be placed.
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
