"""The filter itself, compiled: fast rows and packets in, states out.

Order of a tick: clones of what was captured at the last tick, prediction from the last tick to
this one with the inputs of this row, the gyro, then the packets that arrive. A filter at the slow
sensor's rate does the same once every `stride` ticks, with the mean input, and the packets that
came meanwhile.
"""

from typing import Any

from ..envs.backend import jit, maximum, sqrt
from ..envs.record import FAST, PACKET
from .arrivals import receive, use
from .covariance import measure_state, predict_covariance
from .delay import latch_due
from .intersample import correct_between
from .memory import COUNTERS, FRAMES, INPUTS, SEEN, SLOW, WIDTH
from .models import build
from .speed import cell_of, finite, measured_speed, moved, next_cell


@jit
def begin(f: Any, first: int) -> None:
    """A fresh filter whose first row is the tick `first`."""
    f.start, f.tick, f.begun, f.at = first, first - 1, 0, 0
    f.cell, f.wanted, f.cursor, f.waits, f.fixes, f.u_count = 0, -1, 0, 0, 0, 0
    for i in range(WIDTH):
        f.x[i], f.e[i], f.gain[i] = 0.0, 0.0, 0.0
        for j in range(WIDTH):
            f.P[i, j] = 0.0
    for i in range(f.n):
        for j in range(f.n):
            f.P[i, j] = f.prior[i, j]
    for i in range(INPUTS):
        f.u[i], f.u_sum[i] = 0.0, 0.0
    for s in range(SLOW):
        for i in range(FRAMES):
            f.stamp[s, i] = -1
        for i in range(SEEN):
            f.seen[s, i] = -1
        if f.period[s] > 0:
            late = maximum(first - f.phase[s], 0)
            f.next[s] = f.phase[s] + (late + f.period[s] - 1) // f.period[s] * f.period[s]
    for i in range(len(f.counts)):
        f.counts[i] = 0
    if f.measured == 1:
        f.speed, f.model_speed = 0.0, 0.0
    else:
        build(f, f.speed)


@jit
def _note_inputs(f: Any, delta_f: Any, N_z: Any, now: Any) -> None:
    """Keep a row's inputs (the last finite ones), and its speed; rebuild the model if needed."""
    if finite(delta_f) and finite(N_z):
        f.u[0], f.u[1] = delta_f, N_z
    else:
        f.counts[COUNTERS.invalid] += 1
    if f.measured == 1:
        f.speed = measured_speed(f, now)
        if moved(f, f.speed):
            build(f, f.speed)
            f.cell = cell_of(f, f.speed)


@jit
def _predict(f: Any, v: Any) -> None:
    """v <- F v on the states."""
    n, dense, G, T = f.n, f.dense, f.G, f.work[0, 0]
    for i in range(dense):
        total = 0.0
        for k in range(n):
            total += G[i, k] * v[k]
        T[i] = total
    for i in range(dense):
        v[i] = T[i]
    for i in range(dense, n):
        v[i] *= f.decay[i]


@jit
def _advance_state(f: Any, u0: Any, u1: Any) -> None:
    """x <- F x + H u, and P or e with it."""
    _predict(f, f.x)
    for i in range(f.dense):
        f.x[i] += f.H[i, 0] * u0 + f.H[i, 1] * u1
    if f.pseudo == 1:
        _predict(f, f.e)
    elif f.periodic == 0:
        predict_covariance(f)


@jit
def _gyro(f: Any, gains: Any, measured: Any) -> None:
    residual = measured
    for k in range(f.n):
        residual -= f.gyro[k] * f.x[k]
    if not finite(residual):
        f.counts[COUNTERS.invalid] += 1
        residual = 0.0
        if f.periodic == 0:
            return
    if f.pseudo == 1:
        correct_between(f, gains, 0 if f.period[0] > 0 else 1, residual)
    elif f.periodic == 1:
        x, cell, at = f.x, f.cell, 1 + f.at
        for i in range(f.total):
            x[i] += gains[cell, at, i] * residual
    else:
        measure_state(f, f.gyro, f.r_gyro, residual)


@jit
def tick(f: Any, gains: Any, gyro: Any) -> None:
    """Take the gyro and the noted inputs of one fast row: from the last tick to this one."""
    f.tick += 1
    if f.stride > 1:
        f.u_sum[0] += f.u[0]
        f.u_sum[1] += f.u[1]
        f.u_count += 1
        if f.tick < f.origin or (f.tick - f.origin) % f.stride != 0:
            return
    if f.begun == 1:
        latch_due(f, f.tick - f.stride)
        if f.stride > 1:
            _advance_state(f, f.u_sum[0] / f.u_count, f.u_sum[1] / f.u_count)
        else:
            _advance_state(f, f.u[0], f.u[1])
        f.at = f.at + 1 if f.at + 1 < f.cycle else 0
    else:
        f.begun = 1
        f.at = ((f.tick - f.origin) // f.stride) % f.cycle
    _gyro(f, gains, gyro)
    if f.stride > 1:
        f.u_sum[0], f.u_sum[1], f.u_count = 0.0, 0.0, 0
        for i in range(f.waits):
            use(f, gains, int(f.waiting[i, PACKET.sensor]), f.waiting[i])
        f.waits = 0


@jit
def covariance_of(f: Any, gains: Any, i: int, j: int) -> Any:
    """P[i, j] of two states, i <= j, now; with periodic gains that of the settled cycle."""
    if f.periodic == 1:
        return gains[f.cell, 1 + f.at, f.total + i * f.n - i * (i - 1) // 2 + j - i]
    return f.P[i, j]


@jit
def deviation(f: Any, gains: Any, i: int) -> Any:
    """The standard deviation of a state now."""
    return sqrt(maximum(covariance_of(f, gains, i, i), 0.0))


@jit
def advance(
    f: Any,
    gains: Any,
    fast: Any,
    rows: int,
    packets: Any,
    count: int,
    start: int,
    X: Any,
    S: Any,
) -> int:
    """Take the fast rows from `start` to `rows` and the first `count` packets.

    gains: (cells, ..., ...). X, S: (rows, n) to be filled, or empty. Returns the rows done: fewer
    than `rows` where gains are missing, `f.wanted` says which; call again from there.
    """
    at = 0 if start == 0 else f.cursor
    for j in range(start, rows):
        now = 0.5 * (fast[j, FAST.wheel_left] + fast[j, FAST.wheel_right])
        if f.periodic == 1:
            cell = next_cell(f, now)
            if gains[cell, 0, 0] == 0.0:
                f.wanted, f.cursor = cell, at
                return j
        N_z = f.moment_arm * (fast[j, FAST.torque_right] - fast[j, FAST.torque_left])
        _note_inputs(f, fast[j, FAST.steer], N_z, now)
        tick(f, gains, fast[j, FAST.gyro])
        while at < count and not packets[at, PACKET.arrived] > f.tick:
            receive(f, gains, packets[at])
            at += 1
        if len(X) > 0:
            for i in range(f.n):
                X[j, i] = f.x[i]
                S[j, i] = deviation(f, gains, i)
    f.counts[COUNTERS.future] += count - at
    return rows


@jit
def begin_filter(filters: Any, first: int) -> None:
    """`begin` for the first filter of an array."""
    begin(filters[0], first)


@jit
def receive_filter(filters: Any, gains: Any, packet: Any) -> None:
    """`receive` for the first filter of an array."""
    receive(filters[0], gains, packet)


@jit
def advance_filter(
    filters: Any,
    gains: Any,
    fast: Any,
    rows: int,
    packets: Any,
    count: int,
    start: int,
    X: Any,
    S: Any,
) -> int:
    """`advance` for the first filter of an array."""
    return advance(filters[0], gains, fast, rows, packets, count, start, X, S)
