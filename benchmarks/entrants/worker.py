"""A user's agent or estimators in a process of their own, as their driver asks, watches, ends it.

The process never holds the env, its seeds or a result.

Args:
    chunk: Seeds of an entry that has names and files.
"""

import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import Pipe
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any

import numpy as np
import numpy.typing as npt

from ...agents.env_info import CarVectorEnv, EnvView, get_env_facts
from ...agents.learned.policy import ZIP
from ...envs.numerics.kernel_cache import LAYERS, find_kernel_folder
from ...envs.record import Array
from ...envs.sensors.link import SlowSensor
from ...estimators.core.filter import StepRecord
from ...estimators.make import is_user_file
from ...estimators.vector.batch import ForeignBatch
from ..control.run import NUMBERS, Chunk, DriveResult, run_chunk
from .child import DONE

LIMIT = 600.0  # s of wall time a cell
_GRACE = 60.0  # s to start in
_LONGEST = 2**16  # bytes of an answer beside its numbers
_START = f"from {__package__}.child import main; main()"


class _EntryError(Exception):
    """Why an entry gave no answer."""


class _ChildProcess:
    """The process of texts that make an entry, whose answers together may take a drive's limit."""

    def __init__(self, texts: Sequence[str], drive: "IsolatedDrive") -> None:
        self._texts, self.reason = texts, ""
        self._folder = TemporaryDirectory(prefix="sideslip-")
        self._log = TemporaryFile()  # noqa: SIM115  # closed with the process
        scratch = self._folder.name
        variables = {"OPENBLAS_NUM_THREADS": "1", **os.environ, "SIDESLIP_QUIET": "1"}
        variables |= {"XDG_CACHE_HOME": scratch, "TMPDIR": scratch}
        variables["PYTHONPATH"] = os.pathsep.join(sys.path)
        variables.pop("NUMBA_CACHE_DIR", None)
        for folder in filter(None, map(find_kernel_folder, LAYERS)):
            copy = Path(scratch, "sideslip", "kernels", folder.name)  # it may read ours, not write
            with suppress(OSError):  # one that is pruned meanwhile is compiled again
                shutil.copytree(folder, copy, dirs_exist_ok=True)
        self._pipe, child_end = Pipe()
        with child_end:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _START, str(child_end.fileno())],
                env=variables, stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log,
                pass_fds=(child_end.fileno(),), start_new_session=True,
            )  # fmt: skip
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):  # of a message that stops halfway
            with socket.socket(fileno=os.dup(self._pipe.fileno())) as end:
                end.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(_GRACE), 0))
        self._left = self._limit = _GRACE
        self.call(scratch, drive.allowed)
        self._left = self._limit = drive.limit

    def call(self, *message: object, length: int | None = None) -> bytes:
        """Ask for a method of `_EntryServer` by name; the answer's bytes, of a known length.

        Raises _EntryError where it failed, ended, was too slow or sent something else.
        """
        if self.reason:
            raise _EntryError(self.reason)
        start_time, late = time.monotonic(), False
        try:
            self._pipe.send(message)
            late = not self._pipe.poll(max(self._left, 0.0))
            answer = b"" if late else self._pipe.recv_bytes(_LONGEST + (length or 0))
        except (EOFError, OSError):
            answer = b""
        self._left -= time.monotonic() - start_time
        kind, content = answer[:1], answer[1:]
        if not answer:
            self.reason = self._find_reason(late)
        elif kind != DONE:
            self.reason = " ".join(content.decode(errors="replace").split())[:2000]
        elif length is not None and len(content) != length:
            self.reason = f"its process sent {len(content)} bytes where {length} are right"
        if self.reason:
            raise _EntryError(self.reason)
        return content

    def __deepcopy__(self, memo: object) -> "_ChildProcess":
        return self  # in a copy of a wrapper's recorded arguments, too, there is one process

    def _stop(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def _find_reason(self, late: bool) -> str:
        """End the process; say why it gave no answer, from its log."""
        if late:
            before = os.fstat(self._log.fileno()).st_size
            self._process.send_signal(signal.SIGUSR1)  # it writes where it is
            for _ in range(30):
                time.sleep(0.1)
                if os.fstat(self._log.fileno()).st_size > before:
                    break
        else:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
        self._stop()
        status = self._process.wait()
        self._log.seek(max(self._log.seek(0, os.SEEK_END) - _LONGEST, 0))
        log = self._log.read().decode(errors="replace")
        text, _, stack = log.partition("(most recent call first)")
        if late:
            return f"no end within {self._limit:g} s{_find_place(self._texts, stack)}"
        last = (text.strip().splitlines() or [""])[-1]
        return f"its process ended with status {status}; {last}".rstrip("; ")

    def close(self) -> None:
        """End the process and its group."""
        self._stop()
        self._process.wait()
        self._pipe.close()
        self._log.close()
        self._folder.cleanup()


def _find_place(texts: Sequence[str], stack: str) -> str:
    """Describe where a user's file was."""
    for file, line in re.findall(r'File "(.*)", line (\d+)', stack):
        if any(Path(file).name in text for text in texts):
            return f", still in {Path(file).name}, line {line}"
    return ""


class _RemotePolicy:
    """The agent that a child builds of a text, from the view of an env."""

    def __init__(
        self, child: _ChildProcess, source: str, trust: bool, env: CarVectorEnv, **options: object
    ) -> None:
        spaces = env.single_observation_space, env.single_action_space
        view = EnvView(env.num_envs, get_env_facts(env), *spaces)
        self._child, self._shape = child, (view.num_envs, view.facts.width)
        child.call("agent", source, view, {"trust": trust, **options})

    def predict(
        self, observation: Array, state: object = None, episode_start: Array | None = None,
        deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], None]:  # fmt: skip
        """Return the child's actions, float32 (rows, width); its memory stays there."""
        length = 4 * self._shape[0] * self._shape[1]
        answer = self._child.call("predict", observation, episode_start, length=length)
        return np.frombuffer(answer, np.float32).reshape(self._shape), None


class _RemoteEstimators:
    """The estimators that a child makes of a text, as `make_estimator` takes a factory."""

    def __init__(self, child: _ChildProcess, source: str) -> None:
        self._child, self.name, self._rows = child, source, 0

    def __call__(self, **arguments: object) -> "_RemoteRow":
        """Let the child build one more estimator."""
        row, self._rows = self._rows, self._rows + 1
        names = json.loads(self._child.call("estimator", row, self.name, arguments))
        return _RemoteRow(self._child, row, tuple(names) if isinstance(names, list) else ())


class _RemoteBatch(ForeignBatch):
    """The estimators of a child, all rows in one message."""

    def _step_rows(self, rows: Sequence[int], record: StepRecord) -> Iterator[int]:
        remote: list[Any] = [self[i].inner for i in rows]  # type: ignore[union-attr]
        records = [
            (item.row, record.fast[i, : record.rows[i]], record.packets[i, : record.count[i]])
            for i, item in zip(rows, remote, strict=True)
        ]
        _RemoteRow.take(remote, records)
        yield from rows


@dataclass(eq=False)
class _RemoteRow:
    """One estimator of a child, as an `EstimatorLike`."""

    child: _ChildProcess
    row: int
    names: tuple[str, ...]
    x: Array | None = None
    P: Array | None = None
    batch = _RemoteBatch

    def reset(self, sensors: Mapping[str, SlowSensor], first: int) -> None:
        """Start anew, as `EstimatorLike.reset`."""
        self.child.call("reset", self.row, dict(sensors), first)

    def step(self, rows: Array, packets: Array) -> None:
        """Process records, as `EstimatorLike.step`."""
        self.take([self], [(self.row, rows, packets)])

    @staticmethod
    def take(rows: Sequence["_RemoteRow"], records: Sequence[tuple[int, Array, Array]]) -> None:
        """Step some rows of one child with their records; set each one's x and P."""
        if not rows:
            return
        n = len(rows[0].names)
        answer = rows[0].child.call("step", records, length=8 * len(rows) * n * (n + 1))
        for row, values in zip(rows, np.frombuffer(answer).reshape(len(rows), -1), strict=True):
            row.x, row.P = values[:n], values[n:].reshape(n, n)


def run_user_chunk(chunk: Chunk) -> DriveResult:
    """Run a chunk; an entry whose every episode ends by an action that is none was not driven."""
    result, wrong = run_chunk(chunk), "every action is NaN, or infinite, before an episode is over"
    failed = not result.error and result.mark_failures("bad-action").all()
    return _make_failed_result(chunk, wrong) if failed else result


@dataclass(frozen=True)
class IsolatedDrive:
    """`run_user_chunk`, but agent and estimator of a user in a child of their own."""

    limit: float = LIMIT  # wall time (s)
    allowed: frozenset[str] | None = None  # files that a child may open

    def __call__(self, chunk: Chunk) -> DriveResult:
        """Run a chunk whose entry has names and files."""
        return self._run(chunk)[0]

    def rehearse(self, chunk: Chunk) -> set[str]:
        """Run a chunk; return the files that its entries open."""
        return self._run(chunk)[1]

    def _run(self, chunk: Chunk) -> tuple[DriveResult, set[str]]:
        """Run a chunk; its episodes, and the files that its children opened."""
        entry, children, opened = chunk.entry, list[_ChildProcess](), set[str]()
        objects = dict(entry.objects)
        try:
            for part in ("agent", "estimator"):
                source: str = getattr(entry, part)
                is_foreign = is_user_file(source) or source.endswith(ZIP) or ":" in source
                if part in objects or not is_foreign:
                    continue
                child = _ChildProcess((entry.agent, entry.estimator), self)
                children.append(child)
                make_agent = partial(_RemotePolicy, child, source, entry.trust)
                objects[part] = make_agent if part == "agent" else _RemoteEstimators(child, source)
            result = run_user_chunk(replace(chunk, entry=replace(entry, objects=objects)))
            for child in children:
                if not child.reason:
                    opened.update(json.loads(child.call("opened")))
        except _EntryError as error:
            result = _make_failed_result(chunk, str(error))
        finally:
            for child in children:
                child.close()
        reason = next((child.reason for child in children if child.reason), "")
        return (_make_failed_result(chunk, reason) if reason else result), opened


def _make_failed_result(chunk: Chunk, error: str) -> DriveResult:
    return DriveResult(np.full((len(chunk.seeds), len(NUMBERS)), np.nan), error=error)
