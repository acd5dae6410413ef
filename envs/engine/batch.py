"""Env-steps and resets of a batch, its vehicles of one variant in SIMD lanes; compiled."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..numerics.jit import copy_into, jit, noinline
from ..numerics.packed import count_lanes, load_element, read
from ..numerics.primitives import Matrix, Vector
from ..numerics.simd import LANES
from ..record import FAST_WIDTH, Array
from ..task import REFUSED, REPORT, RUNNING
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH, Z
from .outputs import observe_fast
from .reset import reset_vehicle
from .step import (
    check_action_range,
    clip_action,
    finish_slow_sensors,
    integrate_step,
    make_step_variant,
    step_vehicle,
)
from .window import make_window, overwrite_steering, precompute_lane_window
from .workspace import EpisodeArrays, EpisodeStart

_REPORT, _REFS = len(REPORT), (REPORT.beta_ref, REPORT.gamma_ref)
_DYNAMIC_WIDTH = Z.slow[0].frames  # a tick changes the first numbers, and the driver's angle


class BatchArrays(NamedTuple):
    """The arrays of N episodes, a row for each."""

    params: Matrix  # (N, ...), the rest as in `EpisodeArrays`
    states: Matrix
    switches: Matrix
    obs: Matrix
    rows: Matrix
    packets: Matrix
    reports: Matrix
    ticks_done: Vector  # (N,), how many of `rows` are there
    delivered: Vector  # (N,), how many of `packets` are there
    over: Vector  # (N,) of bool: the episode has ended and was not reset yet


class RecordArrays(NamedTuple):
    """The records of N episodes."""

    rows: Matrix
    packets: Matrix
    ticks_done: Vector
    delivered: Vector


class _LaneBuffers(NamedTuple):
    """Working arrays of a batch step. A block is the rows in the lanes, its arrays' last axis."""

    order: npt.NDArray[np.int64]  # (N,), all rows, those of one variant next to each other
    members: npt.NDArray[np.int64]  # (lanes,), the rows in the lanes now
    params: Array
    states: Array
    shares: Array
    rows: Array
    reports: Array
    obs: Array  # but for the entries of slow sensors
    window: Array  # of the block
    single_window: Array  # of a row that is stepped by itself


def make_lane_buffers(count: int, n: int, entries: int) -> _LaneBuffers:
    """Make the working arrays of a batch step.

    Args:
        count: Number of rows.
        n: Ticks of a step.
        entries: Entries of an observation.

    Returns:
        Buffers, whose `order` is 0 .. count - 1.
    """
    return _LaneBuffers(
        np.arange(count), np.zeros(LANES, np.int64), np.zeros((PARAMS_WIDTH, LANES)),
        np.zeros((STATE_WIDTH, LANES)), np.zeros((2, LANES)), np.zeros((n, FAST_WIDTH, LANES)),
        np.zeros((_REPORT, LANES)), np.zeros((entries, LANES)), make_window(n, LANES),
        make_window(n),
    )  # fmt: skip


@jit
def _get_episode_arrays(batch: BatchArrays, i: int) -> EpisodeArrays:
    """Get the arrays of episode i of a batch."""
    return EpisodeArrays(
        batch.params[i], batch.states[i], batch.switches[i], batch.obs[i], batch.rows[i],
        batch.packets[i], batch.reports[i],
    )  # fmt: skip


@jit
def _get_episode_start(starts: EpisodeStart, i: int) -> EpisodeStart:
    """Get the start of one of several episodes."""
    return EpisodeStart(
        starts.params[i], starts.low[i], starts.high[i], starts.switches[i], starts.motion[i]
    )


@noinline
def _step_lanes(
    count: int, batch: BatchArrays, actions: Matrix, bounds: Matrix, buffers: _LaneBuffers
) -> bool:
    """Step the block's first `count` members; False, and nothing changes, where one ends early."""
    params, states, n = batch.params, batch.states, batch.rows.shape[1]
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
    for lane in range(count_lanes()):
        i = buffers.members[lane if lane < count else 0]
        overwrite_steering(params[i], states[i], n, buffers.window[:, :, lane])
    done = integrate_step(
        buffers.params, buffers.states, variant, load_element(buffers.shares, 0),
        load_element(buffers.shares, 1), n, buffers.rows, buffers.reports, buffers.window, False,
    )  # fmt: skip
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
            _get_episode_arrays(batch, i), n, slow_start, bounds, buffers.window[:, :, lane]
        )
    return True


_MAX_SCALAR = 2  # up to so many vehicles are stepped one by one


@jit
def step_rows(
    batch: BatchArrays, actions: Matrix, bounds: Matrix, results: tuple[Vector, Vector, Vector],
    buffers: _LaneBuffers,
) -> int:  # fmt: skip
    """Step every row by one env-step, and count the episodes that ended.

    Rows whose episode is `over` stand still with reward 0. Afterwards `over` is true only for rows
    that ended in this step: for those that stood still it is cleared before any reset.

    Args:
        batch: Arrays of the rows.
        actions: Fractions of full scale, float32 of shape (N, 1) or (N, 2).
        bounds: Bounds of the observation, shape (2, k).
        results: Rewards, terminated and truncated, shape (N,) each, which are written.
        buffers: Working arrays of the blocks.

    Returns:
        The count, with WILD added for an action beyond its limit. REFUSED, with nothing stepped, if
        an action is not finite in a row whose switch `fail_bad` is off.
    """
    n_ended, over = 0, batch.over
    rewards, terminated, truncated = results
    for i in range(len(over)):
        if batch.switches[i, FLAGS.fail_bad] == 0 and not over[i]:
            for share in actions[i]:
                if float(share) - float(share) != 0.0:  # not finite
                    return REFUSED
        if not over[i]:
            n_ended |= check_action_range(actions[i])
    n_pending, last = 0, len(over) - 1
    for m in range(len(over)):
        i = buffers.order[m]
        if not over[i]:
            share, _ = clip_action(actions[i])
            if share != share:
                batch.ticks_done[i] = _step_single(i, batch, actions, bounds, buffers)
                batch.obs[i, :] = 0.0
            else:
                buffers.members[n_pending] = i
                n_pending += 1
        if n_pending and (
            n_pending == count_lanes() or m == last or _has_variant_change(m, batch, buffers)
        ):
            is_vectorised = False
            if n_pending > _MAX_SCALAR:
                is_vectorised = _step_lanes(n_pending, batch, actions, bounds, buffers)
            for lane in range(n_pending):
                i = buffers.members[lane]
                if is_vectorised:
                    batch.ticks_done[i] = batch.rows.shape[1]
                else:
                    batch.ticks_done[i] = _step_single(i, batch, actions, bounds, buffers)
            n_pending = 0
    for i in range(len(over)):
        if over[i]:
            rewards[i], terminated[i], truncated[i], over[i] = 0.0, False, False, False
            continue
        report = batch.reports[i]
        batch.delivered[i] = int(report[REPORT.packets])
        rewards[i], terminated[i], truncated[i] = read_ends(report)
        over[i] = terminated[i] or truncated[i]
        if over[i]:
            n_ended += 1
    return n_ended


@jit
def read_ends(report: Vector) -> tuple[float, bool, bool]:
    """Read how a step ended from its report.

    Args:
        report: Report of the step, shape (len(StepReport),).

    Returns:
        (reward, terminated, truncated).
    """
    terminated = report[REPORT.failure] != RUNNING
    return -report[REPORT.cost], terminated, report[REPORT.ended] == 1.0 and not terminated


@jit
def _has_variant_change(m: int, batch: BatchArrays, buffers: _LaneBuffers) -> bool:
    """Whether the next row in order has another `StepVariant` than row m."""
    i, j = buffers.order[m], buffers.order[m + 1]
    flags, next_flags = batch.switches[i], batch.switches[j]
    return bool(
        make_step_variant(batch.params[i], flags) != make_step_variant(batch.params[j], next_flags)
    )


@jit
def _step_single(
    i: int, batch: BatchArrays, actions: Matrix, bounds: Matrix, buffers: _LaneBuffers
) -> int:
    """Step row i by itself; return the ticks done."""
    row, n = _get_episode_arrays(batch, i), batch.rows.shape[1]
    return int(step_vehicle(row, actions[i], n, bounds, buffers.single_window))


@jit
def reset_rows(
    chosen: Vector, start_index: Vector, starts: EpisodeStart, keys: Matrix, bounds: Matrix,
    batch: BatchArrays, final: RecordArrays,
) -> None:  # fmt: skip
    """Reset rows, whose records are first copied.

    Args:
        chosen: Indices of the rows, shape (M,).
        start_index: Index in `starts` of each row's start, shape (M,).
        starts: Packed starts of episodes, the first axis of each array.
        keys: Key of each row's episode, two words of 32 bits, shape (M, 2).
        bounds: Bounds of the observation, shape (2, k).
        batch: Arrays of all rows.
        final: Records of all rows, into which those of the chosen are copied.
    """
    for m in range(len(chosen)):
        i, t = chosen[m], start_index[m]
        for j in range(batch.ticks_done[i]):
            copy_into(batch.rows[i, j], final.rows[i, j])
        for j in range(batch.delivered[i]):
            copy_into(batch.packets[i, j], final.packets[i, j])
        final.ticks_done[i], final.delivered[i] = batch.ticks_done[i], batch.delivered[i]
        key_low, key_high = int(keys[m, 0]), int(keys[m, 1])
        reset_vehicle(
            _get_episode_start(starts, t), key_low, key_high, bounds, _get_episode_arrays(batch, i)
        )
        batch.ticks_done[i] = 1
        batch.delivered[i] = int(batch.reports[i, REPORT.packets])
