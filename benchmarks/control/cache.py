"""Finished cases on disk: a run that was stopped goes on where it was."""

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from ...agents.learned.files import stamp
from ...envs.backend.cache import source_stamp
from .episodes import Chunk, Driven, drive

_LENGTH = 24


@dataclass(frozen=True)
class Kept:
    """`drive` that looks in a folder first and leaves its result there.

    folder: None keeps nothing. salt: of the seeds. Results of other sources, plant and matrix
    included, or of a policy's other weights, are not taken for ours.
    """

    folder: Path | None
    salt: str

    def __call__(self, chunk: Chunk) -> Driven:
        """The chunk's result, from the folder if it is there."""
        if self.folder is None:
            return drive(chunk)
        path = self._path(chunk)
        found = _read(path)
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


def _read(path: Path) -> Driven | None:
    try:
        with np.load(path, allow_pickle=False) as found:
            return Driven(found["numbers"], float(found["seconds"]), found.get("series"))
    except (OSError, ValueError, KeyError, BadZipFile):  # absent or cut short: driven again
        return None


def _write(path: Path, driven: Driven) -> None:
    """The whole file or none; a full disk loses the kept case, not the run."""
    part = path.with_suffix(f".{hash(path)}.part.npz")
    arrays: dict[str, Any] = {"numbers": driven.numbers, "seconds": np.array(driven.seconds)}
    if driven.series is not None:
        arrays["series"] = driven.series
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(part, **arrays)
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
