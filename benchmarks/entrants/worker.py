"""A user's cell in a process of its own: what it does there, hang or die, is its result."""

import faulthandler
import json
import os
import re
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..control.cells import Cell
from ..control.contests import Contest
from ..control.episodes import NUMBERS, Chunk, Driven, drive
from ..control.run import read_case, write_case

LIMIT = 600.0  # s of wall time a cell
_GRACE = 60.0  # s to start in
_START = f"from {__name__} import main; main()"


def drive_users(chunk: Chunk) -> Driven:
    """`drive`; a cell of which every episode ends by an action that is none was not driven."""
    driven = drive(chunk)
    if not driven.error and driven.failed("bad-action").all():
        return _undriven(chunk, "every action is NaN, or infinite, before an episode is over")
    return driven


def drive_apart(chunk: Chunk, limit: float = LIMIT) -> Driven:
    """`drive_users` in a fresh process, which finds the same modules and starts in the same folder.

    limit: s of wall time. What it prints is dropped. The cell's contestants are names and files.
    """
    with TemporaryDirectory(prefix="sideslip-") as folder:
        case, log = Path(folder, "case.json"), Path(folder, "log")
        case.write_text(json.dumps(asdict(chunk)))
        variables = {"OPENBLAS_NUM_THREADS": "1", **os.environ}
        variables |= {"PYTHONPATH": os.pathsep.join(sys.path), "SIDESLIP_QUIET": "1"}
        command = [sys.executable, "-P", "-c", _START, str(case), str(limit)]
        with log.open("wb") as out:
            streams = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": out}
            process = subprocess.Popen(command, env=variables, **streams)  # type: ignore[call-overload]
            try:
                status = process.wait(limit + _GRACE)
            except subprocess.TimeoutExpired:
                status = None
            finally:
                process.kill()
                process.wait()
        return _outcome(chunk, case, log, status, limit)


def _outcome(chunk: Chunk, case: Path, log: Path, status: int | None, limit: float) -> Driven:
    """The result that a process left, or why it left none."""
    driven = read_case(case.with_suffix(".npz"), chunk)
    if driven is not None:
        return driven
    if case.with_suffix(".txt").is_file():
        return _undriven(chunk, case.with_suffix(".txt").read_text())
    text = log.read_text(errors="replace")
    late, _, stack = text.partition("Timeout (")
    if status is None or stack:
        return _undriven(chunk, f"no end within {limit:g} s{_place(chunk.cell, stack)}")
    last = (late.strip().splitlines() or [""])[-1]
    return _undriven(chunk, f"its process ended with status {status}; {last}".rstrip("; "))


def _place(cell: Cell, stack: str) -> str:
    """Where a user's file was, from a stack whose innermost frame comes first."""
    for file, line in re.findall(r'File "(.*)", line (\d+)', stack):
        if any(Path(file).name in name for name in (cell.controller, cell.estimator)):
            return f", still in {Path(file).name}, line {line}"
    return ""


def _undriven(chunk: Chunk, error: str) -> Driven:
    return Driven(np.full((len(chunk.seeds), len(NUMBERS)), np.nan), np.nan, error=error)


def main() -> None:
    """The process: reads case.json, writes case.npz, or case.txt with the reason."""
    case, limit = Path(sys.argv[1]), float(sys.argv[2])
    faulthandler.dump_traceback_later(limit, exit=True)  # by a thread that needs no Python
    values = json.loads(case.read_text())
    cell = values["cell"]
    cell = Cell(**cell | {"contest": Contest(**cell["contest"])})
    driven = drive_users(Chunk(cell, tuple(values["seeds"]), values["keep"]))
    if driven.error:
        case.with_suffix(".txt").write_text(driven.error)
    else:
        write_case(case.with_suffix(".npz"), driven)
