"""A user's contestants and the package's, on the same episodes."""

import hashlib
import os
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from rich.console import Console

from ..control.cells import REFERENCE_CONTROLLER, Cell
from ..control.contests import Contest
from ..control.episodes import Chunk
from ..control.ladder import yardsticks
from ..control.run import Results, measure
from ..control.seeds import salt_of, seeds_of_contests, tuning_seeds
from ..control.tables import Standing, standings
from ..harness.parallel import run_cases
from .baselines import cells_of, on_file
from .challenge import Challenge, Pair
from .worker import drive_apart, drive_users, rehearse

REHEARSED = 2  # episodes of a contest in which contestants show what they open


@dataclass(frozen=True)
class Comparison:
    """The episodes of a challenge. salt: of the seeds, "" where the caller chose them. on_file:
    whether the baselines are the file's."""

    challenge: Challenge
    salt: str
    on_file: bool
    results: Results

    @cached_property
    def overall(self) -> list[Standing]:
        """Everybody over all contests, the best first."""
        return self.standings(None)

    def standings(self, tier: str | None) -> list[Standing]:
        """Everybody in a tier, None: in all of them, the best first."""
        return standings(self.results.found, tier, yardsticks(self.results, self.contests))

    @property
    def contests(self) -> list[Contest]:
        """Those that were driven."""
        return list(self.challenge.contests)

    def of(self, pair: Pair) -> Standing:
        """A contestant over all contests."""
        return next(each for each in self.overall if each.label == pair.label)


def compare(
    challenge: Challenge,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> Comparison:
    """Drive a challenge. keep: a folder for the baselines' finished cases.

    A contestant of names and files drives in processes of its own, objects in this one.
    """
    pairs, played = challenge.pairs, challenge.contests
    shared: dict[str, Any] = {"jobs": jobs, "console": console, "keep": keep}
    controllers = any(pair.agent != REFERENCE_CONTROLLER for pair in pairs)
    filters = any(pair.agent == REFERENCE_CONTROLLER for pair in pairs)
    rivals = [
        Cell(cell.contest, cell.estimator, cell.controller, played[cell.contest])
        for cell in cells_of(list(played), controllers, filters)
    ]
    own = [pair.cell(contest, options) for contest, options in played.items() for pair in pairs]
    apart = [cell for cell in own if not cell.objects]
    found = on_file(rivals, challenge.episodes, **shared) if challenge.is_as_shipped else None
    allowed: frozenset[str] | None = None
    salt = found[0] if found else challenge.salt or salt_of()
    if challenge.fresh:
        allowed = _find_opened_files(challenge, apart, jobs, console)
        digests = [hashlib.sha256(Path(each).read_bytes()).hexdigest() for each in sorted(allowed)]
        salt = salt_of(*digests, secrets.token_hex(16))
    seeds = challenge.seeds or seeds_of_contests(salt, challenge.episodes)
    results = found[1] if found else measure(rivals, seeds, title="baselines", **shared)
    by = partial(drive_apart, limit=challenge.limit, allowed=allowed)
    there = measure(apart, seeds, jobs=jobs, console=console, title="entrants", by=by)
    here = measure([cell for cell in own if cell.objects], seeds, jobs=1, by=drive_users)
    every = Results(results.found | there.found | here.found)
    return Comparison(challenge, "" if challenge.seeds else salt, bool(found), every)


def _find_opened_files(
    challenge: Challenge, cells: Sequence[Cell], jobs: int | None, console: Console | None
) -> frozenset[str]:
    """Find the files that contestants open, theirs included, by a drive on tuning seeds."""
    chunks = [Chunk(cell, tuple(tuning_seeds(REHEARSED))) for cell in cells]
    by = partial(rehearse, limit=challenge.limit)
    opened = [files for _, files in run_cases(by, chunks, "rehearsal", jobs, console)]
    return frozenset().union(*opened, (os.path.realpath(each) for each in challenge.files))
