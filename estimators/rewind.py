"""The rule "buffer": what happened in the window is told again when a late sample comes.

Every tick's inputs, fast measurements and speed are kept, and every few ticks the states and their
covariance. A sample captured at c is put in its place: the newest snapshot not after c is taken
back, and the ticks up to now are filtered anew with all samples that are known by now. Exact for
any delay, order and clock; a sample older than the window is refused and counted.
"""

from typing import Any

from ..envs.backend import jit
from ..envs.record import PACKET, PACKET_WIDTH
from .delay import DIRECT
from .measure import measure
from .memory import COUNTERS, EVERY, RECENT, SNAPSHOTS, WINDOW
from .step import advance_state, correct_fast
from .transition import build

_GONE = -1.0  # the captured tick of a place that is empty


@jit
def _shoot(f: Any, tick: int) -> None:
    """Keep the states after the fast row of a tick, before its samples."""
    slot = (tick - f.start) // EVERY % SNAPSHOTS
    for i in range(f.n):
        f.shot_x[slot, i] = f.x[i]
        for j in range(f.n):
            f.shot_P[slot, i, j] = f.P[i, j]


@jit
def remember(f: Any) -> None:
    """Keep what the present tick told."""
    slot = f.tick % WINDOW
    f.told_u[slot] = f.u
    f.told_y[slot] = f.y
    f.told_speed[slot, 0], f.told_speed[slot, 1] = f.model_speed, f.turning
    if (f.tick - f.start) % EVERY == 0:
        _shoot(f, f.tick)


@jit
def _recall(f: Any, tick: int) -> None:
    """Inputs, fast measurements and model of a tick."""
    slot = tick % WINDOW
    f.u[:] = f.told_u[slot]
    f.y[:] = f.told_y[slot]
    speed, turning = f.told_speed[slot, 0], f.told_speed[slot, 1]
    if speed != f.model_speed or turning != f.turning:
        build(f, speed, turning)


@jit
def _keep(f: Any, packet: Any) -> int:
    """Keep a packet in the oldest place; returns the place."""
    place = f.recents % RECENT
    f.recents += 1
    f.recent[place, :] = packet[:PACKET_WIDTH]
    return int(place)


@jit
def _twice(f: Any, s: int, captured: int) -> bool:
    for i in range(RECENT):
        if f.recent[i, PACKET.captured] == captured and f.recent[i, PACKET.sensor] == s:
            return True
    return False


@jit
def _measure_again(f: Any, gains: Any, tick: int, count: int, place: int) -> bool:
    """Use the kept samples captured at a tick; False if the gate refused the one at `place`."""
    passed = True
    for i in range(count):
        packet = f.recent[f.replay[i]]
        if int(packet[PACKET.captured]) == tick:
            good = measure(f, gains, int(packet[PACKET.sensor]), DIRECT, packet)
            if f.replay[i] == place:
                passed = good
    return passed


@jit
def _since(f: Any, first: int) -> int:
    """Collect in f.replay the kept samples captured at `first` or later; returns how many."""
    count = 0
    for i in range(RECENT):
        if f.recent[i, PACKET.captured] >= first:
            f.replay[count] = i
            count += 1
    return count


@jit
def take_late(f: Any, gains: Any, s: int, packet: Any) -> None:
    """Use a sample of any age within the window."""
    captured, now = int(packet[PACKET.captured]), f.tick
    if captured > now:
        f.counts[COUNTERS.future] += 1
        return
    if captured < f.start:
        f.counts[COUNTERS.refused] += 1
        return
    first = f.start + (captured - f.start) // EVERY * EVERY
    if now - first >= WINDOW:
        f.counts[COUNTERS.refused] += 1
        return
    if _twice(f, s, captured):
        f.counts[COUNTERS.duplicates] += 1
        return
    place = _keep(f, packet)
    if captured == now:
        if not measure(f, gains, s, DIRECT, packet):
            f.recent[place, PACKET.captured] = _GONE
        return
    slot = (first - f.start) // EVERY % SNAPSHOTS
    for i in range(f.n):
        f.x[i] = f.shot_x[slot, i]
        for j in range(f.n):
            f.P[i, j] = f.shot_P[slot, i, j]
    _recall(f, first)
    count, nis = _since(f, first), f.nis
    passed = _measure_again(f, gains, first, count, place)
    if captured == first:
        nis = f.nis
    for tick in range(first + 1, now + 1):
        _recall(f, tick)
        advance_state(f, f.u)
        correct_fast(f, gains)
        if (tick - f.start) % EVERY == 0:
            _shoot(f, tick)
        passed = _measure_again(f, gains, tick, count, place) and passed
        if tick == captured:
            nis = f.nis
    f.nis = nis
    if not passed:
        f.recent[place, PACKET.captured] = _GONE


@jit
def forget(f: Any) -> None:
    """Empty the window."""
    f.recents = 0
    for i in range(RECENT):
        f.recent[i, PACKET.captured] = _GONE
