"""The open benchmark's own entries, reused as long as their stored episodes cost the same.

`python -m sideslip.benchmarks.entrants.baselines` drives them all and writes the file.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ...envs.io import from_json
from ...envs.scenarios.world import WORLD_VERSION
from ..control.entries import (
    REFERENCE_CONTROLLER,
    REFERENCE_FILTER,
    TRUTH,
    ControlCase,
    Entry,
    select_quick_tasks,
)
from ..control.run import NUMBERS, DriveResult, Results, measure
from ..control.tasks import (
    NOMINAL,
    STATE,
    ControlTask,
    TaskRecord,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
)
from ..harness.results import read_objects, write_text
from .challenge import EPISODES

FILE = Path(__file__).with_name("baselines.json")
_BASELINES = tuple(map(Entry, (NOMINAL, STATE, "none")))
_AGENT_RIVALS = (Entry("esc", REFERENCE_FILTER),)
_RIVAL_FILTERS = ("multirate-kf, camera and gps", TRUTH)
_RIVALS = tuple(Entry(REFERENCE_CONTROLLER, name) for name in _RIVAL_FILTERS)
"""All baselines, an agent's and an estimator's rivals."""
_SAMPLE = 2  # episodes of a baseline that are driven again
_SAME = 1e-6  # relative difference of equal costs


@dataclass(frozen=True)
class BaselineRecord(TaskRecord):
    """A baseline's episodes in a task: an entry of the file; failures: codes of `FAILURES`."""

    estimator: str
    controller: str
    salt: str
    world_version: int
    costs: list[float]
    failures: list[int]

    @property
    def case(self) -> ControlCase:
        """Who drove these episodes, in which task."""
        return ControlCase(self.task, Entry(self.controller, self.estimator))

    def _make_drives(self, n: int) -> DriveResult:
        """Make the first n episodes; what is not on file is NaN."""
        numbers = np.full((n, len(NUMBERS)), np.nan)
        numbers[:, NUMBERS.index("cost")] = self.costs[:n]
        numbers[:, NUMBERS.index("failure")] = self.failures[:n]
        return DriveResult(numbers, 0.0)


def make_baseline_cases(
    tasks: Sequence[ControlTask], agents: bool = True, estimators: bool = True
) -> list[ControlCase]:
    """Make the baselines' cases.

    Args:
        tasks: Tasks that every entry drives.
        agents: Whether an agent's rivals are among them.
        estimators: Whether an estimator's rivals are among them.

    Returns:
        Cases, task by task.
    """
    entries = _BASELINES + (_AGENT_RIVALS if agents else ()) + (_RIVALS if estimators else ())
    return [ControlCase(task, entry) for task in tasks for entry in entries]


def _read_baselines(path: Path = FILE) -> dict[tuple[ControlTask, Entry], BaselineRecord]:
    """Read the records of a file that are of this world, by case; ValueError for others."""
    items = enumerate(read_objects(path), 1)
    records = (from_json(BaselineRecord, item, f"{path}: entry {i}") for i, item in items)
    return {record.case: record for record in records if record.world_version == WORLD_VERSION}


def find_baselines(
    wanted: Sequence[ControlCase], n: int, **options: Any
) -> tuple[str, Results] | None:
    """Find the stored episodes of baselines, if each baseline has n of them.

    None, too, if a sample driven again (`_SAMPLE` episodes of each case, of slow entries the first
    alone) no longer reproduces any stored cost of a baseline.

    Args:
        wanted: Cases to look up.
        n: Number of episodes of each.
        options: Options of `measure`.

    Returns:
        Salt and episodes, or None.
    """
    records = _read_baselines(FILE) if FILE.is_file() else {}
    matches = {case: records[case] for case in wanted if case in records}
    salts = {record.salt for record in matches.values()}
    is_short = len(matches) < len(wanted) or any(len(x.costs) < n for x in matches.values())
    if is_short or len(salts) != 1:
        return None
    (salt,) = salts
    slow = [case for case in wanted if case.is_slow]
    sample = [case for case in wanted if case not in slow[1:]]
    again = measure(sample, make_task_seeds(salt, _SAMPLE), title="baselines, a sample", **options)
    for case, result in again.items():
        same = np.isclose(result.costs, records[case].costs[:_SAMPLE], rtol=_SAME, atol=0.0)
        # On another processor one drive of `oracle-state` costs 0.3 % more. What changes the car or
        # a controller changes every drive.
        if result.error or not same.any():
            return None
    return salt, {case: record._make_drives(n) for case, record in matches.items()}


def _write_baselines(path: Path = FILE) -> None:
    """Drive all baselines of the usual tasks, and write the file."""
    salt, lines = make_salt(), []
    cases = make_baseline_cases(select_quick_tasks(list_scored_tasks()))
    seeds = make_task_seeds(salt, EPISODES)
    for (task, entry), result in measure(cases, seeds, console=Console()).items():
        if result.error:
            raise ValueError(f"{task.name}, {entry.label}: {result.error}")
        more = {"costs": result.costs.tolist(), "failures": result["failure"].astype(int).tolist()}
        record = {"estimator": entry.estimator, "controller": entry.agent, "salt": salt}
        lines.append(json.dumps(task.record | record | {"world_version": WORLD_VERSION} | more))
    write_text(path, "[\n" + ",\n".join(lines) + "\n]\n")


if __name__ == "__main__":
    _write_baselines()
