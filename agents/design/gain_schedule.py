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
"""Speeds of the designs (m/s); gains are interpolated between and held beyond."""


@jit
def find_cell(axis: Any, value: Any) -> Any:
    """Find the cell of a value in an axis, held at its ends.

    Args:
        axis: Rising knots.
        value: Value in the axis's unit.

    Returns:
        Index of the cell's first knot, and the fraction of the cell; (0, 0) for a single knot.
    """
    if len(axis) < 2:
        return 0, 0.0
    i = 0
    while i < len(axis) - 2 and value >= axis[i + 1]:
        i += 1
    share = (value - axis[i]) / (axis[i + 1] - axis[i])
    return i, min(max(share, 0.0), 1.0)


@jit
def interpolate_gains(table: Any, axes: Any, v: Any, front: Any, rear: Any, K: Any) -> None:
    """Interpolate a table of gains, linear along each axis.

    Args:
        table: Table, shape (speeds, fronts, rears, m, n).
        axes: Knots of the three axes.
        v: Speed (m/s).
        front: Front cornering stiffness of a tyre (N/rad).
        rear: Rear cornering stiffness of a tyre (N/rad).
        K: Gains, shape (m, n), filled.
    """
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
    """The regulators on a grid, shape (speeds, fronts, rears, ...): see `compute_regulator`."""

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
    """Make the regulators of a car over speeds and stiffnesses.

    Args:
        vehicle: Vehicle of the design.
        design_spec: Parameters of the design.
        speeds: Speeds (m/s).
        fronts: Front stiffnesses (N/rad); empty: the vehicle's.
        rears: Rear stiffnesses (N/rad); empty: the vehicle's.

    Returns:
        Tables over speed, front and rear stiffness, in this order.
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
    """Factor V: T (d, n) with |T x|^2 = x'Vx but for the states that no input moves."""
    d = len(DYNAMIC)
    P = V[:d, :d] + 1e-9 * np.diag(np.diag(V)[:d]) + 1e-15 * np.eye(d)  # without lag: singular
    L = np.linalg.cholesky(P)
    return np.hstack([L.T, np.linalg.solve(L, V[:d, d:])])
