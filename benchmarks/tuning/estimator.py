"""Tuning of an estimator: ranges, training and test drives with their errors, entry in files."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ...agents.rollout import rollout
from ...envs.io import to_toml
from ...envs.numerics.kernel_cache import hash_sources
from ...envs.record import Array
from ...estimators.design.options import TUNINGS, read_tunings
from ...estimators.estimator import Estimator
from ...estimators.filters import FILTERS
from ...estimators.make import ESTIMATORS, make_estimator
from ..harness.drives import SETTLED, LoggedEpisode, call_quietly, make_filter_arguments
from ..harness.parallel import run_cases
from ..harness.results import ResultTable, Suite, write_text
from ..harness.stats import Estimate, interval, ratio_of_roots, root_mean
from ..studies.estimation import EXPERIMENTS
from .search import Range, SearchOptions, load_study, make_result_table, make_study_name, run_study

Drives = Sequence[LoggedEpisode]
Numbers = dict[str, float]  # value by option
_PROCESS_RANGE = (1e-8, 1e2)  # (unit of the state)^2 / s
_NOISE_RANGE = (1e-5, 1.0)  # unit of the sensor
FIRST_SEED = 1000  # of training; the test seeds count from 0


@dataclass(frozen=True)
class EstimatorTuning:
    """A search of an estimator's options that are most accurate on drives of scenarios."""

    estimator: str
    scenarios: tuple[str, ...]  # they count alike, each with every seed
    env_id: str
    target: str  # the state whose error counts, in `unit`
    unit: str
    sensors: str  # the slow ones that the estimator uses, joined by commas
    options: dict[str, Any]  # held
    search: dict[str, Range]  # (low, high) by option, both positive
    seeds: tuple[int, ...]

    @property
    def title(self) -> str:
        """Names of the estimator and the scenarios."""
        return f"{self.estimator} on {', '.join(self.scenarios)}"

    @property
    def study(self) -> str:
        """Name of the study."""
        return make_study_name(self.title, self, hash_sources("estimators"))


def make_estimator_tuning(
    estimator: str, scenarios: str | Sequence[str], env_id: str | None = None, target: str = "beta",
    options: Mapping[str, Any] | None = None, search: Mapping[str, Range | None] | None = None,
    noises: Mapping[str, Range | None] | None = None, seeds: int = 12,
) -> EstimatorTuning:  # fmt: skip
    """Make a tuning of what a user asks for: check it, or ValueError, and fill in the rest.

    Args:
        estimator: Name of the estimator.
        scenarios: Name of a scenario, or several.
        env_id: Id of the env; default: the first whose scenarios have the estimator's sensors.
        target: State whose error counts.
        options: Options that are held.
        search: Options to be found, with range or None for the default one; default: `q_...` of
            every state that `options` does not hold.
        noises: Measurement noises, searched as well.
        seeds: Number of training drives in each scenario.
    """
    if seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {seeds}")
    scenarios = (scenarios,) if isinstance(scenarios, str) else tuple(scenarios)
    if not scenarios or len(set(scenarios)) < len(scenarios):
        raise ValueError(f"scenarios are one or more, each once, got {', '.join(scenarios)}")
    held = dict(options or {})
    ESTIMATORS.load(estimator)  # or ValueError
    env_id, arguments, filter_ = _find_env(estimator, scenarios, env_id, held)
    states = filter_.names
    if target not in states:
        raise ValueError(f"{estimator} has no {target}; a target is one of {', '.join(states)}")
    (drive,) = _simulate_case((env_id, scenarios[0], (FIRST_SEED,)))
    if target not in drive.log.truth:
        known = ", ".join(state for state in states if state in drive.log.truth) or "none"
        raise ValueError(f"the truth of {target} is not recorded; of its states: {known}")
    if search is None:
        names = [f"q_{state}" for state in states if f"q_{state}" not in held]
        search = {name: None for name in names if _has_option(estimator, name, arguments)}
    searched = {**search, **(noises or {})}
    if not searched:
        raise ValueError(f"{estimator} has no process noise to search; name the options to search")
    for option in searched:
        if option in arguments:
            raise ValueError(f"the option {option} is both given and searched")
        if not _has_option(estimator, option, arguments):  # it raises with what it has
            call_quietly(make_estimator, estimator, **{**arguments, option: 1.0})
    unit, sensors = filter_.units[states.index(target)], ",".join(filter_.sensors)
    ranges = {option: _check_range(option, limits) for option, limits in searched.items()}
    numbers = tuple(range(FIRST_SEED, FIRST_SEED + seeds))
    subject = estimator, scenarios, env_id, target, unit, sensors
    return EstimatorTuning(*subject, held, ranges, numbers)


def _check_range(option: str, limits: Range | None) -> Range:
    low, high = limits or (_PROCESS_RANGE if option.startswith("q_") else _NOISE_RANGE)
    if not 0.0 < low < high < math.inf:
        raise ValueError(f"the range of {option} is LOW:HIGH with 0 < LOW < HIGH, got {low}:{high}")
    return float(low), float(high)


def _has_option(estimator: str, option: str, arguments: Mapping[str, Any]) -> bool:
    """Check whether the estimator has an option, whatever number suits it."""
    try:
        with suppress(ValueError):
            call_quietly(make_estimator, estimator, **{**arguments, option: 1e-3})
    except TypeError:
        return False
    return True


def _find_env(
    estimator: str, scenarios: Sequence[str], env_id: str | None, held: dict[str, Any]
) -> tuple[str, dict[str, Any], Estimator]:
    """Find an env that suits; its id, the arguments of the untuned estimator, and this itself."""
    unstable = {"allow_unstable": True} if estimator in FILTERS else {}  # its error may grow
    drives = (experiment.simulation for experiment in EXPERIMENTS)
    first = [simulation.env_id for simulation in drives if simulation.name in scenarios]
    others = [name for name in gym.registry if name.startswith("sideslip/Yaw")]
    ids = list(dict.fromkeys([*first, *others])) if env_id is None else [env_id]
    refused: dict[str, str] = {}
    for name in ids:
        try:
            for scenario in scenarios:
                env: gym.Env[Any, Any] = gym.make(name, scenario=scenario)
                env.reset(seed=FIRST_SEED)
                facts = make_filter_arguments(env.unwrapped)
                if known := [option for option in held if option in facts]:
                    raise ValueError(f"{', '.join(known)} is the environment's, no option")
                arguments = facts | unstable | held
                filter_ = call_quietly(make_estimator, estimator, **arguments)
        except ValueError as error:
            refused.setdefault(str(error), name)
        else:
            return name, arguments, filter_
    reasons = "; ".join(f"{name}: {text}" for text, name in refused.items())
    raise ValueError(f"no environment of {', '.join(scenarios)} suits {estimator}: {reasons}")


def _simulate_case(case: tuple[str, str, tuple[int, ...]]) -> list[LoggedEpisode]:
    """Simulate the drives of an env id, a scenario and seeds."""
    env_id, scenario, seeds = case
    env: gym.Env[Any, Any] = gym.make(env_id, scenario=scenario, control_period=1)
    base = env.unwrapped
    return [LoggedEpisode(rollout(env, seed=x).log, make_filter_arguments(base)) for x in seeds]


def _simulate(
    task: EstimatorTuning, seeds: Sequence[int], title: str, search: SearchOptions
) -> list[LoggedEpisode]:
    """Simulate the drives of some seeds in each scenario in turn, four a case."""
    fours = [tuple(seeds[i : i + 4]) for i in range(0, len(seeds), 4)]
    cases = [(task.env_id, scenario, four) for scenario in task.scenarios for four in fours]
    done = run_cases(_simulate_case, cases, title, search.jobs, search.console)
    return [drive for drives in done for drive in drives]


def _compute_squares(task: EstimatorTuning, drives: Drives, values: Numbers) -> Array:
    """Compute the target's mean squared error from `SETTLED` s on, shape (scenarios, seeds)."""
    options, turn = task.options | values, 2.0 * math.pi
    errors, filters = np.empty(len(drives)), dict[str, Estimator]()
    for i, (log, facts) in enumerate(drives):
        clocks = [replace(sensor, phase=0.0) for sensor in facts["sensors"].values()]
        key = repr(facts | {"sensors": clocks})  # a reset sets the clocks' phases
        if key not in filters:
            filters[key] = call_quietly(make_estimator, task.estimator, **facts, **options)
        late = log.time >= SETTLED - 1e-9
        with np.errstate(all="ignore"):
            error = (filters[key].run(log)[task.target] - log.truth[task.target])[late]
            if task.unit == "rad":
                error = np.remainder(error + math.pi, turn) - math.pi
            errors[i] = np.mean(error**2)
    finite = np.where(np.isfinite(errors), errors, np.inf)
    return finite.reshape(len(task.scenarios), -1)


def _compute_stable_squares(task: EstimatorTuning, drives: Drives, values: Numbers) -> Array:
    """Compute the squared errors, infinite where the estimator diverges."""
    try:
        return _compute_squares(task, drives, values)
    except ValueError:  # a filter that diverges, a covariance that is none
        return np.full((len(task.scenarios), len(drives) // len(task.scenarios)), np.inf)


def _evaluate_trial(task: EstimatorTuning, drives: Drives, values: Numbers) -> tuple[float, int]:
    """Evaluate some numbers: the geometric mean of the scenarios' RMSE, and the drives it is of."""
    errors = _compute_stable_squares(task, drives, values)
    return float(np.exp(np.mean(np.log(root_mean(errors))))), len(drives)


def _search(task: EstimatorTuning, drives: Drives, search: SearchOptions) -> Numbers:
    """Search on training drives until the study has so many trials; the best numbers, 3 digits."""
    evaluate = partial(_evaluate_trial, task, drives)
    evaluate_batch = partial(run_cases, evaluate, jobs=search.workers)
    trials = run_study(task.study, task.search, search, evaluate_batch, len(drives))
    best = min(trials, key=lambda trial: float(trial.user_attrs["objective"]))
    if not math.isfinite(best.user_attrs["objective"]):
        _compute_squares(task, drives, best.params)  # the estimator's own words, if it has any
        text = f"none of {search.trials} trials of {task.estimator} gave finite estimates"
        raise ValueError(text)
    return {name: float(f"{v:.3g}") for name, v in best.params.items()}


def run(
    task: EstimatorTuning, search: SearchOptions, test_seeds: int = 20
) -> tuple[Suite, Numbers]:
    """Search on the task's seeds, and judge on others; ValueError where no filter is stable.

    Args:
        task: Tuning.
        search: Options of the search.
        test_seeds: Number of test seeds, from 0 on.

    Returns:
        Suite, and the best numbers by name, of three digits.
    """
    if not 1 <= test_seeds <= task.seeds[0]:
        raise ValueError(f"test seeds are 1 to {task.seeds[0]}, got {test_seeds}")
    load_study(task.study, task.search, search)  # or ValueError, before anything is driven
    training = _simulate(task, task.seeds, "training drives", search)
    numbers = _search(task, training, search)
    test = _simulate(task, range(test_seeds), "test drives", search)
    text = (
        f"RMSE of {task.target} from 2 s on in {task.unit}, with 95 % intervals; "
        f"{search.trials} trials. The default is make_estimator with no more than what is held "
        "fixed. Several scenarios count alike: the search makes the geometric mean of their RMSE "
        "least."
    )
    comparisons = _make_comparisons(task, (training, test), numbers)
    tables = [*comparisons, make_result_table(numbers, task.search)]
    return Suite("tune", f"Tuning {task.title}", text, tables=tables), numbers


def _make_comparisons(
    task: EstimatorTuning, groups: Sequence[Drives], numbers: Numbers
) -> list[ResultTable]:
    """Make a table of errors before and after for each scenario, in training and test drives."""
    default = [_compute_stable_squares(task, drives, {}) for drives in groups]
    tuned = [_compute_stable_squares(task, drives, numbers) for drives in groups]
    tables = []
    for i, scenario in enumerate(task.scenarios):
        before, after = [values[i] for values in default], [values[i] for values in tuned]
        ratio = Estimate(math.nan)
        if np.isfinite([before[1], after[1]]).all():
            ratio = interval(after[1], ratio_of_roots, before[1])
        title = f"{task.estimator} on {scenario} ({task.env_id})"
        heads = ("tuning", f"{before[0].size} training seeds", f"{before[1].size} test seeds")
        lines = [["default", *map(_format_spread, before)], ["found", *map(_format_spread, after)]]
        note = f"Found over default on the test seeds: {ratio.inline(digits='.3f')}."
        tables.append(ResultTable(title, heads, lines, note))
    return tables


def _format_spread(errors: Array) -> str:
    if not np.isfinite(errors).all():
        return "diverges"
    return interval(errors, root_mean).inline(digits=".4g")


def make_entry(
    task: EstimatorTuning, numbers: Numbers, command: str, note: str = ""
) -> dict[str, object]:
    """Make the entry of a tunings file from the numbers that a command found.

    Args:
        task: Tuning.
        numbers: Value by option.
        command: Command that found them.
        note: Remark, "" for none.
    """
    used = task.options | numbers
    q = {key.removeprefix("q_"): value for key, value in used.items() if key.startswith("q_")}
    q = TUNINGS.get((task.estimator, task.sensors), {}) | q
    noise = {key: value for key, value in numbers.items() if not key.startswith("q_")}
    known = {"estimator": task.estimator, "sensors": task.sensors, "command": command}
    return {**known, "q": q, "noise": noise, **({"note": note} if note else {})}


_KEYS = ("estimator", "sensors", "command", "note", "q", "noise")
_HEAD = """\
# Tunings: process noise per second, (unit of the state)^2 / s, and measurement noise where it was
# searched too. Each entry is the output of its command; `sensors` are the slow ones.
"""


def update(path: str | Path, entry: dict[str, Any]) -> None:
    """Replace or add an entry of a tunings file, which is made if it does not exist.

    An old entry's note stays where that entry has a command and the new one has no note.

    Args:
        path: File.
        entry: Estimator, sensors, command, q by state, and perhaps noise by option and a note.
    """
    target = Path(path)
    entries = {_make_key(old): old for old in read_tunings(target)} if target.exists() else {}
    old = entries.get(_make_key(entry), {})
    note = {"note": old["note"]} if {"note", "command"} <= old.keys() else {}
    entries[_make_key(entry)] = note | entry
    text = target.read_text(encoding="utf-8") if target.exists() else ""
    head = text.partition("[[tuning]]")[0] or _HEAD + "\n"
    write_text(target, head + "\n".join(map(_format_entry, entries.values())))


def _make_key(entry: dict[str, Any]) -> tuple[str, str]:
    return entry["estimator"], entry["sensors"]


def _format_entry(entry: dict[str, Any]) -> str:
    present = [key for key in _KEYS if entry.get(key) not in (None, {})]
    return "[[tuning]]\n" + "".join(f"{key} = {to_toml(entry[key])}\n" for key in present)
