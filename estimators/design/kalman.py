"""The Kalman filter in textbook letters: what the designs, the Riccati limit and the tests use.

Shapes: x (n,), P (n, n), F (n, n), Q (n, n), C (p, n), R (p, p), y (p,).
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def predict(x: Array, P: Array, F: Array, Q: Array) -> tuple[Array, Array]:
    """Mean and covariance one step on; inputs are added to the mean by the caller."""
    return F @ x, F @ P @ F.T + Q


def gain(P: Array, C: Array, R: Array) -> Array:
    """K = P C^T (C P C^T + R)^-1, (n, p).

    With R = 0 it is a generalised inverse of C: the Moore-Penrose one for P = I, the P-weighted
    one for a covariance P; with P = I, R = lambda I it is Tikhonov's.
    """
    PC = P @ C.T
    return np.asarray(np.linalg.solve((C @ PC + R).T, PC.T).T, np.float64)


def update(x: Array, P: Array, C: Array, R: Array, y: Array) -> tuple[Array, Array]:
    """Mean and covariance given y = C x + v.

    The covariance takes Joseph's form: a sum of two squares stays symmetric and positive
    semidefinite under rounding, and it holds for every gain, not only the optimal one.
    """
    K = gain(P, C, R)
    return x + K @ (y - C @ x), joseph(P, K, C, R)


def joseph(P: Array, K: Array, C: Array, R: Array) -> Array:
    """Covariance after a correction by any gain K: (I - K C) P (I - K C)^T + K R K^T."""
    rest = np.eye(len(P)) - K @ C
    after: Array = rest @ P @ rest.T + K @ R @ K.T
    return after
