"""A packet that is here: sound or not, late or not, and the correction by it."""

from typing import Any

from ..envs.backend import absolute, jit
from ..envs.elementary import wrap
from ..envs.record import GPS, PACKET, PACKET_WIDTH
from .covariance import measure_clone, measure_state
from .delay import DIRECT, DROPPED, find
from .intersample import correct_sample
from .memory import COUNTERS, SLOW, WAITING
from .speed import finite

ASTRAY = 0.5  # rad: the first course sets the heading where it is so far off


@jit
def _expected(f: Any, s: int, i: int, first: int) -> Any:
    """What the filter expects row i of a sample to be: a clone, or the states' combination."""
    if first != DIRECT:
        return f.x[first + i]
    total = 0.0
    for k in range(f.n):
        total += f.row[s, i, k] * f.x[k]
    return total


@jit
def _align(f: Any, course: Any, first: int) -> None:
    """Turn the heading, and all clones of courses, onto a first course that is far off."""
    turn = wrap(course - _expected(f, GPS, 0, first))
    if absolute(turn) > ASTRAY:
        f.x[2] += turn
        f.expected[0] += turn
        for i in range(f.frames[GPS]):
            f.x[f.home[GPS] + i] += turn


@jit
def use(f: Any, gains: Any, s: int, packet: Any) -> None:
    """Correct by one packet of sensor s whose values are sound."""
    captured = int(packet[PACKET.captured])
    first = find(f, s, captured)
    if first == DROPPED:
        return
    if s == GPS:
        f.fixes += 1
        if f.fixes == 1:
            _align(f, packet[PACKET.value], first)
    if f.pseudo == 1:
        correct_sample(f, gains, s, packet[PACKET.value :])
        return
    frame = (captured - f.phase[s]) // f.period[s] % f.pattern
    for i in range(f.rows[s]):
        residual = packet[PACKET.value + i] - _expected(f, s, i, first)
        if f.angle[s, i] == 1:
            residual = wrap(residual)
        if f.periodic == 1:
            x, cell, at = f.x, f.cell, 1 + f.cycle + frame * f.rows[s] + i
            for j in range(f.total):
                x[j] += gains[cell, at, j] * residual
        elif first == DIRECT:
            measure_state(f, f.row[s, i], f.r[s, i], residual)
        else:
            measure_clone(f, first + i, f.r[s, i], residual)


@jit
def receive(f: Any, gains: Any, packet: Any) -> None:
    """Use a packet that is here now, keep it for the next step, or drop and count it."""
    for i in range(PACKET.value):
        if not finite(packet[i]):
            f.counts[COUNTERS.invalid] += 1
            return
    s = int(packet[PACKET.sensor])
    if s < 0 or s >= SLOW:
        f.counts[COUNTERS.unknown] += 1
        return
    if f.period[s] == 0:
        return
    for i in range(f.rows[s]):
        if not finite(packet[PACKET.value + i]):
            f.counts[COUNTERS.invalid] += 1
            return
    if packet[PACKET.quality] <= 0.0:
        f.counts[COUNTERS.poor] += 1
        return
    if f.stride > 1 and not (f.begun == 1 and (f.tick - f.origin) % f.stride == 0):
        if f.waits == WAITING:
            f.counts[COUNTERS.refused] += 1
            return
        for i in range(PACKET_WIDTH):
            f.waiting[f.waits, i] = packet[i]
        f.waits += 1
        return
    use(f, gains, s, packet)
