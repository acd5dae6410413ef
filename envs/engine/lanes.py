"""One env-step of several vehicles of one kind in SIMD lanes; compiled."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..backend.arrays import count_lanes, load_element, read
from ..backend.decorators import noinline
from ..backend.simd import LANES
from ..record import FAST_WIDTH, Array
from ..task.info import REPORT
from .arrays import BatchArrays, get_episode_arrays
from .layout import PARAMS_WIDTH, STATE_WIDTH, Z
from .observe import observe_fast
from .step import clip_action, finish_slow_sensors, integrate_step, make_step_variant
from .window import has_overwrite, make_window, overwrite_steering, precompute_lane_window

_REPORT, _REFS = len(REPORT), (REPORT.beta_ref, REPORT.gamma_ref)
_DYNAMIC_WIDTH = Z.slow[
    0
].frames  # what a tick changes comes first in a state, but for the driver's angle


class LaneBuffers(NamedTuple):
    """Working arrays of a batch step; the last axis of those of a block is the lanes'."""

    order: npt.NDArray[np.int64]  # (N,), all rows, those of one kind next to each other
    members: npt.NDArray[np.int64]  # (lanes,), the rows in the lanes now
    params: Array
    states: Array
    shares: Array
    rows: Array
    reports: Array
    obs: Array  # but for the entries of slow sensors
    window: Array  # `window.make_window` the block
    single_window: Array  # and of a row that is stepped by itself


def make_lane_buffers(count: int, n: int, entries: int) -> LaneBuffers:
    """The block of an env of `count` rows, n ticks a step and `entries` of an observation."""
    return LaneBuffers(
        np.arange(count),
        np.zeros(LANES, np.int64),
        np.zeros((PARAMS_WIDTH, LANES)),
        np.zeros((STATE_WIDTH, LANES)),
        np.zeros((2, LANES)),
        np.zeros((n, FAST_WIDTH, LANES)),
        np.zeros((_REPORT, LANES)),
        np.zeros((entries, LANES)),
        make_window(n, LANES),
        make_window(n),
    )


@noinline
def step_lanes(
    count: int, batch: BatchArrays, actions: Any, n: int, bounds: Any, buffers: LaneBuffers
) -> bool:
    """One env-step of the first `count` of the block's members, of one kind, whose actions are
    finite; False, and nothing is changed, where not all of them come to the step's end."""
    params, states = batch.params, batch.states
    for lane in range(count_lanes()):
        i = buffers.members[lane if lane < count else 0]  # spare lanes repeat the first
        for k in range(PARAMS_WIDTH):
            buffers.params[k, lane] = params[i, k]
        for k in range(_DYNAMIC_WIDTH):
            buffers.states[k, lane] = states[i, k]
        buffers.states[Z.driver, lane] = states[i, Z.driver]
        buffers.shares[0, lane], buffers.shares[1, lane] = clip_action(actions[i])
    first = buffers.members[0]
    variant = make_step_variant(params[first], batch.switches[first])
    precompute_lane_window(buffers.params, buffers.states, n, variant.has_driver, buffers.window)
    if has_overwrite(buffers.params, params.shape[1]):
        for lane in range(count_lanes()):
            i = buffers.members[lane if lane < count else 0]
            overwrite_steering(params[i], states[i], n, buffers.window[:, :, lane])
    done = integrate_step(
        buffers.params,
        buffers.states,
        variant,
        load_element(buffers.shares, 0),
        load_element(buffers.shares, 1),
        n,
        buffers.rows,
        buffers.reports,
        buffers.window,
        False,
    )
    if done == 0:
        return False
    refs, last = read(buffers.reports, _REFS), len(bounds[0]) - 2
    slow_start = observe_fast(buffers.rows, n, refs, bounds, batch.switches[first], buffers.obs)
    for lane in range(count):
        i = buffers.members[lane]
        for k in range(_DYNAMIC_WIDTH):
            states[i, k] = buffers.states[k, lane]
        states[i, Z.driver] = buffers.states[Z.driver, lane]
        for k in range(_REPORT):
            batch.reports[i, k] = buffers.reports[k, lane]
        for j in range(n):
            for k in range(FAST_WIDTH):
                batch.rows[i, j, k] = buffers.rows[j, k, lane]
        for k in range(slow_start):
            batch.obs[i, k] = buffers.obs[k, lane]
        for k in range(last, last + 2):
            batch.obs[i, k] = buffers.obs[k, lane]
        finish_slow_sensors(
            get_episode_arrays(batch, i), n, slow_start, bounds, buffers.window[:, :, lane]
        )
    return True
