"""One env-step of several vehicles of one kind in SIMD lanes; compiled."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..backend.arrays import at, lane_count, read
from ..backend.decorators import apart
from ..backend.simd import LANES
from ..record import FAST_WIDTH, Array
from ..task.info import REPORT
from .arrays import Rows, row_of
from .layout import PARAMS_WIDTH, STATE_WIDTH, Z
from .observe import observe_fast
from .step import conclude_slow, drive_on, kind_of, shares_of
from .window import follow, follows_another, foresee_lanes, window_of

_REPORT, _REFS = len(REPORT), (REPORT.beta_ref, REPORT.gamma_ref)
_MOVING = Z.slow[0].frames  # what a tick changes comes first in a state, but for the driver's angle


class Block(NamedTuple):
    """Working arrays of a batch step; the last axis of those of a block is the lanes'."""

    order: npt.NDArray[np.int64]  # (N,), all rows, those of one kind next to each other
    members: npt.NDArray[np.int64]  # (lanes,), the rows in the lanes now
    params: Array
    states: Array
    shares: Array
    rows: Array
    reports: Array
    obs: Array  # but for the entries of slow sensors
    window: Array  # `window.window_of` the block
    alone: Array  # and of a row that is stepped by itself


def block_of(count: int, n: int, entries: int) -> Block:
    """The block of an env of `count` rows, n ticks a step and `entries` of an observation."""
    return Block(
        np.arange(count),
        np.zeros(LANES, np.int64),
        np.zeros((PARAMS_WIDTH, LANES)),
        np.zeros((STATE_WIDTH, LANES)),
        np.zeros((2, LANES)),
        np.zeros((n, FAST_WIDTH, LANES)),
        np.zeros((_REPORT, LANES)),
        np.zeros((entries, LANES)),
        window_of(n, LANES),
        window_of(n),
    )


@apart
def step_block(count: int, rows: Rows, actions: Any, n: int, bounds: Any, block: Block) -> bool:
    """One env-step of the first `count` of the block's members, of one kind, whose actions are
    finite; False, and nothing is changed, where not all of them come to the step's end."""
    params, states = rows.params, rows.states
    for lane in range(lane_count()):
        i = block.members[lane if lane < count else 0]  # spare lanes repeat the first
        for k in range(PARAMS_WIDTH):
            block.params[k, lane] = params[i, k]
        for k in range(_MOVING):
            block.states[k, lane] = states[i, k]
        block.states[Z.driver, lane] = states[i, Z.driver]
        block.shares[0, lane], block.shares[1, lane] = shares_of(actions[i])
    first = block.members[0]
    kind = kind_of(params[first], rows.switches[first])
    foresee_lanes(block.params, block.states, n, kind.follows, block.window)
    if follows_another(block.params, params.shape[1]):
        for lane in range(lane_count()):
            i = block.members[lane if lane < count else 0]
            follow(params[i], states[i], n, block.window[:, :, lane])
    done = drive_on(
        block.params,
        block.states,
        kind,
        at(block.shares, 0),
        at(block.shares, 1),
        n,
        block.rows,
        block.reports,
        block.window,
        False,
    )
    if done == 0:
        return False
    refs, last = read(block.reports, _REFS), len(bounds[0]) - 2
    slow = observe_fast(block.rows, n, refs, bounds, rows.switches[first], block.obs)
    for lane in range(count):
        i = block.members[lane]
        for k in range(_MOVING):
            states[i, k] = block.states[k, lane]
        states[i, Z.driver] = block.states[Z.driver, lane]
        for k in range(_REPORT):
            rows.reports[i, k] = block.reports[k, lane]
        for j in range(n):
            for k in range(FAST_WIDTH):
                rows.rows[i, j, k] = block.rows[j, k, lane]
        for k in range(slow):
            rows.obs[i, k] = block.obs[k, lane]
        for k in range(last, last + 2):
            rows.obs[i, k] = block.obs[k, lane]
        conclude_slow(row_of(rows, i), n, slow, bounds, block.window[:, :, lane])
    return True
