"""Finished cases on disk: a run that was stopped goes on where it was."""

import contextlib
import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...agents.learned.files import stamp
from ...envs.backend.cache import source_stamp
from ...envs.backend.files import whole
from .episodes import NUMBERS, SIGNALS, Chunk, Driven, drive

_LENGTH = 24


@dataclass(frozen=True)
class CachedDrive:
    """`drive` that looks in a folder first and leaves its result there.

    folder: None caches nothing. salt: of the seeds. Results of other sources, plant and matrix
    included, or of a policy's other weights, are not taken for ours.
    """

    folder: Path | None
    salt: str

    def __call__(self, chunk: Chunk) -> Driven:
        """The chunk's result, from the folder if it is there."""
        if self.folder is None:
            return drive(chunk)
        path = self._path(chunk)
        found = _read(path, chunk)
        if found is not None:
            return found
        driven = drive(chunk)
        if not driven.error:  # an error is worth another try
            _write(path, driven)
        return driven

    def _path(self, chunk: Chunk) -> Path:
        assert self.folder is not None
        weights = stamp(chunk.cell.controller)
        text = json.dumps([self.salt, sources(), weights, asdict(chunk)], sort_keys=True)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:_LENGTH]}.npz"


@cache
def sources() -> str:
    """A hash of all files that an episode's numbers depend on."""
    digest = hashlib.sha256(source_stamp("agents").encode())
    for name in ("build.py", "cells.py", "episodes.py", "../harness/metrics.py"):
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()


def _read(path: Path, chunk: Chunk) -> Driven | None:
    """The chunk's result; None where the file is absent, damaged or another chunk's."""
    shapes: dict[str, tuple[int, ...]] = {
        "numbers": (len(chunk.seeds), len(NUMBERS)),
        "seconds": (),
    }
    try:
        with np.load(path, allow_pickle=False) as found:
            arrays = dict(found)
        if chunk.keep:
            shapes["series"] = len(arrays["series"]), 1 + len(SIGNALS)
        if not all(_fits(arrays[name], shape) for name, shape in shapes.items()):
            return None
    except Exception:  # whatever NumPy, zipfile and zlib find wrong with it
        return None
    return Driven(arrays["numbers"], float(arrays["seconds"]), arrays.get("series"))


def _fits(array: npt.NDArray[Any], shape: tuple[int, ...]) -> bool:
    return array.dtype == np.float64 and array.shape == shape and bool(np.isfinite(array).all())


def _write(path: Path, driven: Driven) -> None:
    """A full disk loses the file, not the run."""
    arrays: dict[str, Any] = {"numbers": driven.numbers, "seconds": np.array(driven.seconds)}
    if driven.series is not None:
        arrays["series"] = driven.series
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as file:
            np.savez_compressed(file, **arrays)
