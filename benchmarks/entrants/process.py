"""The process of a contestant as its driver sees it: asked, watched, ended."""

import json
import os
import re
import resource
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any

from ...envs.backend.cache import LAYERS, find_kernel_folder
from .child import DONE, ChildSettings

_GRACE = 60.0  # s to start in
_LONGEST = 2**16  # bytes of an answer beside its numbers
_START = f"from {__package__}.child import main; main()"


class ContestantError(Exception):
    """Why a contestant gave no answer."""


class ChildProcess:
    """The process of a contestant, and the one way to ask it.

    Args:
        texts: What it is made of; its stack is searched for these files.
        limit: Seconds of wall time that all its answers may take.
        allowed: Of `ChildSettings`.
    """

    def __init__(
        self, texts: Sequence[str], limit: float, allowed: Iterable[str] | None = None
    ) -> None:
        self._texts, self.reason = texts, ""
        self._folder = TemporaryDirectory(prefix="sideslip-")
        self._log = TemporaryFile()  # noqa: SIM115  # closed with the process
        scratch = self._folder.name
        variables = {"OPENBLAS_NUM_THREADS": "1", **os.environ}
        variables |= {"PYTHONPATH": os.pathsep.join(sys.path), "SIDESLIP_QUIET": "1"}
        variables |= {"XDG_CACHE_HOME": scratch, "TMPDIR": scratch}
        variables.pop("NUMBA_CACHE_DIR", None)
        for layer in LAYERS:  # kernels of its own: it may read ours, and write none of them
            folder = find_kernel_folder(layer)
            if folder is not None:
                copy = Path(scratch, "sideslip", "kernels", folder.name)
                with suppress(OSError):  # one that is pruned meanwhile is compiled again
                    shutil.copytree(folder, copy, dirs_exist_ok=True)
        self._pipe, child_end = Pipe()
        with child_end:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _START, str(child_end.fileno())],
                env=variables,
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                pass_fds=(child_end.fileno(),),
                start_new_session=True,
            )
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):  # of a message that stops halfway
            with socket.socket(fileno=os.dup(self._pipe.fileno())) as end:
                end.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(_GRACE), 0))
        start = ChildSettings(scratch, None if allowed is None else frozenset(allowed))
        self._left, self._limit = _GRACE, _GRACE
        self._started = float(json.loads(self.call(start)))
        self._left = self._limit = limit

    def call(self, *message: Any, length: int | None = None) -> bytes:
        """Send a message and return the answer.

        Args:
            message: A method of `Contestant` by name, and its arguments.
            length: Bytes of the answer, where they are known.

        Returns:
            The answer's bytes.

        Raises:
            ContestantError: The contestant failed, ended, was too slow or sent something else.
        """
        if self.reason:
            raise ContestantError(self.reason)
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
            raise ContestantError(self.reason)
        return content

    def __deepcopy__(self, memo: Any) -> "ChildProcess":
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
        text, _, stack = (
            self._log.read().decode(errors="replace").partition("(most recent call first)")
        )
        if late:
            return f"no end within {self._limit:g} s{find_place(self._texts, stack)}"
        last = (text.strip().splitlines() or [""])[-1]
        return f"its process ended with status {status}; {last}".rstrip("; ")

    def close(self) -> float:
        """End the process and what it started; return its CPU seconds after its start."""
        self._stop()
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        self._process.wait()
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        self._pipe.close()
        self._log.close()
        self._folder.cleanup()
        spent = after.ru_utime + after.ru_stime - usage.ru_utime - usage.ru_stime
        return max(spent - self._started, 0.0)


def find_place(texts: Sequence[str], stack: str) -> str:
    """Say where a user's file was, from a stack whose innermost frame comes first."""
    for file, line in re.findall(r'File "(.*)", line (\d+)', stack):
        if any(Path(file).name in text for text in texts):
            return f", still in {Path(file).name}, line {line}"
    return ""
