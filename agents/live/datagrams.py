"""The datagrams on a car's wires: their format, and a decoder that nothing makes raise.

Network byte order: a header of 20 bytes, `count` doubles and, behind the estimates, names.

| bytes | header |
|---|---|
| 0-3 | "SLIP" |
| 4 | VERSION |
| 5 | kind, of `DatagramKind` |
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
MAX_BYTES = 1400  # bytes: fits a frame of Ethernet
LIMIT = 1e7  # the largest magnitude of any value, SI
MAX_STAMP = 2**53  # us: 285 years, and a whole number as a double too
MAX_AGE = 10.0  # s, of a slow sensor's sample
TICK_US = 1000  # us a tick


class DatagramKind(IntEnum):
    """The kinds of datagrams."""

    INERTIAL = 1  # a fast row: the tick is complete with it
    CAMERA = 2
    GPS = 3
    ESTIMATE = 4  # states, their standard deviations, then their names
    CONTROL = 5  # its stamp is that of the fast row it answers
    STATUS = 6  # what the loop has counted
    END = 7  # the drive is over


class RejectReason(StrEnum):
    """The reasons to ignore a datagram; each is counted."""

    FOREIGN = "foreign"  # shorter than a header, or without the magic
    VERSION = "version"
    KIND = "kind"
    LENGTH = "length"
    OVERSIZED = "oversized"
    NOT_FINITE = "not finite"
    RANGE = "range"
    DUPLICATE = "duplicate"  # the same sequence number as the newest
    REORDERED = "reordered"  # an older one


class LoopStatus(NamedTuple):
    """The counts of a loop, as the doubles of a datagram; latencies and jitter in us."""

    ticks: float = 0.0
    misses: float = 0.0
    held: float = 0.0
    bad: float = 0.0
    lost: float = 0.0
    jitter: float = 0.0
    latency: float = 0.0
    time: float = 0.0  # us of the last tick's work


def _list_slow_fields(place: int) -> tuple[str, ...]:
    return *(value.name for value in SLOW[place].values), "age", "quality"


SENSORS = {DatagramKind.CAMERA: CAMERA, DatagramKind.GPS: GPS}
FIELDS: dict[int, tuple[str, ...]] = {
    DatagramKind.INERTIAL: (*FAST._fields, "steer_next"),  # rad, the driver's command from now on
    **{
        kind: _list_slow_fields(place) for kind, place in SENSORS.items()
    },  # age: s from capture to sending
    DatagramKind.CONTROL: ("yaw_moment", "steering"),  # N m, rad, both added to the driver's
    DatagramKind.STATUS: LoopStatus._fields,
    DatagramKind.END: (),
}


class Message(NamedTuple):
    """The content of a valid datagram."""

    kind: int
    sequence: int
    stamp: int  # us
    values: tuple[float, ...]
    names: tuple[str, ...] = ()


def encode(
    kind: int, sequence: int, stamp: int, values: Sequence[float], names: Sequence[str] = ()
) -> bytes:
    """Encode a message.

    Args:
        kind: Kind of the datagram.
        sequence: Sequence number, taken modulo 2^32.
        stamp: Time stamp (us).
        values: Values of `FIELDS`, in SI units.
        names: Names of states, for estimates.

    Returns:
        Bytes of the datagram.
    """
    count = len(values)
    head = HEADER.pack(MAGIC, VERSION, kind, count, sequence & 0xFFFFFFFF, stamp)
    return head + struct.pack(f"!{count}d", *values) + ",".join(names).encode()


def decode(data: bytes) -> Message | RejectReason:
    """Decode a datagram; it raises nothing.

    Args:
        data: Bytes of the datagram.

    Returns:
        Message, or the reason to ignore it.
    """
    if len(data) > MAX_BYTES:
        return RejectReason.OVERSIZED
    if len(data) < HEADER.size or data[:4] != MAGIC:
        return RejectReason.FOREIGN
    _, version, kind, count, sequence, stamp = HEADER.unpack_from(data)
    end = HEADER.size + 8 * count
    names: tuple[str, ...] = ()
    if version != VERSION:
        return RejectReason.VERSION
    if kind == DatagramKind.ESTIMATE:
        names = tuple(data[end:].decode("ascii", "replace").split(","))
        if end > len(data) or count != 2 * len(names):
            return RejectReason.LENGTH
    elif kind not in FIELDS:
        return RejectReason.KIND
    elif end != len(data) or count != len(FIELDS[kind]):
        return RejectReason.LENGTH
    values = struct.unpack_from(f"!{count}d", data, HEADER.size)
    if not all(map(math.isfinite, values)):
        return RejectReason.NOT_FINITE
    is_large = kind != DatagramKind.STATUS and any(abs(value) > LIMIT for value in values)
    if is_large or not 0 <= stamp <= MAX_STAMP:
        return RejectReason.RANGE
    if kind in SENSORS and not 0.0 <= values[-2] <= MAX_AGE:
        return RejectReason.RANGE
    return Message(kind, sequence, stamp, values, names)
