"""A session on disk: every accepted datagram with its tick, and its replay bit for bit.

A file is a head (MAGIC, the length of its JSON, the JSON) and blocks that are appended as they are
full. A crash loses the last one at most, and a file that is cut is read up to there. A block has
a checksum of itself and one of all estimates so far, by which a replay checks itself. Nothing in a
file is run.
"""

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .assemble import Arrival, StreamSynchroniser
from .onboard import OnboardController

MAGIC = b"SLIPSES1"
MAX_BATCHES, MAX_BLOCK_BYTES = 100, 1 << 13  # of a block at most: a tenth of a second
_LENGTH = struct.Struct("!I")
_BLOCK = struct.Struct("!4sIIII")  # magic, batches, bytes, checksums of these and of estimates
_ITEM = struct.Struct("!HH")  # which batch of the block, bytes of the datagram
_MAGIC = b"BLOK"
_SETUP: dict[str, Any] = {
    **dict.fromkeys(("estimator", "agent", "env"), str),
    **dict.fromkeys(("options", "agent_options", "estimator_options"), dict),
    "seed": int,
    "patience": (int, type(None)),
}
"""Types of a session's setup, by key."""


class Recorder:
    """Writes a session.

    Args:
        path: File to write.
        setup: Setup of the replay, in JSON types.

    Raises:
        FileExistsError: The file exists; a session is never overwritten.
    """

    def __init__(self, path: Path | str, setup: Mapping[str, Any]) -> None:
        self._file = open(path, "xb", buffering=0)  # noqa: SIM115, closed by `close`
        text = json.dumps(dict(setup)).encode()
        self._file.write(MAGIC + _LENGTH.pack(len(text)) + text)
        self._items, self._batches, self._digest = bytearray(), 0, 0

    def note(self, onboard: OnboardController) -> None:
        """Add an estimate to the checksum.

        Args:
            onboard: On-board controller after a tick.
        """
        self._digest = update_digest(onboard, self._digest)

    def take(self, accepted: list[bytes]) -> None:
        """Record the accepted datagrams of a batch.

        Args:
            accepted: Datagrams of the batch.
        """
        for data in accepted:
            self._items += _ITEM.pack(self._batches, len(data)) + data
        self._batches += 1
        if self._batches == MAX_BATCHES or len(self._items) > MAX_BLOCK_BYTES:
            self._write()

    def _write(self) -> None:
        sizes = len(self._items), zlib.crc32(self._items), self._digest
        self._file.write(_BLOCK.pack(_MAGIC, self._batches, *sizes) + self._items)
        self._items, self._batches = bytearray(), 0

    def close(self) -> None:
        """Write the last block and close the file."""
        if self._batches:
            self._write()
        self._file.close()


def update_digest(onboard: OnboardController, digest: int) -> int:
    """Update the checksum of all estimates by the newest one.

    Args:
        onboard: On-board controller after a tick.
        digest: Checksum of the estimates before.

    Returns:
        CRC-32 of all estimates.
    """
    return zlib.crc32(onboard.std.tobytes(), zlib.crc32(onboard.x.tobytes(), digest))


class SessionBlock(NamedTuple):
    """A block of a session.

    Attributes:
        batches: Batches of datagrams.
        digest: Checksum of all estimates after the block.
    """

    batches: list[list[Arrival]]
    digest: int


def read_setup(path: Path | str) -> dict[str, Any]:
    """Read the setup of a session.

    Args:
        path: File of the session.

    Returns:
        Setup as JSON types.

    Raises:
        ValueError: The file is no session, or its setup is incomplete.
    """
    with open(path, "rb") as file:
        setup = _read_header(path, file)
    wrong = [name for name, kind in _SETUP.items() if not isinstance(setup.get(name, ...), kind)]
    if wrong:
        raise ValueError(f"{path}: its setup lacks {', '.join(wrong)}, or has it of another type")
    return setup


def _read_header(path: Path | str, file: Any) -> dict[str, Any]:
    if file.read(len(MAGIC)) == MAGIC:
        length = file.read(_LENGTH.size)
        if len(length) == _LENGTH.size:
            try:
                setup = json.loads(file.read(*_LENGTH.unpack(length)))
            except (ValueError, RecursionError):
                setup = None
            if isinstance(setup, dict):
                return setup
    raise ValueError(f"{path} is no session of `sideslip live --record`, or only its beginning")


def read_blocks(path: Path | str) -> Iterator[SessionBlock]:
    """Read the blocks of a session up to its end, or to where it was cut or damaged.

    Args:
        path: File of the session.
    """
    with open(path, "rb") as file:
        _read_header(path, file)
        while len(head := file.read(_BLOCK.size)) == _BLOCK.size:
            magic, count, size, check, digest = _BLOCK.unpack(head)
            data = file.read(size) if magic == _MAGIC and count <= MAX_BATCHES else b""
            if magic != _MAGIC or len(data) != size or zlib.crc32(data) != check:
                return
            batches = _parse_batches(data, count)
            if batches is None:
                return
            yield SessionBlock(batches, digest)


def _parse_batches(data: bytes, count: int) -> list[list[Arrival]] | None:
    """Parse the datagrams of each batch; None for data that no recorder wrote."""
    batches: list[list[Arrival]] = [[] for _ in range(count)]
    offset = 0
    while len(data) - offset >= _ITEM.size:
        index, size = _ITEM.unpack_from(data, offset)
        offset += _ITEM.size + size
        if index >= count or offset > len(data):
            return None
        batches[index].append(Arrival(0, data[offset - size : offset]))
    return batches if offset == len(data) else None


class SessionReplay(NamedTuple):
    """The result of a replay.

    Attributes:
        ticks: Numbers of the ticks, shape (T,).
        x: Estimates, shape (T, n).
        std: Standard deviations, shape (T, n).
        same: Whether every block's checksum of the estimates is the session's.
    """

    ticks: npt.NDArray[np.int64]
    x: npt.NDArray[np.float64]
    std: npt.NDArray[np.float64]
    same: bool


def replay(path: Path | str, onboard: OnboardController, patience: int | None) -> SessionReplay:
    """Replay a session.

    Args:
        path: File of the session.
        onboard: On-board controller of the session's setup.
        patience: Patience of the `StreamSynchroniser`.

    Returns:
        Ticks, estimates and deviations, and whether they agree with the session's checksums.
    """
    assembler, digest, same = StreamSynchroniser(patience), 0, True
    ticks: list[int] = []
    numbers: list[list[npt.NDArray[np.float64]]] = [[], []]
    for block in read_blocks(path):
        for batch in block.batches:
            for tick in assembler.take(batch):
                onboard.take(tick)
                digest = update_digest(onboard, digest)
                ticks.append(tick.number)
                numbers[0].append(onboard.x.copy())
                numbers[1].append(onboard.std.copy())
        same = same and digest == block.digest
    shape = len(ticks), len(onboard.names)
    x, std = (np.array(values).reshape(shape) for values in numbers)
    return SessionReplay(np.array(ticks, np.int64), x, std, same)
