"""The relay: a receiver's NMEA, decoded, as datagrams of course, speed, HDOP and satellites."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from ...envs.recordings.geodesy import to_metres
from ...envs.recordings.sources import make_source
from .datagrams import MAX_AGE, DatagramKind
from .port import Port

MAX_HDOP = 99.0  # of a receiver without a fix
MAX_PAUSE = 10.0  # s between two epochs of a file


@dataclass
class Relay:
    """Sends the epochs of a source as datagrams.

    A lost line is opened again.

    Attributes:
        source: Source, as for `envs.recordings.sources.make_source`, whose errors it raises.
        port: Port that sends.
        to: Address of the receiver.
        latency: Delay from an epoch to its sentences (s), added to the age.
        speed: Speed of a file's clock, 1 for real time.
        sent: Number of datagrams.
        error: Reason of the end, "" at a file's end.
        counts: Counts of the decoder.
    """

    source: str
    port: Port
    to: Any
    latency: float = 0.0
    speed: float = 1.0
    sent: int = 0
    error: str = ""
    counts: Any = None
    _origin: tuple[float, float] | None = field(default=None)

    def __post_init__(self) -> None:
        self._chunks = make_source(self.source)

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Relay until the source ends or is lost.

        Args:
            stop: Function that returns whether to stop.
        """
        is_file = not self.source.startswith(("serial:", "tcp:"))
        last_time, due = math.nan, time.monotonic()
        try:
            for epoch in self._iterate_epochs():
                if epoch is not None and is_file and epoch.t > last_time:
                    due += min(epoch.t - last_time, MAX_PAUSE) / self.speed
                while not stop() and is_file and (left := due - time.monotonic()) > 0.0:
                    time.sleep(min(left, 0.1))
                if stop():
                    return
                if epoch is not None:
                    last_time = epoch.t
                    self.port.send(self.to, DatagramKind.GPS, 0, self._make_values(epoch))
                    self.sent += 1
        except OSError as error:
            self.error = str(error)

    def _iterate_epochs(self) -> Iterator[Any]:
        """Iterate over the epochs, with None after each chunk of bytes."""
        from ...envs.recordings.nmea import Decoder

        decoder = Decoder()
        self.counts = decoder.counts
        for chunk in self._chunks:
            yield from decoder.decode_chunk(chunk)
            yield None
        yield from decoder.finish()

    def _make_values(self, epoch: Any) -> list[float]:
        """Make the doubles of a datagram; an unknown number is 0, an unknown HDOP the worst."""
        X, Y = self._compute_position(epoch) if epoch.has_fix else (0.0, 0.0)
        hdop = epoch.hdop if math.isfinite(epoch.hdop) else MAX_HDOP
        course, speed = (value if math.isfinite(value) else 0.0 for value in epoch[3:5])
        age = epoch.age + self.latency
        age = min(max(age, 0.0), MAX_AGE) if math.isfinite(age) else MAX_AGE
        return [course, speed, X, Y, hdop, float(epoch.satellites), age, float(epoch.quality)]

    def _compute_position(self, epoch: Any) -> tuple[float, float]:
        """Compute the position east and north of the first fix (m)."""
        if self._origin is None:
            self._origin = epoch.latitude, epoch.longitude
        east, north = to_metres(epoch.latitude, epoch.longitude, self._origin)
        return float(east), float(north)
