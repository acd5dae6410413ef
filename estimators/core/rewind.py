"""The rule "buffer": what happened in the window is told again when a late sample comes.

Every tick's inputs, fast measurements and speed are kept, and every few ticks the states and their
covariance. A sample captured at c is put in its place: the newest snapshot not after c is taken
back, and the ticks up to now are filtered anew with all samples that are known by now. Exact for
any delay, order and clock; a sample older than the window, or than a sample that is no longer kept,
is refused and counted. The gate judges a sample once, by what was known of the time before it; one
that it refuses leaves everything as it was.
"""

from typing import Any

from ...envs.backend.decorators import apart, jit
from ...envs.backend.primitives import maximum
from ...envs.record import PACKET, PACKET_WIDTH
from .delay import direct
from .fast import advance_state, correct_fast
from .memory import COUNTERS, EVERY, FASTS, INPUTS, RECENT, ROWS, SLOW, SNAPSHOTS, WINDOW
from .transition import VELOCITY_ROLL, build
from .update import measure

_GONE = -1  # the captured tick of a place that is empty
_NOW = SNAPSHOTS  # the snapshot of now, while the past is told


@jit
def _slot(f: Any, tick: int) -> int:
    """The snapshot after the fast row of a tick, before its samples."""
    return int((tick - f.start) // EVERY % SNAPSHOTS)


@jit
def _shoot(f: Any, slot: int) -> None:
    """Keep the states in a snapshot."""
    for i in range(f.n):
        f.shot_x[slot, i] = f.x[i]
        for j in range(f.n):
            f.shot_P[slot, i, j] = f.P[i, j]


@jit
def _take_back(f: Any, slot: int) -> None:
    """The states of a snapshot."""
    for i in range(f.n):
        f.x[i] = f.shot_x[slot, i]
        for j in range(f.n):
            f.P[i, j] = f.shot_P[slot, i, j]


@jit
def remember(f: Any) -> None:
    """Keep what the present tick told."""
    slot = f.tick % WINDOW
    for i in range(INPUTS):
        f.told_u[slot, i] = f.u[i]
    for i in range(FASTS):
        f.told_y[slot, i] = f.y[i]
    f.told_speed[slot, 0], f.told_speed[slot, 1] = f.model_speed, f.turning
    if (f.tick - f.start) % EVERY == 0:
        _shoot(f, _slot(f, f.tick))


@jit
def _recall(f: Any, tick: int) -> None:
    """Inputs, fast measurements and model of a tick."""
    slot = tick % WINDOW
    for i in range(INPUTS):
        f.u[i] = f.told_u[slot, i]
    for i in range(FASTS):
        f.y[i] = f.told_y[slot, i]
    speed, turning = f.told_speed[slot, 0], f.told_speed[slot, 1]
    if speed != f.model_speed or turning != f.turning:
        build(f, speed, turning)


@jit
def _oldest(f: Any) -> int:
    """The place to keep a packet in: an empty one, or that of the earliest captured."""
    place = 0
    for i in range(RECENT):
        if f.recent[i, PACKET.captured] < f.recent[place, PACKET.captured]:
            place = i
    return place


@jit
def _keep(f: Any, s: int, packet: Any, place: int) -> None:
    """Keep a packet and its noise; what stood in its place is lost."""
    f.lost = maximum(f.lost, int(f.recent[place, PACKET.captured]))
    for i in range(PACKET_WIDTH):
        f.recent[place, i] = packet[i]
    for i in range(ROWS):
        f.recent_r[place, i] = f.r[s, i]


@jit
def _twice(f: Any, s: int, captured: int) -> bool:
    for i in range(RECENT):
        if f.recent[i, PACKET.captured] == captured and f.recent[i, PACKET.sensor] == s:
            return True
    return False


@jit
def _since(f: Any, first: int) -> int:
    """Collect in f.replay the good samples captured at `first` or later; returns how many."""
    count = 0
    for i in range(RECENT):
        if f.recent[i, PACKET.captured] >= first and f.recent[i, PACKET.quality] > 0.0:
            f.replay[count] = i
            count += 1
    return count


@jit
def _measure(f: Any, gains: Any, s: int, place: int, new: bool) -> bool:
    """Use a kept sample; False if it is new and the gate refuses it, now and for ever."""
    if f.kind == VELOCITY_ROLL:  # told its noise with each packet
        for i in range(ROWS):
            f.r[s, i] = f.recent_r[place, i]
    for i in range(PACKET_WIDTH):
        f.sample[i] = f.recent[place, i]
    passed = measure(f, gains, s, direct(), f.sample, new)
    if not passed:
        f.recent[place, PACKET.quality] = 0.0
    return passed


@jit
def _measure_again(f: Any, gains: Any, tick: int, count: int, new: int) -> bool:
    """Use the samples captured at a tick, one sensor after the other; False as `_measure`."""
    for s in range(SLOW):
        for i in range(count):
            place = f.replay[i]
            due = f.recent[place, PACKET.captured] == tick and f.recent[place, PACKET.sensor] == s
            if due and not _measure(f, gains, s, place, place == new):
                return False
    return True


@jit
def _tell_again(f: Any, gains: Any, first: int, new: int) -> bool:
    """Filter anew from the snapshot at `first` to now; False, and back to now, if the gate refuses
    the sample at the place `new`."""
    now, invalid, count = f.tick, f.counts[COUNTERS.invalid], _since(f, first)
    _shoot(f, _NOW)
    _take_back(f, _slot(f, first))
    passed = True
    for tick in range(first, now + 1):
        _recall(f, tick)
        if tick > first:
            advance_state(f, f.u)
            correct_fast(f, gains)
            if (tick - f.start) % EVERY == 0:
                _shoot(f, _slot(f, tick))
        if not _measure_again(f, gains, tick, count, new):  # no snapshot was changed before
            passed = False
            break
    f.counts[COUNTERS.invalid] = invalid  # each row was counted when it came
    if not passed:
        _recall(f, now)
        _take_back(f, _NOW)
    return passed


@apart
def take_late(f: Any, gains: Any, s: int, packet: Any) -> bool:
    """Use a sample of any age within the window; whether it was used."""
    captured = int(packet[PACKET.captured])
    first = f.start + (captured - f.start) // EVERY * EVERY
    if _twice(f, s, captured):
        f.counts[COUNTERS.duplicates] += 1
        return False
    place = _oldest(f)
    if f.tick - first >= WINDOW or first <= maximum(f.lost, int(f.recent[place, PACKET.captured])):
        f.counts[COUNTERS.refused] += 1
        return False
    _keep(f, s, packet, place)
    if captured == f.tick:
        return _measure(f, gains, s, place, captured == f.tick)
    return _tell_again(f, gains, first, place)


@jit
def forget(f: Any) -> None:
    """Empty the window."""
    f.lost = _GONE
    for i in range(RECENT):
        f.recent[i, PACKET.captured] = _GONE
