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
from ..core.innovation import BUFFER, LARSEN
from ..core.model import KINEMATIC, VELOCITY_ROLL
from ..core.record import N_CORE, N_FAST, N_INPUTS, FilterRecord
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

    Args:
        b: Block of lanes.
        lane: Index in it.
        f: Record of the lane's filter.

    Returns:
        1 or 0.
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
