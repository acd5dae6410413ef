"""A contestant has its observations and its own files: of the driver there is nothing to reach."""

import ast
import ctypes
import re
import socket
import sys
from pathlib import Path

import pytest

from sideslip.benchmarks.control.entries import Entry
from sideslip.benchmarks.control.run import Chunk
from sideslip.benchmarks.control.tasks import ControlTask
from sideslip.benchmarks.entrants.worker import IsolatedDrive

SEEDS = (918273645, 918273646)
LANDLOCK = ctypes.CDLL(None).syscall(444, None, 0, 1) if sys.platform == "linux" else 0
HEAD = """
import json, os, subprocess, sys
from pathlib import Path
import numpy as np


def attempt(action):
    try:
        return str(action())
    except Exception as error:
        return type(error).__name__


"""


def cheat(folder: Path, init: str, predict: str = "") -> Chunk:
    """Two short episodes of a contestant whose bodies these are."""
    lines = [
        f"{HEAD}class Mine:",
        "    def __init__(self, env):",
        *(f"        {line}" for line in init.strip().splitlines()),
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):",
        *(f"        {line}" for line in predict.strip().splitlines()),
        "        return np.zeros((len(observation), 1), np.float32), state",
    ]
    (folder / "mine.py").write_text("\n".join(lines))
    changes = {"scenario": {"base": "gust", "duration": 0.05}}
    task = ControlTask(scenario="gust", changes=changes)
    return Chunk(task, Entry(str(folder / "mine.py")), SEEDS)


def test_neither_env_nor_seeds_nor_files_of_the_driver_are_in_reach(tmp_path: Path) -> None:
    (tmp_path / "result.npz").write_bytes(b"right")
    driven = IsolatedDrive()(cheat(tmp_path, f"""
base, parent = env.unwrapped, f"/proc/{{os.getppid()}}"
found = {{
    "state": attempt(lambda: base.states),
    "truth": attempt(lambda: base.motion),
    "params": attempt(lambda: base.params),
    "reset": attempt(lambda: env.reset(seed=1)),
    "forge": attempt(lambda: Path(sys.argv[1]).read_text()),
    "overwrite": attempt(lambda: Path({str(tmp_path)!r}, "result.npz").write_text("mine")),
    "remove": attempt(lambda: Path({str(tmp_path)!r}, "result.npz").unlink()),
    "beside": attempt(lambda: Path({str(tmp_path)!r}, "new").write_text("mine")),
    "memory": attempt(lambda: open(f"{{parent}}/mem", "rb+")),
    "signal": attempt(lambda: os.kill(os.getppid(), 0)),
    "scratch": attempt(lambda: Path(os.environ["TMPDIR"], "own").write_text("mine")),
    "seeds": any("91827364" in text for text in [
        repr(sys.argv), repr(dict(os.environ)), repr(vars(env)),
        *(Path(f"/proc/self/{{name}}").read_text() for name in ("cmdline", "environ")),
    ]),
}}
raise ValueError(json.dumps(found))
"""))  # fmt: skip
    text = driven.error[driven.error.index("{") : driven.error.rindex("}") + 1]
    found = ast.literal_eval(text.replace("false", "False").replace("true", "True"))
    for name in ("state", "truth", "params", "reset"):
        assert found[name] == "AttributeError", name
    assert found["forge"] == "FileNotFoundError" and found["seeds"] is False
    assert found["scratch"] == "4"
    if LANDLOCK >= 6:
        assert found["signal"] == "PermissionError"
    if LANDLOCK > 0:
        for name in ("overwrite", "remove", "beside", "memory"):
            assert found[name] == "PermissionError", name
        assert (tmp_path / "result.npz").read_bytes() == b"right"
        assert not (tmp_path / "new").exists()


def test_a_hang_ends_with_what_it_started(tmp_path: Path) -> None:
    """At the limit, and the reason says where it was."""
    body = 'subprocess.Popen(["sleep", "91827.364"])\nwhile True: pass'
    driven = IsolatedDrive(2.0)(cheat(tmp_path, body))
    assert re.fullmatch(r"no end within 2 s, still in mine.py, line \d+", driven.error)
    running = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
    assert not any(b"91827.364" in text for text in running)


def test_memory_ends_at_a_stated_limit(tmp_path: Path) -> None:
    driven = IsolatedDrive()(cheat(tmp_path, "self.kept = bytearray(5 * 2**30)"))
    stated = r"MemoryError: .mine.py, line \d+.; an entry has 4 GiB of memory"
    assert re.fullmatch(stated, driven.error)


@pytest.mark.parametrize("when", ["before", "later"])
def test_what_it_opens_shows_in_a_rehearsal_or_ends_it(when: str, tmp_path: Path) -> None:
    """Its neighbours that it imports and its data; one that was not opened then ends the drive."""
    (tmp_path / "neighbour.py").write_text("K = 1\n")
    (tmp_path / "table.txt").write_text("2")
    read = f"open({str(tmp_path / 'table.txt')!r}).read()"
    if when == "before":
        opened = IsolatedDrive().rehearse(cheat(tmp_path, f"import neighbour\n{read}"))
        names = {"mine.py", "neighbour.py", "table.txt"}
        assert opened == {str(tmp_path / name) for name in names}
        return
    allowed = frozenset(str(tmp_path / name) for name in ("mine.py", "neighbour.py"))
    driven = IsolatedDrive(allowed=allowed)(cheat(tmp_path, "import neighbour", read))
    right = f"it opened {tmp_path}/table.txt, which it had not opened in the rehearsal"
    assert driven.error == right


@pytest.mark.skipif(sys.platform != "linux", reason="namespaces are Linux's")
def test_no_other_process_is_reached_by_network_or_shared_memory(tmp_path: Path) -> None:
    """An entry that has seen the seeds' drives could tell another one of them."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        segment = ctypes.CDLL(None).shmget(0x5EED, 4096, 0o1600)
        try:
            driven = IsolatedDrive()(cheat(tmp_path, f"""
import ctypes, socket
found = [
    attempt(lambda: socket.create_connection(("127.0.0.1", {server.getsockname()[1]}), 2.0)),
    ctypes.CDLL(None).shmget(0x5EED, 4096, 0o600),
]
raise ValueError(json.dumps(found))
"""))  # fmt: skip
        finally:
            ctypes.CDLL(None).shmctl(segment, 0, None)  # IPC_RMID
    assert segment >= 0 and '["OSError", -1]' in driven.error, driven.error


def test_a_process_that_it_starts_ends_a_fresh_drive(tmp_path: Path) -> None:
    """Nobody knows what it opens."""
    allowed = frozenset({str(tmp_path / "mine.py")})
    driven = IsolatedDrive(allowed=allowed)(cheat(tmp_path, "os.system('true')"))
    assert driven.error == "it started a process (os.system)"
