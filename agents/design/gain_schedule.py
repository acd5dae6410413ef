"""Gains over speed and cornering stiffness: designed on a grid, interpolated in compiled code."""

import itertools
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.record import Array
from ...envs.vehicle.vehicle import Vehicle
from .sampled_model import (
    DYNAMIC,
    DesignSpec,
    compute_cost_to_go,
    compute_input_cost,
    make_design_model,
)

SPEEDS = tuple(np.geomspace(2.0, 60.0, 48).tolist())
"""m/s: gains are designed at these, interpolated between and held beyond."""


@jit
def find_cell(axis: Any, value: Any) -> Any:
    """(i, share): where a value lies in an axis, held at its ends; (0, 0) of a single knot."""
    if len(axis) < 2:
        return 0, 0.0
    i = 0
    while i < len(axis) - 2 and value >= axis[i + 1]:
        i += 1
    share = (value - axis[i]) / (axis[i + 1] - axis[i])
    return i, min(max(share, 0.0), 1.0)


@jit
def interpolate_gains(table: Any, axes: Any, v: Any, front: Any, rear: Any, K: Any) -> None:
    """Fill K (m, n) from a table (speeds, fronts, rears, m, n), linear along each axis."""
    i, a = find_cell(axes[0], v)
    j, b = find_cell(axes[1], front)
    k, c = find_cell(axes[2], rear)
    K[:] = 0.0
    for corner in range(8):
        p, q, r = corner & 1, (corner >> 1) & 1, corner >> 2
        w = (a if p else 1.0 - a) * (b if q else 1.0 - b) * (c if r else 1.0 - c)
        if w > 0.0:
            K += w * table[i + p, j + q, k + r]


class GainTables(NamedTuple):
    """What the regulator is on a grid, (speeds, fronts, rears, ...): see `regulator`."""

    gains: Array  # [K S], (..., m, n + m)
    terminal: Array  # T, (..., d, n): what is to come costs |T x|^2, but for what no input changes


@lru_cache(maxsize=16)
def make_gain_table(
    vehicle: Vehicle,
    design_spec: DesignSpec,
    speeds: Sequence[float],
    fronts: Sequence[float],
    rears: Sequence[float],
) -> GainTables:
    """The regulators of a car over speeds in m/s and stiffnesses.

    fronts, rears: stiffnesses in N/rad, none: the vehicle's.
    """
    shape = len(speeds), max(len(fronts), 1), max(len(rears), 1)
    gains, terminal = [], []
    for speed, front, rear in itertools.product(
        speeds, fronts or (vehicle.front_stiffness,), rears or (vehicle.rear_stiffness,)
    ):
        car = vehicle.replace(front_stiffness=front, rear_stiffness=rear)
        model = make_design_model(car, speed, design_spec)
        K, V = compute_cost_to_go(model)
        gains.append(np.hstack([K, compute_input_cost(model, V)]))
        terminal.append(_factor_cost(V))
    return GainTables(
        *(np.array(parts).reshape(*shape, *parts[0].shape) for parts in (gains, terminal))
    )


def _factor_cost(V: Array) -> Array:
    """T (d, n) with |T x|^2 = x'Vx but for the part of the states that no input moves."""
    d = len(DYNAMIC)
    P = V[:d, :d] + 1e-9 * np.diag(np.diag(V)[:d]) + 1e-15 * np.eye(d)  # without lag: singular
    L = np.linalg.cholesky(P)
    return np.hstack([L.T, np.linalg.solve(L, V[:d, d:])])
