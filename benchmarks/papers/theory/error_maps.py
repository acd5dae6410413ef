"""Estimation errors between slow samples: maps from the error at the sample.

dual-rate's letters: X~_{k+i|k+i} after i steps of 1 / r of the sampling period, from the prediction
error X~_{k|k-1} at the sample, without noise.
"""

import numpy as np

from ....envs.record import Array
from ....estimators.design import dual_rate as dual_rate


def make_fast_maps(A: Array, C: Array, L: Array, r: int) -> list[Array]:
    """Maps to X~_{k+i|k+i}, i = 0 .. r-1, with a measurement at every step: (22) repeated."""
    left = np.eye(len(A)) - L @ C
    maps = [left]
    for _ in range(1, r):
        maps.append(left @ A @ maps[-1])  # Omega of (22)
    return maps


def make_shared_maps(A: Array, C: Array, shares: Array) -> list[Array]:
    """Maps to X~_{k+i|k+i} with corrections by shares (r, n, q) of the sample's innovation."""
    error, maps = np.eye(len(A)), []
    for i, share in enumerate(shares):
        error = (A @ error if i > 0 else error) - share @ C
        maps.append(error)
    return maps


def make_pseudo_maps(A: Array, C: Array, L: Array, r: int) -> list[Array]:
    """Maps with pseudo measurements (14), G from (31)."""
    return make_shared_maps(
        A, C, dual_rate.compute_pseudo_shares(A, C, L, np.linalg.pinv(C) - L, r)
    )


def make_predicted_maps(A: Array, C: Array, L: Array, r: int) -> list[Array]:
    """Maps with no correction between samples: (34)."""
    return make_shared_maps(A, C, np.concatenate([L[None], np.zeros((r - 1, *L.shape))]))


def compute_difference(maps: list[Array], others: list[Array]) -> float:
    """The largest difference of two sequences of maps, over the largest of the others."""
    size = max(float(np.linalg.norm(matrix)) for matrix in others)
    return max(float(np.linalg.norm(a - b)) / size for a, b in zip(maps, others, strict=True))
