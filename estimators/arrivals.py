"""A packet that is here: sound or not, for now or for the next step."""

from typing import Any

import numpy as np

from ..envs.backend import jit
from ..envs.record import GPS, PACKET, PACKET_WIDTH
from .delay import BUFFER, DROPPED, find
from .innovation import SATELLITES
from .measure import measure
from .memory import COUNTERS, SLOW, WAITING
from .rewind import take_late
from .speed import finite


@jit
def use(f: Any, gains: Any, s: int, packet: Any) -> None:
    """Use a sound packet of sensor s according to its age."""
    if f.late == BUFFER:
        take_late(f, gains, s, packet)
        return
    first = find(f, s, int(packet[PACKET.captured]))
    if first != DROPPED:
        measure(f, gains, s, first, packet)


@jit
def sound(f: Any, packet: Any) -> bool:
    """Whether a packet is one for this filter and fit for use; what is not is counted."""
    for i in range(PACKET.value):
        if not finite(packet[i]):
            f.counts[COUNTERS.invalid] += 1
            return False
    s = int(packet[PACKET.sensor])
    if s < 0 or s >= SLOW:
        f.counts[COUNTERS.unknown] += 1
        return False
    if f.period[s] == 0:
        return False
    for i in range(f.rows[s]):
        if not finite(packet[PACKET.value + i]):
            f.counts[COUNTERS.invalid] += 1
            return False
    satellites = packet[PACKET.value + SATELLITES]  # 0 or NaN: not told
    few = s == GPS and satellites > 0.0 and satellites < f.satellites
    if packet[PACKET.quality] <= 0.0 or few:
        f.counts[COUNTERS.poor] += 1
        return False
    return True


@jit
def receive(f: Any, gains: Any, packet: Any) -> None:
    """Use a packet that is here now, keep it for the next step, or drop and count it."""
    f.nis = np.nan
    if not sound(f, packet):
        return
    if f.pace > 1 and not (f.begun == 1 and (f.tick - f.origin) % f.pace == 0):
        if f.waits == WAITING:
            f.counts[COUNTERS.refused] += 1
            return
        for i in range(PACKET_WIDTH):
            f.waiting[f.waits, i] = packet[i]
        f.waits += 1
        return
    use(f, gains, int(packet[PACKET.sensor]), packet)
