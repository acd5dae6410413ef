"""The datagrams on a car's wires: a decoder that raises nothing, and the ticks that they make.

docs/howto/live.md has their format, of which a change is another VERSION, but for STATUS, which no
other program gets. A fast row, an INERTIAL datagram, ends its tick; packets of slow sensors belong
to the next row, captured their age before their stamp or, where that is 0, before that row. Equal
batches give equal ticks.
"""

import math
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from enum import IntEnum, StrEnum
from typing import NamedTuple

import numpy as np

from ...envs.numerics.functions import TICK
from ...envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Array
from ...envs.sensors.slow import CAMERA, GPS, SLOW

MAGIC, VERSION = b"SLIP", 1
HEADER = struct.Struct("!4sBBHIq")
MAX_BYTES = 1400  # bytes: fits a frame of Ethernet
LIMIT = 1e7  # the largest magnitude of any value, SI
MAX_STAMP = 2**53  # us: 285 years, and a whole number as a double too
MAX_AGE = 10.0  # s, largest age of a slow sensor's packet
TICK_US = 1000  # us a tick
PATIENCE = 10  # ticks of silence, from which on the last row is held
MAX_HELD = 1000  # ticks that are bridged; a longer gap begins anew
MAX_BEHIND = 100  # rows from the past in succession: then the sender's clock was set back
_WINDOW = 1024  # sequence numbers; one further back is of a sender that began anew
_MAX_WAITING = 64  # packets of slow sensors before a fast row
Address = tuple[str, int]  # host and port


class DatagramKind(IntEnum):
    """The kinds of datagrams."""

    INERTIAL = 1  # a fast row: the tick is complete with it
    CAMERA = 2
    GPS = 3
    ESTIMATE = 4  # states, their standard deviations, then their names
    CONTROL = 5  # answers a fast row, whose stamp it has
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
    """The counts of a loop, as the doubles of a datagram."""

    ticks: float = 0.0  # of the estimator
    misses: float = 0.0  # missed deadlines
    held: float = 0.0  # ticks without a row
    bad: float = 0.0  # datagrams with a `RejectReason`
    lost: float = 0.0  # sequence numbers that never came
    jitter: float = 0.0  # us, of the last tick
    latency: float = 0.0  # us, of the last tick with a datagram
    time: float = 0.0  # us, of the last tick's work
    deadlines: float = 0.0  # that were due: one a tick of the loop's clock
    healthy: float = 1.0  # 0 while the estimator is lost


SENSORS = {DatagramKind.CAMERA: CAMERA, DatagramKind.GPS: GPS}
KINDS = {place: kind for kind, place in SENSORS.items()}
FIELDS: dict[int, tuple[str, ...]] = {
    DatagramKind.INERTIAL: (*FAST._fields, "steer_next"),  # rad, the driver's command from now on
    **{  # age: s from capture to sending
        kind: (*(value.name for value in SLOW[place].values), "age", "quality")
        for kind, place in SENSORS.items()
    },
    DatagramKind.CONTROL: ("yaw_moment", "steering"),  # N m, rad, both added to the driver's
    DatagramKind.STATUS: LoopStatus._fields,
    DatagramKind.END: (),
}


class Message(NamedTuple):
    """The content of a valid datagram."""

    kind: int
    sequence: int  # of a datagram modulo 2^32
    stamp: int  # us
    values: Sequence[float]  # of `FIELDS`, in SI units
    names: tuple[str, ...] = ()  # of states, for estimates

    def encode(self) -> bytes:
        """Encode the message as a datagram."""
        kind, sequence, stamp, values, names = self
        head = HEADER.pack(MAGIC, VERSION, kind, len(values), sequence & 0xFFFFFFFF, stamp)
        return head + struct.pack(f"!{len(values)}d", *values) + ",".join(names).encode()


def decode(data: bytes) -> Message | RejectReason:
    """Decode a datagram, or say why to ignore it; it raises nothing.

    Args:
        data: Bytes of the datagram.
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


_INPUTS = (DatagramKind.INERTIAL, DatagramKind.END, *SENSORS)
NO_PACKETS = np.zeros((0, PACKET_WIDTH))
# Counts beside those of `RejectReason`: sequence numbers that never came, senders that began anew,
# ticks without a row, rows behind their tick, gaps too long to bridge, packets that no row took.
_STREAM_COUNTS = ("lost", "restarted", "held", "late", "begun anew", "dropped")


class Arrival(NamedTuple):
    """A datagram and its arrival."""

    at: int  # time of the monotonic clock (ns)
    data: bytes
    sender: Address | None = None


class Tick(NamedTuple):
    """The data of one tick."""

    number: int
    row: Array  # (FAST_WIDTH,)
    steer_next: float  # rad, the driver's command from now on
    packets: Array  # (count, PACKET_WIDTH)
    begins: bool  # forget everything before


class StreamSynchroniser:
    """Makes ticks from datagrams.

    Args:
        patience: Calls of `take` without a fast row before the last one is held; None: no limit.
    """

    def __init__(self, patience: int | None = PATIENCE) -> None:
        self.patience = patience
        self.counts = Counter[str]({name: 0 for name in (*RejectReason, *_STREAM_COUNTS)})
        self.sender: Address | None = None  # of the newest row
        self.accepted: list[bytes] = []  # of the newest batch
        self.over, self.silent = False, 0  # the drive's end came; calls since the last fast row
        self._newest: dict[int, Message] = {}  # by kind
        self._waiting: list[tuple[int, Message]] = []
        self._last: Tick | None = None
        self._behind = 0

    def take(self, batch: Sequence[Arrival]) -> Iterator[Tick]:
        """Take a batch of datagrams and yield the ticks that it completes; called once a period.

        Args:
            batch: Datagrams in the order of their arrival.

        Yields:
            Ticks in order.
        """
        before, self.silent = self.silent, self.silent + 1
        self.accepted.clear()
        for arrival in batch:
            message = decode(arrival.data)
            if isinstance(message, RejectReason):
                self.counts[message] += 1
            elif message.kind not in _INPUTS:
                self.counts[RejectReason.KIND] += 1
            elif self._check_order(message):
                self.accepted.append(arrival.data)
                if message.kind == DatagramKind.INERTIAL:
                    self.sender, self.silent = arrival.sender, 0
                    yield from self._process_row(message)
                elif message.kind in SENSORS:
                    self._waiting.append((SENSORS[DatagramKind(message.kind)], message))
                    if len(self._waiting) > _MAX_WAITING:  # no row takes them
                        self.counts["dropped"] += 1
                        del self._waiting[0]
                elif message.kind == DatagramKind.END:
                    self.over = True
        last, patience = self._last, self.patience
        if last is not None and self.silent and patience is not None and self.silent > patience:
            # the first call beyond the patience catches up on the ticks that it waited for
            for _ in range(patience + 1 if before == patience else 1):
                self.counts["held"] += 1
                last = last._replace(number=last.number + 1, begins=False)
                yield self._finish_tick(last)

    def _check_order(self, message: Message) -> bool:
        """Return whether a message is the newest of its kind; count it otherwise."""
        newest = self._newest.get(message.kind)
        if newest is not None:
            advance = (message.sequence - newest.sequence) & 0xFFFFFFFF
            # a lower number on a later datagram is of a sender that began anew
            is_older = 2**32 - advance < _WINDOW and message.stamp <= newest.stamp
            if advance == 0 or is_older:
                self.counts[RejectReason.REORDERED if advance else RejectReason.DUPLICATE] += 1
                return False
            if advance < 2**31:
                self.counts["lost"] += advance - 1
            else:
                self.counts["restarted"] += 1
                self._last = None if message.kind == DatagramKind.INERTIAL else self._last
        self._newest[message.kind] = message
        return True

    def _process_row(self, message: Message) -> Iterator[Tick]:
        """Yield the tick of a fast row, after those that are missing before it."""
        number, last = round(message.stamp / TICK_US), self._last
        begins = last is None
        if last is not None:
            missing = number - last.number - 1
            if missing < 0:
                self._behind += 1
                if self._behind <= MAX_BEHIND:
                    self.counts["late"] += 1
                    return
            begins = not 0 <= missing <= MAX_HELD
            self.counts["begun anew"] += begins
            for skipped in range(0 if begins else missing):
                self.counts["held"] += 1
                held = last.number + 1 + skipped
                yield last._replace(number=held, packets=NO_PACKETS, begins=False)
        self._behind = 0
        fast, steer_next = np.array(message.values[:FAST_WIDTH]), message.values[-1]
        yield self._finish_tick(Tick(number, fast, steer_next, NO_PACKETS, begins))

    def _finish_tick(self, tick: Tick) -> Tick:
        """Add the waiting packets to a tick."""
        packets = NO_PACKETS
        if self._waiting:
            packets = np.zeros((len(self._waiting), PACKET_WIDTH))
            for packet, (sensor, message) in zip(packets, self._waiting, strict=True):
                *values, age, quality = message.values
                sent = round(message.stamp / TICK_US) if message.stamp else tick.number
                captured = sent - round(age / TICK)
                head = sensor, captured, tick.number, quality, message.sequence
                packet[: PACKET.value + len(values)] = *head, *values
            packets = packets[np.lexsort(packets[:, [PACKET.sensor, PACKET.captured]].T)]
            self._waiting.clear()
        self._last = tick._replace(packets=packets)
        return self._last
