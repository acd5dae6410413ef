"""The car's computer: estimates at every tick, an action per control period, and sessions on disk.

A session's file is a head (MAGIC, the length of its JSON, the JSON) and blocks that are appended
as they are full; a file that is cut is read up to there. A block has a checksum of itself and one
of all estimates so far, by which a replay checks itself bit for bit. Nothing in a file is run.

Args:
    path: File of a session, which a `Recorder` writes; ValueError for one that is none.
"""

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import FLAGS, STATE_WIDTH, EpisodeArrays, P, Z
from ...envs.engine.outputs import observe, update_newest
from ...envs.numerics.functions import NEVER
from ...envs.numerics.jit import as_python
from ...envs.numerics.packed import read
from ...envs.record import FAST, FAST_WIDTH
from ...envs.task import REPORT, compute_reference, filter_reference
from ...estimators.core.filter import NO_OUTPUTS, Observed, StepRecord
from ...estimators.estimator import Estimator
from ...estimators.protocol import compute_std
from ...estimators.wrappers.estimate import EstimateObservation, compile_observe, write_outputs
from ..env_info import get_env_facts
from .messages import NO_PACKETS, Arrival, StreamSynchroniser, Tick

if TYPE_CHECKING:
    from .. import Agent

MAGIC = b"SLIPSES1"
MAX_BATCHES, _FULL_BLOCK_BYTES = 100, 1 << 13  # a block ends with 0.1 s or beyond these bytes
_LENGTH = struct.Struct("!I")
_BLOCK = struct.Struct("!4sIIII")  # magic, batches, bytes, checksums of these and of estimates
_ITEM = struct.Struct("!HH")  # which batch of the block, bytes of the datagram
_BLOCK_MAGIC = b"BLOK"
_SETUP: dict[str, Any] = {
    **dict.fromkeys(("estimator", "agent", "env"), str),
    **dict.fromkeys(("options", "agent_options", "estimator_options"), dict),
    "seed": int,
    "patience": (int, type(None)),
}  # types of a session's setup, by key

_reference, _filter_reference = as_python(compute_reference), as_python(filter_reference)


class OnboardController:
    """An estimator and an agent on the wires' data, equal to those in the env bit for bit.

    Args:
        env: `EstimateObservation` with sensors' clocks, nominal car, references; it is not driven.
        agent: Agent of `make_agent` for the env; None: without control.
        seed: Seed of the env, whose reset draws the sensors' phases.
    """

    def __init__(
        self, env: gym.Env[Any, Any], agent: "Agent | None" = None, seed: int | None = 0
    ) -> None:
        if not isinstance(env, EstimateObservation):
            raise TypeError(f"it reads an EstimateObservation, got {type(env).__name__}")
        self.base = cast("Any", env.unwrapped)
        env.reset(seed=seed)
        self.facts, self.agent, self.outputs = get_env_facts(env), agent, env.outputs
        self.estimator: Any = env.estimator
        self.sensors, self.names = self.base.slow_sensors, env.estimator.names
        self._is_native = isinstance(self.estimator, Estimator) and self.estimator.compiled
        snapshot = self.base.get_state()
        self._p, self._switches = snapshot["params"], snapshot["switches"]
        self._kind, self._target = int(self._switches[FLAGS.reference]), read(self._p, P.target)
        self._bounds = self.base.config.bounds
        self._rows = np.zeros((self.facts.control_period, FAST_WIDTH))
        X, S = np.zeros((2, 1, len(self.names)))
        self._outputs = NO_OUTPUTS._replace(X=X, S=S)
        # estimated states and their standard deviations, shape (n,), written anew by every tick
        self.x, self.std = X[0], S[0]
        self.digest = 0  # CRC-32 of all estimates
        self._begin(0)
        row, packet = self.base.record.fast[0], np.zeros((1, NO_PACKETS.shape[1]))
        for number in range(self.facts.control_period + 1):  # compiles the code of first ticks
            self.take(Tick(number, row, 0.0, packet, number == 0))
        self._begin(0)
        self.digest = 0

    @property
    def refused(self) -> dict[str, int]:
        """Counts of packets that a compiled `Estimator` did not use, by reason; else empty."""
        return self.estimator.counts if self._is_native else {}

    @property
    def is_healthy(self) -> bool:
        """Whether a compiled `Estimator` is not lost; True for others, which do not tell."""
        return not self._is_native or self.estimator.is_healthy

    def _begin(self, first: int) -> None:
        """Clear all memory; the next tick has the number `first`."""
        self.estimator.reset(self.sensors, first)
        self._z = np.zeros(STATE_WIDTH)  # packed state, laid out as `Z`; no measurement
        self._refs = None
        for sensor in Z.slow:
            self._z[sensor.captured] = NEVER
        self._count, self._packets = 0, [NO_PACKETS]
        self._memory, self._start = None, np.ones(1, np.bool_)
        self.action: npt.NDArray[np.float32] | None = None  # the newest
        self.has_new_action = False  # of this tick

    def take(self, tick: Tick) -> None:
        """Process a tick: the estimate and, at the end of a control period, the agent's action.

        Args:
            tick: Data of the tick.
        """
        if tick.begins:
            self._begin(tick.number)
        n, row = self.facts.control_period, tick.row
        if self._is_native:
            record = StepRecord(row.reshape(1, -1), 1, tick.packets, len(tick.packets))
            self.estimator.take(record, self._outputs)
        else:
            self.estimator.step(row.reshape(1, -1), tick.packets)
            self.x[:], self.std[:] = self.estimator.x, compute_std(self.estimator.P)
        self.digest = zlib.crc32(self.std.tobytes(), zlib.crc32(self.x.tobytes(), self.digest))
        self._rows[self._count] = row
        self._count += 1
        self._packets.append(tick.packets)
        for packet in tick.packets:
            update_newest(self._z, packet, float(tick.number))
        v = 0.5 * float(row[FAST.wheel_left] + row[FAST.wheel_right])
        before, params = self._refs, (self._target, self._kind)
        steady = _reference(tick.steer_next, v, *params)
        self._refs = steady if before is None else _filter_reference(before, steady, *params)
        self.has_new_action = tick.number % n == 0
        if self.has_new_action:
            obs, start = self._make_observation(tick.number), self._start
            self._count, self._packets, self._start = 0, [NO_PACKETS], np.zeros(1, np.bool_)
            self.action = np.zeros(self.facts.width, np.float32)
            if self.agent is not None:
                prediction = self.agent.predict(obs, self._memory, start, deterministic=True)
                self.action, self._memory = prediction
        elif self._count == n:  # begun within a period
            self._count = 0

    def _make_observation(self, number: int) -> npt.NDArray[np.float32]:
        """Make the observation (k,) that the env's agents would get at a tick."""
        n_rows, outputs, packets = self._count, self.outputs, np.concatenate(self._packets)
        self._rows[n_rows:] = self._rows[n_rows - 1]
        self._z[Z.clock.tick] = number
        switches, report = self._switches, np.zeros(len(REPORT))
        shown = len(self._rows) if switches[FLAGS.all_samples] else n_rows
        obs = np.empty(self._bounds.shape[1], np.float32)
        numbers = self._p, self._z, switches, obs, self._rows, packets, report, self._bounds
        observe(EpisodeArrays(*numbers, np.empty((0, 0))), shown, len(packets), self._refs)
        out, estimator = np.empty(len(outputs.layout), np.float32), self.estimator
        # the true beta and gamma (0.0) serve the summary of errors alone, which nobody reads here
        observed = Observed(obs, outputs.table, 0.0, 0.0, out, np.zeros(4))
        if self._is_native:  # `take` has given it all: no rows and no packets here
            record = StepRecord(self._rows, 0, NO_PACKETS, 0)
            compile_observe()(estimator.filters, estimator.gains, record, 0, observed)
        else:
            write_outputs(estimator, observed)
        return out


class Recorder:
    """Writes a session; FileExistsError for a file that exists.

    Args:
        path: File to write.
        setup: Setup of the replay, in JSON types.
    """

    def __init__(self, path: Path | str, setup: Mapping[str, object]) -> None:
        self._file = open(path, "xb", buffering=0)  # noqa: SIM115, closed by `close`
        text = json.dumps(dict(setup)).encode()
        self._file.write(MAGIC + _LENGTH.pack(len(text)) + text)
        self._items, self._batches, self._digest = bytearray(), 0, 0

    def take(self, accepted: list[bytes], digest: int) -> None:
        """Record the accepted datagrams of a batch.

        Args:
            accepted: Datagrams of the batch.
            digest: `OnboardController.digest` after it.
        """
        self._digest = digest
        for data in accepted:
            self._items += _ITEM.pack(self._batches, len(data)) + data
        self._batches += 1
        if self._batches == MAX_BATCHES or len(self._items) > _FULL_BLOCK_BYTES:
            self._write()

    def _write(self) -> None:
        sizes = len(self._items), zlib.crc32(self._items), self._digest
        self._file.write(_BLOCK.pack(_BLOCK_MAGIC, self._batches, *sizes) + self._items)
        self._items, self._batches = bytearray(), 0

    def close(self) -> None:
        """Write the last block and close the file."""
        if self._batches:
            self._write()
        self._file.close()


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


def _read_header(file: BinaryIO, path: Path | str) -> dict[str, Any]:
    """Read a session's setup; ValueError for a file that is none."""
    if file.read(len(MAGIC)) == MAGIC:
        with suppress(ValueError, RecursionError, struct.error):
            setup = json.loads(file.read(*_LENGTH.unpack(file.read(_LENGTH.size))))
            if isinstance(setup, dict):
                return setup
    text = "no session of `sideslip live --record`, or only its beginning"
    raise ValueError(f"{path} is {text}")


def read_setup(path: Path | str) -> dict[str, Any]:
    """Read the setup of a session, in JSON types; ValueError for an incomplete one."""
    with open(path, "rb") as file:
        setup = _read_header(file, path)
    if wrong := [name for name, x in _SETUP.items() if not isinstance(setup.get(name, ...), x)]:
        text = f"{path}: its setup lacks {', '.join(wrong)}"
        raise ValueError(f"{text}, or has it of another type")
    return setup


def read_blocks(path: Path | str) -> Iterator[tuple[list[list[Arrival]], int]]:
    """Read batches of datagrams and the checksum of all estimates after them, as far as sound."""
    with open(path, "rb") as file:
        _read_header(file, path)
        while len(head := file.read(_BLOCK.size)) == _BLOCK.size:
            magic, count, size, check, digest = _BLOCK.unpack(head)
            is_sound = magic == _BLOCK_MAGIC and count <= MAX_BATCHES
            data = file.read(size) if is_sound else b""
            if not is_sound or len(data) != size or zlib.crc32(data) != check:
                return
            if (batches := _parse_batches(data, count)) is None:
                return
            yield batches, digest


def replay_session(
    path: Path | str, onboard: OnboardController, patience: int | None
) -> tuple[int, bool]:
    """Replay a session; the number of ticks, and whether its checksums are the estimates'.

    Args:
        path: File of the session.
        onboard: On-board controller made from the session's setup.
        patience: Batches without a fast row before the last row is held; None: no limit.
    """
    synchroniser, ticks, same, onboard.digest = StreamSynchroniser(patience), 0, True, 0
    for batches, block_digest in read_blocks(path):
        for tick in chain.from_iterable(map(synchroniser.take, batches)):
            onboard.take(tick)
            ticks += 1
        same = same and onboard.digest == block_digest
    return ticks, same
