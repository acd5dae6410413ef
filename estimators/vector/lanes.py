"""The batch's part of an observation, compiled: filters of one shape by lanes, others alone.

A lane's tick is computed in its memory, as that of a filter alone is, where the model changes or a
row is not sound. So is every packet, and what is stored of a capture.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics.jit import jit, jit_nrt, noinline
from ...envs.numerics.packed import count_lanes, load_element, store_element
from ...envs.numerics.primitives import Matrix, Scalar, Vector, any_lane, maximum, minimum, select
from ...envs.numerics.simd import LANES
from ...envs.record import FAST, PACKET, Array
from ..core.covariance import correct_scalar, has_covariance, project
from ..core.filter import Observed, StepRecord, observe, run_tick
from ..core.late_samples import store_due_captures
from ..core.memory import N_SLOW, WINDOW, FilterLayers, FilterMemory, GainTables
from ..core.model import CURVATURE, is_finite
from ..core.packets import process_packet
from ..core.predict import (
    compute_residual,
    compute_signal,
    find_next_cell,
    is_speed_changed,
    propagate,
    read_fast_row,
)

LaneBlock = Any
"""One record of the dtype `batch.BLOCK`; `b` in compiled code."""
MIN_LANES = 4  # filters that are computed alone in less time than in lanes


class FilterBank(NamedTuple):
    """The filters of a batch, and the gains of all of them in one array."""

    filters: FilterLayers  # dtype `FILTER`, shape (N, layers)
    pool: Array  # gains, shape (total,)
    places: npt.NDArray[np.int64]  # offset, cells, rows and columns of each in the pool, (N, 4)


@jit_nrt
def _get_gains(bank: FilterBank, i: int) -> GainTables:
    """Return the table of gains of a filter, a view of shape (cells, rows, columns)."""
    place = bank.places[i]
    start, cells, height, width = place[0], place[1], place[2], place[3]
    return bank.pool[start : start + cells * height * width].reshape((cells, height, width))


@jit
def _load_model(b: LaneBlock, lane: int, f: FilterMemory) -> None:
    """Load what a filter's ticks read and do not write."""
    n, dense = f.n, f.dense
    for i in range(n):
        b.own_decay[i, lane], b.decay[i, lane] = f.own_decay[i], f.decay[i]
        b.drift[i, lane] = f.drift[i]
        for j in range(n):
            b.GT[i, j, lane] = f.GT[i, j]
        for j in range(i, n):
            b.Q[i, j, lane] = f.Q[i, j]
    for i in range(dense):
        for j in range(n):
            b.G[i, j, lane] = f.G[i, j]
    for i in range(n, f.total):
        b.own_decay[i, lane] = f.own_decay[i]
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
def _load_lane(b: LaneBlock, lane: int, f: FilterMemory) -> None:
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
def _load_states(b: LaneBlock, lane: int, f: FilterMemory) -> None:
    N = b.total
    for i in range(N):
        b.x[i, lane] = f.x[i]
    if has_covariance(b):
        for i in range(N):
            for j in range(i, N):
                b.P[i, j, lane] = f.P[i, j]


@jit
def _load_clock(b: LaneBlock, lane: int, f: FilterMemory) -> None:
    """Load the tick of the next capture."""
    first = np.inf
    for s in range(N_SLOW):
        if f.period[s] > 0:
            first = min(first, float(f.next[s]))
    b.next[lane] = first


@jit
def _store_lane(b: LaneBlock, lane: int, f: FilterMemory) -> None:
    """Store the state of a lane in its filter's memory."""
    _store_states(b, lane, f)
    for k in range(b.inputs):
        f.u[k] = b.u[k, lane]
    for i in range(b.fasts):
        f.y[i] = b.y[i, lane]
    f.speed, f.speed_before, f.road_turn = b.speed[lane], b.speed_before[lane], b.road_turn[lane]
    f.tick, f.at = b.tick[lane], b.at[lane]


@jit
def _store_states(b: LaneBlock, lane: int, f: FilterMemory) -> None:
    N = b.total
    for i in range(N):
        f.x[i] = b.x[i, lane]
    if has_covariance(b):
        for i in range(N):
            for j in range(i, N):
                f.P[i, j] = f.P[j, i] = b.P[i, j, lane]


@jit
def _store_lane_captures(b: LaneBlock, lane: int, f: FilterMemory) -> None:
    """Store in its memory what a lane's filter captured at its last tick; before the next one."""
    _store_states(b, lane, f)
    f.road_turn, f.speed_before = b.road_turn[lane], f.model_speed
    store_due_captures(f, b.tick[lane])
    _load_states(b, lane, f)
    _load_clock(b, lane, f)


@jit
def _read_rows(b: LaneBlock, first: int, fast: Matrix, j: int) -> None:
    """Read row j of each lane's filter into b.row."""
    for lane in range(count_lanes()):
        if b.here[lane] == 1.0:
            for k in range(b.columns):
                b.row[b.column[k], lane] = fast[first + lane, j, b.column[k]]
    store_element(b.now, load_element(b.now) + 1.0)


@jit
def _read_signals(b: LaneBlock) -> Any:
    """Read b.u_new (inputs) and b.y (measurements); return speeds and which ticks stand apart."""
    is_outlier = load_element(b.here) != 1.0  # lanes without a filter: masked below
    for i in range(b.inputs):
        store_element(b.u_new, compute_signal(b.row, b.u_column[i], b.u_factor[i]), i)
        is_outlier = is_outlier | (is_finite(load_element(b.u_new, i)) ^ True)
    for i in range(b.fasts):
        store_element(b.y, compute_signal(b.row, b.y_column[i], b.y_factor[i]), i)
        is_outlier = is_outlier | (is_finite(load_element(b.y, i)) ^ True)
    speed = load_element(b.speed)
    if b.measured == 1:
        wheel = 0.5 * (load_element(b.row, FAST.wheel_left) + load_element(b.row, FAST.wheel_right))
        speed = speed + load_element(b.smoothing) * (wheel - speed)
        is_outlier = is_outlier | (is_finite(wheel) ^ True)
        is_outlier = is_outlier | is_speed_changed(speed, load_element(b.model_speed))
    return speed, is_outlier & (load_element(b.here) == 1.0)


@jit
def _gather_gains(b: LaneBlock, first: int, bank: FilterBank) -> None:
    """Gather the periodic gains of this tick in b.K."""
    for lane in range(count_lanes()):
        if b.here[lane] == 1.0:
            place = bank.places[first + lane]
            row = b.cell[lane] * place[2] + 1 + b.at[lane] * maximum(b.fasts, 1)
            for k in range(b.fasts):
                for j in range(b.total):
                    b.K[k, j, lane] = bank.pool[place[0] + (row + k) * place[3] + j]


@jit
def _correct(b: LaneBlock, first: int, filters: Matrix) -> None:
    """Correct all lanes by their fast measurements; a residual that is not finite is skipped."""
    for i in range(b.fasts):
        residual = compute_residual(b, i)
        is_together = (load_element(b.apart) == 0.0) & (load_element(b.here) == 1.0)
        is_invalid = (is_finite(residual) ^ True) & is_together
        has_invalid = any_lane(is_invalid)
        if has_invalid:
            store_element(b.wild, select(is_invalid, 1.0, 0.0))
            for lane in range(count_lanes()):
                if b.wild[lane] == 1.0:
                    _store_lane(b, lane, filters[first + lane, 0])
        if has_covariance(b):
            variance = project(b, b.C_fast[i]) + load_element(b.r_fast, i)
            correct_scalar(b, variance, residual)
        else:
            for j in range(b.total):
                store_element(b.x, load_element(b.x, j) + load_element(b.K, i, j) * residual, j)
        if has_invalid:
            for lane in range(count_lanes()):
                if b.wild[lane] == 1.0:
                    _load_lane(b, lane, filters[first + lane, 0])


@jit
def _store_captures(b: LaneBlock, first: int, filters: Matrix) -> None:
    """Store what lanes that do this tick together captured at the last one."""
    if any_lane((load_element(b.now) > load_element(b.next)) & (load_element(b.here) == 1.0)):
        for lane in range(count_lanes()):
            is_due = b.now[lane] > b.next[lane]
            if is_due and b.here[lane] == 1.0 and b.apart[lane] == 0.0:
                _store_lane_captures(b, lane, filters[first + lane, 0])


@jit
def _step_lanes(b: LaneBlock, first: int, bank: FilterBank, speed: Scalar) -> None:
    """Step all lanes by one tick."""
    store_element(b.speed_before, load_element(b.model_speed))
    store_element(b.speed, speed)
    for k in range(b.inputs):
        store_element(b.u, load_element(b.u_new, k), k)
    if b.inputs > CURVATURE:
        turn = load_element(b.model_speed) * load_element(b.u, CURVATURE) * load_element(b.step)
        store_element(b.road_turn, load_element(b.road_turn) + turn)
    propagate(b, b.u)
    for lane in range(count_lanes()):
        b.tick[lane] += 1
        b.at[lane] = b.at[lane] + 1 if b.at[lane] + 1 < b.cycle else 0
    if b.stored > 0:
        for lane in range(count_lanes()):
            if b.here[lane] == 1.0 and b.apart[lane] == 0.0:
                f, slot = bank.filters[first + lane, 0], b.tick[lane] % WINDOW
                f.past_road_turn[slot] = b.road_turn[lane]
                for i in range(b.stored):
                    f.predicted[slot, i] = b.x[i, lane]
    if not has_covariance(b):
        _gather_gains(b, first, bank)
    _correct(b, first, bank.filters)


@jit
def _store_outliers(b: LaneBlock, first: int, bank: FilterBank, fast: Matrix, j: int) -> bool:
    """Store lanes that stand apart in their memory; False, unchanged, where gains are missing."""
    if not has_covariance(b):
        for lane in range(count_lanes()):
            if b.apart[lane] == 1.0:
                i = first + lane
                f, place = bank.filters[i, 0], bank.places[i]
                f.speed = b.speed[lane]
                cell = find_next_cell(f, fast[i, j])
                if bank.pool[place[0] + cell * place[2] * place[3]] == 0.0:
                    return False
    for lane in range(count_lanes()):
        if b.apart[lane] == 1.0:
            _store_lane(b, lane, bank.filters[first + lane, 0])
    return True


@noinline
def _step_filter(f: FilterMemory, gains: GainTables, row: Vector) -> None:
    """Step one filter by one tick."""
    read_fast_row(f, row)
    run_tick(f, gains)


@jit
def _step_outliers(b: LaneBlock, first: int, bank: FilterBank, fast: Matrix, j: int) -> None:
    """Step the lanes that stand apart in their memory, which the lanes take over."""
    for lane in range(count_lanes()):
        if b.apart[lane] == 1.0:
            i = first + lane
            _step_filter(bank.filters[i, 0], _get_gains(bank, i), fast[i, j])
            _load_lane(b, lane, bank.filters[i, 0])


@jit
def _set_next_due(b: LaneBlock, lane: int, packets: Matrix, count: int) -> None:
    """Set when the lane's next packet is taken; one that no tick of this call waits for is next."""
    k, due_tick = b.cursor[lane], np.inf
    if k < count:
        arrived = packets[k, PACKET.arrived]
        due_tick = arrived if b.now[lane] < arrived <= b.last[lane] else -np.inf
    b.due[lane] = due_tick


@jit
def _process_packets(
    b: LaneBlock, lane: int, f: FilterMemory, gains: GainTables, packets: Matrix, count: int
) -> None:
    """Process the packets of a lane's filter that are here now, in its memory."""
    k = b.cursor[lane]
    _store_lane(b, lane, f)
    while k < count and not (f.tick < packets[k, PACKET.arrived] <= b.last[lane]):
        process_packet(f, gains, packets[k])
        k += 1
    b.cursor[lane] = k
    _load_lane(b, lane, f)
    _set_next_due(b, lane, packets, count)


@jit_nrt
def _advance_block(
    b: LaneBlock, first: int, bank: FilterBank, fast: Matrix, rows: int, packets: Matrix,
    counts: Vector,
) -> int:  # fmt: skip
    """Advance filters that are `here` by `rows` rows; return fewer where one has no gains."""
    # first: filter in the first lane; fast (N, k, FAST_WIDTH), packets (N, capacity, PACKET_WIDTH)
    filters = bank.filters
    store_element(b.due, np.inf)
    for lane in range(count_lanes()):
        if b.here[lane] == 1.0:
            i = first + lane
            _load_lane(b, lane, filters[i, 0])
            b.cursor[lane], b.now[lane] = 0, float(b.tick[lane])
            b.last[lane] = b.tick[lane] + rows
            _set_next_due(b, lane, packets[i], counts[i])
    for j in range(rows):
        _read_rows(b, first, fast, j)
        speed, is_outlier = _read_signals(b)
        has_outlier = any_lane(is_outlier)
        store_element(b.apart, select(is_outlier, 1.0, 0.0))
        if has_outlier and not _store_outliers(b, first, bank, fast, j):
            rows = j
            break
        _store_captures(b, first, filters)
        _step_lanes(b, first, bank, speed)
        if has_outlier:
            _step_outliers(b, first, bank, fast, j)
        if any_lane(load_element(b.now) >= load_element(b.due)):
            for lane in range(count_lanes()):
                if b.here[lane] == 1.0 and b.now[lane] >= b.due[lane]:
                    i = first + lane
                    lane_args = filters[i, 0], _get_gains(bank, i), packets[i], counts[i]
                    _process_packets(b, lane, *lane_args)
    for lane in range(count_lanes()):
        if b.here[lane] == 1.0:
            f = filters[first + lane, 0]
            _store_lane(b, lane, f)
            f.cursor = b.cursor[lane]
    return rows


@jit
def _select_lanes(b: LaneBlock, first: int, filters: Matrix, done: Vector, rows: Vector) -> int:
    """Select the filters that do their rows in lanes into b.here; return how many rows all do."""
    n_rows, count = 0, 0
    for lane in range(count_lanes()):
        i = first + lane
        b.here[lane] = 0.0
        if i < len(filters) and done[i] == -1 and rows[i] > 0:
            f = filters[i, 0]
            is_ready = b.shaped[lane] == 1 and f.has_started == 1 and f.model_speed > 0.0
            if is_ready and (count == 0 or rows[i] == n_rows):
                b.here[lane], n_rows = 1.0, rows[i]
                count += 1
    return n_rows if count >= MIN_LANES else 0


@jit_nrt
def observe_batch(
    bank: FilterBank, done: Vector, lanes: Vector, record: StepRecord, observed: Observed
) -> int:
    """Call `observe` for every filter that has rows to do; return how many still have.

    Args:
        bank: Filters and gains.
        done: Rows done, -1 where a filter has not started, updated, shape (N,).
        lanes: Blocks of lanes, in which filters of one shape go.
        record: Records of N cars.
        observed: Observations and outputs of N cars.
    """
    fast, rows, packets, counts = record
    obs, table, beta, gamma, out, summary = observed
    filters, n_waiting = bank.filters, 0
    for first in range(0, len(filters), count_lanes()):  # without the compiler one by one
        b = lanes[first // LANES]
        n_rows, n_done = _select_lanes(b, first, filters, done, rows), 0
        if n_rows > 0:
            n_done = _advance_block(b, first, bank, fast, n_rows, packets, counts)
        for lane in range(minimum(count_lanes(), len(filters) - first)):
            i = first + lane
            if done[i] < rows[i]:
                f, gains = filters[i], _get_gains(bank, i)
                start = n_done if b.here[lane] == 1.0 else maximum(done[i], 0)
                outputs = Observed(obs[i], table, beta[i], gamma[i], out[i], summary[i])
                row_record = StepRecord(fast[i], rows[i], packets[i], counts[i])
                done[i] = observe(f, gains, row_record, start, outputs)
                n_waiting += 1 if done[i] < rows[i] else 0
    return n_waiting
