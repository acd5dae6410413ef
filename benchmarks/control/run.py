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

from ...agents.learned.files import hash_policy
from ...envs.backend.cache import hash_experiment
from ...envs.backend.files import atomic_file
from ..harness.parallel import run_cases
from .cells import SLOW_EPISODES, ControlEntry
from .contests import ControlTask
from .episodes import NUMBERS, SIGNALS, Chunk, DriveResult, run_chunk
from .seeds import Seeds, make_salt

CHUNK = 64
"""Episodes of a case: a run of so many is found again by a longer one."""
_LENGTH = 24


@dataclass
class Results:
    """Every cell's episodes."""

    outcomes: dict[ControlEntry, DriveResult] = field(default_factory=dict)

    def select(self, task: ControlTask, controller: str, estimator: str = "") -> DriveResult:
        """One cell; KeyError if it was not asked for."""
        return self.outcomes[ControlEntry(task, estimator, controller)]


def measure(
    entries: Sequence[ControlEntry],
    seeds: Seeds,
    *,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    runner: Callable[[Chunk], DriveResult] | None = None,
    title: str = "control",
) -> Results:
    """Drive every cell on its contest's seeds, slow ones on the first of them.

    keep: a folder in which finished cases stay, so that a run that was stopped goes on. by: what
    drives a chunk instead of `run_chunk`. title: of the progress bar.
    """
    if not entries:
        return Results()
    seeds_by_entry = {entry: seeds(entry.task) if callable(seeds) else seeds for entry in entries}
    seeds_by_entry = {
        entry: item[:SLOW_EPISODES] if entry.slow else item
        for entry, item in seeds_by_entry.items()
    }
    chunks = [  # the first of every cell before the second of any: a stopped run has them all
        Chunk(entry, tuple(entry_seeds[first : first + CHUNK]), keep=first == 0)
        for first in range(0, max(map(len, seeds_by_entry.values())), CHUNK)
        for entry, entry_seeds in seeds_by_entry.items()
        if first < len(entry_seeds)
    ]
    cached = CachedDrive(keep and keep.absolute(), runner)  # a worker of a cluster runs elsewhere
    results = run_cases(cached, chunks, title, jobs, console)
    parts: dict[ControlEntry, list[DriveResult]] = {}
    for chunk, item in zip(chunks, results, strict=True):
        parts.setdefault(chunk.entry, []).append(item)
    return Results({entry: _join_results(item) for entry, item in parts.items()})


def _join_results(parts: list[DriveResult]) -> DriveResult:
    return DriveResult(
        np.concatenate([part.numbers for part in parts]),
        sum(part.seconds for part in parts),
        parts[0].series,
        next((part.error for part in parts if part.error), ""),
    )


@dataclass(frozen=True)
class CachedDrive:
    """`run_chunk` that looks in a folder first and leaves its result there; None caches nothing.

    runner: what drives instead. Results of other sources, plant and matrix included, or of a
    policy's other weights, are not taken for ours.
    """

    folder: Path | None
    runner: Callable[[Chunk], DriveResult] | None = None

    def __call__(self, chunk: Chunk) -> DriveResult:
        """The chunk's result, from the folder if it is there."""
        if self.folder is None:
            return self._run_chunk(chunk)
        path = self._make_path(chunk)
        cached = read_case(path, chunk, entire=self.runner is None)
        if cached is not None:
            return cached
        result = self._run_chunk(chunk)
        if not result.error:  # an error is worth another try
            write_case(path, result)
        return result

    def _run_chunk(self, chunk: Chunk) -> DriveResult:
        return run_chunk(chunk) if self.runner is None else self.runner(chunk)

    def _make_path(self, chunk: Chunk) -> Path:
        assert self.folder is not None
        weights = hash_policy(chunk.entry.controller)
        source_text = "" if self.runner is None else Path(inspect.getfile(self.runner)).read_text()
        text = json.dumps(
            [hash_sources(), source_text, weights, chunk.entry.oracle, asdict(chunk)],
            sort_keys=True,
        )
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:_LENGTH]}.npz"


@cache
def hash_sources() -> str:
    """A hash of all files that an episode's numbers depend on, tuned options and weights too."""
    digest = hashlib.sha256((hash_experiment() + make_salt()).encode())
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


def read_case(path: Path, chunk: Chunk, entire: bool = True) -> DriveResult | None:
    """The chunk's result; None where the file is absent, damaged or another chunk's. entire: with
    all numbers, and the series that the chunk keeps."""
    shapes: dict[str, tuple[int, ...]] = {
        "numbers": (len(chunk.seeds), len(NUMBERS)),
        "seconds": (),
    }
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        if chunk.keep and entire:
            shapes["series"] = len(arrays["series"]), 1 + len(SIGNALS)
        if not all(_has_shape(arrays[name], shape, entire) for name, shape in shapes.items()):
            return None
    except Exception:  # whatever NumPy, zipfile and zlib find wrong with it
        return None
    return DriveResult(arrays["numbers"], float(arrays["seconds"]), arrays.get("series"))


def _has_shape(array: npt.NDArray[Any], shape: tuple[int, ...], entire: bool) -> bool:
    finite = np.isfinite(array)
    is_valid = finite.all() if entire else finite.any()
    return array.dtype == np.float64 and array.shape == shape and bool(is_valid)


def write_case(path: Path, result: DriveResult) -> None:
    """Write a file of `read_case`; a full disk loses the file, not the run."""
    arrays: dict[str, Any] = {"numbers": result.numbers, "seconds": np.array(result.seconds)}
    if result.series is not None:
        arrays["series"] = result.series
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            np.savez_compressed(file, **arrays)
