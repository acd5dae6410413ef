"""The Kalman filter in textbook letters, and the generalised inverses that pseudo-residuals need.

Shapes: P (n, n), C (p, n), R (p, p), y = C x + v (p,).
"""

import numpy as np

from ...envs.record import Array

RIDGE = 1e-3  # lambda of Tikhonov's inverse, in SI units squared
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
    after: Array = rest @ P @ rest.T + K @ R @ K.T
    return after


def compute_inverse(kind: str, C: Array, P: Array, R: Array) -> Array:
    """Compute the generalised inverse of C that tie-vision (20) needs.

    C has full row rank only, so C^T C of the printed (20) is singular; the Moore-Penrose inverse is
    C^T (C C^T)^-1. "bayes" is the mean of the error given the residual, P C^T (C P C^T + R)^-1: for
    an optimal gain it leaves nothing to correct between the samples.

    Args:
        kind: Name of `INVERSES`; "p-weighted" weighs by P, "tikhonov" is regularised by `RIDGE`.
        C: Measurement matrix, shape (p, n).
        P: Covariance of the state, shape (n, n).
        R: Covariance of the measurement noise, shape (p, p).

    Returns:
        Inverse, shape (n, p).
    """
    I, zero = np.eye(C.shape[1]), np.zeros((len(C), len(C)))  # noqa: E741
    if kind == "moore-penrose":
        return kalman_gain(I, C, zero)
    if kind == "p-weighted":
        return kalman_gain(P, C, zero)
    if kind == "bayes":
        return kalman_gain(P, C, R)
    return kalman_gain(I, C, RIDGE * np.eye(len(C)))


def constant_gain(K_fast: Array, K_slow: Array, steps: int) -> Array:
    """Compute one gain for every tick from the multirate filter's gains over a period.

    Every tick of the frame corrects by a pseudo-residual, so each takes its even fraction of the
    gain that the multirate filter applies at once.

    Args:
        K_fast: Gains of the fast rows, shape (steps, m, N).
        K_slow: Joint gain of the slow rows at a sample, shape (p, N).
        steps: Number of ticks between two samples.

    Returns:
        Gain, shape (N, m + p).
    """
    return np.column_stack([K_fast.mean(0).T, K_slow.T / steps])
