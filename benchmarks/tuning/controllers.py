"""Search of the options that make a controller cheapest over the tasks of a class.

Every controller gets the same number of trials on the same tuning seeds. The objective is minus the
mean of `compute_log_ratios` over tasks and seeds: log(J / J_nominal), J_nominal that of the untuned
`nominal`, clipped to +-3, where a failure counts log 20.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ... import __version__
from ...agents.baselines import NOMINAL, ORACLES, Options
from ...agents.controllers.yaw_stability import BANDWIDTH
from ...agents.design.pi import POLE
from ...envs.numerics.kernel_cache import hash_experiment
from ...envs.record import Array
from ...envs.validation import check_choice
from ..control.entries import ADAPTIVE, JOINT, REFERENCE_FILTER, Entry
from ..control.run import Chunk, DriveResult, run_chunk
from ..control.score import compute_log_ratios
from ..control.tasks import ControlTask, list_candidates, list_scored_tasks
from ..harness.parallel import count_cores, run_cases
from ..harness.results import Suite, write_text
from .estimator import SearchOptions
from .study import create_study, make_result_table, run_search

KINDS = ("coms-model", "coms-zero-slip", "car-yaw", "car-steering")
"""Classes of tasks."""
STEERING = ("coms-model", "car-steering")  # the action steers too


class SearchNumber(NamedTuple):
    """A number that is searched between low and high, on a logarithmic scale, from `start` on."""

    name: str  # of the option, behind a dot the place in a list
    start: float
    low: float
    high: float
    of: tuple[str, ...] = ("controller",)  # whose option it is: controller, filter or both
    is_integer: bool = False
    steering: bool = False  # it means something only where the action steers


_TIME = SearchNumber("disturbance_time", 0.3, 0.03, 3.0, ("filter",))  # s
_LEVELS = (
    SearchNumber("force_sd", 50.0, 10.0, 3e3, ("filter",)),  # N
    SearchNumber("moment_sd", 20.0, 5.0, 3e3, ("filter",)),  # N m
    SearchNumber("bias_sd", 0.01, 1e-4, 0.05, ("filter",)),  # rad/s
    SearchNumber("accel_bias_sd", 0.2, 0.01, 2.0, ("filter",)),  # m/s2
    SearchNumber("bank_sd", 0.01, 1e-4, 0.1, ("filter",)),  # rad
    SearchNumber("accel_y_noise", 0.1, 0.02, 2.0, ("filter",)),  # m/s2
)
_GRIP = SearchNumber("grip", 0.7, 0.3, 1.0)
_FILTER = (*_LEVELS, _TIME, _GRIP)
_STEER = SearchNumber("steer_weight", 100.0, 0.3, 1e3, steering=True)
_BOTH_TIMES = _TIME._replace(of=("filter", "controller"))
_MPC = (*_LEVELS, _BOTH_TIMES, _GRIP)
_LQG = (*_MPC, _STEER)
_NMPC = (SearchNumber("horizon", 0.5, 0.2, 1.0), _STEER._replace(start=10.0))  # s
_ADAPTIVE = (_TIME._replace(of=("controller",)), _GRIP)

SPACES: dict[str, tuple[SearchNumber, ...]] = {
    "two-dof": (
        SearchNumber("gain", 1.0, 0.1, 10.0),
        SearchNumber("pole", POLE, 2.0, 60.0),
        *_FILTER,
    ),
    "model-following": (
        SearchNumber("bandwidth.0", 5.0, 0.5, 50.0),  # rad/s, of the slip
        SearchNumber("bandwidth.1", 5.0, 0.5, 50.0),  # of the yaw rate
        *_FILTER,
    ),
    "esc": (
        SearchNumber("bandwidth", BANDWIDTH, 2.0, 60.0),  # rad/s
        SearchNumber("band", 0.02, 1e-3, 0.1),  # rad/s
        SearchNumber("slip", 0.05, 2e-3, 0.3),  # rad
        *_FILTER,
    ),
    "sliding-mode": (
        SearchNumber("pole", 15.0, 2.0, 60.0),  # rad/s
        SearchNumber("rate", 40.0, 4.0, 400.0),
        SearchNumber("layer", 0.2, 0.02, 2.0),
        *_FILTER,
    ),
    "lqr": _LQG,
    "mpc": (SearchNumber("horizon", 30, 10, 60, is_integer=True), *_MPC),
    "nmpc": (*_NMPC, *_MPC),
    "adaptive-lqr": (_STEER, *_ADAPTIVE),
    "adaptive-nmpc": (*_NMPC, *_ADAPTIVE),
    "nominal": _LQG,
    # it knows the gyro's bias
    "oracle-parameters-lqr": tuple(number for number in _LQG if number.name != "bias_sd"),
}
"""Numbers by controller. All but the oracles drive on `exact-kf` with all sensors, adaptive ones on
the filter whose tyres they follow; `lqr` has what is found for `nominal`, the same design."""
_SLOW = ("mpc", "nmpc", "adaptive-nmpc", "oracle-parameters-lqr")
_STAGES = (2, 4, 8)  # seeds after which the better half of a slow controller's trials goes on
_TRIALS = 60
LOGS = Path(__file__).with_name("logs")
"""Studies whose options the package ships."""
_UNTUNED: Options = {"filter": {}, "controller": {}}


def _get_space(name: str, kind: str) -> tuple[SearchNumber, ...]:
    """Get the numbers of a controller in a class of tasks; ValueError for unknown names."""
    check_choice("controller", name, SPACES)
    check_choice("class", kind, KINDS)
    return tuple(number for number in SPACES[name] if kind in STEERING or not number.steering)


@dataclass(frozen=True)
class ControllerTuning:
    """A search of a controller's numbers over the tasks of a class, on tuning seeds."""

    name: str
    kind: str
    contests: tuple[ControlTask, ...]
    seeds: tuple[int, ...]
    numbers: tuple[SearchNumber, ...]

    @property
    def study(self) -> str:
        """Name of the study: one for the same question, asked of the same sources."""
        stamp = f"{json.dumps(asdict(self), default=str)} {hash_experiment()} {__version__}"
        digest = hashlib.sha256(stamp.encode()).hexdigest()[:12]
        return f"{self.name} in {self.kind} {digest}"

    @property
    def search(self) -> dict[str, tuple[float, float]]:
        """Range (low, high) of each number by name."""
        return {number.name: (number.low, number.high) for number in self.numbers}

    @property
    def start(self) -> dict[str, float]:
        """Value of each number at which the search starts."""
        return {number.name: number.start for number in self.numbers}

    def _make_options(self, values: dict[str, float]) -> Options:
        """Make the options of filter and controller from numbers, rounded to three digits."""
        options: dict[str, dict[str, Any]] = {"filter": {}, "controller": {}}
        for number in self.numbers:
            name, _, index = number.name.partition(".")
            rounded = float(f"{values[number.name]:.3g}")
            value = round(rounded) if number.is_integer else rounded
            for part in number.of:
                if index:
                    options[part].setdefault(name, []).append(value)
                else:
                    options[part][name] = value
        return options


def make_controller_tuning(name: str, kind: str, seeds: Sequence[int]) -> ControllerTuning:
    """Make the search of a controller's options.

    Args:
        name: Name of the controller.
        kind: Class of tasks.
        seeds: Tuning seeds.

    Returns:
        Search.

    Raises:
        ValueError: The name or class is unknown, or there are no tasks or no seeds.
    """
    numbers, matching = _get_space(name, kind), _list_contests(name, kind)
    if not matching or not seeds:
        raise ValueError(f"{kind}: {len(matching)} contests, {len(seeds)} seeds; both are needed")
    return ControllerTuning(name, kind, tuple(matching), tuple(seeds), numbers)


def _list_contests(name: str, kind: str) -> list[ControlTask]:
    """List the scored tasks of a class; for an oracle all candidates, chosen by its costs."""
    tasks = list_candidates() if name in ORACLES else list_scored_tasks()
    return [task for task in tasks if task.kind == kind]


def _run_contestant(
    contest: ControlTask, name: str, options: Options, seeds: tuple[int, ...]
) -> DriveResult:
    """Run a controller on a task with some options, an episode for each seed."""
    estimator = "" if name in ORACLES else JOINT if name in ADAPTIVE else REFERENCE_FILTER
    return run_chunk(Chunk(contest, Entry(name, estimator, options), seeds))


@lru_cache(maxsize=64)
def _compute_nominal_costs(contest: ControlTask, seeds: tuple[int, ...]) -> Array:
    return _run_contestant(contest, NOMINAL, _UNTUNED, seeds).costs


def _compute_objective(
    task: ControllerTuning, seeds: tuple[int, ...], values: dict[str, float]
) -> float:
    """Compute the mean over tasks and some seeds; infinite where the design fails."""
    options, log_ratios = task._make_options(values), []
    for contest in task.contests:
        result = _run_contestant(contest, task.name, options, seeds)
        if result.error:
            return math.inf
        log_ratios.append(-compute_log_ratios(_compute_nominal_costs(contest, seeds), result))
    value = float(np.mean(log_ratios))
    return value if math.isfinite(value) else math.inf


def _evaluate_trials(
    task: ControllerTuning, jobs: int, batch: Sequence[dict[str, float]]
) -> list[tuple[float, int]]:
    """Evaluate a batch of trials, each to its objective and the number of seeds that it drove.

    The worse half of a slow controller's trials ends after each of `_STAGES` (successive halving).
    """
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
    """Search for the best options by TPE; a search that was stopped goes on.

    Args:
        task: Search.
        search: Options of the search, but for its sampler.

    Returns:
        The study's log as JSON types.

    Raises:
        ValueError: The controller cannot drive a task, the storage fails, or no trial that drove
            all seeds is finite.
    """
    options = task._make_options(task.start)
    for contest in task.contests:  # what cannot be driven at all; kernels are compiled once
        if error := _run_contestant(contest, task.name, options, task.seeds[:1]).error:
            raise ValueError(f"{task.name} in {contest.name}: {error}")
    study = create_study(task, search.storage, "tpe", search.seed)
    if not study.trials:
        study.enqueue_trial(task.start)
    evaluate = partial(_evaluate_trials, task, search.jobs or count_cores())
    run_search(study, task, search, evaluate, len(task.seeds))
    return _make_log(task, study.trials)


def _make_log(task: ControllerTuning, trials: Sequence[Any]) -> dict[str, Any]:
    """Make the log of a study from Optuna's trials."""
    rows: list[dict[str, Any]] = []
    for item in trials:
        if "seeds" in item.user_attrs:  # the others were stopped
            numbers = {name: float(f"{value:.3g}") for name, value in item.params.items()}
            value, count = item.user_attrs["objective"], item.user_attrs["seeds"]
            known = round(value, 5) if math.isfinite(value) else None
            rows.append({"numbers": numbers, "seeds": count, "objective": known})
    complete = [r for r in rows if r["seeds"] == len(task.seeds) and r["objective"] is not None]
    if not complete:
        raise ValueError(f"none of {len(rows)} trials of {task.name} could be driven: {task.kind}")
    best = min(complete, key=lambda row: float(row["objective"]))
    return {
        "contestant": task.name,
        "class": task.kind,
        "env_version": __version__,
        "contests": [item.name for item in task.contests],
        "seeds": list(task.seeds),
        "start": rows[0]["objective"],
        "best": best,
        "options": task._make_options(best["numbers"]),
        "trials": rows,
    }


def write_log(path: Path, log: dict[str, Any]) -> None:
    """Write a log as JSON, a trial a line.

    Args:
        path: File.
        log: Log of `tune`.
    """
    lines = ",\n  ".join(json.dumps(trial) for trial in log["trials"])
    head = json.dumps({key: value for key, value in log.items() if key != "trials"}, indent=1)
    write_text(path, f'{head[:-2]},\n "trials": [\n  {lines}\n ]\n}}\n')


def make_suite(task: ControllerTuning, log: dict[str, Any]) -> Suite:
    """Make a suite with the numbers that a study found.

    Args:
        task: Search.
        log: Log of `tune`.

    Returns:
        Suite with a table.
    """
    best = log["best"]
    start = math.inf if log["start"] is None else math.exp(log["start"])
    text = (
        f"{len(log['trials'])} trials over {len(task.contests)} contests of {task.kind} on "
        f"{len(task.seeds)} tuning seeds each: cost {100.0 * math.exp(best['objective']):.1f} % of "
        f"the untuned nominal's (geometric mean, a failure counts 20), {100.0 * start:.1f} % at "
        "the start."
    )
    table = make_result_table(best["numbers"], task.search)
    return Suite("tune", f"Tuning {task.name} in {task.kind}", text, tables=[table])
