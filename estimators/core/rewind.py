"""The rule "buffer": the window is filtered anew when a late sample comes.

Every tick's inputs, fast measurements and speed are stored, and every few ticks the states and
their covariance. A sample captured at c is put in its place: the newest snapshot not after c is
restored, and the ticks up to now are filtered anew with all samples that are known by now. Exact
for any delay, order and clock; a sample older than the window, or than a sample that had to go, is
refused and counted. The gate judges a sample once, by what was known of the time before it; one
that it refuses leaves everything as it was.
"""

from ...envs.backend.decorators import apart, copied, jit
from ...envs.backend.primitives import maximum
from ...envs.record import PACKET
from .delay import direct
from .fast import advance_state, correct_fast
from .memory import COUNTERS, EVERY, RECENT, SLOW, SNAPSHOTS, WINDOW, Gains, Memory, Row
from .transition import VELOCITY_ROLL, build
from .update import measure

_GONE = -1  # the captured tick of a place that is empty
_NOW = SNAPSHOTS  # the snapshot of now, while the past is filtered anew


@jit
def _slot(f: Memory, tick: int) -> int:
    """The snapshot after the fast row of a tick, before its samples."""
    return int((tick - f.start) // EVERY % SNAPSHOTS)


@jit
def _snapshot(f: Memory, slot: int) -> None:
    """Store states and covariance in a snapshot."""
    for i in range(f.n):
        f.snapshot_x[slot, i] = f.x[i]
        for j in range(f.n):
            f.snapshot_P[slot, i, j] = f.P[i, j]


@jit
def _restore(f: Memory, slot: int) -> None:
    """The states and covariance of a snapshot."""
    for i in range(f.n):
        f.x[i] = f.snapshot_x[slot, i]
        for j in range(f.n):
            f.P[i, j] = f.snapshot_P[slot, i, j]


@jit
def remember(f: Memory) -> None:
    """Store the inputs, fast measurements and model of the present tick."""
    slot = f.tick % WINDOW
    copied(f.u, f.past_u[slot])
    copied(f.y, f.past_y[slot])
    f.past_speed[slot], f.past_turning[slot] = f.model_speed, f.turning
    f.past_road_turn[slot] = f.road_turn
    if (f.tick - f.start) % EVERY == 0:
        _snapshot(f, _slot(f, f.tick))


@jit
def _recall(f: Memory, tick: int) -> None:
    """Inputs, fast measurements and model of a tick."""
    slot = tick % WINDOW
    copied(f.past_u[slot], f.u)
    copied(f.past_y[slot], f.y)
    f.road_turn = f.past_road_turn[slot]
    speed, turning = f.past_speed[slot], f.past_turning[slot]
    if speed != f.model_speed or turning != f.turning:
        build(f, speed, turning)


@jit
def _oldest(f: Memory) -> int:
    """The place to store a packet in: an empty one, or that of the earliest captured."""
    place = 0
    for i in range(RECENT):
        if f.recent[i, PACKET.captured] < f.recent[place, PACKET.captured]:
            place = i
    return place


@jit
def _store(f: Memory, s: int, packet: Row, place: int) -> None:
    """Store a packet and its noise; what stood in its place is lost."""
    f.lost = maximum(f.lost, int(f.recent[place, PACKET.captured]))
    copied(packet, f.recent[place])
    copied(f.r[s], f.recent_r[place])


@jit
def _twice(f: Memory, s: int, captured: int) -> bool:
    """Whether a sample is a duplicate of a stored one."""
    for i in range(RECENT):
        if f.recent[i, PACKET.captured] == captured and f.recent[i, PACKET.sensor] == s:
            return True
    return False


@jit
def _since(f: Memory, first: int) -> int:
    """Collect in f.replay the good samples captured at `first` or later; returns how many."""
    count = 0
    for i in range(RECENT):
        if f.recent[i, PACKET.captured] >= first and f.recent[i, PACKET.quality] > 0.0:
            f.replay[count] = i
            count += 1
    return count


@jit
def _measure(f: Memory, gains: Gains, s: int, place: int, new: bool) -> bool:
    """Use a stored sample; False if it is new and the gate refuses it, now and for ever."""
    if f.kind == VELOCITY_ROLL:  # its noise comes with each packet
        copied(f.recent_r[place], f.r[s])
    copied(f.recent[place], f.sample)
    passed = measure(f, gains, s, direct(), f.sample, new)
    if not passed:
        f.recent[place, PACKET.quality] = 0.0
    return passed


@jit
def _measure_again(f: Memory, gains: Gains, tick: int, count: int, new: int) -> bool:
    """Use the samples captured at a tick, one sensor after the other; False as `_measure`."""
    for s in range(SLOW):
        for i in range(count):
            place = f.replay[i]
            due = f.recent[place, PACKET.captured] == tick and f.recent[place, PACKET.sensor] == s
            if due and not _measure(f, gains, s, place, place == new):
                return False
    return True


@jit
def _filter_anew(f: Memory, gains: Gains, first: int, new: int) -> bool:
    """Filter anew from the snapshot at `first` to now; False, and back to now, if the gate refuses
    the sample at the place `new`."""
    now, invalid, count = f.tick, f.counts[COUNTERS.invalid], _since(f, first)
    _snapshot(f, _NOW)
    _restore(f, _slot(f, first))
    passed = True
    for tick in range(first, now + 1):
        _recall(f, tick)
        if tick > first:
            advance_state(f, f.u)
            correct_fast(f, gains)
            if (tick - f.start) % EVERY == 0:
                _snapshot(f, _slot(f, tick))
        f.stretch = 1.0  # what was restored is of this tick's speed
        if not _measure_again(f, gains, tick, count, new):  # no snapshot was changed before
            passed = False
            break
    f.counts[COUNTERS.invalid] = invalid  # each row was counted when it came
    if not passed:
        _recall(f, now)
        _restore(f, _NOW)
        f.stretch = 1.0
    return passed


@apart
def take_late(f: Memory, gains: Gains, s: int, packet: Row) -> bool:
    """Use a packet (PACKET_WIDTH,) of any age within the window; whether it was used."""
    captured = int(packet[PACKET.captured])
    first = f.start + (captured - f.start) // EVERY * EVERY
    if _twice(f, s, captured):
        f.counts[COUNTERS.duplicates] += 1
        return False
    place = _oldest(f)
    if f.tick - first >= WINDOW or first <= maximum(f.lost, int(f.recent[place, PACKET.captured])):
        f.counts[COUNTERS.refused] += 1
        return False
    _store(f, s, packet, place)
    if captured == f.tick:
        return _measure(f, gains, s, place, captured == f.tick)
    return _filter_anew(f, gains, first, place)


@jit
def forget(f: Memory) -> None:
    """Empty the window."""
    f.lost = _GONE
    for i in range(RECENT):
        f.recent[i, PACKET.captured] = _GONE
