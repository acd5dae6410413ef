"""The ticks of a block of filters, by lanes, and the pool of their tables of gains.

A lane's tick is computed by its record, as that of a filter alone is, where the model changes or a
row is not sound. So is every packet, and what is stored of a capture.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.numerics.jit import jit, jit_nrt, noinline
from ...envs.numerics.packed import count_lanes, load_element, store_element
from ...envs.numerics.primitives import Matrix, Scalar, Vector, any_lane, maximum, minimum, select
from ...envs.numerics.simd8 import prefetch
from ...envs.record import FAST, FAST_WIDTH, PACKET, Array
from ..core.covariance import correct_scalar, project
from ..core.filter import run_tick
from ..core.model import (
    CURVATURE,
    LATERAL,
    compute_road_turn,
    find_next_cell,
    is_finite,
    is_speed_changed,
    smooth_speed,
)
from ..core.packets import process_packet
from ..core.predict import compute_residual, compute_signal, propagate, read_fast_row
from ..core.record import X_OFFSET, FilterRecord, GainTables
from ..estimator import Estimator
from ..wrappers.estimate import AnyEstimator, EstimatorSpec
from .lanes import LaneBlock, load_lane, store_captures, store_lane, store_prediction

Build = Callable[[EstimatorSpec], AnyEstimator]


@jit_nrt
def get_gains(pool: Vector, place: Vector) -> Any:
    """Return the table of gains at a place in the pool.

    Args:
        pool: Gains of all filters in one array, shape (total,).
        place: Offset, cells, rows and columns, shape (4,).

    Returns:
        View of shape (cells, rows, columns).
    """
    start, cells, height, width = place[0], place[1], place[2], place[3]
    return pool[start : start + cells * height * width].reshape((cells, height, width))


class GainPool:
    """Estimators by the design of their specs, and their gains in one flat array, the pool.

    Args:
        build: Function that builds one estimator from its spec.
    """

    def __init__(self, build: Build) -> None:
        self._build = build
        self._estimators: dict[Any, Estimator] = {}
        self._places: dict[Any, tuple[int, ...]] = {}
        self.pool = np.zeros(0)

    def __getitem__(self, design: Any) -> Estimator:
        return self._estimators[design]

    def get_estimator(self, spec: EstimatorSpec) -> Estimator:
        """Return the estimator for a spec, built unless it is at hand.

        Args:
            spec: Vehicle, sensors and speed.

        Returns:
            An estimator of the spec's design.

        Raises:
            TypeError: The factory builds an `Estimator` for other specs, but not for this one.
        """
        design = spec.design
        if design not in self._estimators:
            estimator = self._build(spec)
            if not isinstance(estimator, Estimator):
                raise TypeError(
                    f"a batch is of filters of ours or of none, got {estimator!r} as well"
                )
            self._estimators[design] = estimator
        return self._estimators[design]

    def gains(self, design: Any) -> Array:
        """Return the table of a design, to be read and written in the pool.

        Args:
            design: `EstimatorSpec.design`.

        Returns:
            View of shape (cells, rows, columns).
        """
        start, *shape = self._places[design]
        return self.pool[start : start + int(np.prod(shape))].reshape(shape)

    def place(self, used_keys: Sequence[Any]) -> npt.NDArray[np.int64]:
        """Lay the gains of the designs in use side by side in a new pool and drop the others.

        Args:
            used_keys: Design of each row, N of them.

        Returns:
            Offset and shape of each row's table, shape (N, 4).
        """
        self._estimators = {design: self._estimators[design] for design in dict.fromkeys(used_keys)}
        tables = [
            self.gains(design) if design in self._places else estimator.gains
            for design, estimator in self._estimators.items()
        ]
        ends = np.cumsum([table.size for table in tables])
        self.pool = np.concatenate([table.ravel() for table in tables])
        self._places = {
            design: (int(end) - table.size, *table.shape)
            for design, table, end in zip(self._estimators, tables, ends, strict=True)
        }
        return np.array([self._places[design] for design in used_keys], np.int64)


@jit
def _fetch_next(b: LaneBlock, first: int, filters: Matrix, fast: Any, j: int, rows: int) -> None:
    """Have the caches fetch row j of the next block, from filter `first` on, and some states."""
    last = minimum(first + count_lanes(), len(filters))
    for i in range(first, last):
        for k in range(0, FAST_WIDTH, 5):  # a row lies on two cache lines or three
            prefetch(fast, i, j, k)
    for lane in range(count_lanes() * j // rows, count_lanes() * (j + 1) // rows):
        if first + lane < last:
            f = filters[first + lane, 0]
            for k in range(0, X_OFFSET + b.total, 8):
                prefetch(f.padding, k)
            for i in range(b.total if b.periodic == 0 else 0):
                for k in range(0, b.total, 8):
                    prefetch(f.P, i, k)


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
        wheel_speed = 0.5 * (
            load_element(b.row, FAST.wheel_left) + load_element(b.row, FAST.wheel_right)
        )
        speed = smooth_speed(speed, wheel_speed, load_element(b.smoothing))
        is_outlier = (
            is_outlier
            | (is_finite(wheel_speed) ^ True)
            | is_speed_changed(speed, load_element(b.model_speed))
        )
    return speed, is_outlier & (load_element(b.here) == 1.0)


@jit
def _gather_gains(b: LaneBlock, first: int, pool: Vector, places: Any) -> None:
    """Gather the periodic gains of this tick in b.K."""
    for lane in range(count_lanes()):
        if b.here[lane] == 1.0:
            place = places[first + lane]
            row = b.cell[lane] * place[2] + 1 + b.at[lane] * maximum(b.fasts, 1)
            for k in range(b.fasts):
                for j in range(b.total):
                    b.K[k, j, lane] = pool[place[0] + (row + k) * place[3] + j]


@jit
def _correct(b: LaneBlock, first: int, filters: Matrix) -> None:
    """Correct all lanes by their fast measurements; a residual that is not finite is skipped."""
    for i in range(b.fasts):
        residual = compute_residual(b, i)
        is_invalid = (
            (is_finite(residual) ^ True)
            & (load_element(b.apart) == 0.0)
            & (load_element(b.here) == 1.0)
        )
        has_invalid = any_lane(is_invalid)
        if has_invalid:
            store_element(b.wild, select(is_invalid, 1.0, 0.0))
            for lane in range(count_lanes()):
                if b.wild[lane] == 1.0:
                    store_lane(b, lane, filters[first + lane, 0])
        if b.periodic == 1:
            for j in range(b.total):
                store_element(b.x, load_element(b.x, j) + load_element(b.K, i, j) * residual, j)
        else:
            variance = project(b, b.C_fast[i]) + load_element(b.r_fast, i)
            correct_scalar(b, variance, residual)
        if has_invalid:
            for lane in range(count_lanes()):
                if b.wild[lane] == 1.0:
                    load_lane(b, lane, filters[first + lane, 0])


@jit
def _store_captures(b: LaneBlock, first: int, filters: Matrix) -> None:
    """Store what lanes that do this tick together captured at the last one."""
    if any_lane((load_element(b.now) > load_element(b.next)) & (load_element(b.here) == 1.0)):
        for lane in range(count_lanes()):
            is_due = b.now[lane] > b.next[lane]
            if is_due and b.here[lane] == 1.0 and b.apart[lane] == 0.0:
                store_captures(b, lane, filters[first + lane, 0])


@jit
def _step_lanes(
    b: LaneBlock, first: int, filters: Matrix, pool: Vector, places: Any, speed: Any
) -> None:
    """Step all lanes by one tick."""
    store_element(b.speed_before, load_element(b.model_speed))
    store_element(b.speed, speed)
    for k in range(b.inputs):
        store_element(b.u, load_element(b.u_new, k), k)
    if b.kind == LATERAL and b.inputs > CURVATURE:
        turn = compute_road_turn(
            load_element(b.model_speed), load_element(b.u, CURVATURE), load_element(b.step)
        )
        store_element(b.road_turn, load_element(b.road_turn) + turn)
    propagate(b, b.u)
    for lane in range(count_lanes()):
        b.tick[lane] += 1
        b.at[lane] = b.at[lane] + 1 if b.at[lane] + 1 < b.cycle else 0
    if b.store_predictions == 1:
        for lane in range(count_lanes()):
            if b.here[lane] == 1.0 and b.apart[lane] == 0.0:
                store_prediction(b, lane, filters[first + lane, 0])
    if b.periodic == 1:
        _gather_gains(b, first, pool, places)
    _correct(b, first, filters)


@jit
def _average_wheel_speed(row: Vector) -> Scalar:
    return 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])


@jit
def _store_outliers(
    b: LaneBlock, first: int, filters: Matrix, pool: Vector, places: Any, fast: Matrix, j: int
) -> bool:
    """Store lanes that stand apart in their records; False, unchanged, where gains are missing."""
    if b.periodic == 1:
        for lane in range(count_lanes()):
            if b.apart[lane] == 1.0:
                i = first + lane
                f = filters[i, 0]
                f.speed = b.speed[lane]
                cell = find_next_cell(f, _average_wheel_speed(fast[i, j]))
                if pool[places[i, 0] + cell * places[i, 2] * places[i, 3]] == 0.0:
                    return False
    for lane in range(count_lanes()):
        if b.apart[lane] == 1.0:
            store_lane(b, lane, filters[first + lane, 0])
    return True


@noinline
def _step_filter(f: FilterRecord, gains: GainTables, row: Vector) -> None:
    """Step one filter by one tick."""
    read_fast_row(f, row, _average_wheel_speed(row))
    run_tick(f, gains)


@jit
def _step_outliers(
    b: LaneBlock, first: int, filters: Matrix, pool: Vector, places: Any, fast: Matrix, j: int
) -> None:
    """Step the lanes that stand apart by their records, which the lanes take over."""
    for lane in range(count_lanes()):
        if b.apart[lane] == 1.0:
            i = first + lane
            _step_filter(filters[i, 0], get_gains(pool, places[i]), fast[i, j])
            load_lane(b, lane, filters[i, 0])


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
    b: LaneBlock, lane: int, f: FilterRecord, gains: GainTables, packets: Matrix, count: int
) -> None:
    """Process the packets of a lane's filter that are here now, by its record."""
    k = b.cursor[lane]
    store_lane(b, lane, f)
    while k < count and not (f.tick < packets[k, PACKET.arrived] <= b.last[lane]):
        process_packet(f, gains, packets[k])
        k += 1
    b.cursor[lane] = k
    load_lane(b, lane, f)
    _set_next_due(b, lane, packets, count)


@jit_nrt
def advance_block(
    b: LaneBlock,
    first: int,
    filters: Matrix,
    pool: Vector,
    places: Any,
    fast: Matrix,
    rows: int,
    packets: Matrix,
    counts: Vector,
) -> int:
    """Advance the filters that are `here` from their first row on, as `core.filter.advance` does.

    Args:
        b: Block of lanes.
        first: Index of the filter in the first lane.
        filters: Memories, dtype `FILTER`, shape (N, layers).
        pool: Gains of all filters in one array, shape (total,).
        places: Place of each filter's gains in the pool, shape (N, 4).
        fast: Fast rows, shape (N, k, FAST_WIDTH).
        rows: Number of fast rows, equal for these filters.
        packets: Packets, shape (N, capacity, PACKET_WIDTH).
        counts: Number of packets of each filter, shape (N,).

    Returns:
        Number of rows done by all alike: fewer than `rows` where one of them has no gains.
    """
    store_element(b.due, np.inf)
    for lane in range(count_lanes()):
        if b.here[lane] == 1.0:
            i = first + lane
            load_lane(b, lane, filters[i, 0])
            b.cursor[lane], b.now[lane] = 0, float(b.tick[lane])
            b.last[lane] = b.tick[lane] + rows
            _set_next_due(b, lane, packets[i], counts[i])
    for j in range(rows):
        _fetch_next(b, first + count_lanes(), filters, fast, j, rows)
        _read_rows(b, first, fast, j)
        speed, is_outlier = _read_signals(b)
        has_outlier = any_lane(is_outlier)
        store_element(b.apart, select(is_outlier, 1.0, 0.0))
        if has_outlier and not _store_outliers(b, first, filters, pool, places, fast, j):
            rows = j
            break
        _store_captures(b, first, filters)
        _step_lanes(b, first, filters, pool, places, speed)
        if has_outlier:
            _step_outliers(b, first, filters, pool, places, fast, j)
        if any_lane(load_element(b.now) >= load_element(b.due)):
            for lane in range(count_lanes()):
                if b.here[lane] == 1.0 and b.now[lane] >= b.due[lane]:
                    i = first + lane
                    lane_args = filters[i, 0], get_gains(pool, places[i]), packets[i]
                    _process_packets(b, lane, *lane_args, counts[i])
    for lane in range(count_lanes()):
        if b.here[lane] == 1.0:
            f = filters[first + lane, 0]
            store_lane(b, lane, f)
            f.cursor = b.cursor[lane]
    return rows
