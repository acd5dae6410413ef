"""Question: which options make a contestant of the matrix cheapest, over a class's contests?

Every contestant gets the same number of trials on the same tuning seeds. What is made small is
minus the mean of `scores.gains` over contests and seeds: log(J / J_nominal), J_nominal that of the
untuned `nominal`, clipped to +-3, where a failure counts log 20.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ... import __version__
from ...agents.rungs import NOMINAL, RUNGS
from ...agents.tuned import Options
from ...envs.backend.cache import experiment_stamp
from ...envs.record import Array
from ..control.cells import ADAPTIVE, REFERENCE_FILTER, Cell
from ..control.contests import Contest, candidates, contests
from ..control.episodes import Chunk, Driven, drive
from ..control.scores import gains
from ..harness.engines import cores
from ..harness.parallel import run_cases
from ..harness.results import Suite, write_text
from .spaces import SLOW, Number, options_of, space
from .suite import found_table
from .task import STORAGE

TRIALS = 60
LOGS = Path(__file__).with_name("logs")
"""The studies whose options the package ships."""
STAGES = (2, 4, 8)
"""Seeds after which the better half of a slow contestant's trials goes on."""
_UNTUNED: Options = {"filter": {}, "controller": {}}


@dataclass(frozen=True)
class Contestant:
    """What is searched: a contestant's numbers, over a class's contests, on tuning seeds."""

    name: str
    kind: str
    contests: tuple[Contest, ...]
    seeds: tuple[int, ...]
    numbers: tuple[Number, ...]

    @property
    def study(self) -> str:
        """The study's name: the same for the same question asked of the same sources."""
        stamp = f"{json.dumps(asdict(self), default=str)} {experiment_stamp()} {__version__}"
        digest = hashlib.sha256(stamp.encode()).hexdigest()[:12]
        return f"{self.name} in {self.kind} {digest}"

    @property
    def search(self) -> dict[str, tuple[float, float]]:
        """(low, high) by name."""
        return {each.name: (each.low, each.high) for each in self.numbers}

    @property
    def start(self) -> dict[str, float]:
        """Where the search starts."""
        return {each.name: each.start for each in self.numbers}

    def options(self, found: dict[str, float]) -> Options:
        """The options with some numbers, which have three digits."""
        return options_of(self.numbers, {name: float(f"{v:.3g}") for name, v in found.items()})


def contestant(name: str, kind: str, seeds: Sequence[int]) -> Contestant:
    """The question; ValueError for an unknown name or class, no contests and no seeds."""
    numbers, found = space(name, kind), contests_of(name, kind)
    if not found or not seeds:
        raise ValueError(f"{kind}: {len(found)} contests, {len(seeds)} seeds; both are needed")
    return Contestant(name, kind, tuple(found), tuple(seeds), numbers)


def contests_of(name: str, kind: str) -> list[Contest]:
    """The scored contests of a class; of a rung, by which those are chosen, all candidates."""
    return [each for each in (candidates() if name in RUNGS else contests()) if each.kind == kind]


def driven(contest: Contest, name: str, options: Options, seeds: tuple[int, ...]) -> Driven:
    """A contestant's episodes with some options."""
    follows = {who: estimator for estimator, who in ADAPTIVE.items()}
    estimator = "" if name in RUNGS else follows.get(name, REFERENCE_FILTER)
    return drive(Chunk(Cell(contest, estimator, name, tuned=options), seeds))


@lru_cache(maxsize=64)
def _nominal(contest: Contest, seeds: tuple[int, ...]) -> Array:
    return driven(contest, NOMINAL, _UNTUNED, seeds).costs


def objective(task: Contestant, seeds: tuple[int, ...], found: dict[str, float]) -> float:
    """The mean over contests and some seeds, infinite where nothing can be designed."""
    options, logs = task.options(found), []
    for contest in task.contests:
        mine = driven(contest, task.name, options, seeds)
        if mine.error:
            return math.inf
        logs.append(-gains(_nominal(contest, seeds), mine))
    value = float(np.mean(logs))
    return value if math.isfinite(value) else math.inf


def judge(
    task: Contestant, jobs: int, batch: Sequence[dict[str, float]]
) -> list[tuple[float, int]]:
    """(objective, seeds driven) of each of a batch's trials.

    Of a slow contestant's the worse half is left after each of `STAGES` (successive halving); the
    others go on with the seeds that they have not driven.
    """
    stages = [each for each in STAGES if task.name in SLOW and each < len(task.seeds)]
    judged, going, done = [(0.0, 0)] * len(batch), list(range(len(batch))), 0
    for count in (*stages, len(task.seeds)):
        new = task.seeds[done:count]
        values = run_cases(partial(objective, task, new), [batch[i] for i in going], jobs=jobs)
        for i, value in zip(going, values, strict=True):
            judged[i] = (judged[i][0] * done + value * len(new)) / count, count
        done = count
        going = sorted(going, key=lambda i: judged[i])[: (len(going) + 1) // 2]
    return judged


def tune(
    task: Contestant,
    trials: int = TRIALS,
    storage: str = STORAGE,
    seed: int = 0,
    jobs: int | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Search; the study as a mapping of JSON types: every trial and the best of those that drove
    all seeds.

    A stopped search goes on where it was. Raises ValueError for a contestant that cannot drive the
    contests, no trials, a storage that fails, and where no trial is finite.
    """
    from .study import open_study, search_on

    if trials < 1:
        raise ValueError(f"trials must be at least 1, got {trials}")
    for contest in task.contests:  # what cannot be driven at all; kernels are compiled once
        if error := driven(contest, task.name, task.options(task.start), task.seeds[:1]).error:
            raise ValueError(f"{task.name} in {contest.name}: {error}")
    study = open_study(task, storage, "tpe", seed)
    if not study.trials:
        study.enqueue_trial(task.start)
    search_on(study, task, trials, partial(judge, task, jobs or cores()), len(task.seeds), console)
    return log_of(task, study.trials)


def log_of(task: Contestant, trials: Sequence[Any]) -> dict[str, Any]:
    """The log of a study; trials: Optuna's."""
    rows: list[dict[str, Any]] = []
    for each in trials:
        if "seeds" in each.user_attrs:  # the others were stopped
            found = {name: float(f"{value:.3g}") for name, value in each.params.items()}
            value, count = each.user_attrs["objective"], each.user_attrs["seeds"]
            known = round(value, 5) if math.isfinite(value) else None
            rows.append({"numbers": found, "seeds": count, "objective": known})
    whole = [r for r in rows if r["seeds"] == len(task.seeds) and r["objective"] is not None]
    if not whole:
        raise ValueError(f"none of {len(rows)} trials of {task.name} could be driven: {task.kind}")
    best = min(whole, key=lambda row: float(row["objective"]))
    return {
        "contestant": task.name,
        "class": task.kind,
        "env_version": __version__,
        "contests": [each.name for each in task.contests],
        "seeds": list(task.seeds),
        "start": rows[0]["objective"],
        "best": best,
        "options": task.options(best["numbers"]),
        "trials": rows,
    }


def write_log(path: Path, log: dict[str, Any]) -> None:
    """A log as JSON, a trial a line."""
    lines = ",\n  ".join(json.dumps(trial) for trial in log["trials"])
    head = json.dumps({key: value for key, value in log.items() if key != "trials"}, indent=1)
    write_text(path, f'{head[:-2]},\n "trials": [\n  {lines}\n ]\n}}\n')


def suite_of(task: Contestant, log: dict[str, Any]) -> Suite:
    """What a study found, as a table."""
    best = log["best"]
    start = math.inf if log["start"] is None else math.exp(log["start"])
    text = (
        f"{len(log['trials'])} trials over {len(task.contests)} contests of {task.kind} on "
        f"{len(task.seeds)} tuning seeds each: cost {100.0 * math.exp(best['objective']):.1f} % of "
        f"the untuned nominal's (geometric mean, a failure counts 20), {100.0 * start:.1f} % at "
        "the start."
    )
    table = found_table(best["numbers"], task.search)
    return Suite("tune", f"Tuning {task.name} in {task.kind}", text, tables=[table])
