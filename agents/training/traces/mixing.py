"""Inputs without correlation."""

from typing import Any

import numpy as np

from ....estimators.learned.memory import Array

APART = 7  # steps, of those by which means are mixed
SMALL = 1e-4  # variance that a mixture of means has at least


def scale_of(spread: Any, least: float = 1e-9) -> Array:
    """One over each standard deviation, zero of what does not vary."""
    return np.where(spread > least, 1.0 / np.maximum(spread, least), 0.0)


def whitening(z: Any, least: float) -> Array:
    """(k, k) what makes the covariance of z (n, k) one; a smaller eigenvalue counts as `least`."""
    sizes, axes = np.linalg.eigh(np.cov(z, rowvar=False))
    return np.asarray(axes / np.sqrt(np.maximum(sizes, least)) @ axes.T)
