"""The ticks of a block of filters: what all do in lanes, and by its record what one alone does.

A lane's tick is computed by its record, as that of a filter alone is, where the model changes or a
row is not sound. So is every packet, and what is stored of a capture.
"""

from typing import Any

import numpy as np

from ...envs.backend.arrays import at, lane_count, put
from ...envs.backend.decorators import apart, counted, jit
from ...envs.backend.eights import prefetch
from ...envs.backend.primitives import anywhere, maximum, minimum, select
from ...envs.record import FAST, FAST_WIDTH, PACKET
from ..core.covariance import condition, project
from ..core.fast import propagate, read, residual_of, signal
from ..core.memory import OFTEN, Gains, Memory, Row
from ..core.packets import receive
from ..core.run import tick
from ..core.speed import finite, low_passed, next_cell, off
from ..core.transition import CURVATURE, LATERAL, road_turned
from .designs import gains_of
from .lanes import Block, capture, load, remember_prediction, store


@jit
def _fetch_next(b: Block, first: int, filters: Any, fast: Any, j: int, rows: int) -> None:
    """Have the caches fetch what the next block, of the filters from `first` on, reads at tick j,
    and its share of their states."""
    last = minimum(first + lane_count(), len(filters))
    for i in range(first, last):
        for k in range(0, FAST_WIDTH, 5):  # a row lies on two cache lines or three
            prefetch(fast, i, j, k)
    for lane in range(lane_count() * j // rows, lane_count() * (j + 1) // rows):
        if first + lane < last:
            f = filters[first + lane, 0]
            for k in range(0, OFTEN + b.total, 8):
                prefetch(f.ahead, k)
            for i in range(b.total if b.periodic == 0 else 0):
                for k in range(0, b.total, 8):
                    prefetch(f.P, i, k)


@jit
def _read(b: Block, first: int, fast: Any, j: int) -> None:
    """Row j of each lane's filter into b.row."""
    for lane in range(lane_count()):
        if b.here[lane] == 1.0:
            for k in range(b.columns):
                b.row[b.column[k], lane] = fast[first + lane, j, b.column[k]]
    put(b.now, at(b.now) + 1.0)


@jit
def _sense(b: Block) -> Any:
    """Inputs into b.u_new, measurements into b.y; (speeds, whether a lane's tick stands apart)."""
    odd = at(b.here) != 1.0  # nowhere, as far as anybody looks at it
    for i in range(b.inputs):
        put(b.u_new, signal(b.row, b.u_column[i], b.u_factor[i]), i)
        odd = odd | (finite(at(b.u_new, i)) ^ True)
    for i in range(b.fasts):
        put(b.y, signal(b.row, b.y_column[i], b.y_factor[i]), i)
        odd = odd | (finite(at(b.y, i)) ^ True)
    speed = at(b.speed)
    if b.measured == 1:
        now = 0.5 * (at(b.row, FAST.wheel_left) + at(b.row, FAST.wheel_right))
        speed = low_passed(speed, now, at(b.smoothing))
        odd = odd | (finite(now) ^ True) | off(speed, at(b.model_speed))
    return speed, odd & (at(b.here) == 1.0)


@jit
def _gather(b: Block, first: int, pool: Row, places: Any) -> None:
    """The periodic gains of this tick into b.K."""
    for lane in range(lane_count()):
        if b.here[lane] == 1.0:
            place = places[first + lane]
            row = b.cell[lane] * place[2] + 1 + b.at[lane] * maximum(b.fasts, 1)
            for k in range(b.fasts):
                for j in range(b.total):
                    b.K[k, j, lane] = pool[place[0] + (row + k) * place[3] + j]


@jit
def _correct(b: Block, first: int, filters: Any) -> None:
    """The fast measurements of all lanes; a lane whose residual is not finite stays as it is."""
    for i in range(b.fasts):
        residual = residual_of(b, i)
        wild = (finite(residual) ^ True) & (at(b.apart) == 0.0) & (at(b.here) == 1.0)
        some = anywhere(wild)
        if some:
            put(b.wild, select(wild, 1.0, 0.0))
            for lane in range(lane_count()):
                if b.wild[lane] == 1.0:
                    store(b, lane, filters[first + lane, 0])
        if b.periodic == 1:
            for j in range(b.total):
                put(b.x, at(b.x, j) + at(b.K, i, j) * residual, j)
        else:
            variance = project(b, b.C_fast[i]) + at(b.r_fast, i)
            condition(b, variance, residual)
        if some:
            for lane in range(lane_count()):
                if b.wild[lane] == 1.0:
                    load(b, lane, filters[first + lane, 0])


@jit
def _capture(b: Block, first: int, filters: Any) -> None:
    """What lanes that do this tick together captured at the last one."""
    if anywhere((at(b.now) > at(b.next)) & (at(b.here) == 1.0)):
        for lane in range(lane_count()):
            due = b.now[lane] > b.next[lane]
            if due and b.here[lane] == 1.0 and b.apart[lane] == 0.0:
                capture(b, lane, filters[first + lane, 0])


@jit
def _together(b: Block, first: int, filters: Any, pool: Row, places: Any, speed: Any) -> None:
    """A tick of all lanes."""
    put(b.speed_before, at(b.model_speed))
    put(b.speed, speed)
    for k in range(b.inputs):
        put(b.u, at(b.u_new, k), k)
    if b.kind == LATERAL and b.inputs > CURVATURE:
        turn = road_turned(at(b.model_speed), at(b.u, CURVATURE), at(b.step))
        put(b.road_turn, at(b.road_turn) + turn)
    propagate(b, b.u)
    for lane in range(lane_count()):
        b.tick[lane] += 1
        b.at[lane] = b.at[lane] + 1 if b.at[lane] + 1 < b.cycle else 0
    if b.store_predictions == 1:
        for lane in range(lane_count()):
            if b.here[lane] == 1.0 and b.apart[lane] == 0.0:
                remember_prediction(b, lane, filters[first + lane, 0])
    if b.periodic == 1:
        _gather(b, first, pool, places)
    _correct(b, first, filters)


@jit
def _speed_of(row: Row) -> Any:
    return 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])


@jit
def _leave(b: Block, first: int, filters: Any, pool: Any, places: Any, fast: Any, j: int) -> bool:
    """Lanes whose tick stands apart into their records; False, and nothing is changed, where the
    gains of one of them are missing."""
    if b.periodic == 1:
        for lane in range(lane_count()):
            if b.apart[lane] == 1.0:
                i = first + lane
                f = filters[i, 0]
                f.speed = b.speed[lane]
                cell = next_cell(f, _speed_of(fast[i, j]))
                if pool[places[i, 0] + cell * places[i, 2] * places[i, 3]] == 0.0:
                    return False
    for lane in range(lane_count()):
        if b.apart[lane] == 1.0:
            store(b, lane, filters[first + lane, 0])
    return True


@apart
def _tick_apart(f: Memory, gains: Gains, row: Row) -> None:
    """A tick of a filter alone."""
    read(f, row, _speed_of(row))
    tick(f, gains)


@jit
def _return(b: Block, first: int, filters: Any, pool: Any, places: Any, fast: Any, j: int) -> None:
    """The tick of the lanes that stand apart, by their records, which the lanes take over."""
    for lane in range(lane_count()):
        if b.apart[lane] == 1.0:
            i = first + lane
            _tick_apart(filters[i, 0], gains_of(pool, places[i]), fast[i, j])
            load(b, lane, filters[i, 0])


@jit
def _await(b: Block, lane: int, packets: Any, count: int) -> None:
    """When the lane's next packet is taken; one that no tick of this call waits for at the next."""
    k, due = b.cursor[lane], np.inf
    if k < count:
        arrived = packets[k, PACKET.arrived]
        due = arrived if b.now[lane] < arrived <= b.last[lane] else -np.inf
    b.due[lane] = due


@jit
def _receive(b: Block, lane: int, f: Memory, gains: Gains, packets: Any, count: int) -> None:
    """The packets of a lane's filter that are here now, by its record."""
    k = b.cursor[lane]
    store(b, lane, f)
    while k < count and not (f.tick < packets[k, PACKET.arrived] <= b.last[lane]):
        receive(f, gains, packets[k])
        k += 1
    b.cursor[lane] = k
    load(b, lane, f)
    _await(b, lane, packets, count)


@counted
def advance_block(
    b: Block,
    first: int,
    filters: Any,
    pool: Any,
    places: Any,
    fast: Any,
    rows: int,
    packets: Any,
    counts: Any,
) -> int:
    """`core.run.advance` from their first row on of the filters that are `here`.

    first: the filter of the first lane. filters, places, fast, packets, counts: as in
    `kernel.observe_batch`. Returns the rows done, of all alike: fewer than `rows` where one of them
    has no gains.
    """
    put(b.due, np.inf)
    for lane in range(lane_count()):
        if b.here[lane] == 1.0:
            i = first + lane
            load(b, lane, filters[i, 0])
            b.cursor[lane], b.now[lane] = 0, float(b.tick[lane])
            b.last[lane] = b.tick[lane] + rows
            _await(b, lane, packets[i], counts[i])
    for j in range(rows):
        _fetch_next(b, first + lane_count(), filters, fast, j, rows)
        _read(b, first, fast, j)
        speed, odd = _sense(b)
        some = anywhere(odd)
        put(b.apart, select(odd, 1.0, 0.0))
        if some and not _leave(b, first, filters, pool, places, fast, j):
            rows = j
            break
        _capture(b, first, filters)
        _together(b, first, filters, pool, places, speed)
        if some:
            _return(b, first, filters, pool, places, fast, j)
        if anywhere(at(b.now) >= at(b.due)):
            for lane in range(lane_count()):
                if b.here[lane] == 1.0 and b.now[lane] >= b.due[lane]:
                    i = first + lane
                    own = filters[i, 0], gains_of(pool, places[i]), packets[i]
                    _receive(b, lane, *own, counts[i])
    for lane in range(lane_count()):
        if b.here[lane] == 1.0:
            f = filters[first + lane, 0]
            store(b, lane, f)
            f.cursor = b.cursor[lane]
    return rows
