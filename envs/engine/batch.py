"""Env-steps and resets of a batch, its vehicles of one variant in SIMD lanes: `NumbaEngine`."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..numerics.jit import copy_into, jit, noinline
from ..numerics.packed import count_lanes, read, write
from ..numerics.primitives import Matrix, Vector
from ..numerics.simd import LANES
from ..record import FAST_WIDTH, PACKET_WIDTH, Array
from ..task import REFUSED, REPORT, RUNNING
from ..validation import Mask
from .config import EnvConfig
from .layout import FLAGS, PARAMS_WIDTH, EpisodeArrays, EpisodeStart, P, Z
from .outputs import finish_slow_sensors, observe_fast
from .reset import reset_vehicle
from .step import (
    SHARES,
    check_action_range,
    clip_action,
    integrate_step,
    make_step_variant,
    step_vehicle,
)
from .window import overwrite_steering, precompute_lane_window

IntArray = npt.NDArray[np.int64]
_REPORT, _REFS = len(REPORT), (REPORT.beta_ref, REPORT.gamma_ref)
_MAX_SCALAR = 2  # up to so many vehicles are stepped one by one
# How many parameters ticks read, and how many numbers of the state they change besides the driver's
# angle: in an ideal world, and in one with errors.
_TICK_PARAMS = (P.errors[0], P.slow[0].period)
_TICK_STATE = (Z.errors[0], Z.slow[0].frames)


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

    @property
    def record(self) -> "RecordArrays":
        """The newest records."""
        return RecordArrays(self.rows, self.packets, self.ticks_done, self.delivered)


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
    block: EpisodeArrays  # without packets, and without the observation's entries of slow sensors
    shares: Array
    window: Array  # of a row that is stepped by itself


@jit
def _get_arrays(batch: BatchArrays, i: int, bounds: Matrix, window: Matrix) -> EpisodeArrays:
    """Get the arrays of episode i of a batch."""
    return EpisodeArrays(
        batch.params[i], batch.states[i], batch.switches[i], batch.obs[i], batch.rows[i],
        batch.packets[i], batch.reports[i], bounds, window,
    )  # fmt: skip


@noinline
def _step_lanes(count: int, batch: BatchArrays, actions: Matrix, buffers: _LaneBuffers) -> bool:
    """Step the block's first `count` members; False, and nothing changes, where one ends early."""
    params, states, n, block = batch.params, batch.states, batch.rows.shape[1], buffers.block
    first, bounds = buffers.members[0], block.bounds
    copy_into(batch.switches[first], block.switches)
    variant = make_step_variant(params[first], block.switches)
    n_params, n_state = _TICK_PARAMS[variant.has_errors], _TICK_STATE[variant.has_errors]
    for lane in range(count_lanes()):
        i = buffers.members[lane if lane < count else 0]  # spare lanes repeat the first
        for k in range(n_params):
            block.p[k, lane] = params[i, k]
        for k in range(n_state):
            block.z[k, lane] = states[i, k]
        block.z[Z.driver, lane] = states[i, Z.driver]
        write(buffers.shares, clip_action(actions[i]), SHARES, lane)
    precompute_lane_window(block, n, variant)
    for lane in range(count_lanes()):
        i = buffers.members[lane if lane < count else 0]
        window = block.window[:, :, lane]
        overwrite_steering(_get_arrays(batch, i, bounds, window), n)
    if integrate_step(block, variant, read(buffers.shares, SHARES), n, False) == 0:
        return False
    refs, last = read(block.report, _REFS), len(bounds[0]) - 2
    slow_start = observe_fast(block, n, refs)
    for lane in range(count):
        i = buffers.members[lane]
        row = _get_arrays(batch, i, bounds, block.window[:, :, lane])
        for k in range(n_state):
            states[i, k] = block.z[k, lane]
        states[i, Z.driver] = block.z[Z.driver, lane]
        for k in range(_REPORT):
            batch.reports[i, k] = block.report[k, lane]
        for j in range(n):
            for k in range(FAST_WIDTH):
                batch.rows[i, j, k] = block.rows[j, k, lane]
        for k in range(slow_start):
            batch.obs[i, k] = block.obs[k, lane]
        for k in range(last, last + 2):
            batch.obs[i, k] = block.obs[k, lane]
        finish_slow_sensors(row, n, slow_start)
    return True


@jit
def _step_rows(
    batch: BatchArrays, actions: Matrix, results: tuple[Vector, Vector, Vector],
    buffers: _LaneBuffers,
) -> int:  # fmt: skip
    """Step every row as `NumbaEngine.step` says; `results` are written."""
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
            share = clip_action(actions[i])[0]
            if share != share:
                batch.ticks_done[i] = _step_single(i, batch, actions, buffers)
                batch.obs[i, :] = 0.0
            else:
                buffers.members[n_pending] = i
                n_pending += 1
        if n_pending and (
            n_pending == count_lanes() or m == last or _has_variant_change(m, batch, buffers)
        ):
            is_wide = n_pending > _MAX_SCALAR and _step_lanes(n_pending, batch, actions, buffers)
            for lane in range(n_pending):
                i, n = buffers.members[lane], batch.rows.shape[1]
                batch.ticks_done[i] = n if is_wide else _step_single(i, batch, actions, buffers)
            n_pending = 0
    for i in range(len(over)):
        if over[i]:
            rewards[i], terminated[i], truncated[i], over[i] = 0.0, False, False, False
            continue
        report = batch.reports[i]
        batch.delivered[i] = int(report[REPORT.packets])
        rewards[i], terminated[i], truncated[i] = read_ends(report)
        over[i] = terminated[i] or truncated[i]
        n_ended += int(over[i])
    return n_ended


@jit
def read_ends(report: Vector) -> tuple[float, bool, bool]:
    """Read how a step ended from its report: (reward, terminated, truncated).

    Args:
        report: Report of the step, shape (len(StepReport),).
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
def _step_single(i: int, batch: BatchArrays, actions: Matrix, buffers: _LaneBuffers) -> int:
    """Step row i by itself; return the ticks done."""
    row = _get_arrays(batch, i, buffers.block.bounds, buffers.window)
    return int(step_vehicle(row, actions[i], batch.rows.shape[1]))


@jit
def _reset_rows(
    chosen: Vector, start_index: Vector, starts: EpisodeStart, keys: Matrix, batch: BatchArrays,
    final: RecordArrays, buffers: _LaneBuffers,
) -> None:  # fmt: skip
    """Reset rows `chosen` (M,) with keys (M, 2) of 32 bits; their records are copied to `final`."""
    for m in range(len(chosen)):
        i, t = chosen[m], start_index[m]
        for j in range(batch.ticks_done[i]):
            copy_into(batch.rows[i, j], final.rows[i, j])
        for j in range(batch.delivered[i]):
            copy_into(batch.packets[i, j], final.packets[i, j])
        final.ticks_done[i], final.delivered[i] = batch.ticks_done[i], batch.delivered[i]
        key_low, key_high = int(keys[m, 0]), int(keys[m, 1])
        row = _get_arrays(batch, i, buffers.block.bounds, buffers.window)
        start = EpisodeStart(
            starts.params[t], starts.low[t], starts.high[t], starts.switches[t], starts.motion[t]
        )
        reset_vehicle(start, key_low, key_high, row)
        batch.ticks_done[i], batch.delivered[i] = 1, int(batch.reports[i, REPORT.packets])


def _pad_params(params: Array, width: int) -> Array:
    """Pad packed parameters to (width,): a trace repeats its last angle, others append zeros."""
    has_trace = len(params) > PARAMS_WIDTH
    return np.pad(params, (0, width - len(params)), "edge" if has_trace else "constant")


class NumbaEngine:
    """N episodes in compiled code, those of one variant in SIMD lanes.

    Args:
        config: Config of the rows, which differ in scenario and vehicles alone.
        count: Number of rows N.

    Attributes:
        arrays: The rows' arrays.
        final: The rows' records before their newest reset.
        lane_buffers: Working arrays of a step.
    """

    def __init__(self, config: EnvConfig, count: int) -> None:
        one = config.make_arrays()  # all have its bounds, and write its window in turn
        numbers = [np.zeros((count, *array.shape), array.dtype) for array in one[:-2]]
        ticks_done, delivered = np.zeros((2, count), np.int64)
        self.arrays = BatchArrays._make([*numbers, ticks_done, delivered, np.zeros(count, bool)])
        self.final = RecordArrays(*(array.copy() for array in self.arrays.record))
        names = "p", "z", "obs", "rows", "report", "window"
        widened = {name: np.zeros((*getattr(one, name).shape, LANES)) for name in names}
        block = one._replace(packets=np.zeros((0, PACKET_WIDTH)), **widened)
        members, shares = np.zeros(LANES, np.int64), np.zeros((len(SHARES), LANES))
        self.lane_buffers = _LaneBuffers(np.arange(count), members, block, shares, one.window)

    def reset(
        self, chosen: IntArray, starts: Sequence[EpisodeStart], index: IntArray,
        keys: npt.NDArray[np.uint64],
    ) -> None:  # fmt: skip
        """Reset rows.

        Args:
            chosen: The rows, shape (M,).
            starts: Starts of their episodes.
            index: Index of each one's start, shape (M,).
            keys: Key of each one's episode, shape (M,).
        """
        words = np.stack([keys & 0xFFFFFFFF, keys >> 32], 1).astype(np.int64)
        params = self.arrays.params
        width = max(params.shape[1], *(len(start.params) for start in starts))
        if width > params.shape[1]:  # for a trace
            params = np.array([_pad_params(row, width) for row in params])
            self.arrays = self.arrays._replace(params=params)
        packed = [start._replace(params=_pad_params(start.params, width)) for start in starts]
        stacked = EpisodeStart(*map(np.stack, zip(*packed, strict=True)))
        _reset_rows(chosen, index, stacked, words, self.arrays, self.final, self.lane_buffers)
        self.arrays.over[chosen] = False
        self._group_by_variant()

    def step(self, commands: npt.NDArray[np.float32], results: tuple[Array, Mask, Mask]) -> int:
        """Step all rows by one env-step.

        Rows whose episode is `over` stand still with reward 0. Afterwards `over` is true only for
        rows that ended in this step: where they stood still it is cleared before any reset.

        Args:
            commands: Fractions of full scale, shape (N, width).
            results: Rewards, terminated and truncated, shape (N,) each, which are written.

        Returns:
            Number of episodes that ended, with WILD added for an action beyond its limit. REFUSED,
            with nothing stepped, if an action is not finite in a row that does not fail by it.
        """
        return _step_rows(self.arrays, commands, results, self.lane_buffers)

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """Restore arrays.

        Args:
            arrays: Copies of `BatchArrays`, by name.
        """
        self.arrays = self.arrays._replace(params=arrays["params"].copy())
        for name, array in self.arrays._asdict().items():
            array[:] = arrays[name]
        self._group_by_variant()

    def _group_by_variant(self) -> None:
        """Sort rows of the same variant next to each other in the lanes' order."""
        lags = self.arrays.params[:, [P.motor.start, P.steering.start]] > 0.0
        variants, order = np.hstack([self.arrays.switches, lags]), self.lane_buffers.order
        is_mixed = (variants != variants[0]).any()
        order[:] = np.lexsort(variants.T) if is_mixed else np.arange(len(order))
