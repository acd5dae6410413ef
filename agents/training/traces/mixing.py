"""Whitening: inputs without correlation."""

from typing import Any

import numpy as np

from ....envs.record import Array

SAMPLE_STRIDE = 7  # steps, of those by which means are mixed
MIN_VARIANCE = 1e-4  # variance that a mixture of means has at least


def compute_scale(spread: Any, minimum: float = 1e-9) -> Array:
    """Compute the inverse of each standard deviation, zero where nothing varies.

    Args:
        spread: Standard deviations, shape (k,).
        minimum: Deviation below which an input counts as constant.

    Returns:
        Factors, shape (k,).
    """
    return np.where(spread > minimum, 1.0 / np.maximum(spread, minimum), 0.0)


def compute_whitening(z: Any, minimum: float) -> Array:
    """Compute the symmetric matrix that makes a covariance one, shape (k, k).

    Args:
        z: Samples, shape (n, k).
        minimum: Least eigenvalue of the covariance.

    Returns:
        The matrix.
    """
    sizes, axes = np.linalg.eigh(np.cov(z, rowvar=False))
    return np.asarray(axes / np.sqrt(np.maximum(sizes, minimum)) @ axes.T)
