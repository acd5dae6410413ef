"""The batch's part of an observation, compiled: filters of one shape in SIMD lanes, others alone.

A block b has a record's fields of the same names, whose numbers are lanes, so the equations of
`core` are compiled for it unchanged. Filter i of a batch, record f, has a lane of block i // LANES.
Its model stays there and is loaded anew where its speed changed; its state in every call.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from ...envs.numerics.jit import jit, jit_nrt
from ...envs.numerics.packed import count_lanes
from ...envs.numerics.primitives import Matrix, Scalar, Vector, maximum, minimum
from ...envs.numerics.simd import LANES
from ...envs.numerics.simd8 import allocate_aligned, pad_to_cache_line, prefetch
from ...envs.record import FAST, FAST_WIDTH
from ..core.filter import StepRecord
from ..core.innovation import BUFFER, LARSEN
from ..core.model import KINEMATIC, VELOCITY_ROLL
from ..core.record import (
    FILTER,
    N_CORE,
    N_FAST,
    N_INPUTS,
    N_SMALL,
    N_TOTAL,
    X_OFFSET,
    FilterRecord,
)
from ..core.update import NONE
from ..estimator import compile_call
from ..wrappers.outputs import Observed, OutputTable, observe
from .lane_ticks import FilterBank, LaneBlock, advance_block, get_gains

_MIN_LANES = 4  # filters that are computed alone in less time than in lanes
_MAX_STATES = 16  # states and clones
_ROW_LENGTH = _MAX_STATES + 1  # as long as a power of two, rows would share few places of the cache
_FLOATS: tuple[tuple[tuple[int, ...], tuple[str, ...]], ...] = (
    ((_ROW_LENGTH,), ("x", "own_decay", "decay", "drift", "PC", "gain")),
    ((_MAX_STATES, _ROW_LENGTH), ("P",)),  # on and above the diagonal, as Q
    ((N_CORE, _ROW_LENGTH), ("G", "GT", "Q")),
    ((N_INPUTS, _ROW_LENGTH), ("HT",)),
    ((N_FAST, _ROW_LENGTH), ("K", "C_fast")),  # K: periodic gains of this tick
    ((N_FAST, N_INPUTS), ("D_fast",)),
    ((N_FAST,), ("rest_fast", "r_fast", "y")),
    ((N_INPUTS, 2), ("u_factor",)),
    ((N_FAST, 2), ("y_factor",)),
    ((N_INPUTS,), ("u", "u_new")),
    ((FAST_WIDTH,), ("row",)),  # of this tick
)
# of a lane: ticks are those of now, of the last row, of the next packet to take and capture;
# model_speed, 0: no model was loaded; here, 1: its filter has a row now, else what the lane holds
# is of no use; apart, 1: the tick is computed by the record; wild, 1: its residual is none
_SCALARS = (
    *("speed", "speed_before", "model_speed", "smoothing", "step", "road_turn"),
    *("now", "last", "due", "next", "here", "apart", "wild"),
)
# of a lane: whether its filter has the block's shape (1, -1; 0 before the first look), tick, step
# within the cycle, table of gains, packets done
_INTS = ("shaped", "tick", "at", "cell", "cursor")
_SHAPE = (
    *("n", "dense", "total", "inputs", "fasts", "kind", "periodic", "measured", "cycle"),
    *("store_predictions", "tyres", "robust"),
)
_FIELDS = (
    [
        (name, np.float64, (*shape, LANES))
        for shape, names in (*_FLOATS, ((), _SCALARS))
        for name in names
    ]
    + [(name, np.int64, (LANES,)) for name in _INTS]
    + [(name, np.float64 if name == "robust" else np.int64) for name in _SHAPE]
    + [("u_column", np.int64, (N_INPUTS, 2)), ("y_column", np.int64, (N_FAST, 2))]
    + [("column", np.int64, (FAST_WIDTH,)), ("columns", np.int64)]  # of a fast row, that are read
)
BLOCK = pad_to_cache_line(_FIELDS)


def make_blocks(count: int) -> Any:
    """Allocate empty blocks.

    Args:
        count: Number of filters N.

    Returns:
        Records of the dtype `BLOCK`, enough for N lanes.
    """
    return allocate_aligned((-(-count // LANES),), BLOCK)


@jit
def _is_lane_compatible(b: LaneBlock, lane: int, f: FilterRecord) -> Scalar:
    """Return whether a filter's ticks are computed in its lane now; the first shapes the block."""
    # lanes compute models that change by speed alone, of which every tick predicts and corrects
    # without rules between samples, and store nothing of the past but predictions
    if b.shaped[lane] == 0:
        is_steady = f.tyres == 0 and f.kind != KINEMATIC and f.kind != VELOCITY_ROLL
        is_plain = f.stride == 1 and f.pace == 1 and f.intersample_rule == NONE and f.joint == 0
        has_fixed_noise = f.r_share == 0.0 and f.steer_jump == 0.0
        is_supported = f.delay_rule != BUFFER and f.delay_rule != LARSEN and f.total <= _MAX_STATES
        is_supported = is_supported and is_steady and is_plain and has_fixed_noise
        if is_supported and b.n == 0:
            _set_shape(b, f)
        b.shaped[lane] = 1 if is_supported and _is_same_shape(b, f) else -1
    return b.shaped[lane] == 1 and f.has_started == 1 and f.model_speed > 0.0


@jit
def _is_same_shape(b: LaneBlock, f: FilterRecord) -> Scalar:
    is_same = f.n == b.n and f.dense == b.dense and f.total == b.total and f.inputs == b.inputs
    is_same = is_same and f.fasts == b.fasts and f.kind == b.kind and f.periodic == b.periodic
    is_same = is_same and f.measured == b.measured and f.cycle == b.cycle and f.robust == b.robust
    is_same = is_same and f.store_predictions == b.store_predictions
    for k in range(2):
        for i in range(f.inputs):
            is_same = is_same and f.u_column[i, k] == b.u_column[i, k]
        for i in range(f.fasts):
            is_same = is_same and f.y_column[i, k] == b.y_column[i, k]
    return is_same


@jit
def _set_shape(b: LaneBlock, f: FilterRecord) -> None:
    """Write into the block what all its filters share."""
    b.n, b.dense, b.total, b.inputs, b.fasts = f.n, f.dense, f.total, f.inputs, f.fasts
    b.kind, b.periodic, b.measured, b.cycle = f.kind, f.periodic, f.measured, f.cycle
    b.store_predictions, b.tyres, b.robust = f.store_predictions, f.tyres, f.robust
    b.columns = 0
    if f.measured == 1:
        _add_column(b, FAST.wheel_left)
        _add_column(b, FAST.wheel_right)
    for k in range(2):
        for i in range(f.inputs):
            b.u_column[i, k] = f.u_column[i, k]
            _add_column(b, f.u_column[i, k])
        for i in range(f.fasts):
            b.y_column[i, k] = f.y_column[i, k]
            _add_column(b, f.y_column[i, k])


@jit
def _add_column(b: LaneBlock, column: int) -> None:
    for i in range(b.columns):
        if b.column[i] == column:
            return
    b.column[b.columns] = column
    b.columns += 1


@jit
def _fetch(f: FilterRecord, template: FilterRecord) -> None:
    """Have the caches fetch what a tick reads of a filter with as many states as `template`."""
    for i in range(0, X_OFFSET + template.total, 8):
        prefetch(f.padding, i)
    for i in range(0, N_SMALL, 8):
        prefetch(f.P, N_TOTAL, i)
    for j in range(0, template.total, 8):
        for i in range(template.total):
            prefetch(f.P, i, j)
    for j in range(0, template.n, 8):
        for i in range(template.n):
            prefetch(f.Q, i, j)
            if i < template.dense:
                prefetch(f.G, i, j)
            if j < template.dense:
                prefetch(f.GT, i, j)


@jit
def _select_lanes(b: LaneBlock, first: int, filters: Matrix, done: Vector, rows: Vector) -> int:
    """Select the filters that do their rows in lanes into b.here; return how many rows all do."""
    n_rows, count = 0, 0
    for lane in range(count_lanes()):
        i = first + lane
        b.here[lane] = 0.0
        if i < len(filters) and done[i] == -1 and rows[i] > 0:
            is_same = count == 0 or rows[i] == n_rows
            if is_same and len(filters[i]) == 1 and _is_lane_compatible(b, lane, filters[i, 0]):
                b.here[lane], n_rows = 1.0, rows[i]
                count += 1
    return n_rows if count >= _MIN_LANES else 0


@jit_nrt
def _observe_batch(
    bank: FilterBank, done: Vector, lanes: Vector, record: StepRecord, observed: Observed
) -> int:
    """Call `observe` for every filter that has rows to do; return how many still have."""
    # record, observed: of N cars; done: rows done, -1 where a filter has not started, updated;
    # filters of one shape go in lanes
    fast, rows, packets, counts = record
    obs, table, beta, gamma, out, summary = observed
    filters, n_waiting = bank.filters, 0
    for first in range(0, len(filters), count_lanes()):  # without the compiler one by one
        b = lanes[first // LANES]
        n_rows, n_done = _select_lanes(b, first, filters, done, rows), 0
        if n_rows > 0:
            n_done = advance_block(b, first, bank, fast, n_rows, packets, counts)
        for lane in range(minimum(count_lanes(), len(filters) - first)):
            i = first + lane
            if done[i] < rows[i]:
                f, gains = filters[i], get_gains(bank, i)
                start = n_done if b.here[lane] == 1.0 else maximum(done[i], 0)
                outputs = Observed(obs[i], table, beta[i], gamma[i], out[i], summary[i])
                if n_done == 0 and i + 1 < len(filters):
                    for layer in range(len(f)):
                        _fetch(filters[i + 1, layer], f[layer])
                row_record = StepRecord(fast[i], rows[i], packets[i], counts[i])
                done[i] = observe(f, gains, row_record, start, outputs)
                n_waiting += 1 if done[i] < rows[i] else 0
    return n_waiting


@cache
def compile_observe_batch() -> Callable[..., int]:
    """Return `_observe_batch` as a plain call, for the types that all banks and records have."""
    counts, numbers, cube = np.zeros(1, np.int64), np.zeros(1), np.zeros((1, 1, 1))
    bank = FilterBank(np.zeros((1, 1), FILTER), numbers, np.zeros((1, 4), np.int64))
    record, obs = StepRecord(cube, counts, cube, counts), np.zeros((1, 0), np.float32)
    table = OutputTable(0, np.zeros((0, 3), np.int64), numbers)
    observed = Observed(obs, table, numbers, numbers, obs, np.zeros((1, 4)))
    return compile_call(_observe_batch, bank, counts, make_blocks(1), record, observed)
