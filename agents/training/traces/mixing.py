"""Inputs without correlation."""

from typing import Any

import numpy as np

from ....estimators.learned.memory import Array

SAMPLE_STRIDE = 7  # steps, of those by which means are mixed
MIN_VARIANCE = 1e-4  # variance that a mixture of means has at least


def compute_scale(spread: Any, minimum: float = 1e-9) -> Array:
    """One over each standard deviation, zero of what does not vary."""
    return np.where(spread > minimum, 1.0 / np.maximum(spread, minimum), 0.0)


def compute_whitening(z: Any, minimum: float) -> Array:
    """(k, k) what makes the covariance of z (n, k) one; a smaller eigenvalue counts as
    `minimum`."""
    sizes, axes = np.linalg.eigh(np.cov(z, rowvar=False))
    return np.asarray(axes / np.sqrt(np.maximum(sizes, minimum)) @ axes.T)
