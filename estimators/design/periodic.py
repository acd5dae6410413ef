"""Gains of a periodic schedule: the covariance filter is run over it until its gains repeat.

A table of gains has a head row, then, for each step of the cycle, one row for every fast
measurement (one where there is none), then one for each slow row at each frame of the pattern.
Pseudo-residuals add K^T and the transposed inverse, shared innovations a share for each step.
Behind the gains of a step stands the upper half of the states' covariance after that step.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, maximum
from ...envs.sensors.slow import SLOW_NAMES
from ..core.covariance import measure_clone, measure_state
from ..core.delay import CLONE, DIRECT, DROPPED, IGNORE, find
from ..core.intersample import NONE, PSEUDO, SPREAD
from ..core.memory import Filters
from ..core.run import begin, tick
from .dual_rate import shares
from .pole_placement import place
from .pseudo_gains import constant_gain, inverse
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
    n, size, cycle, width = f.n, f.total, f.cycle, maximum(f.fasts, 1)
    for done in range(cycles):
        change = 0.0
        for at in range(cycle):
            tick(f, gains)
            if f.tick % f.pace == 0:
                for i in range(f.fasts):
                    change = maximum(change, _copy(f.share[i], table[1 + at * width + i], size))
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
                    to = table[1 + cycle * width + frame * f.rows[s] + i]
                    change = maximum(change, _copy(f.gain, to, size))
            k = size
            for i in range(n):
                for j in range(i, n):
                    table[1 + at * width, k] = f.P[i, j]
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


@jit
def settle_filter(
    filters: Any, s: int, lags: Any, cycles: int, table: Any, before: Any, none: Any
) -> None:
    """`settle` for the first filter of an array, from its beginning."""
    begin(filters[0], 0)
    settle(filters[0], s, lags, cycles, table, before, none)


@jit
def prepare(filters: Any) -> None:
    """Begin the first filter of an array, so that its model stands."""
    begin(filters[0], 0)


def table_shape(f: Any, schedule: Schedule) -> tuple[int, int]:
    """Rows and columns of a table of gains."""
    p, m = int(f.rows.max()), int(f.fasts)
    extra = {NONE: 0, PSEUDO: 2 * (m + p), SPREAD: schedule.cycle * p}[int(f.between)]
    rows = 1 + schedule.cycle * max(m, 1) + p * len(schedule.lags) + extra
    return rows, int(f.total + f.n * (f.n + 1) // 2)


def design(f: Any, schedule: Schedule, speed: float, wish: Any) -> tuple[Array, Array]:
    """The table of gains at a speed in m/s, and the transition G there (dense, n).

    f: the filter's record, left as it is. wish: a `wish.Wish`, how its gains are found.
    """
    twins: Filters = np.array([f])
    twin = twins.view(np.recarray)[0]
    twin.periodic = twin.measured = twin.origin = twin.joint = twin.between = 0
    twin.pace = 1 if f.stride > 1 else f.pace
    twin.stride, twin.speed = 1, speed
    twin.late = CLONE if f.late == CLONE else IGNORE
    twin.cycle, twin.pattern = schedule.cycle, max(1, len(schedule.lags))
    used = twin.period > 0
    twin.period[used] = schedule.period
    twin.phase[:] = 0
    s = slow_index(twin)
    table = np.zeros(table_shape(f, schedule))
    table[0, 0] = 1.0
    G: Array
    if wish.poles and f.between == NONE:
        prepare(twins)
        G = twin.G[: twin.dense, : twin.n].copy()
        place(twin, G, wish.poles, table)
        return table, G
    if f.between == SPREAD:
        prepare(twins)
        G = twin.G[: twin.dense, : twin.n].copy()
        shares(twin, G, schedule, wish, table)
        return table, G
    lags = np.array(schedule.lags, np.int64) * int(f.late == CLONE)
    cycles = max(2, int(LONGEST / float(twin.step)) // schedule.cycle)
    before = np.zeros((int(f.total), int(f.total)))
    settle_filter(twins, s, lags, cycles, table, before, np.zeros((1, 1, 1)))
    if f.between == PSEUDO:
        C = measured_rows(f, s, 0)
        R = np.diag([*twin.r_fast[: twin.fasts], *twin.r[s, : twin.rows[s]]])
        _pseudo_gains(twin, s, schedule, table, inverse(wish.inverse, C, before, R))
    return table, twin.G[: twin.dense, : twin.n].copy()


def measured_rows(f: Any, s: int, frame: int, lag: int = 1) -> Array:
    """C over states and clones, (m + p, size): the fast rows, then the slow rows of a frame.

    A frame without lag, or where no clones are held, measures the states.
    """
    p, m = (int(f.rows[s]) if s >= 0 else 0), int(f.fasts)
    C = np.zeros((m + p, int(f.total)))
    C[:m, : f.n] = f.y_row[:m, : f.n]
    if s >= 0 and f.late == CLONE and f.frames[s] > 0 and lag > 0:
        first = int(f.home[s]) + frame % int(f.frames[s]) * p
        C[m:, first : first + p] = np.eye(p)
    elif s >= 0:
        C[m:, : f.n] = f.row[s, :p, : f.n]
    return C


def _pseudo_gains(f: Any, s: int, schedule: Schedule, table: Array, inverse: Array) -> None:
    """Append the constant gain and the generalised inverse of the pseudo-residual rule."""
    p, m, total = int(f.rows[s]), int(f.fasts), int(f.total)
    cycle, frames, width = schedule.cycle, len(schedule.lags), max(int(f.fasts), 1)
    first = 1 + cycle * width + p * frames
    turns = table[1 + cycle * width : first, :total].reshape(frames, p, total)
    slow = np.mean([together(gains, measured_rows(f, s, 0)[m:]) for gains in turns], axis=0)
    fast = table[1 : 1 + cycle * width, :total].reshape(cycle, width, total)[:, :m]
    K = constant_gain(fast, slow, schedule.period)
    table[first : first + m + p, :total] = K.T
    table[first + m + p :, :total] = inverse.T


def together(K: Array, C: Array) -> Array:
    """The gains (p, n) of rows that correct together from those of one after the other."""
    joint = np.zeros_like(K)
    for i in range(len(K)):
        joint[:i] -= np.outer(joint[:i] @ C[i], K[i])
        joint[i] = K[i]
    return joint


def slow_index(f: Any) -> int:
    """The index of the filter's slow sensor, -1 if it has none."""
    return next((s for s in range(len(SLOW_NAMES)) if f.period[s] > 0), -1)
