"""Vectors and matrices from the user: shape, finiteness, and covariances that are some."""

import numpy as np
import numpy.typing as npt

from ..envs.record import Array


def parse_matrix(name: str, value: npt.ArrayLike) -> Array:
    """Parse a finite matrix.

    Args:
        name: Name for messages.
        value: Numbers of shape (k, m).

    Returns:
        Matrix, shape (k, m).

    Raises:
        ValueError: It is no finite matrix.
    """
    M = np.array(value, np.float64)
    if M.ndim != 2 or not M.size or not np.isfinite(M).all():
        raise ValueError(f"{name} is a finite matrix, got {value!r}")
    return M


def parse_vector(name: str, value: npt.ArrayLike, n: int) -> Array:
    """Parse a finite vector.

    Args:
        name: Name for messages.
        value: Numbers of shape (n,), or a number that stands for n equal ones.
        n: Number of elements.

    Returns:
        Vector, shape (n,).

    Raises:
        ValueError: It is not finite or has another shape.
    """
    v = np.array(value, np.float64)
    v = np.full(n, v) if v.ndim == 0 else v
    if v.shape != (n,) or not np.isfinite(v).all():
        raise ValueError(f"{name} is finite and has shape ({n},), got {value!r}")
    return v


def parse_square(name: str, value: npt.ArrayLike, n: int) -> Array:
    """Parse a finite square matrix.

    Args:
        name: Name for messages.
        value: Numbers of shape (n, n), a diagonal (n,) or one number for the diagonal.
        n: Number of rows.

    Returns:
        Matrix, shape (n, n).

    Raises:
        ValueError: It is not finite or has another shape.
    """
    M = np.array(value, np.float64)
    M = np.diag(parse_vector(name, M, n)) if M.ndim < 2 else M
    if M.shape != (n, n) or not np.isfinite(M).all():
        raise ValueError(f"{name} is finite and has shape ({n}, {n}) or ({n},), got {value!r}")
    return M


def check_covariance(name: str, M: Array, definite: bool = False) -> None:
    """Check that a matrix is a covariance.

    Args:
        name: Name for messages.
        M: Matrix, shape (n, n).
        definite: Whether it must be positive definite.

    Raises:
        ValueError: It is not finite, symmetric and positive semidefinite (or definite).
    """
    if not np.isfinite(M).all():
        raise ValueError(f"{name} is not finite")
    if not np.allclose(M, M.T, rtol=1e-9, atol=0.0):
        raise ValueError(f"{name} is not symmetric")
    min_eigenvalue = np.linalg.eigvalsh(M).min(initial=np.inf)
    if min_eigenvalue < -1e-12 * np.abs(M).max(initial=1e-300):
        raise ValueError(f"{name} is indefinite: its least eigenvalue is {min_eigenvalue:.3g}")
    if definite and not min_eigenvalue > 0.0:
        raise ValueError(
            f"{name} must be positive definite: its least eigenvalue is {min_eigenvalue:.3g}"
        )


def parse_covariance(name: str, value: npt.ArrayLike, n: int, definite: bool = False) -> Array:
    """Parse a covariance; errors as in `parse_square` and `check_covariance`.

    Args:
        name: Name for messages.
        value: Numbers of shape (n, n), a diagonal (n,) or one number for the diagonal.
        n: Number of rows.
        definite: Whether it must be positive definite.

    Returns:
        Covariance, shape (n, n).
    """
    M = parse_square(name, value, n)
    check_covariance(name, M, definite)
    return M
