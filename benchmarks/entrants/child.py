"""The process of a user's entry: it gets observations or records, returns actions or estimates.

The env, its seeds and the results stay with the driver; nothing of an answer is unpickled.
"""

import ctypes
import faulthandler
import importlib.util
import json
import os
import resource
import signal
import site
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from ...agents import Agent, make_agent
from ...agents.env_info import EnvView
from ...envs.record import Array
from ...envs.sensors.link import SlowSensor
from ...envs.validation import parse_actions
from ...estimators.make import describe_error, make_estimator
from ...estimators.protocol import EstimatorLike
from ..control.entries import check_agent

_MEMORY = 4 * 2**30  # bytes of address space
_WRITTEN = 2**26  # bytes of the longest file that it may write, in its scratch folder
DONE, _FAILED = b"d", b"f"

_PACKAGE = Path(__file__).resolve().parents[2]
_INSTALLED = {*site.getsitepackages(), sys.prefix, sys.base_prefix, str(_PACKAGE)}
_SYSTEM = ("/proc", "/sys", "/dev", "/etc", "/usr", "/lib", "/lib64")
_OPENS = {"open": 0, "ctypes.dlopen": 0, "import": 1}  # audit events, the argument with the path
_STARTS = ("subprocess.Popen", "os.fork", "os.forkpty", "os.exec", "os.posix_spawn", "os.system")


class _EntryServer:
    """The agent, or the estimators of all rows, of one process."""

    def __init__(self) -> None:
        self._agent: Agent
        self._shape: tuple[int, int]
        self._state: object = None
        self._estimators: dict[int, EstimatorLike] = {}

    def agent(self, source: str, view: EnvView, options: Mapping[str, Any]) -> bytes:
        """Build the agent of a text that `make_agent` takes."""
        env: Any = view
        agent = make_agent(source, env, **options)
        self._shape = view.num_envs, view.facts.width
        self._agent = check_agent(agent, self._shape)
        return b""

    def predict(self, observation: Array, start: Array) -> bytes:
        """Return the actions of all rows, float32 (rows, width); the memory stays here."""
        action, self._state = self._agent.predict(observation, self._state, start)
        return parse_actions(action, *self._shape, fail=True).tobytes()

    def estimator(self, row: int, source: str, arguments: Mapping[str, Any]) -> bytes:
        """Build the estimator of a row; return the names of its states as JSON."""
        self._estimators[row] = make_estimator(source, **arguments)
        return json.dumps(self._estimators[row].names).encode()

    def reset(self, row: int, sensors: Mapping[str, SlowSensor], first: int) -> bytes:
        """Reset the estimator of a row."""
        self._estimators[row].reset(sensors, first)
        return b""

    def step(self, records: Sequence[tuple[int, Array, Array]]) -> bytes:
        """Let some rows take fast rows and packets; return each x and P, float64."""
        parts = []
        for row, fast, packets in records:
            estimator = self._estimators[row]
            estimator.step(fast, packets)
            parts += [np.asarray(estimator.x).tobytes(), np.asarray(estimator.P).tobytes()]
        return b"".join(parts)


def main() -> None:
    """Serve the driver on the connection whose descriptor is the first argument."""
    driver = Connection(int(sys.argv[1]))
    scratch, allowed = driver.recv()  # where it may write; what it may open, None: all, noted
    faulthandler.register(signal.SIGUSR1, all_threads=False)
    opened: set[str] = set()

    def refuse(text: str) -> None:
        driver.send_bytes(_FAILED + text.encode())
        os._exit(1)

    _limit_process(Path(scratch))
    sys.addaudithook(_make_audit_hook(opened, scratch, allowed, refuse))
    driver.send_bytes(DONE)
    server = _EntryServer()
    with suppress(EOFError):
        while True:
            name, *arguments = driver.recv()
            try:
                if name == "opened":
                    answer = json.dumps(sorted(opened)).encode()
                else:
                    answer = getattr(server, name)(*arguments)
            except MemoryError as error:
                memory = f"an entry has {_MEMORY / 2**30:g} GiB of memory"
                refuse(f"{describe_error(error)}; {memory}")
            except Exception as error:
                refuse(describe_error(error))
            driver.send_bytes(DONE + answer)


def _make_audit_hook(
    opened: set[str], scratch: str, allowed: frozenset[str] | None, refuse: Callable[[str], None]
) -> Callable[[str, tuple[object, ...]], None]:
    """Make the audit hook that notes what is opened outside the installation, or ends there."""
    folders = {*_INSTALLED, *_SYSTEM, scratch}
    skipped = tuple(f"{os.path.realpath(folder)}/" for folder in folders)

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event in _STARTS and allowed is not None:  # of which nobody knows what it opens
            refuse(f"it started a process ({event})")
        place = _OPENS.get(event)
        path = None if place is None else arguments[place]
        if not isinstance(path, str | bytes | os.PathLike) or not path:
            return
        real = os.path.realpath(os.fsdecode(path))
        with suppress(ValueError, NotImplementedError):  # bytecode stands for its source
            real = importlib.util.source_from_cache(real)
        if real.startswith(skipped) or real in opened or not os.path.isfile(real):
            return
        opened.add(real)
        if allowed is not None and real not in allowed:
            refuse(f"it opened {real}, which it had not opened in the rehearsal")

    return hook


def _limit_process(scratch: Path) -> None:
    """Limit this process for good: its memory, where it may write, and whom it can reach."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_WRITTEN, _WRITTEN))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        libc.prctl(1, 9, 0, 0, 0)  # PR_SET_PDEATHSIG: killed with the driver
        apart = _NEW_NETWORK | _NEW_IPC  # no other entry's process is to be reached
        if libc.unshare(apart):
            libc.unshare(apart | _NEW_USER)
        libc.prctl(38, 1, 0, 0, 0)  # PR_SET_NO_NEW_PRIVS
        _apply_landlock(libc, {scratch: _WRITES, Path(os.devnull): _WRITES & _OF_FILES})


_NEW_IPC, _NEW_USER, _NEW_NETWORK = 1 << 27, 1 << 28, 1 << 30  # unshare(2)
# Linux's Landlock (landlock(7)): its system calls, and the rights to change files.
_CREATE, _ADD, _RESTRICT = 444, 445, 446
_WRITES = sum(1 << bit for bit in (1, *range(4, 15)))
_OF_FILES = 1 << 1 | 1 << 14  # write, truncate
_NEWER = {1: 1 << 13 | 1 << 14, 2: 1 << 14}  # rights that this version does not know
_SIGNALS = 0b11  # sockets and signals to processes outside


def _apply_landlock(libc: ctypes.CDLL, rights: Mapping[Path, int]) -> None:
    """Deny this process to change files but below these paths, and to reach others, if it can."""
    version = libc.syscall(_CREATE, None, 0, 1)
    if version < 1:
        return
    known = _WRITES & ~_NEWER.get(version, 0)
    scoped = _SIGNALS if version >= 6 else 0
    attributes, size = (ctypes.c_uint64 * 3)(known, 0, scoped), 24 if scoped else 8
    ruleset = libc.syscall(_CREATE, ctypes.byref(attributes), ctypes.c_size_t(size), 0)
    for path, right in rights.items():
        descriptor = os.open(path, os.O_PATH)
        rule = (right & known).to_bytes(8, sys.byteorder) + descriptor.to_bytes(4, sys.byteorder)
        libc.syscall(_ADD, ruleset, 1, ctypes.c_char_p(rule), 0)
        os.close(descriptor)
    if libc.syscall(_RESTRICT, ruleset, 0):
        raise OSError(ctypes.get_errno(), "Landlock refused the entry's rules")
    os.close(ruleset)
