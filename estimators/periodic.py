"""Gains of a periodic schedule: the covariance filter is run over it until its gains repeat.

A table of gains has a head row, one row for the gyro at each step of the cycle, one for each slow
row at each frame of the pattern, and, for pseudo-residuals, K^T and the transposed inverse. Behind
the gains of a step stands the upper half of the states' covariance after that step.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from ..envs.backend import absolute, jit, maximum
from ..envs.record import SLOW_NAMES
from .core import begin_filter, tick
from .covariance import measure_clone, measure_state
from .delay import DIRECT, DROPPED, find
from .intersample import constant_gain, inverse
from .memory import Filters
from .schedule import Schedule

Array = npt.NDArray[np.float64]

SETTLED = 1e-12
LONGEST = 600.0  # s of the recursion


@jit
def settle(f: Any, s: int, lags: Any, cycles: int, table: Any, before: Any, gains: Any) -> int:
    """Run the covariance filter over its schedule and write its gains; returns cycles used.

    f: a filter in covariance mode whose ticks are steps. s: its slow sensor, -1 for none. lags:
    (pattern,) steps. before: (total, total), to hold the covariance before the last frame. gains:
    what a filter with periodic gains would read.
    """
    n, size, cycle = f.n, f.total, f.cycle
    for done in range(cycles):
        change = 0.0
        for at in range(cycle):
            tick(f, gains, 0.0)
            change = maximum(change, _copy(f.gain, table[1 + at], size))
            for frame in range(len(lags)):
                captured = f.tick - lags[frame]
                if (captured - frame * f.period[s]) % cycle != 0 or captured < 0:
                    continue
                first = find(f, s, captured)
                if first == DROPPED:
                    continue
                for i in range(size):
                    _copy(f.P[i], before[i], size)
                for i in range(f.rows[s]):
                    if first == DIRECT:
                        measure_state(f, f.row[s, i], f.r[s, i], 0.0)
                    else:
                        measure_clone(f, first + i, f.r[s, i], 0.0)
                    to = table[1 + cycle + frame * f.rows[s] + i]
                    change = maximum(change, _copy(f.gain, to, size))
            k = size
            for i in range(n):
                for j in range(i, n):
                    table[1 + at, k] = f.P[i, j]
                    k += 1
        if change < SETTLED:
            return done + 1
    return cycles


@jit
def _copy(source: Any, target: Any, size: int) -> Any:
    """Copy a gain; returns the largest relative change."""
    change = 0.0
    for i in range(size):
        new = source[i]
        change = maximum(change, absolute(new - target[i]) / maximum(absolute(new), 1e-9))
        target[i] = new
    return change


def table_shape(f: Any, schedule: Schedule) -> tuple[int, int]:
    """Rows and columns of a table of gains."""
    p = int(f.rows.max())
    pseudo = 2 * (1 + p) if f.pseudo else 0
    rows = 1 + schedule.cycle + p * len(schedule.lags) + pseudo
    return rows, int(f.total + f.n * (f.n + 1) // 2)


def design(f: Any, schedule: Schedule, speed: float, kind: str) -> tuple[Array, Array]:
    """The table of gains at a speed in m/s, and the transition G there (dense, n).

    f: the filter's record, left as it is. kind: the generalised inverse of (20).
    """
    twins: Filters = np.array([f])
    twin = twins.view(np.recarray)[0]
    twin.periodic = twin.pseudo = twin.measured = twin.origin = 0
    twin.stride, twin.speed = 1, speed
    twin.cycle, twin.pattern = schedule.cycle, max(1, len(schedule.lags))
    used = twin.period > 0
    twin.period[used] = schedule.period
    twin.phase[:] = 0
    s = int(np.argmax(used)) if used.any() else -1
    begin_filter(twins, 0)
    table = np.zeros(table_shape(f, schedule))
    cycles = max(2, int(LONGEST / float(twin.step)) // schedule.cycle)
    before = np.zeros((int(f.total), int(f.total)))
    settle_filter(twins, s, np.array(schedule.lags, np.int64), cycles, table, before)
    if f.pseudo:
        _pseudo_gains(twin, s, schedule, table, inverse(kind, measured_rows(f, s, 0), before))
    table[0, 0] = 1.0
    return table, twin.G[: twin.dense, : twin.n].copy()


@jit
def settle_filter(filters: Any, s: int, lags: Any, cycles: int, table: Any, before: Any) -> None:
    """`settle` for the first filter of an array."""
    settle(filters[0], s, lags, cycles, table, before, np.zeros((1, 1, 1)))


def measured_rows(f: Any, s: int, frame: int, lag: int = 1) -> Array:
    """C over states and clones, (1 + p, size): the gyro, then the slow rows of a frame.

    A frame without lag, or where no clones are held, measures the states.
    """
    p = int(f.rows[s]) if s >= 0 else 0
    C = np.zeros((1 + p, int(f.total)))
    C[0, : f.n] = f.gyro[: f.n]
    if s >= 0 and f.frames[s] > 0 and lag > 0:
        first = int(f.home[s]) + frame % int(f.frames[s]) * p
        C[1:, first : first + p] = np.eye(p)
    elif s >= 0:
        C[1:, : f.n] = f.row[s, :p, : f.n]
    return C


def _pseudo_gains(f: Any, s: int, schedule: Schedule, table: Array, inverse: Array) -> None:
    """Append the constant gain and the generalised inverse of the pseudo-residual rule."""
    p, total, cycle, frames = int(f.rows[s]), int(f.total), schedule.cycle, len(schedule.lags)
    first = 1 + cycle + p * frames
    slow = table[1 + cycle : first, :total].reshape(frames, p, total).mean(0)
    K = constant_gain(table[1 : 1 + cycle, :total], slow, schedule.period)
    table[first : first + 1 + p, :total] = K.T
    table[first + 1 + p :, :total] = inverse.T


def slow_index(f: Any) -> int:
    """The index of the filter's slow sensor, -1 if it has none."""
    return next((s for s in range(len(SLOW_NAMES)) if f.period[s] > 0), -1)
