"""The datagrams on a car's wires: their format, and a decoder that nothing makes raise.

Network byte order: a header of 20 bytes, `count` doubles and, behind the estimates, names.

| bytes | header |
|---|---|
| 0-3 | "SLIP" |
| 4 | VERSION |
| 5 | kind, of `Kind` |
| 6-7 | count, the doubles that follow |
| 8-11 | sequence number: of this sender's datagrams of this kind, modulo 2^32 |
| 12-19 | stamp, us of the inertial sender's clock, int64, 0 to 2^53; 0: of another clock |

FIELDS names the doubles of each kind, in SI units. A change of any of it is another VERSION.
"""

import math
import struct
from collections.abc import Sequence
from enum import IntEnum, StrEnum
from typing import NamedTuple

from ...envs.record import FAST
from ...envs.sensors.slow import CAMERA, GPS, SLOW

MAGIC, VERSION = b"SLIP", 1
HEADER = struct.Struct("!4sBBHIq")
MOST = 1400  # bytes: fits a frame of Ethernet
LIMIT = 1e7  # the largest magnitude of any value, SI
LATEST = 2**53  # us: 285 years, and a whole number as a double too
LONGEST_AGE = 10.0  # s, of a slow sensor's sample
STAMP = 1000  # us a tick


class Kind(IntEnum):
    """What a datagram holds."""

    INERTIAL = 1  # a fast row: the tick is complete with it
    CAMERA = 2
    GPS = 3
    ESTIMATE = 4  # states, their standard deviations, then their names
    CONTROL = 5  # its stamp is that of the fast row it answers
    STATUS = 6  # what the loop has counted
    END = 7  # the drive is over


class Bad(StrEnum):
    """Why a datagram is ignored; every one is counted."""

    FOREIGN = "foreign"  # shorter than a header, or without the magic
    VERSION = "version"
    KIND = "kind"
    LENGTH = "length"
    OVERSIZED = "oversized"
    NOT_FINITE = "not finite"
    RANGE = "range"
    DUPLICATE = "duplicate"  # the same sequence number as the newest
    REORDERED = "reordered"  # an older one


class Status(NamedTuple):
    """What a loop has counted, as the doubles of a datagram; latencies and jitter in us."""

    ticks: float = 0.0
    misses: float = 0.0
    held: float = 0.0
    bad: float = 0.0
    lost: float = 0.0
    jitter: float = 0.0
    latency: float = 0.0
    time: float = 0.0  # us of the last tick's work


def _slow(place: int) -> tuple[str, ...]:
    return *(value.name for value in SLOW[place].values), "age", "quality"


SENSORS = {Kind.CAMERA: CAMERA, Kind.GPS: GPS}
FIELDS: dict[int, tuple[str, ...]] = {
    Kind.INERTIAL: (*FAST._fields, "steer_next"),  # rad, the driver's command from now on
    **{kind: _slow(place) for kind, place in SENSORS.items()},  # age: s from capture to sending
    Kind.CONTROL: ("yaw_moment", "steering"),  # N m, rad, both added to the driver's
    Kind.STATUS: Status._fields,
    Kind.END: (),
}


class Message(NamedTuple):
    """What a sound datagram holds."""

    kind: int
    sequence: int
    stamp: int  # us
    values: tuple[float, ...]
    names: tuple[str, ...] = ()


def encode(
    kind: int, sequence: int, stamp: int, values: Sequence[float], names: Sequence[str] = ()
) -> bytes:
    """The datagram of a message; sequence: is taken modulo 2^32. stamp: us."""
    count = len(values)
    head = HEADER.pack(MAGIC, VERSION, kind, count, sequence & 0xFFFFFFFF, stamp)
    return head + struct.pack(f"!{count}d", *values) + ",".join(names).encode()


def decode(data: bytes) -> Message | Bad:
    """The message of a datagram, or why there is none."""
    if len(data) > MOST:
        return Bad.OVERSIZED
    if len(data) < HEADER.size or data[:4] != MAGIC:
        return Bad.FOREIGN
    _, version, kind, count, sequence, stamp = HEADER.unpack_from(data)
    end = HEADER.size + 8 * count
    names: tuple[str, ...] = ()
    if version != VERSION:
        return Bad.VERSION
    if kind == Kind.ESTIMATE:
        names = tuple(data[end:].decode("ascii", "replace").split(","))
        if end > len(data) or count != 2 * len(names):
            return Bad.LENGTH
    elif kind not in FIELDS:
        return Bad.KIND
    elif end != len(data) or count != len(FIELDS[kind]):
        return Bad.LENGTH
    values = struct.unpack_from(f"!{count}d", data, HEADER.size)
    if not all(map(math.isfinite, values)):
        return Bad.NOT_FINITE
    far = kind != Kind.STATUS and any(abs(value) > LIMIT for value in values)
    if far or not 0 <= stamp <= LATEST:
        return Bad.RANGE
    if kind in SENSORS and not 0.0 <= values[-2] <= LONGEST_AGE:
        return Bad.RANGE
    return Message(kind, sequence, stamp, values, names)
