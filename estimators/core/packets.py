"""A packet that is here: sound or not, for now or for the next step.

A packet is a row (PACKET_WIDTH,), columns as in `envs.record.Packet`.
"""

from typing import Any

import numpy as np

from ...envs.backend.decorators import copy_into, jit, noinline
from ...envs.backend.primitives import floor
from ...envs.record import PACKET, PACKET_WIDTH
from .delay import BUFFER, DROPPED, find_clone, is_duplicate
from .memory import COUNTERS, N_SLOW, N_WAITING, FilterRecord, GainTables, Vector
from .rewind import rewind_update
from .speed import is_finite
from .transition import MIN_SPEED
from .update import update_filter


@jit
def apply_packet(f: FilterRecord, gains: GainTables, s: int, packet: Vector) -> bool:
    """Correct by a sound packet according to its age.

    Args:
        f: Memory of the filter.
        gains: Tables of gains, shape (cells, rows, columns).
        s: Index of the slow sensor.
        packet: Packet, shape (PACKET_WIDTH,).

    Returns:
        Whether it was used.
    """
    if f.late == BUFFER:
        return rewind_update(f, gains, s, packet)
    first = find_clone(f, s, int(packet[PACKET.captured]))
    is_usable = first != DROPPED
    return is_usable and update_filter(f, gains, s, first, packet, is_usable)


@jit
def _is_whole(value: Any) -> Any:
    return floor(value) == value


@jit
def _is_timely(f: FilterRecord, captured: Any, arrived: Any) -> bool:
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
def _is_frozen(f: FilterRecord, s: int, packet: Vector) -> bool:
    """Return whether a packet repeats the sensor's last one while the car moves.

    Two values or more, and all there are, are equal: noise repeats no number, and a receiver's
    rounded course comes with a position.
    """
    last = f.last[s]
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
def is_valid(f: FilterRecord, packet: Vector) -> bool:
    """Return whether a packet is one for this filter and fit for use; what is not is counted.

    Numbers are judged as floats, before any becomes an int.

    Args:
        f: Memory of the filter.
        packet: Packet, shape (PACKET_WIDTH,).

    Returns:
        True for a packet to use.
    """
    for i in range(PACKET.value):
        if not is_finite(packet[i]):
            f.counts[COUNTERS.invalid] += 1
            return False
    sensor = packet[PACKET.sensor]
    if sensor < 0.0 or sensor >= N_SLOW or not _is_whole(sensor):
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
    if f.wary > 0 and _is_frozen(f, s, packet):
        f.counts[COUNTERS.stuck] += 1
        return False
    return True


@jit
def _store_waiting(f: FilterRecord, s: int, packet: Vector) -> bool:
    """Queue a packet for the next step that listens; False if it is refused, and counted."""
    if is_duplicate(f, s, int(packet[PACKET.captured])):
        return False
    for i in range(f.waits):
        is_same_sensor = f.waiting[i, PACKET.sensor] == packet[PACKET.sensor]
        if is_same_sensor and f.waiting[i, PACKET.captured] == packet[PACKET.captured]:
            f.counts[COUNTERS.duplicates] += 1
            return False
    if f.waits == N_WAITING:
        f.counts[COUNTERS.refused] += 1
        return False
    copy_into(packet, f.waiting[f.waits])
    f.waits += 1
    return True


@jit
def process_sample(f: FilterRecord, gains: GainTables) -> bool:
    """Process the packet in f.sample, see `process_packet`.

    Args:
        f: Memory of the filter.
        gains: Tables of gains, shape (cells, rows, columns).

    Returns:
        False if it was dropped.
    """
    f.nis = np.nan
    if not is_valid(f, f.sample):
        return False
    s = int(f.sample[PACKET.sensor])
    if f.pace > 1 and not (f.has_started == 1 and (f.tick - f.origin) % f.pace == 0):
        return _store_waiting(f, s, f.sample)
    return apply_packet(f, gains, s, f.sample)


@noinline
def process_packet(f: FilterRecord, gains: GainTables, packet: Vector) -> bool:
    """Use a packet that has arrived, queue it for the next step, or drop and count it.

    Args:
        f: Memory of the filter.
        gains: Tables of gains, shape (cells, rows, columns).
        packet: Packet, shape (PACKET_WIDTH,).

    Returns:
        False if it was dropped.
    """
    copy_into(packet, f.sample)
    return process_sample(f, gains)


@jit
def apply_waiting(f: FilterRecord, gains: GainTables) -> None:
    """Correct by the packets that came since the last step that listened.

    Args:
        f: Memory of the filter.
        gains: Tables of gains, shape (cells, rows, columns).
    """
    for i in range(f.waits):
        copy_into(f.waiting[i], f.sample)
        apply_packet(f, gains, int(f.sample[PACKET.sensor]), f.sample)
    f.waits = 0
