"""A packet that has arrived: whether it is sound, and the rule "buffer", which rewinds to it.

For a late sample the newest snapshot not after its capture is restored, and the stored ticks up to
now are filtered anew with all samples known by now: exact for any delay and order. The gate judges
a sample once, by what was known before it; a refused one changes nothing.
"""

import numpy as np

from ...envs.numerics.jit import copy_into, jit, noinline
from ...envs.numerics.primitives import Matrix, Scalar, Vector, floor, maximum
from ...envs.record import PACKET, PACKET_WIDTH
from .late_samples import BUFFER, DROPPED, find_target, get_direct, is_duplicate
from .memory import COUNTERS, N_SNAPSHOTS, SNAPSHOT_INTERVAL, WINDOW, FilterMemory, GainTables
from .model import MIN_SPEED, build_model, compute_row_variance, is_finite
from .predict import advance_state
from .update import correct_fast, update_filter

_NOW_SLOT = N_SNAPSHOTS  # the snapshot of now, while the past is filtered anew


@jit
def _find_slot(f: FilterMemory, tick: int) -> int:
    """Find the snapshot after the fast row of a tick, before its samples."""
    return int((tick - f.start) // SNAPSHOT_INTERVAL % N_SNAPSHOTS)


@jit
def _copy_moments(n: int, x: Vector, P: Matrix, to_x: Vector, to_P: Matrix) -> None:
    """Copy n states and their covariance to or from a snapshot."""
    for i in range(n):
        to_x[i] = x[i]
        for j in range(n):
            to_P[i, j] = P[i, j]


@jit
def store_history(f: FilterMemory) -> None:
    """Store the inputs, fast measurements and model of the present tick; "buffer" alone."""
    if f.delay_rule != BUFFER:
        return
    slot = f.tick % WINDOW
    copy_into(f.u, f.past_u[slot])
    copy_into(f.y, f.past_y[slot])
    f.past_speed[slot], f.past_turning[slot] = f.model_speed, f.turning
    if (f.tick - f.start) % SNAPSHOT_INTERVAL == 0:
        slot = _find_slot(f, f.tick)
        _copy_moments(f.n, f.x, f.P, f.snapshot_x[slot], f.snapshot_P[slot])


@jit
def _restore_history(f: FilterMemory, tick: int) -> None:
    """Restore inputs, fast measurements and model of a tick."""
    slot = tick % WINDOW
    copy_into(f.past_u[slot], f.u)
    copy_into(f.past_y[slot], f.y)
    f.road_turn = f.past_road_turn[slot]
    speed, turning = f.past_speed[slot], f.past_turning[slot]
    if speed != f.model_speed or turning != f.turning:
        build_model(f, speed, turning)


@jit
def _has_sample(f: FilterMemory, s: int, captured: int) -> bool:
    """Return whether a sensor's sample of a captured tick is stored already."""
    for i in range(len(f.recent)):
        if f.recent[i, PACKET.captured] == captured and f.recent[i, PACKET.sensor] == s:
            return True
    return False


@jit
def _apply_stored(f: FilterMemory, gains: GainTables, s: int, place: int, is_new: bool) -> bool:
    """Use a stored sample; False if it is new and the gate refuses it, now and for ever."""
    for i in range(f.rows[s]):  # noise that does not follow the speed can come with the packet
        f.r[s, i] = f.recent_r[place, i]
        f.r[s, i] = compute_row_variance(f, s, i, f.model_speed)
    copy_into(f.recent[place], f.sample)
    passed = update_filter(f, gains, s, get_direct(), is_new)
    if not passed:
        f.recent[place, PACKET.quality] = 0.0
    return passed


@jit
def _apply_tick_samples(
    f: FilterMemory, gains: GainTables, tick: int, count: int, new_place: int
) -> bool:
    """Use the samples captured at a tick, one sensor after the other; False as `_apply_stored`."""
    for s in range(len(f.period)):
        for i in range(count):
            place = f.replay[i]
            due = f.recent[place, PACKET.captured] == tick and f.recent[place, PACKET.sensor] == s
            if due and not _apply_stored(f, gains, s, place, place == new_place):
                return False
    return True


@jit
def _replay_window(f: FilterMemory, gains: GainTables, first: int, new_place: int) -> bool:
    """Filter anew from `first` to now with a new sample; False, undone, if the gate refuses it."""
    now, invalid, count = f.tick, f.counts[COUNTERS.invalid], 0
    for i in range(len(f.recent)):
        if f.recent[i, PACKET.captured] >= first and f.recent[i, PACKET.quality] > 0.0:
            f.replay[count] = i
            count += 1
    x, P, passed, slot = f.snapshot_x, f.snapshot_P, True, _find_slot(f, first)
    _copy_moments(f.n, f.x, f.P, x[_NOW_SLOT], P[_NOW_SLOT])
    _copy_moments(f.n, x[slot], P[slot], f.x, f.P)
    for tick in range(first, now + 1):
        _restore_history(f, tick)
        if tick > first:
            advance_state(f, f.u)
            correct_fast(f, gains)
            if (tick - f.start) % SNAPSHOT_INTERVAL == 0:
                slot = _find_slot(f, tick)
                _copy_moments(f.n, f.x, f.P, x[slot], P[slot])
        f.beta_scale = 1.0  # the restored beta belongs to this tick's speed
        # no snapshot was changed before a refusal
        if not _apply_tick_samples(f, gains, tick, count, new_place):
            passed = False
            break
    f.counts[COUNTERS.invalid] = invalid  # each row was counted when it came
    if not passed:
        _restore_history(f, now)
        _copy_moments(f.n, x[_NOW_SLOT], P[_NOW_SLOT], f.x, f.P)
        f.beta_scale = 1.0
    return passed


@noinline
def _rewind_update(f: FilterMemory, gains: GainTables, s: int) -> bool:
    """Correct by f.sample, of any age within the window; return whether it was used."""
    captured = int(f.sample[PACKET.captured])
    first = f.start + (captured - f.start) // SNAPSHOT_INTERVAL * SNAPSHOT_INTERVAL
    if _has_sample(f, s, captured):
        f.counts[COUNTERS.duplicates] += 1
        return False
    place = 0  # an empty one, or that of the earliest captured, which is lost
    for i in range(len(f.recent)):
        if f.recent[i, PACKET.captured] < f.recent[place, PACKET.captured]:
            place = i
    evicted = maximum(f.evicted, int(f.recent[place, PACKET.captured]))
    if f.tick - first >= WINDOW or first <= evicted:
        f.counts[COUNTERS.refused] += 1
        return False
    f.evicted = evicted
    copy_into(f.sample, f.recent[place])
    copy_into(f.r[s], f.recent_r[place])
    if captured == f.tick:  # is_new is True then
        return _apply_stored(f, gains, s, place, captured == f.tick)
    return _replay_window(f, gains, first, place)


@jit
def _apply_sample(f: FilterMemory, gains: GainTables, s: int) -> bool:
    """Correct by f.sample, a sound packet, according to its age; return whether it was used."""
    if f.delay_rule == BUFFER:
        return _rewind_update(f, gains, s)
    target = find_target(f, s, int(f.sample[PACKET.captured]))
    is_usable = target != DROPPED  # is_gated below: a literal would compile it anew
    return is_usable and update_filter(f, gains, s, target, is_usable)


@jit
def _is_whole(value: Scalar) -> Scalar:
    return floor(value) == value


@jit
def _is_timely(f: FilterMemory, captured: Scalar, arrived: Scalar) -> bool:
    """Return whether stamps are ticks from the first row to now, in order; else count them."""
    if not (_is_whole(captured) and _is_whole(arrived)) or arrived < captured:
        f.counts[COUNTERS.unknown] += 1
    elif arrived > f.tick:
        f.counts[COUNTERS.future] += 1
    elif captured < f.start:
        f.counts[COUNTERS.refused] += 1
    else:
        return True
    return False


@jit
def _is_frozen(f: FilterMemory, s: int) -> bool:
    """Return whether f.sample, of two values or more, repeats the sensor's last while it moves."""
    packet, last = f.sample, f.last[s]
    if packet[PACKET.captured] == last[PACKET.captured]:  # a duplicate
        return False
    n_equal = 0
    for i in range(PACKET.value, PACKET_WIDTH):
        if packet[i] == last[i]:
            n_equal += 1
        elif is_finite(packet[i]):
            n_equal = 0 - PACKET_WIDTH
    copy_into(packet, last)
    return n_equal > 1 and f.speed > MIN_SPEED


@jit
def _is_valid(f: FilterMemory) -> bool:
    """Return whether f.sample is for this filter and fit for use; what is not is counted."""
    packet = f.sample
    for i in range(PACKET.value):
        if not is_finite(packet[i]):
            f.counts[COUNTERS.invalid] += 1
            return False
    sensor = packet[PACKET.sensor]
    if sensor < 0.0 or sensor >= len(f.period) or not _is_whole(sensor):
        f.counts[COUNTERS.unknown] += 1
        return False
    s = int(sensor)
    if f.period[s] == 0 or not _is_timely(f, packet[PACKET.captured], packet[PACKET.arrived]):
        return False
    for i in range(f.rows[s]):
        if not is_finite(packet[PACKET.value + i]):
            f.counts[COUNTERS.invalid] += 1
            return False
    has_few, column = False, f.satellites_column[s]
    if column > 0:
        has_few = packet[column] > 0.0 and packet[column] < f.least_satellites  # 0 or NaN: unknown
    if packet[PACKET.quality] <= 0.0 or has_few:
        f.counts[COUNTERS.poor] += 1
        return False
    if f.recovery_count > 0 and _is_frozen(f, s):
        f.counts[COUNTERS.stuck] += 1
        return False
    return True


@jit
def _store_waiting(f: FilterMemory, s: int, packet: Vector) -> bool:
    """Queue a packet for the next step that listens; False if it is refused, and counted."""
    if is_duplicate(f, s, int(packet[PACKET.captured])):
        return False
    for i in range(f.waits):
        is_same_sensor = f.waiting[i, PACKET.sensor] == packet[PACKET.sensor]
        if is_same_sensor and f.waiting[i, PACKET.captured] == packet[PACKET.captured]:
            f.counts[COUNTERS.duplicates] += 1
            return False
    if f.waits == len(f.waiting):
        f.counts[COUNTERS.refused] += 1
        return False
    copy_into(packet, f.waiting[f.waits])
    f.waits += 1
    return True


@noinline
def process_packet(f: FilterMemory, gains: GainTables, packet: Vector) -> bool:
    """Use a packet that has arrived or queue it for the next step; False: dropped and counted."""
    copy_into(packet, f.sample)
    f.nis = np.nan
    if not _is_valid(f):
        return False
    s = int(f.sample[PACKET.sensor])
    if f.pace > 1 and not (f.has_started == 1 and (f.tick - f.origin) % f.pace == 0):
        return _store_waiting(f, s, f.sample)
    return _apply_sample(f, gains, s)


@jit
def apply_waiting(f: FilterMemory, gains: GainTables) -> None:
    """Correct by the packets that came since the last step that listened."""
    for i in range(f.waits):
        copy_into(f.waiting[i], f.sample)
        _apply_sample(f, gains, int(f.sample[PACKET.sensor]))
    f.waits = 0
