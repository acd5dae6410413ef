"""Sources of a receiver's bytes: a file, a serial port, a TCP peer.

Args:
    path: Path of the file.
"""

import re
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..numerics import require_extra
from ..validation import short_repr

if TYPE_CHECKING:
    from .nmea import Counts, Epoch

BAUD = 4800  # of NMEA 0183
_PAUSE = 0.5  # s without a byte after which b"" is handed out
_CHUNK_SIZE = 65_536  # bytes of a chunk, and those that show what a file holds
_LINE = re.compile(rb"\$(?:[A-Z]{2}(?:RMC|GGA|GNS|GLL),|[A-Z]{3,6},[^$*\r\n]*\*[0-9A-Fa-f]{2})")


@dataclass
class ByteSource:
    """The bytes of a receiver in chunks, b"" where none came for a while; only a file ends.

    Iterating raises OSError where the line cannot be opened at first, ConnectionError where it was
    lost and does not come back; leaving the loop closes it.
    """

    name: str  # for messages
    read: Callable[[], Iterator[bytes]]  # opens the line, and yields b"" first
    tries: int = 5  # to open a lost line again before a byte comes
    wait: float = 1.0  # s, before each
    losses: int = 0  # of the line so far

    def __iter__(self) -> Iterator[bytes]:
        failures, is_open, is_first = 0, False, True
        while True:
            try:
                for chunk in self.read():
                    is_open, failures = True, 0 if chunk else failures
                    yield chunk
                return
            except OSError as error:
                if is_first and not is_open:
                    raise
                self.losses += is_open
                failures += 1
                if failures > self.tries:
                    text = f"{self.name}: lost, and not back after {self.tries} tries: {error}"
                    raise ConnectionError(text) from None
            is_open = is_first = False
            yield b""
            time.sleep(self.wait)


def make_source(text: str) -> ByteSource:
    """Make the source that a text names; nothing is opened before it is iterated.

    Raises ValueError for a text of another form and a folder, FileNotFoundError without the file.

    Args:
        text: A file's path, serial:PORT[:BAUD] (extra `wires`) or tcp:HOST:PORT.
    """
    kind, _, rest = text.partition(":")
    head, _, number = rest.rpartition(":")
    if kind == "serial" and rest:
        port, baud = (head, int(number)) if head and number.isdecimal() else (rest, BAUD)
        return ByteSource(text, lambda: _read_serial(port, baud))
    if kind == "tcp":
        if not (head and number.isdecimal() and 0 < int(number) < 65_536):
            raise ValueError(f"expected tcp:HOST:PORT, got {short_repr(text)}")
        host = head.strip("[]")
        return ByteSource(text, lambda: _read_tcp(host, int(number)))
    path = Path(text)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.is_dir():
        raise ValueError(f"{path}: expected a file, found a folder")
    return ByteSource(text, lambda: _read_file(path), tries=0)


def is_nmea(path: str | Path) -> bool:
    """Check whether a file is NMEA, by its ending or a sentence near its start, valid or not."""
    source = Path(path)
    if (is_named := source.suffix.lower() == ".nmea") or not source.is_file():
        return is_named
    with source.open("rb") as stream:
        return bool(_LINE.search(stream.read(_CHUNK_SIZE)))


def read_nmea(path: str | Path) -> tuple[list["Epoch"], "Counts"]:
    """Read all epochs of a file, their dates mended, and its counts (extra `wires`).

    Raises FileNotFoundError without it, ValueError for a folder and where no sentence is valid or
    no epoch has a fix.
    """
    from .nmea import Decoder, correct_dates

    decoder, sent = Decoder(), []
    for chunk in make_source(str(Path(path).absolute())):
        sent += decoder.decode_chunk(chunk)
    sent += decoder.finish()
    epochs, counts = correct_dates(sent), decoder.counts
    counts.redated = sum(abs(new.t - old.t) > 0.0 for new, old in zip(epochs, sent, strict=True))
    if not counts.received:
        raise ValueError(f"{path}: the file is empty")
    if not counts.sentences:
        received = ", ".join(f"{n} {what}" for what, n in counts.rows() if n)
        raise ValueError(f"{path}: no valid NMEA sentence in {received}")
    if not any(epoch.has_fix and epoch.t == epoch.t for epoch in epochs):
        lacks = "both a fix and a time" if any(epoch.has_fix for epoch in epochs) else "a fix"
        kinds = ", ".join(f"{n} {kind}" for kind, n in sorted(counts.sentences.items()))
        raise ValueError(f"{path}: none of {len(epochs)} epochs has {lacks}; sentences: {kinds}")
    return epochs, counts


def _read_file(path: Path) -> Iterator[bytes]:
    with path.open("rb", buffering=0) as stream:
        yield b""
        while chunk := stream.read(_CHUNK_SIZE):
            yield chunk


def _read_serial(port: str, baud: int) -> Iterator[bytes]:
    with require_extra("wires", "a serial port needs pyserial"):
        import serial
    with serial.Serial(port, baud, timeout=_PAUSE) as device:
        yield b""
        while True:
            yield bytes(device.read(min(device.in_waiting or 1, _CHUNK_SIZE)))


def _read_tcp(host: str, port: int) -> Iterator[bytes]:
    with socket.create_connection((host, port), timeout=5.0) as peer:
        yield b""
        peer.settimeout(_PAUSE)
        chunk: bytes | None = None
        while chunk != b"":
            try:
                yield (chunk := peer.recv(_CHUNK_SIZE))
            except TimeoutError:
                yield b""
        raise ConnectionError("the peer closed")
