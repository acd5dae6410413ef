"""Gains over speed and cornering stiffness: designed on a grid, interpolated in compiled code."""

import itertools
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.record import Array
from ...envs.vehicle.vehicle import Vehicle
from .sampled_model import Purpose, design_model, regulator

SPEEDS = tuple(np.geomspace(2.0, 60.0, 48).tolist())
"""m/s: gains are designed at these, interpolated between and held beyond."""


@jit
def cell(axis: Any, at: Any) -> Any:
    """(i, share): where a value lies in an axis, held at its ends; (0, 0) of a single knot."""
    if len(axis) < 2:
        return 0, 0.0
    i = 0
    while i < len(axis) - 2 and at >= axis[i + 1]:
        i += 1
    share = (at - axis[i]) / (axis[i + 1] - axis[i])
    return i, min(max(share, 0.0), 1.0)


@jit
def interpolated(table: Any, axes: Any, v: Any, front: Any, rear: Any, K: Any) -> None:
    """Fill K (m, n) from a table (speeds, fronts, rears, m, n), linear along each axis."""
    i, a = cell(axes[0], v)
    j, b = cell(axes[1], front)
    k, c = cell(axes[2], rear)
    K[:] = 0.0
    for corner in range(8):
        p, q, r = corner & 1, (corner >> 1) & 1, corner >> 2
        w = (a if p else 1.0 - a) * (b if q else 1.0 - b) * (c if r else 1.0 - c)
        if w > 0.0:
            K += w * table[i + p, j + q, k + r]


@lru_cache(maxsize=16)
def gain_table(
    vehicle: Vehicle,
    purpose: Purpose,
    speeds: Sequence[float],
    fronts: Sequence[float],
    rears: Sequence[float],
) -> Array:
    """[K S] on a grid, (speeds, fronts, rears, m, n + m); see `regulator`.

    fronts, rears: stiffnesses in N/rad, none: the vehicle's.
    """
    shape = len(speeds), max(len(fronts), 1), max(len(rears), 1)
    gains = []
    for speed, front, rear in itertools.product(
        speeds, fronts or (vehicle.front_stiffness,), rears or (vehicle.rear_stiffness,)
    ):
        car = vehicle.replace(front_stiffness=front, rear_stiffness=rear)
        gains.append(np.hstack(regulator(design_model(car, speed, purpose))))
    table = np.array(gains)
    return np.ascontiguousarray(table.reshape(*shape, *table.shape[1:]))
