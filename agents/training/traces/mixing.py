"""Inputs without correlation."""

from typing import Any

import numpy as np

from ....estimators.learned.memory import Array


def whitening(z: Any, least: float) -> Array:
    """(k, k) what makes the covariance of z (n, k) one; a smaller eigenvalue counts as `least`."""
    sizes, axes = np.linalg.eigh(np.cov(z, rowvar=False))
    return np.asarray(axes / np.sqrt(np.maximum(sizes, least)) @ axes.T)
