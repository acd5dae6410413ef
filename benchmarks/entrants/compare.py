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

from ..control.cells import REFERENCE_CONTROLLER, ControlEntry
from ..control.contests import ControlTask
from ..control.episodes import Chunk
from ..control.ladder import make_score_scales
from ..control.run import Results, measure
from ..control.seeds import make_salt, make_task_seeds, make_tuning_seeds
from ..control.tables import Standing, rank_entries
from ..harness.parallel import run_cases
from .baselines import find_baselines, make_baseline_entries
from .challenge import ComparisonRequest, UserEntry
from .worker import run_isolated_chunk, run_rehearsal, run_user_chunk

REHEARSED = 2  # episodes of a contest in which contestants show what they open


@dataclass(frozen=True)
class Comparison:
    """The episodes of a challenge. salt: of the seeds, "" where the caller chose them. on_file:
    whether the baselines are the file's."""

    request: ComparisonRequest
    salt: str
    on_file: bool
    results: Results

    @cached_property
    def overall(self) -> list[Standing]:
        """Everybody over all contests, the best first."""
        return self.standings(None)

    def standings(self, tier: str | None) -> list[Standing]:
        """Everybody in a tier, None: in all of them, the best first."""
        return rank_entries(
            self.results.outcomes, tier, make_score_scales(self.results, self.tasks)
        )

    @property
    def tasks(self) -> list[ControlTask]:
        """Those that were driven."""
        return list(self.request.tasks)

    def select(self, entry: UserEntry) -> Standing:
        """A contestant over all contests."""
        return next(standing for standing in self.overall if standing.label == entry.label)


def compare(
    request: ComparisonRequest,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> Comparison:
    """Drive a challenge. keep: a folder for the baselines' finished cases.

    A contestant of names and files drives in processes of its own, objects in this one.
    """
    entries, tasks = request.entries, request.tasks
    shared: dict[str, Any] = {"jobs": jobs, "console": console, "keep": keep}
    controllers = any(entry.agent != REFERENCE_CONTROLLER for entry in entries)
    filters = any(entry.agent == REFERENCE_CONTROLLER for entry in entries)
    rivals = [
        ControlEntry(
            control_entry.task,
            control_entry.estimator,
            control_entry.controller,
            tasks[control_entry.task],
        )
        for control_entry in make_baseline_entries(list(tasks), controllers, filters)
    ]
    user_entries = [
        entry.make_entry(task, options) for task, options in tasks.items() for entry in entries
    ]
    isolated = [control_entry for control_entry in user_entries if not control_entry.objects]
    baselines = (
        find_baselines(rivals, request.episodes, **shared) if request.is_as_shipped else None
    )
    allowed: frozenset[str] | None = None
    salt = baselines[0] if baselines else request.salt or make_salt()
    if request.fresh:
        allowed = _find_opened_files(request, isolated, jobs, console)
        digests = [hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in sorted(allowed)]
        salt = make_salt(*digests, secrets.token_hex(16))
    seeds = request.seeds or make_task_seeds(salt, request.episodes)
    results = baselines[1] if baselines else measure(rivals, seeds, title="baselines", **shared)
    runner = partial(run_isolated_chunk, limit=request.limit, allowed=allowed)
    remote = measure(isolated, seeds, jobs=jobs, console=console, title="entrants", runner=runner)
    in_process = measure(
        [control_entry for control_entry in user_entries if control_entry.objects],
        seeds,
        jobs=1,
        runner=run_user_chunk,
    )
    all_results = Results(results.outcomes | remote.outcomes | in_process.outcomes)
    return Comparison(request, "" if request.seeds else salt, bool(baselines), all_results)


def _find_opened_files(
    request: ComparisonRequest,
    entries: Sequence[ControlEntry],
    jobs: int | None,
    console: Console | None,
) -> frozenset[str]:
    """Find the files that contestants open, theirs included, by a drive on tuning seeds."""
    chunks = [Chunk(entry, tuple(make_tuning_seeds(REHEARSED))) for entry in entries]
    runner = partial(run_rehearsal, limit=request.limit)
    opened = [files for _, files in run_cases(runner, chunks, "rehearsal", jobs, console)]
    return frozenset().union(*opened, (os.path.realpath(path) for path in request.files))
