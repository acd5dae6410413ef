"""The filter itself, compiled: fast rows and packets in, states out.

Order of a tick: what was captured at the last tick is held, prediction from the last tick to this
one with the inputs of this row, the fast sensors, then the packets that arrive. A filter at the
slow sensor's rate listens once every `pace` ticks, to the packets that came meanwhile; it holds its
states in between (`stride`) or predicts them.
"""

from typing import Any

import numpy as np

from ...envs.backend.decorators import apart, copied, counted, jit
from ...envs.backend.primitives import maximum, sqrt
from ...envs.record import FAST, PACKET
from .delay import BUFFER, latch_due
from .fast import advance_state, correct_fast, read
from .layers import mix, own, pass_on, receive_beside, renew
from .memory import (
    CORE,
    COUNTERS,
    FRAMES,
    SEEN,
    SLOW,
    WIDTH,
    WINDOW,
    Filters,
    Gains,
    Memory,
    Row,
)
from .packets import receive, use_waiting
from .rewind import forget, remember
from .speed import next_cell, step_row
from .transition import CURVATURE, LATERAL, build, road_turned
from .tyres import linearise


@jit
def _fill(vector: Row, value: float) -> None:
    for i in range(len(vector)):
        vector[i] = value


@apart
def begin(f: Memory, first: int) -> None:
    """A fresh filter whose first row is the tick `first`."""
    f.start, f.tick, f.begun, f.at = first, first - 1, 0, 0
    f.cell, f.wanted, f.cursor, f.waits, f.u_count = 0, -1, 0, 0, 0
    f.first_fix, f.since, f.nis, f.turning, f.road_turn = -1, -1, np.nan, 0.0, 0.0
    _fill(f.x, 0.0)
    copied(f.first, f.x)
    _fill(f.e, 0.0)
    _fill(f.gain, 0.0)
    _fill(f.eps, 0.0)
    _fill(f.innovation, 0.0)
    _fill(f.u, 0.0)
    _fill(f.u_sum, 0.0)
    for i in range(len(f.share)):
        _fill(f.share[i], 0.0)
    for i in range(WIDTH):
        _fill(f.P[i], 0.0)
    for i in range(CORE):
        copied(f.prior[i], f.P[i])
    for s in range(SLOW):
        _fill(f.scale[s], 1.0)
        _fill(f.last[s], np.nan)
        f.believed[s], f.doubts[s] = -1, 0
        for i in range(FRAMES):
            f.stamp[s, i] = -1
        for i in range(SEEN):
            f.seen[s, i] = -1
        if f.period[s] > 0:
            late = maximum(first - f.phase[s], 0)
            f.next[s] = f.phase[s] + (late + f.period[s] - 1) // f.period[s] * f.period[s]
    for i in range(len(f.counts)):
        f.counts[i] = 0
    forget(f)
    for i in range(WIDTH):
        f.keep[i] = 0.0 if i < f.dense else f.decay[i] if i < f.n else 1.0
    f.weight, f.fresh = f.odds, 0.0
    if f.r_share > 0.0:
        f.r_fast[f.accel_row] = f.r_told
        _fill(f.y_past, np.nan)
    f.steer_before = np.nan
    if f.scaled > 0:
        f.C_fast[f.accel_row, f.scaled] = 0.0
    if f.tyres > 0:
        linearise(f, 0.0)
    if f.measured == 1:
        f.speed, f.model_speed = 0.0, 0.0
    else:
        build(f, f.speed, 0.0)
    f.stretch = 1.0


@jit
def _start(f: Memory) -> None:
    """The first step: nothing to predict from."""
    f.begun = 1
    f.at = ((f.tick - f.origin) // f.stride) % f.cycle
    if f.speed_state >= 0:
        f.x[f.speed_state] = f.speed


@jit
def _turn_road(f: Memory, u: Row) -> None:
    """The road turns beside the car, over a step with the inputs u (INPUTS,)."""
    if f.kind == LATERAL and f.inputs > CURVATURE:
        f.road_turn += road_turned(f.model_speed, u[CURVATURE], f.step)


@jit
def tick(f: Memory, gains: Gains) -> None:
    """From the last tick to this one, whose fast row was read."""
    f.tick += 1
    if f.stride > 1:
        for i in range(f.inputs):
            f.u_sum[i] += f.u[i]
        f.u_count += 1
    listens = f.pace == 1 or (f.tick >= f.origin and (f.tick - f.origin) % f.pace == 0)
    if f.stride > 1 and not listens:
        return
    if f.begun == 1:
        latch_due(f, f.tick - f.stride)
        if f.stride > 1:
            for i in range(f.inputs):
                f.u_sum[i] /= f.u_count
            _turn_road(f, f.u_sum)
            advance_state(f, f.u_sum)
        else:
            _turn_road(f, f.u)
            advance_state(f, f.u)
        f.at = f.at + 1 if f.at + 1 < f.cycle else 0
    else:
        _start(f)
    if f.store_predictions == 1:
        f.past_road_turn[f.tick % WINDOW] = f.road_turn
        for i in range(f.n):
            f.predicted[f.tick % WINDOW, i] = f.x[i]
    if listens:
        correct_fast(f, gains)
    if f.late == BUFFER:
        remember(f)
    for i in range(f.inputs):
        f.u_sum[i] = 0.0
    f.u_count = 0
    if f.pace > 1 and listens:
        use_waiting(f, gains)


@jit
def covariance_of(f: Memory, gains: Gains, i: int, j: int) -> Any:
    """P[i, j] of two states, i <= j, now; with periodic gains that of the settled cycle."""
    if f.periodic == 1:
        return gains[f.cell, step_row(f), f.total + i * f.n - i * (i - 1) // 2 + j - i]
    return f.P[i, j]


@jit
def deviation(f: Memory, gains: Gains, i: int) -> Any:
    """The standard deviation of a state now."""
    return sqrt(maximum(covariance_of(f, gains, i, i), 0.0))


@jit
def _write(layers: Filters, gains: Gains, j: int, X: Any, S: Any) -> None:
    """The states and standard deviations of all layers into row j of X and S (rows, n)."""
    column = 0
    for layer in range(len(layers) if own(layers) == 0 else 1):
        f = layers[layer]
        for i in range(f.n):
            X[j, column] = f.x[i]
            S[j, column] = deviation(f, gains, i)
            column += 1


@jit
def write_estimate(layers: Filters, gains: Gains, x: Row, P: Any) -> bool:
    """Write the states of all layers into x (n,) and their covariance into zeros P (n, n) or none.

    Returns False where P is to be read from gains that are missing.
    """
    at, f = 0, layers[0]
    if len(P) > 0 and f.periodic == 1 and gains[f.cell, 0, 0] == 0.0:
        return False
    for layer in range(len(layers) if own(layers) == 0 else 1):
        f = layers[layer]
        for i in range(f.n):
            x[at + i] = f.x[i]
            for j in range(f.n if len(P) > 0 else 0):  # a table holds one triangle
                row, column = (j, i) if f.periodic == 1 and i > j else (i, j)
                P[at + i, at + j] = covariance_of(f, gains, row, column)
        at += f.n
    return True


@apart
def advance(
    layers: Filters,
    gains: Gains,
    fast: Any,
    rows: int,
    packets: Any,
    count: int,
    start: int,
    X: Any,
    S: Any,
    nis: Row,
) -> int:
    """Take the fast rows from `start` to `rows` and the first `count` packets.

    layers: (1,); (2,), of which the second measures what the first estimates; or a bank, the
    mixture and its members. gains: of the first layer.
    fast: (rows or more, FAST_WIDTH). packets: (count or more, PACKET_WIDTH). X, S: (rows, n) to be
    filled with states and standard deviations, or empty. nis: (count,) to be filled with each
    packet's normalised innovation squared, or empty. Returns the rows done: fewer than `rows` where
    gains are missing, those of the cell `wanted` of the first layer; call again from there.
    """
    first = own(layers)
    f = layers[first]
    at, last = 0 if start == 0 else f.cursor, f.tick + rows - start
    for j in range(start, rows):
        now = 0.5 * (fast[j, FAST.wheel_left] + fast[j, FAST.wheel_right])
        if f.periodic == 1:
            cell = next_cell(f, now)
            if gains[cell, 0, 0] == 0.0:
                f.wanted, f.cursor = cell, at
                return j
        for layer in range(first, len(layers)):
            read(layers[layer], fast[j], now)
            tick(layers[layer], gains)
        while at < count and not (f.tick < packets[at, PACKET.arrived] <= last):
            used = receive(f, gains, packets[at])  # from beyond the last row: counted here
            if len(nis) > 0:
                nis[at] = f.nis
            if first > 0:
                receive_beside(layers, gains, packets[at])
            elif used and len(layers) > 1:
                pass_on(f, layers[1], gains, packets[at])
            at += 1
        if first > 0 and f.tick % f.respawn == 0 and f.tick > f.start:
            renew(layers)
        if first > 0 and (len(X) > 0 or j == rows - 1):
            mix(layers)
        if len(X) > 0:
            _write(layers, gains, j, X, S)
    f.counts[COUNTERS.future] += count - at  # of a call without rows
    return rows


@counted
def step_all(layers: Filters, gains: Gains, fast: Any, packets: Any, count: int) -> int:
    """`advance` over all rows with nothing to be filled: fewer arguments to hand over."""
    nothing = fast[:0]
    return advance(
        layers,
        gains,
        fast,
        len(fast),
        packets,
        count,
        len(nothing),
        nothing,
        nothing,
        nothing.reshape(0),
    )


@jit
def begin_all(layers: Filters, first: int) -> None:
    """`begin` for all layers of an estimator."""
    for i in range(len(layers)):
        begin(layers[i], first)


@jit
def receive_all(layers: Filters, gains: Gains, packet: Row) -> None:
    """`receive` a packet (PACKET_WIDTH,) by all layers of an estimator."""
    if own(layers) > 0:
        receive(layers[1], gains, packet)
        receive_beside(layers, gains, packet)
        mix(layers)
    elif receive(layers[0], gains, packet) and len(layers) > 1:
        pass_on(layers[0], layers[1], gains, packet)
