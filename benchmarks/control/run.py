"""All cells driven: the episodes of each, and finished cases on disk."""

import contextlib
import hashlib
import inspect
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console

from ...agents.learned.files import stamp
from ...envs.backend.cache import experiment_stamp
from ...envs.backend.files import whole
from ..harness.parallel import run_cases
from .cells import SLOW_EPISODES, Cell
from .contests import Contest
from .episodes import NUMBERS, SIGNALS, Chunk, Driven, drive
from .seeds import Seeds, salt_of

CHUNK = 64
"""Episodes of a case: a run of so many is found again by a longer one."""
_LENGTH = 24


@dataclass
class Results:
    """Every cell's episodes."""

    found: dict[Cell, Driven] = field(default_factory=dict)

    def of(self, contest: Contest, controller: str, estimator: str = "") -> Driven:
        """One cell; KeyError if it was not asked for."""
        return self.found[Cell(contest, estimator, controller)]


def measure(
    cells: Sequence[Cell],
    seeds: Seeds,
    *,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    by: Callable[[Chunk], Driven] | None = None,
    title: str = "control",
) -> Results:
    """Drive every cell on its contest's seeds, slow ones on the first of them.

    keep: a folder in which finished cases stay, so that a run that was stopped goes on. by: what
    drives a chunk instead of `drive`. title: of the progress bar.
    """
    if not cells:
        return Results()
    asked = {cell: seeds(cell.contest) if callable(seeds) else seeds for cell in cells}
    asked = {cell: each[:SLOW_EPISODES] if cell.slow else each for cell, each in asked.items()}
    chunks = [  # the first of every cell before the second of any: a stopped run has them all
        Chunk(cell, tuple(mine[first : first + CHUNK]), keep=first == 0)
        for first in range(0, max(map(len, asked.values())), CHUNK)
        for cell, mine in asked.items()
        if first < len(mine)
    ]
    cached = CachedDrive(keep and keep.absolute(), by)  # a worker of a cluster runs elsewhere
    driven = run_cases(cached, chunks, title, jobs, console)
    parts: dict[Cell, list[Driven]] = {}
    for chunk, each in zip(chunks, driven, strict=True):
        parts.setdefault(chunk.cell, []).append(each)
    return Results({cell: _joined(each) for cell, each in parts.items()})


def _joined(parts: list[Driven]) -> Driven:
    return Driven(
        np.concatenate([part.numbers for part in parts]),
        sum(part.seconds for part in parts),
        parts[0].series,
        next((part.error for part in parts if part.error), ""),
    )


@dataclass(frozen=True)
class CachedDrive:
    """`drive` that looks in a folder first and leaves its result there; None caches nothing.

    by: what drives instead. Results of other sources, plant and matrix included, or of a policy's
    other weights, are not taken for ours.
    """

    folder: Path | None
    by: Callable[[Chunk], Driven] | None = None

    def __call__(self, chunk: Chunk) -> Driven:
        """The chunk's result, from the folder if it is there."""
        if self.folder is None:
            return self._drive(chunk)
        path = self._path(chunk)
        found = read_case(path, chunk, entire=self.by is None)
        if found is not None:
            return found
        driven = self._drive(chunk)
        if not driven.error:  # an error is worth another try
            write_case(path, driven)
        return driven

    def _drive(self, chunk: Chunk) -> Driven:
        return drive(chunk) if self.by is None else self.by(chunk)

    def _path(self, chunk: Chunk) -> Path:
        assert self.folder is not None
        weights = stamp(chunk.cell.controller)
        own = "" if self.by is None else Path(inspect.getfile(self.by)).read_text()
        text = json.dumps([sources(), own, weights, chunk.cell.rung, asdict(chunk)], sort_keys=True)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:_LENGTH]}.npz"


@cache
def sources() -> str:
    """A hash of all files that an episode's numbers depend on, tuned options and weights too."""
    digest = hashlib.sha256((experiment_stamp() + salt_of()).encode())
    for name in (
        "build.py",
        "cells.py",
        "contests.py",
        "episodes.py",
        "../harness/metrics.py",
        "../harness/dissipation.py",
    ):
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()


def read_case(path: Path, chunk: Chunk, entire: bool = True) -> Driven | None:
    """The chunk's result; None where the file is absent, damaged or another chunk's. entire: with
    all numbers, and the series that the chunk keeps."""
    shapes: dict[str, tuple[int, ...]] = {
        "numbers": (len(chunk.seeds), len(NUMBERS)),
        "seconds": (),
    }
    try:
        with np.load(path, allow_pickle=False) as found:
            arrays = dict(found)
        if chunk.keep and entire:
            shapes["series"] = len(arrays["series"]), 1 + len(SIGNALS)
        if not all(_fits(arrays[name], shape, entire) for name, shape in shapes.items()):
            return None
    except Exception:  # whatever NumPy, zipfile and zlib find wrong with it
        return None
    return Driven(arrays["numbers"], float(arrays["seconds"]), arrays.get("series"))


def _fits(array: npt.NDArray[Any], shape: tuple[int, ...], entire: bool) -> bool:
    finite = np.isfinite(array)
    found = finite.all() if entire else finite.any()
    return array.dtype == np.float64 and array.shape == shape and bool(found)


def write_case(path: Path, driven: Driven) -> None:
    """Write a file of `read_case`; a full disk loses the file, not the run."""
    arrays: dict[str, Any] = {"numbers": driven.numbers, "seconds": np.array(driven.seconds)}
    if driven.series is not None:
        arrays["series"] = driven.series
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as file:
            np.savez_compressed(file, **arrays)
