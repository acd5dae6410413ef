"""Search of the options that give a controller the best score over the tasks of a class.

Every controller gets the same number of trials on the same tuning seeds, with a short lead-in. The
objective is minus the mean score r over tasks and seeds.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...agents.baselines import GRIP, STEER_WEIGHT, Options, read_tuned
from ...agents.controllers.two_dof import POLE
from ...agents.controllers.yaw_stability import BANDWIDTH
from ...envs.io import to_toml
from ...envs.numerics.kernel_cache import hash_experiment
from ...envs.scenarios.world import WORLD_VERSION
from ...envs.validation import check_choice
from ..control.entries import ADAPTIVE, JOINT, REFERENCE_FILTER, Entry
from ..control.run import Chunk, DriveResult, run_chunk
from ..control.score import PairedDrives
from ..control.tasks import NOMINAL, QUICK_LEAD_IN, ControlTask, list_scored_tasks
from ..harness.parallel import run_cases
from ..harness.results import Suite, write_text
from .search import Range, SearchOptions, make_result_table, make_study_name, run_study

KINDS = ("coms-model", "coms-zero-slip", "car-yaw", "car-steering")  # classes of tasks
STEERING = ("coms-model", "car-steering")  # the action steers too


class SearchNumber(NamedTuple):
    """A number that is searched between low and high, on a logarithmic scale, from `start` on."""

    name: str  # of the controller's option, behind a dot the place in a list
    start: float
    low: float
    high: float
    is_integer: bool = False
    steering: bool = False  # it means something only where the action steers


_TIME = SearchNumber("disturbance_time", 0.3, 0.03, 30.0)  # s
_GRIP = SearchNumber("grip", GRIP, 0.1, 1.0)
_STEER = SearchNumber("steer_weight", STEER_WEIGHT, 0.3, 1e3, steering=True)
_LQG = (_TIME, _GRIP, _STEER)
_NMPC = (SearchNumber("horizon", 0.5, 0.2, 1.0), _TIME, _GRIP, _STEER._replace(start=10.0))  # s

SPACES: dict[str, tuple[SearchNumber, ...]] = {
    "two-dof": (SearchNumber("gain", 1.0, 0.1, 10.0), SearchNumber("pole", POLE, 2.0, 60.0), _GRIP),
    "model-following": (
        SearchNumber("bandwidth.0", 5.0, 0.5, 50.0),  # rad/s, of the slip
        SearchNumber("bandwidth.1", 5.0, 0.5, 50.0),  # of the yaw rate
        _GRIP,
    ),
    "esc": (
        SearchNumber("bandwidth", BANDWIDTH, 2.0, 60.0),  # rad/s
        SearchNumber("band", 0.02, 1e-3, 0.1),  # rad/s
        SearchNumber("slip", 0.05, 2e-3, 0.3),  # rad
        _GRIP,
    ),
    "sliding-mode": (
        SearchNumber("pole", 15.0, 2.0, 60.0),  # rad/s
        SearchNumber("rate", 40.0, 4.0, 400.0),
        SearchNumber("layer", 0.2, 0.02, 2.0),
        _GRIP,
    ),
    "lqr": _LQG,
    "mpc": (SearchNumber("horizon", 30, 10, 60, is_integer=True), _TIME, _GRIP),
    "nmpc": _NMPC,
    "adaptive-lqr": _LQG,
    "adaptive-nmpc": _NMPC,
}
"""Numbers by controller. Filters are not tuned here: the world's ranges tell the levels of
`exact-kf`, and `joint` takes none. Nominal and the oracles are designed, not tuned: `lqr` is what
tuning makes of nominal."""
_SLOW = ("mpc", "nmpc", "adaptive-nmpc")
_STAGES = (2, 4, 8)  # seeds after which the better half of a slow controller's trials goes on
_HEAD = "# Options of entries as [class.name.part]; found by `sideslip tune controller NAME`.\n"
LOGS = Path(__file__).with_name("logs")  # studies whose options the package ships


@dataclass(frozen=True)
class ControllerTuning:
    """A search of a controller's numbers over the tasks of a class, on tuning seeds."""

    name: str
    kind: str
    tasks: tuple[ControlTask, ...]
    seeds: tuple[int, ...]
    numbers: tuple[SearchNumber, ...]

    @property
    def study(self) -> str:
        """Name of the study."""
        return make_study_name(f"{self.name} in {self.kind}", self, hash_experiment())

    @property
    def search(self) -> dict[str, Range]:
        """Range (low, high) of each number by name."""
        return {number.name: (number.low, number.high) for number in self.numbers}

    @property
    def start(self) -> dict[str, float]:
        """Value of each number at which the search starts."""
        return {number.name: number.start for number in self.numbers}

    def _make_options(self, values: dict[str, float]) -> Options:
        """Make the controller's options from numbers, rounded to three digits."""
        options: dict[str, Any] = {}
        for number in self.numbers:
            name, _, index = number.name.partition(".")
            rounded = float(f"{values[number.name]:.3g}")
            value = round(rounded) if number.is_integer else rounded
            if index:
                options.setdefault(name, []).append(value)
            else:
                options[name] = value
        return {"filter": {}, "controller": options}


def make_controller_tuning(name: str, kind: str, seeds: Sequence[int]) -> ControllerTuning:
    """Make the search of a controller's options; ValueError without tasks or seeds."""
    check_choice("controller", name, SPACES)
    check_choice("class", kind, KINDS)
    numbers = tuple(number for number in SPACES[name] if kind in STEERING or not number.steering)
    changes = {"lead_in": QUICK_LEAD_IN}
    tasks = [replace(t, changes=changes) for t in list_scored_tasks() if t.kind == kind]
    if not tasks or not seeds:
        raise ValueError(f"{kind}: {len(tasks)} tasks, {len(seeds)} seeds; both are needed")
    return ControllerTuning(name, kind, tuple(tasks), tuple(seeds), numbers)


def _run_entry(
    control_task: ControlTask, name: str, options: Options, seeds: tuple[int, ...]
) -> DriveResult:
    """Run a controller on a task with some options, an episode for each seed."""
    estimator = "" if name == NOMINAL else JOINT if name in ADAPTIVE else REFERENCE_FILTER
    return run_chunk(Chunk(control_task, Entry(name, estimator, options), seeds))


@lru_cache(maxsize=64)
def _drive_nominal(control_task: ControlTask, seeds: tuple[int, ...]) -> DriveResult:
    return _run_entry(control_task, NOMINAL, {"filter": {}, "controller": {}}, seeds)


def _compute_objective(
    task: ControllerTuning, seeds: tuple[int, ...], values: dict[str, float]
) -> float:
    """Compute the mean over tasks and some seeds; infinite where the design fails."""
    options, scores = task._make_options(values), []
    for control_task in task.tasks:
        result = _run_entry(control_task, task.name, options, seeds)
        if result.error:
            return math.inf
        nominal = _drive_nominal(control_task, seeds)
        scores.append(PairedDrives(nominal, result, control_task.cost_floor).compute_scores())
    return -float(np.mean(scores))


def _evaluate_trials(
    task: ControllerTuning, jobs: int, batch: Sequence[dict[str, float]]
) -> list[tuple[float, int]]:
    """Evaluate a batch of trials, each to its objective and the number of seeds that it drove."""
    # the worse half of a slow controller's trials ends after each stage: successive halving
    stages = [stage for stage in _STAGES if task.name in _SLOW and stage < len(task.seeds)]
    results, remaining, done = [(0.0, 0)] * len(batch), list(range(len(batch))), 0
    for count in (*stages, len(task.seeds)):
        new = task.seeds[done:count]
        trials = [batch[i] for i in remaining]
        values = run_cases(partial(_compute_objective, task, new), trials, jobs=jobs)
        for i, value in zip(remaining, values, strict=True):
            results[i] = (results[i][0] * done + value * len(new)) / count, count
        done = count
        remaining = sorted(remaining, key=lambda i: results[i])[: (len(remaining) + 1) // 2]
    return results


def tune(task: ControllerTuning, search: SearchOptions) -> dict[str, Any]:
    """Search for the best options by TPE, or go on; ValueError where a task cannot be driven."""
    options = task._make_options(task.start)
    for control_task in task.tasks:  # what cannot be driven at all; kernels are compiled once
        if error := _run_entry(control_task, task.name, options, task.seeds[:1]).error:
            raise ValueError(f"{task.name} in {control_task.name}: {error}")
    evaluate = partial(_evaluate_trials, task, search.workers)
    study = task.study, task.search, replace(search, sampler="tpe")
    return _make_log(task, run_study(*study, evaluate, len(task.seeds), task.start))


def _make_log(task: ControllerTuning, trials: Sequence[Any]) -> dict[str, Any]:
    """Make the log of a study from its finished trials."""
    rows: list[dict[str, Any]] = []
    for item in trials:
        numbers = {name: float(f"{value:.3g}") for name, value in item.params.items()}
        value, count = item.user_attrs["objective"], item.user_attrs["seeds"]
        known = round(value, 5) if math.isfinite(value) else None
        rows.append({"numbers": numbers, "seeds": count, "objective": known})
    complete = [r for r in rows if r["seeds"] == len(task.seeds) and r["objective"] is not None]
    if not complete:
        raise ValueError(f"none of {len(rows)} trials of {task.name} could be driven: {task.kind}")
    best = min(complete, key=lambda row: float(row["objective"]))
    start = rows[0]["objective"]
    if rows[0] not in complete and start is not None:  # it lost to others on a few seeds
        start = round(_compute_objective(task, task.seeds, task.start), 5)
    return {
        "contestant": task.name, "class": task.kind, "world_version": WORLD_VERSION,
        "contests": [item.name for item in task.tasks], "seeds": list(task.seeds), "start": start,
        "best": best, "options": task._make_options(best["numbers"]), "trials": rows,
    }  # fmt: skip


def write_log(path: Path, log: dict[str, Any]) -> None:
    """Write a log as JSON, a trial a line."""
    lines = ",\n  ".join(json.dumps(trial) for trial in log["trials"])
    head = json.dumps({key: value for key, value in log.items() if key != "trials"}, indent=1)
    write_text(path, f'{head[:-2]},\n "trials": [\n  {lines}\n ]\n}}\n')


def write_tuned(path: str | Path, kind: str, name: str, options: Options) -> None:
    """Replace or add a controller's options in a file of `read_tuned`."""
    target = Path(path)
    read_tuned.cache_clear()
    classes = read_tuned(target) if target.exists() else {}
    classes = classes | {kind: classes.get(kind, {}) | {name: options}}
    tables = [
        f"[{class_name}.{entry}.{part}]\n"
        + "".join(f"{option} = {to_toml(value)}\n" for option, value in part_options.items())
        for class_name, names in sorted(classes.items())
        for entry, parts in sorted(names.items())
        for part, part_options in parts.items()
        if part_options
    ]
    write_text(target, "\n".join([f"{_HEAD}world_version = {WORLD_VERSION}\n", *tables]))
    read_tuned.cache_clear()


def make_suite(task: ControllerTuning, log: dict[str, Any]) -> Suite:
    """Make a suite with the numbers that a study found."""
    best, start = log["best"], log["start"]
    before = "it cannot be driven" if start is None else f"{-start:.3f}"
    text = (
        f"{len(log['trials'])} trials over {len(task.tasks)} tasks of {task.kind} on "
        f"{len(task.seeds)} tuning seeds: score {-best['objective']:.3f}; at the start {before}."
    )
    table = make_result_table(best["numbers"], task.search)
    return Suite("tune", f"Tuning {task.name} in {task.kind}", text, tables=[table])
