"""Tuning of an estimator: its options and ranges, its drives, and the files of tunings."""

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from rich.console import Console

from ... import __version__
from ...agents.baselines import Options, read_tuned
from ...agents.rollout import rollout
from ...envs.io import to_toml
from ...envs.numerics.kernel_cache import hash_sources
from ...envs.scenarios.world import WORLD_VERSION
from ...estimators.design.options import read_tunings
from ...estimators.estimator import Estimator
from ...estimators.filters import FILTERS
from ...estimators.make import ESTIMATORS, make_estimator
from ..harness.drives import LoggedEpisode, call_quietly, make_filter_arguments
from ..harness.parallel import run_cases
from ..harness.results import write_text
from ..studies.estimation import EXPERIMENTS

Range = tuple[float, float]

_PROCESS_RANGE = (1e-8, 1e2)  # (unit of the state)^2 / s
_NOISE_RANGE = (1e-5, 1.0)  # unit of the sensor
SAMPLERS = ("cma", "tpe")
STORAGE = "sqlite:///sideslip-tune.db"
FIRST_SEED = 1000  # of training; the test seeds count from 0


@dataclass(frozen=True)
class SearchOptions:
    """How long a study is searched, and by whom; ValueError where there are no trials."""

    trials: int  # of the study, the finished ones included
    storage: str = STORAGE  # RDB URL or SQLite file
    sampler: str = SAMPLERS[0]  # name in `SAMPLERS`
    seed: int = 0  # of the sampler
    jobs: int | None = None  # processes, None for all processors
    console: Console | None = None  # where progress is shown

    def __post_init__(self) -> None:
        if self.trials < 1:
            raise ValueError(f"trials must be at least 1, got {self.trials}")


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
    def subject(self) -> str:
        """Names of the scenarios."""
        return ", ".join(self.scenarios)

    @property
    def study(self) -> str:
        """Name of the study: one for the same question, asked of the same sources."""
        question = json.dumps(dataclasses.asdict(self), sort_keys=True, default=str)
        stamp = f"{question} {hash_sources('estimators')} {__version__}"
        digest = hashlib.sha256(stamp.encode()).hexdigest()[:12]
        return f"{self.estimator} on {self.subject} {digest}"


def make_estimator_tuning(
    estimator: str,
    scenarios: str | Sequence[str],
    env_id: str | None = None,
    target: str = "beta",
    options: Mapping[str, Any] | None = None,
    search: Mapping[str, Range | None] | None = None,
    noises: Mapping[str, Range | None] | None = None,
    seeds: int = 12,
) -> EstimatorTuning:
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
    env_id, facts, filter_ = _find_env(estimator, scenarios, env_id, held)
    states = filter_.names
    if target not in states:
        raise ValueError(f"{estimator} has no {target}; a target is one of {', '.join(states)}")
    (drive,) = _simulate_case((env_id, scenarios[0], (FIRST_SEED,)))
    if target not in drive.log.truth:
        known = ", ".join(state for state in states if state in drive.log.truth) or "none"
        raise ValueError(f"the truth of {target} is not recorded; of its states: {known}")
    if search is None:
        names = [f"q_{state}" for state in states if f"q_{state}" not in held]
        search = {name: None for name in names if _has_option(estimator, name, held, facts)}
    searched = {**search, **(noises or {})}
    if not searched:
        raise ValueError(f"{estimator} has no process noise to search; name the options to search")
    for option in searched:
        if option in held:
            raise ValueError(f"the option {option} is both held and searched")
        if not _has_option(estimator, option, held, facts):  # it raises with what it has
            call_quietly(make_estimator, estimator, **{**facts, **held, option: 1.0})
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


def _make_unstable_option(estimator: str) -> dict[str, bool]:
    """Make the option that lets our filters be built though their error grows."""
    return {"allow_unstable": True} if estimator in FILTERS else {}


def _has_option(
    estimator: str, option: str, held: Mapping[str, Any], facts: Mapping[str, Any]
) -> bool:
    """Check whether the estimator has an option, whatever number suits it."""
    options = {**_make_unstable_option(estimator), **held, option: 1e-3}
    try:
        with suppress(ValueError):
            call_quietly(make_estimator, estimator, **facts, **options)
    except TypeError:
        return False
    return True


def _find_env(
    estimator: str, scenarios: Sequence[str], env_id: str | None, held: dict[str, Any]
) -> tuple[str, dict[str, Any], Estimator]:
    """Find an env that suits; its id, its facts, and the untuned estimator."""
    first = [experiment.env_id for experiment in EXPERIMENTS if experiment.scenario in scenarios]
    others = [name for name in gym.registry if name.startswith("sideslip/Yaw")]
    ids = list(dict.fromkeys([*first, *others])) if env_id is None else [env_id]
    refused: dict[str, str] = {}
    for name in ids:
        try:
            for scenario in scenarios:
                env: gym.Env[Any, Any] = gym.make(name, scenario=scenario)
                env.reset(seed=FIRST_SEED)
                facts = make_filter_arguments(env.unwrapped)
                options = {**_make_unstable_option(estimator), **held}
                filter_ = call_quietly(make_estimator, estimator, **facts, **options)
        except ValueError as error:
            refused.setdefault(str(error), name)
        else:
            return name, facts, filter_
    reasons = "; ".join(f"{name}: {text}" for text, name in refused.items())
    raise ValueError(f"no environment of {', '.join(scenarios)} suits {estimator}: {reasons}")


def _simulate_case(case: tuple[str, str, tuple[int, ...]]) -> list[LoggedEpisode]:
    """Simulate the drives of an env id, a scenario and seeds."""
    env_id, scenario, seeds = case
    env: gym.Env[Any, Any] = gym.make(env_id, scenario=scenario, control_period=1)
    base = env.unwrapped
    return [LoggedEpisode(rollout(env, seed=x).log, make_filter_arguments(base)) for x in seeds]


def simulate(
    task: EstimatorTuning,
    seeds: Sequence[int],
    title: str,
    jobs: int | None,
    console: Console | None,
) -> list[LoggedEpisode]:
    """Simulate the drives of some seeds in each scenario in turn, four a case.

    Args:
        task: Tuning.
        seeds: Seeds.
        title: Title of the progress bar.
        jobs: Processes, None for all processors.
        console: Where progress is shown.

    Returns:
        Drives of the first scenario, then those of the next one.
    """
    fours = [tuple(seeds[i : i + 4]) for i in range(0, len(seeds), 4)]
    cases = [(task.env_id, scenario, four) for scenario in task.scenarios for four in fours]
    done = run_cases(_simulate_case, cases, title, jobs, console)
    return [drive for drives in done for drive in drives]


_KEYS = ("estimator", "sensors", "command", "note", "q", "noise")
_TUNED = "# Options of entries as [class.name.part]; found by `sideslip tune controller NAME`.\n"
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


def write_tuned(path: str | Path, kind: str, name: str, options: Options) -> None:
    """Replace or add a controller's options in a file of `read_tuned`.

    Args:
        path: File.
        kind: Class of tasks.
        name: Name of the controller.
        options: Options of filter and controller.
    """
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
    write_text(target, "\n".join([f"{_TUNED}world_version = {WORLD_VERSION}\n", *tables]))
    read_tuned.cache_clear()
