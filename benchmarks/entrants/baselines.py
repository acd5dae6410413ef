"""The package's own contestants of the open benchmark: on file, where their episodes still cost
what they did.

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
from ..control.cells import REFERENCE_CONTROLLER, REFERENCE_FILTER, TRUTH, Cell, some_of
from ..control.contests import NOMINAL, STATE, Contest, contests
from ..control.episodes import NUMBERS, Driven
from ..control.run import Results, measure
from ..control.seeds import salt_of, seeds_of_contests
from ..harness.results import made_of, read_objects, write_text
from .challenge import EPISODES

FILE = Path(__file__).with_name("baselines.json")
COMMAND = f"python -m {__name__}"
RUNGS = (("", NOMINAL), ("", STATE), ("", "none"))
CONTROLLERS = ((REFERENCE_FILTER, "esc"),)
ESTIMATORS = (("multirate-kf, camera and gps", REFERENCE_CONTROLLER), (TRUTH, REFERENCE_CONTROLLER))
"""(estimator, controller) of everybody's baselines, an agent's rivals and an estimator's."""
SAMPLE = 2  # episodes of a baseline that are driven again
_SAME = 1e-6  # of a cost, on whatever processor


@dataclass(frozen=True)
class Entry:
    """A baseline's episodes in a contest: an entry of the file. salt: of the seeds. failures:
    codes."""

    tier: str
    env_id: str
    vehicle: str
    reference: str
    scenario: str
    estimator: str
    controller: str
    salt: str
    env_version: str
    costs: list[float]
    failures: list[int]

    @property
    def cell(self) -> Cell:
        """Of which these are the episodes."""
        contest = Contest(self.tier, self.env_id, self.vehicle, self.reference, self.scenario)
        return Cell(contest, self.estimator, self.controller)

    def driven(self, n: int) -> Driven:
        """The first n episodes; what is not on file is NaN."""
        numbers = np.full((n, len(NUMBERS)), np.nan)
        numbers[:, NUMBERS.index("cost")] = self.costs[:n]
        numbers[:, NUMBERS.index("failure")] = self.failures[:n]
        return Driven(numbers, 0.0)


def cells_of(those: Sequence[Contest], agents: bool = True, estimators: bool = True) -> list[Cell]:
    """The baselines in these contests. agents, estimators: whether such are among the rivals."""
    who = RUNGS + (CONTROLLERS if agents else ()) + (ESTIMATORS if estimators else ())
    return [Cell(contest, *each) for contest in those for each in who]


def read_baselines(path: Path = FILE) -> dict[Cell, Entry]:
    """The entries of a file; none of another version's. Raises ValueError for another file."""
    entries = (made_of(Entry, x, f"{path}: entry {i}") for i, x in enumerate(read_objects(path), 1))
    return {each.cell: each for each in entries if each.env_version == __version__}


def on_file(cells: Sequence[Cell], n: int, **options: Any) -> tuple[str, Results] | None:
    """(salt, first n episodes) of baselines that are all on file with so many, and of whom a sample
    that is driven again costs the same; None where there are no such.

    The sample: `SAMPLE` episodes of each, of the slow ones in one contest. options: of `measure`.
    """
    entries = read_baselines(FILE) if FILE.is_file() else {}
    there = [entries[cell] for cell in cells if cell in entries and len(entries[cell].costs) >= n]
    salts = {each.salt for each in there}
    if len(there) < len(cells) or len(salts) != 1:
        return None
    (salt,) = salts
    slow = [cell for cell in cells if cell.slow]
    sample = [cell for cell in cells if cell not in slow[1:]]
    again = measure(sample, seeds_of_contests(salt, SAMPLE), title="baselines, a sample", **options)
    for cell, driven in again.found.items():
        if driven.error or not np.allclose(
            driven.costs, entries[cell].costs[:SAMPLE], rtol=_SAME, atol=0.0
        ):
            return None
    return salt, Results({cell: entries[cell].driven(n) for cell in cells})


def write_baselines(path: Path = FILE, jobs: int | None = None) -> None:
    """Drive all baselines of the usual contests, and write the file; ValueError where one fails."""
    salt = salt_of()
    cells = cells_of(some_of(contests()))
    found = measure(cells, seeds_of_contests(salt, EPISODES), jobs=jobs, console=Console()).found
    lines = []
    for cell, driven in found.items():
        if driven.error:
            raise ValueError(f"{cell.contest.name}, {cell.label}: {driven.error}")
        costs, failures = driven.costs.tolist(), driven["failure"].astype(int).tolist()
        names = asdict(cell.contest) | {"estimator": cell.estimator, "controller": cell.controller}
        entry = Entry(**names, salt=salt, env_version=__version__, costs=costs, failures=failures)
        lines.append(json.dumps(asdict(entry)))
    write_text(path, "[\n" + ",\n".join(lines) + "\n]\n")


if __name__ == "__main__":
    write_baselines()
