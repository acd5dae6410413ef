"""Sensors at a tick: sample the state, put packets on their way, deliver those that arrive.

Packets are delivered in the order (captured tick, sensor); what is under way lies in the state.
"""

from typing import Any

from ..backend.arrays import fixed_tuple
from ..backend.decorators import jit, store
from ..backend.elementary import exp
from ..backend.primitives import minimum
from ..backend.random import CHANNELS, normals
from ..record import CAMERA, GPS, PACKET, PACKET_WIDTH, VALUES
from ..sensors.camera import camera_sample
from ..sensors.gps import Sky, gps_sample, sky_deviation
from ..sensors.link import Link, arrivals
from ..sensors.noise import Noise
from ..ticks import NEVER
from ..vehicle.dynamics import Road
from .layout import P, Z

FAR = 1e15
_LINK, _NOISE, _ROAD = len(Link._fields), len(Noise._fields), len(Road._fields)
_SKY = len(Sky._fields)


@jit
def _push(z: Any, sensor: int, captured: Any, due: Any, quality: Any, frame: Any, v: Any) -> None:
    """Put a captured sample on its way; the arrays' room was checked when the env was built."""
    slot = int(z[Z.under_way])
    store(z, Z.queue + slot * PACKET_WIDTH, (sensor * 1.0, captured, due, quality, frame))
    store(z, Z.queue + slot * PACKET_WIDTH + PACKET.value, v)
    z[Z.under_way] = slot + 1.0
    z[Z.clock + 5] = minimum(z[Z.clock + 5], due)


@jit
def _capture(z: Any, sensor: int, at: int, link: Any, tick: Any, key: Any, v: Any, q: Any) -> None:
    """A frame of a slow sensor: queue it for its arrivals and set the clock on."""
    frame = z[at]
    block = CHANNELS.camera_link if sensor == CAMERA else CHANNELS.gps_link
    first, second = arrivals(link, frame, tick, key[0], key[1], block)
    if first != NEVER:
        _push(z, sensor, tick, first, q, frame, v)
    if second != NEVER:
        _push(z, sensor, tick, second, q, frame, v)
    z[at] = frame + 1.0
    z[at + 1] = tick + link.period


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
                rank = 2.0 * z[at + PACKET.captured] + z[at + PACKET.sensor]
                if rank < best_rank:
                    best, best_rank = at, rank
            else:
                due = minimum(due, arrived)
        if best < 0:
            z[Z.clock + 5] = due
            return count
        for i in range(PACKET_WIDTH):
            packets[count, i] = z[best + i]
        newest = Z.camera if z[best] == CAMERA else Z.gps
        if z[best + PACKET.captured] > z[newest + 2]:
            z[newest + 2] = z[best + PACKET.captured]
            for i in range(VALUES):
                z[newest + 3 + i] = z[best + PACKET.value + i]
            z[newest + 3 + VALUES] = tick
        last = Z.queue + (under_way - 1) * PACKET_WIDTH  # it takes the free place
        for i in range(PACKET_WIDTH):
            z[best + i] = z[last + i]
        z[Z.under_way] = under_way - 1.0
        count += 1


@jit
def due(z: Any, tick: Any) -> bool:
    """Whether a slow sensor captures or a packet arrives at a tick."""
    captures = (tick == z[Z.camera + 1]) | (tick == z[Z.gps + 1])
    return bool(captures | (tick >= z[Z.clock + 5]))


@jit
def sense_slow(
    p: Any, z: Any, motion: Any, tick: Any, small_angle: int, packets: Any, count: int
) -> int:
    """The slow sensors sample the motion at a tick, and due packets are delivered.

    Returns how many packets there are then.
    """
    noise = Noise(*fixed_tuple(p[P.noise :], _NOISE))
    key = (int(z[Z.clock]), int(z[Z.clock + 1]))
    if tick == z[Z.camera + 1]:
        link = Link(*fixed_tuple(p[P.camera :], _LINK))
        road = Road(*fixed_tuple(p[P.road :], _ROAD))
        n = normals(key[0], key[1], int(tick), CHANNELS.camera)
        psi, y_l = camera_sample(motion, road, p[P.car + 11], noise, n)
        _capture(z, CAMERA, Z.camera, link, tick, key, (psi, y_l, 0.0, 0.0, 0.0, 0.0), 1.0)
    if tick == z[Z.gps + 1]:
        link = Link(*fixed_tuple(p[P.gps :], _LINK))
        n = normals(key[0], key[1], int(tick), CHANNELS.gps)
        sky = Sky(*fixed_tuple(p[P.sky :], _SKY))
        seen = normals(key[0], key[1], int(tick), CHANNELS.sky)
        z[Z.sky] = sky_deviation(z[Z.sky], sky, link, tick, seen)
        hdop = exp(sky.median + z[Z.sky])
        course, speed, X, Y, hdop, satellites, quality = gps_sample(
            motion, p[P.car + 17], p[P.car + 18], hdop, sky.weight, noise, n, small_angle
        )
        values = (course, speed, X, Y, hdop, satellites)
        _capture(z, GPS, Z.gps, link, tick, key, values, quality)
    if tick >= z[Z.clock + 5]:
        count = _deliver(z, tick, packets, count)
    return count
