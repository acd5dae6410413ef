"""The queue of slow sensors' packets: capture at a tick, delivery at their arrival; compiled.

Packets are delivered in the order (captured tick, sensor); what is under way lies in the state.
"""

from typing import Any

from ..backend.arrays import read
from ..backend.decorators import jit
from ..backend.primitives import maximum, minimum, select, word
from ..record import PACKET, PACKET_WIDTH
from ..sensors.link import arrivals
from ..sensors.slow import BLOCKS, SEES, VALUES, Scene, sample
from ..ticks import NEVER
from .layout import FLAGS, P, Z

FAR = 1e15


@jit
def _push(z: Any, sensor: int, captured: Any, due: Any, quality: Any, frame: Any, v: Any) -> None:
    """Put a captured sample on its way; that the queue is long enough, `link_of` has checked."""
    slot = int(z[Z.under_way])
    packet = z[Z.queue + slot * PACKET_WIDTH :]
    packet[PACKET.sensor] = sensor
    packet[PACKET.captured] = captured
    packet[PACKET.arrived] = due
    packet[PACKET.quality] = quality
    packet[PACKET.sequence] = frame
    for i in range(VALUES):
        packet[PACKET.value + i] = v[i]
    z[Z.under_way] = slot + 1.0
    z[Z.clock.next_due] = minimum(z[Z.clock.next_due], due)


@jit
def _capture(z: Any, sensor: int, link: Any, tick: Any, key: Any, v: Any, q: Any) -> None:
    """A frame of a slow sensor: queue it for its arrivals and set the clock on."""
    at = Z.slow[sensor]
    frame = z[at.frames]
    first, second = arrivals(link, frame, tick, key[0], key[1], BLOCKS[sensor].link)
    if first != NEVER:
        _push(z, sensor, tick, first, q, frame, v)
    if second != NEVER:
        _push(z, sensor, tick, second, q, frame, v)
    z[at.frames] = frame + 1.0
    z[at.next_capture] = tick + link.period


@jit
def note(z: Any, packet: Any, tick: Any) -> None:
    """A packet (PACKET_WIDTH,) that is here becomes its sensor's newest sample, if it is newer."""
    sensor = int(packet[PACKET.sensor])
    newest = Z.slow[sensor]
    nothing = SEES[sensor] and packet[PACKET.quality] <= 0.0
    if not nothing and packet[PACKET.captured] > z[newest.captured]:
        z[newest.captured] = packet[PACKET.captured]
        for i in range(VALUES):
            z[newest.values[0] + i] = packet[PACKET.value + i]
        z[newest.arrived] = tick


@jit
def _deliver(z: Any, tick: Any, packets: Any, count: int) -> int:
    """Move the packets that arrive at this tick into `packets`; returns the new count."""
    while True:
        best, best_rank, due = -1, FAR, FAR
        under_way = int(z[Z.under_way])
        for slot in range(under_way):
            at = Z.queue + slot * PACKET_WIDTH
            arrived = z[at + PACKET.arrived]
            if arrived == tick:
                rank = len(Z.slow) * z[at + PACKET.captured] + z[at + PACKET.sensor]
                if rank < best_rank:
                    best, best_rank = at, rank
            else:
                due = minimum(due, arrived)
        if best < 0:
            z[Z.clock.next_due] = due
            return count
        for i in range(PACKET_WIDTH):
            packets[count, i] = z[best + i]
        note(z, packets[count], tick)
        last = Z.queue + (under_way - 1) * PACKET_WIDTH  # it takes the free place
        for i in range(PACKET_WIDTH):
            z[best + i] = z[last + i]
        z[Z.under_way] = under_way - 1.0
        count += 1


@jit
def next_due(z: Any, tick: Any) -> Any:
    """The first tick after this one at which a slow sensor captures or a packet arrives."""
    soon = maximum(z[Z.clock.next_due], tick + 1.0)
    for sensor in range(len(Z.slow)):
        capture = z[Z.slow[sensor].next_capture]
        soon = select(capture > tick, minimum(soon, capture), soon)
    return soon


@jit
def scene_of(p: Any, motion: Any, small_angle: int, key: Any, tick: Any) -> Scene:
    """The scene that slow sensors see at a tick."""
    road, car, noise = read(p, P.road), read(p, P.car), read(p, P.noise)
    sky, sight = read(p, P.sky), read(p, P.sight)
    return Scene(motion, road, car, noise, sky, sight, small_angle, key[0], key[1], tick)


@jit
def sense_slow(row: Any, motion: Any, tick: Any, count: int) -> int:
    """The slow sensors sample the motion at a tick, and due packets are delivered.

    Returns how many packets there are then.
    """
    p, z, small_angle = row.p, row.z, row.switches[FLAGS.small_angle]
    key = (word(z[Z.clock.key_low]), word(z[Z.clock.key_high]))
    for sensor in range(len(Z.slow)):
        at = Z.slow[sensor]
        if tick == z[at.next_capture]:
            link, scene = read(p, P.slow[sensor]), scene_of(p, motion, small_angle, key, tick)
            values, quality, z[at.drift] = sample(sensor, scene, link, z[at.drift])
            _capture(z, sensor, link, tick, key, values, quality)
    if tick >= z[Z.clock.next_due]:
        count = _deliver(z, tick, row.packets, count)
    return count
