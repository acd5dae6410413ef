"""Filters of one shape in SIMD lanes: what their ticks read and write, side by side.

A block has a record's fields of the same names, whose numbers are lanes, so the equations of `core`
are compiled for it unchanged. Filter i of a batch has lane i mod LANES of block i // LANES. Its
model stays there and is loaded anew where its speed changed; its state is loaded and stored in
every call. In all functions b is a block, lane an index in it, and f the record of the lane's
filter.
"""

from typing import Any

import numpy as np

from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Scalar
from ...envs.numerics.simd import LANES
from ...envs.numerics.simd8 import allocate_aligned, pad_to_cache_line
from ...envs.record import FAST, FAST_WIDTH
from ..core.innovation import BUFFER, LARSEN, store_due_captures
from ..core.model import KINEMATIC, VELOCITY_ROLL
from ..core.record import N_CORE, N_FAST, N_INPUTS, N_SLOW, WINDOW, FilterRecord
from ..core.update import NONE

LaneBlock = Any
"""One record of the dtype `BLOCK`; `b` in compiled code."""

_MAX_STATES = 16  # states and clones
_ROW_LENGTH = _MAX_STATES + 1  # as long as a power of two, rows would share few places of the cache
_FLOATS = {
    "x": (_ROW_LENGTH,),
    "P": (_MAX_STATES, _ROW_LENGTH),  # on and above the diagonal
    "G": (N_CORE, _ROW_LENGTH),
    "GT": (N_CORE, _ROW_LENGTH),
    "HT": (N_INPUTS, _ROW_LENGTH),
    "Q": (N_CORE, _ROW_LENGTH),  # on and above the diagonal
    "keep": (_ROW_LENGTH,),
    "decay": (_ROW_LENGTH,),
    "drift": (_ROW_LENGTH,),
    "PC": (_ROW_LENGTH,),
    "gain": (_ROW_LENGTH,),
    "K": (N_FAST, _ROW_LENGTH),  # periodic gains of this tick
    "C_fast": (N_FAST, _ROW_LENGTH),
    "D_fast": (N_FAST, N_INPUTS),
    "rest_fast": (N_FAST,),
    "r_fast": (N_FAST,),
    "u_factor": (N_INPUTS, 2),
    "y_factor": (N_FAST, 2),
    "u": (N_INPUTS,),
    "u_new": (N_INPUTS,),
    "y": (N_FAST,),
    "row": (FAST_WIDTH,),  # of this tick
    "speed": (),
    "speed_before": (),
    "model_speed": (),  # 0: no model was loaded
    "smoothing": (),
    "step": (),
    "road_turn": (),
    "now": (),  # tick
    "last": (),  # tick of the last row
    "due": (),  # tick at which the next packet is taken
    "next": (),  # tick of the next capture
    "here": (),  # 1: its filter has a row now; else what the lane holds is of no use
    "apart": (),  # 1: the tick is computed by the record
    "wild": (),  # 1: its residual is none
}
# of a lane: whether its filter has the block's shape (1, -1; 0 before the first look), tick, step
# within the cycle, table of gains, packets done
_INTS = ("shaped", "tick", "at", "cell", "cursor")
_SHAPE = (
    *("n", "dense", "total", "inputs", "fasts", "kind", "periodic", "measured", "cycle"),
    *("store_predictions", "tyres", "robust"),
)
_FIELDS = (
    [(name, np.float64, (*shape, LANES)) for name, shape in _FLOATS.items()]
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
def is_lane_compatible(b: LaneBlock, lane: int, f: FilterRecord) -> Scalar:
    """Return whether a filter's ticks are computed in its lane now; the first shapes the block.

    Lanes compute models that change by speed alone, of which every tick predicts and corrects.
    Nothing is done between samples, and nothing of the past is stored but predictions.
    """
    if b.shaped[lane] == 0:
        is_steady = f.tyres == 0 and f.kind != KINEMATIC and f.kind != VELOCITY_ROLL
        is_plain = f.stride == 1 and f.pace == 1 and f.between == NONE and f.joint == 0
        has_fixed_noise = f.r_share == 0.0 and f.steer_jump == 0.0
        is_supported = f.late != BUFFER and f.late != LARSEN and f.total <= _MAX_STATES
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
def _load_model(b: LaneBlock, lane: int, f: FilterRecord) -> None:
    """Load what a filter's ticks read and do not write."""
    n, dense = f.n, f.dense
    for i in range(n):
        b.keep[i, lane], b.decay[i, lane], b.drift[i, lane] = f.keep[i], f.decay[i], f.drift[i]
        for j in range(n):
            b.GT[i, j, lane] = f.GT[i, j]
        for j in range(i, n):
            b.Q[i, j, lane] = f.Q[i, j]
    for i in range(dense):
        for j in range(n):
            b.G[i, j, lane] = f.G[i, j]
    for i in range(n, f.total):
        b.keep[i, lane] = f.keep[i]
    for k in range(f.inputs):
        b.u_factor[k, 0, lane], b.u_factor[k, 1, lane] = f.u_factor[k, 0], f.u_factor[k, 1]
        for j in range(dense):
            b.HT[k, j, lane] = f.HT[k, j]
    for i in range(f.fasts):
        b.y_factor[i, 0, lane], b.y_factor[i, 1, lane] = f.y_factor[i, 0], f.y_factor[i, 1]
        b.rest_fast[i, lane], b.r_fast[i, lane] = f.rest_fast[i], f.r_fast[i]
        for j in range(n):
            b.C_fast[i, j, lane] = f.C_fast[i, j]
        for k in range(f.inputs):
            b.D_fast[i, k, lane] = f.D_fast[i, k]
    b.model_speed[lane], b.smoothing[lane], b.step[lane] = f.model_speed, f.smoothing, f.step


@jit
def load_lane(b: LaneBlock, lane: int, f: FilterRecord) -> None:
    """Load a filter's model, where its speed changed, and its state into its lane."""
    if b.model_speed[lane] != f.model_speed:
        _load_model(b, lane, f)
    _load_states(b, lane, f)
    for k in range(b.inputs):
        b.u[k, lane] = f.u[k]
    b.speed[lane], b.speed_before[lane], b.road_turn[lane] = f.speed, f.speed_before, f.road_turn
    b.tick[lane], b.at[lane], b.cell[lane] = f.tick, f.at, f.cell
    _load_clock(b, lane, f)


@jit
def _load_states(b: LaneBlock, lane: int, f: FilterRecord) -> None:
    N = b.total
    for i in range(N):
        b.x[i, lane] = f.x[i]
    if b.periodic == 0:
        for i in range(N):
            for j in range(i, N):
                b.P[i, j, lane] = f.P[i, j]


@jit
def _load_clock(b: LaneBlock, lane: int, f: FilterRecord) -> None:
    """Load the tick of the next capture."""
    first = np.inf
    for s in range(N_SLOW):
        if f.period[s] > 0:
            first = min(first, float(f.next[s]))
    b.next[lane] = first


@jit
def store_lane(b: LaneBlock, lane: int, f: FilterRecord) -> None:
    """Store the state of a lane in its filter's record."""
    _store_states(b, lane, f)
    for k in range(b.inputs):
        f.u[k] = b.u[k, lane]
    for i in range(b.fasts):
        f.y[i] = b.y[i, lane]
    f.speed, f.speed_before, f.road_turn = b.speed[lane], b.speed_before[lane], b.road_turn[lane]
    f.tick, f.at = b.tick[lane], b.at[lane]


@jit
def _store_states(b: LaneBlock, lane: int, f: FilterRecord) -> None:
    N = b.total
    for i in range(N):
        f.x[i] = b.x[i, lane]
    if b.periodic == 0:
        for i in range(N):
            for j in range(i, N):
                f.P[i, j] = f.P[j, i] = b.P[i, j, lane]


@jit
def store_captures(b: LaneBlock, lane: int, f: FilterRecord) -> None:
    """Store by its record what a lane's filter captured at its last tick; before the next one."""
    _store_states(b, lane, f)
    f.road_turn, f.speed_before = b.road_turn[lane], f.model_speed
    store_due_captures(f, b.tick[lane])
    _load_states(b, lane, f)
    _load_clock(b, lane, f)


@jit
def store_prediction(b: LaneBlock, lane: int, f: FilterRecord) -> None:
    """Store a lane's prediction of this tick, before its fast measurements."""
    slot = b.tick[lane] % WINDOW
    f.past_road_turn[slot] = b.road_turn[lane]
    for i in range(b.n):
        f.predicted[slot, i] = b.x[i, lane]
