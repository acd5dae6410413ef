"""A packet that is here: sound or not, for now or for the next step.

A packet is a row (PACKET_WIDTH,), columns as in `envs.record.Packet`.
"""

from typing import Any

import numpy as np

from ...envs.backend.decorators import apart, copied, jit
from ...envs.backend.primitives import floor
from ...envs.record import PACKET, PACKET_WIDTH
from .delay import BUFFER, DROPPED, find, known
from .memory import COUNTERS, SLOW, WAITING, Gains, Memory, Row
from .rewind import take_late
from .speed import finite
from .transition import SLOWEST
from .update import measure


@jit
def use(f: Memory, gains: Gains, s: int, packet: Row) -> bool:
    """Use a sound packet of sensor s according to its age; whether it was used."""
    if f.late == BUFFER:
        return take_late(f, gains, s, packet)
    first = find(f, s, int(packet[PACKET.captured]))
    found = first != DROPPED
    return found and measure(f, gains, s, first, packet, found)


@jit
def _whole(value: Any) -> Any:
    return floor(value) == value


@jit
def _timely(f: Memory, captured: Any, arrived: Any) -> bool:
    """Whether stamps are ticks from the first row to now, in their order; else counted."""
    if not (_whole(captured) and _whole(arrived)) or arrived < captured:
        f.counts[COUNTERS.unknown] += 1
    elif arrived > f.tick:
        f.counts[COUNTERS.future] += 1
    elif captured < f.start:
        f.counts[COUNTERS.refused] += 1
    else:
        return True
    return False


@jit
def _stuck(f: Memory, s: int, packet: Row) -> bool:
    """Whether two values or more, and all there are, are those of the sensor's last packet, and the
    car moves: noise repeats no number, and a receiver's rounded course comes with a position."""
    last = f.last[s]
    if packet[PACKET.captured] == last[PACKET.captured]:  # a duplicate
        return False
    same = 0
    for i in range(PACKET.value, PACKET_WIDTH):
        if packet[i] == last[i]:
            same += 1
        elif finite(packet[i]):
            same = 0 - PACKET_WIDTH
    copied(packet, last)
    return same > 1 and f.speed > SLOWEST


@jit
def sound(f: Memory, packet: Row) -> bool:
    """Whether a packet is one for this filter and fit for use; what is not is counted.

    Numbers are judged as floats, before any becomes an int.
    """
    for i in range(PACKET.value):
        if not finite(packet[i]):
            f.counts[COUNTERS.invalid] += 1
            return False
    sensor = packet[PACKET.sensor]
    if sensor < 0.0 or sensor >= SLOW or not _whole(sensor):
        f.counts[COUNTERS.unknown] += 1
        return False
    s = int(sensor)
    if f.period[s] == 0 or not _timely(f, packet[PACKET.captured], packet[PACKET.arrived]):
        return False
    for i in range(f.rows[s]):
        if not finite(packet[PACKET.value + i]):
            f.counts[COUNTERS.invalid] += 1
            return False
    few, column = False, f.satellites_column[s]
    if column > 0:
        few = packet[column] > 0.0 and packet[column] < f.least_satellites  # 0 or NaN: unknown
    if packet[PACKET.quality] <= 0.0 or few:
        f.counts[COUNTERS.poor] += 1
        return False
    if f.wary > 0 and _stuck(f, s, packet):
        f.counts[COUNTERS.stuck] += 1
        return False
    return True


@jit
def _wait(f: Memory, s: int, packet: Row) -> bool:
    """Queue a packet for the next step that listens; False if it is refused, and counted."""
    if known(f, s, int(packet[PACKET.captured])):
        return False
    for i in range(f.waits):
        same = f.waiting[i, PACKET.sensor] == packet[PACKET.sensor]
        if same and f.waiting[i, PACKET.captured] == packet[PACKET.captured]:
            f.counts[COUNTERS.duplicates] += 1
            return False
    if f.waits == WAITING:
        f.counts[COUNTERS.refused] += 1
        return False
    copied(packet, f.waiting[f.waits])
    f.waits += 1
    return True


@jit
def receive_sample(f: Memory, gains: Gains) -> bool:
    """`receive` the packet that lies in f.sample."""
    f.nis = np.nan
    if not sound(f, f.sample):
        return False
    s = int(f.sample[PACKET.sensor])
    if f.pace > 1 and not (f.begun == 1 and (f.tick - f.origin) % f.pace == 0):
        return _wait(f, s, f.sample)
    return use(f, gains, s, f.sample)


@apart
def receive(f: Memory, gains: Gains, packet: Row) -> bool:
    """Use a packet that is here now, queue it for the next step, or drop and count it; False if it
    was dropped."""
    copied(packet, f.sample)
    return receive_sample(f, gains)


@jit
def use_waiting(f: Memory, gains: Gains) -> None:
    """Use the packets that came since the last step that listened."""
    for i in range(f.waits):
        copied(f.waiting[i], f.sample)
        use(f, gains, int(f.sample[PACKET.sensor]), f.sample)
    f.waits = 0
