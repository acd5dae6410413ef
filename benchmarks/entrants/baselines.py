"""The open benchmark's own entries, reused as long as their stored episodes cost the same.

`python -m sideslip.benchmarks.entrants.baselines` drives them all and writes the file.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ... import __version__
from ...envs.io import from_json
from ..control.entries import (
    REFERENCE_CONTROLLER,
    REFERENCE_FILTER,
    TRUTH,
    ControlEntry,
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
COMMAND = f"python -m {__name__}"
_BASELINE_PAIRS = (("", NOMINAL), ("", STATE), ("", "none"))
_AGENT_RIVALS = ((REFERENCE_FILTER, "esc"),)
_RIVALS = (("multirate-kf, camera and gps", REFERENCE_CONTROLLER), (TRUTH, REFERENCE_CONTROLLER))
"""(estimator, controller) pairs of all baselines, of an agent's and of an estimator's rivals."""
_SAMPLE = 2  # episodes of a baseline that are driven again
_SAME = 1e-6  # relative difference of equal costs


@dataclass(frozen=True)
class BaselineRecord(TaskRecord):
    """A baseline's episodes in a task: an entry of the file; failures: codes of `FAILURES`."""

    estimator: str
    controller: str
    salt: str
    env_version: str
    costs: list[float]
    failures: list[int]

    @property
    def entry(self) -> ControlEntry:
        """The entry of these episodes."""
        return ControlEntry(self.task, self.estimator, self.controller)

    def drives(self, n: int) -> DriveResult:
        """Return the first episodes; what is not on file is NaN.

        Args:
            n: Number of episodes.

        Returns:
            Episodes.
        """
        numbers = np.full((n, len(NUMBERS)), np.nan)
        numbers[:, NUMBERS.index("cost")] = self.costs[:n]
        numbers[:, NUMBERS.index("failure")] = self.failures[:n]
        return DriveResult(numbers, 0.0)


def make_baseline_entries(
    tasks: Sequence[ControlTask], agents: bool = True, estimators: bool = True
) -> list[ControlEntry]:
    """Make the baselines' entries.

    Args:
        tasks: Tasks that every pair drives.
        agents: Whether an agent's rivals are among them.
        estimators: Whether an estimator's rivals are among them.

    Returns:
        Entries, task by task.
    """
    pairs = _BASELINE_PAIRS + (_AGENT_RIVALS if agents else ()) + (_RIVALS if estimators else ())
    return [ControlEntry(task, *pair) for task in tasks for pair in pairs]


def read_baselines(path: Path = FILE) -> dict[ControlEntry, BaselineRecord]:
    """Read the records of a file that are of this version.

    Args:
        path: JSON file of the records.

    Returns:
        Records by entry.

    Raises:
        ValueError: The file holds no such records.
    """
    items = enumerate(read_objects(path), 1)
    records = (from_json(BaselineRecord, item, f"{path}: entry {i}") for i, item in items)
    return {record.entry: record for record in records if record.env_version == __version__}


def find_baselines(
    wanted: Sequence[ControlEntry], n: int, **options: Any
) -> tuple[str, Results] | None:
    """Find the stored episodes of baselines, if each baseline has n of them.

    Returns None if a sample driven again no longer reproduces any stored cost of a baseline. The
    sample is `_SAMPLE` episodes of each entry, of slow entries the first alone.

    Args:
        wanted: Entries to look up.
        n: Number of episodes of each.
        options: Options of `measure`.

    Returns:
        Salt and episodes, or None.
    """
    records = read_baselines(FILE) if FILE.is_file() else {}
    known = (records[entry] for entry in wanted if entry in records)
    matches = [record for record in known if len(record.costs) >= n]
    salts = {record.salt for record in matches}
    if len(matches) < len(wanted) or len(salts) != 1:
        return None
    (salt,) = salts
    slow = [entry for entry in wanted if entry.slow]
    sample = [entry for entry in wanted if entry not in slow[1:]]
    again = measure(sample, make_task_seeds(salt, _SAMPLE), title="baselines, a sample", **options)
    for entry, result in again.outcomes.items():
        same = np.isclose(result.costs, records[entry].costs[:_SAMPLE], rtol=_SAME, atol=0.0)
        # On another processor one drive of `oracle-state` costs 0.3 % more. What changes the car or
        # a controller changes every drive.
        if result.error or not same.any():
            return None
    return salt, Results({entry: records[entry].drives(n) for entry in wanted})


def write_baselines(path: Path = FILE, jobs: int | None = None) -> None:
    """Drive all baselines of the usual tasks, and write the file.

    Args:
        path: JSON file to write.
        jobs: Processes, None for all processors.

    Raises:
        ValueError: An entry cannot drive.
    """
    salt, lines = make_salt(), []
    entries = make_baseline_entries(select_quick_tasks(list_scored_tasks()))
    seeds = make_task_seeds(salt, EPISODES)
    for entry, result in measure(entries, seeds, jobs=jobs, console=Console()).outcomes.items():
        if result.error:
            raise ValueError(f"{entry.task.name}, {entry.label}: {result.error}")
        record = asdict(entry.task) | {"estimator": entry.estimator, "controller": entry.controller}
        record |= {"salt": salt, "env_version": __version__, "costs": result.costs.tolist()}
        record |= {"failures": result["failure"].astype(int).tolist()}
        lines.append(json.dumps(record))
    write_text(path, "[\n" + ",\n".join(lines) + "\n]\n")


if __name__ == "__main__":
    write_baselines()
