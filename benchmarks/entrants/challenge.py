"""What an open benchmark compares: a user's entries in their tasks, and the package's own.

The package's own are reused as long as their stored episodes cost the same. `python -m
sideslip.benchmarks.entrants.challenge` drives them all and writes the file.

Args:
    agent: Name, file's class or path of `make_agent`, or an object or factory.
    estimator: The same of `make_estimator`, or a name in `SETUPS`, "" for none.
    trust: Whether a zip may be read.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from ...agents import AGENTS
from ...agents.learned.policy import ZIP, is_policy, list_shipped, load_policy
from ...agents.training.export import check_trusted
from ...envs.io import from_json
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.scenarios.world import WORLD_VERSION
from ...envs.validation import check_choice
from ...envs.vehicle.parameters import make_vehicle
from ...estimators.make import ESTIMATORS, find_class, is_user_file
from ..control.entries import (
    ADAPTIVE,
    CONTROLLERS,
    JOINT,
    ORACLE_NAMES,
    REFERENCE_CONTROLLER,
    REFERENCE_FILTER,
    SETUPS,
    TRUTH,
    ControlCase,
    Entry,
    select_quick_tasks,
)
from ..control.run import NUMBERS, DriveResult, Results, measure
from ..control.tasks import (
    NOMINAL,
    STATE,
    STEERING,
    TIERS,
    YAW,
    ControlTask,
    TaskRecord,
    list_scored_tasks,
    make_salt,
    make_salted_seeds,
    make_task_seeds,
)
from ..harness.results import read_objects, write_text
from ..report.study import Request
from .worker import LIMIT

EPISODES = 64
_IDS = [name for name in gym.registry if name.startswith("sideslip/") and "Outside" not in name]
_TAKEN = {*ORACLE_NAMES, *CONTROLLERS[YAW], REFERENCE_CONTROLLER, "none", TRUTH, JOINT}


def make_user_entry(agent: object, estimator: object, trust: bool = False) -> Entry:
    """Make the entry of a user's agent and estimator."""
    parts = {"agent": agent, "estimator": estimator}
    objects = {part: value for part, value in parts.items() if not isinstance(value, str)}
    label = _label(agent)  # of a zip alone: what else is trusted would lose its tuned options
    return Entry(label, _label(estimator), objects=objects, trust=trust and label.endswith(ZIP))


def _label(source: object) -> str:
    kind = source if isinstance(source, type) or hasattr(source, "__qualname__") else type(source)
    return source if isinstance(source, str) else str(kind.__qualname__)


def _check_entry(entry: Entry) -> None:
    """Raise FileNotFoundError or ValueError for what is unknown, PermissionError for a zip."""
    for part, known in (("agent", AGENTS), ("estimator", ESTIMATORS)):
        source: str = getattr(entry, part)
        if part in entry.objects:  # whose name decides which results are its
            if source in _TAKEN:
                raise ValueError(f"{part} {source!r} is one of the package's: rename yours")
            continue
        if is_user_file(source):
            find_class(source)
        elif known is AGENTS and is_policy(source):
            load_policy(source)
        elif known is AGENTS and source.endswith(ZIP):
            check_trusted(Path(source), entry.trust)
        elif source == TRUTH:
            raise ValueError("truth is what oracles are told; an entry estimates")
        elif source not in ("", *SETUPS) and ":" not in source:
            known.load(source, list_shipped() if known is AGENTS else SETUPS)


def make_user_entries(
    agents: Sequence[str], estimators: Sequence[str], trust: bool = False
) -> list[Entry]:
    """Make every agent on every or its usual estimator, and the reference controller on each.

    Args:
        agents: Names, files' classes or paths.
        estimators: The same of estimators; empty: each agent's usual one.
        trust: Whether a zip may be read.
    """
    pairs = [(agent, one) for agent in agents for one in estimators or [choose_estimator(agent)]]
    entries = [make_user_entry(*pair, trust) for pair in pairs]
    entries += [Entry(REFERENCE_CONTROLLER, estimator) for estimator in estimators if estimator]
    return list(dict.fromkeys(entries))


def choose_estimator(agent: str) -> str:
    """Choose the estimator of a named agent: a policy's own, "" for what saw an env alone."""
    if is_policy(agent):
        return load_policy(agent).card.estimator or ""
    if agent.endswith(ZIP):
        return ""
    return JOINT if agent in ADAPTIVE else REFERENCE_FILTER


@dataclass(frozen=True)
class ComparisonRequest(Request):
    """A user's entries and where they drive; ValueError for what cannot be compared.

    A scenario's name that is scored means its tasks; another one is driven in both ids with a yaw
    moment on camera and GPS, by the COMS, or by `vehicle` with the passenger car's references.
    """

    entries: tuple[Entry, ...]
    vehicle: Any = None  # as for `make_vehicle`, instead of the tasks' cars, true and nominal
    scenarios: tuple[Any, ...] = ()  # as for `make_scenario`; empty: some tasks of every tier
    env_id: str = ""  # id whose tasks alone are driven
    seeds: tuple[int, ...] | None = None  # instead of salted ones
    fresh: bool = False  # seeds are drawn after the user's files are hashed, and all drive anew
    limit: float = LIMIT  # wall time of an entry in a task (s)

    def __post_init__(self) -> None:
        for entry in self.entries:
            _check_entry(entry)
        if self.env_id:
            check_choice("env", self.env_id, _IDS)
        if self.n < 2:
            raise ValueError("an interval needs two episodes or more")
        if len(set(self.seeds or ())) < len(self.seeds or ()):
            raise ValueError("a seed stands twice: its drives would count as independent")
        if self.fresh and not self.files:
            raise ValueError("fresh seeds follow the files of the entries, and there is none")
        if self.salt:
            make_salted_seeds(self.salt, 1)
            if self.fresh or self.seeds:
                raise ValueError("a salt repeats its seeds: no fresh ones, and no others beside it")
        if not self.limit > 0.0:
            raise ValueError(f"a limit is in s and above 0, got {self.limit!r}")
        _ = self.tasks

    @property
    def n(self) -> int:
        """Episodes of a task."""
        if self.seeds:
            return len(self.seeds)
        return EPISODES if self.episodes is None else self.episodes

    @property
    def files(self) -> list[Path]:
        """The user's files without repetition."""
        parts = [(entry, part) for entry in self.entries for part in ("agent", "estimator")]
        texts = [getattr(entry, part) for entry, part in parts if part not in entry.objects]
        paths = [find_class(text)[0] if is_user_file(text) else Path(text) for text in texts]
        return list(dict.fromkeys(path for path in paths if path.is_file()))

    @property
    def is_as_shipped(self) -> bool:
        """Whether all tasks are the package's own, on its seeds."""
        return not (self.fresh or self.salt or self.seeds or any(x.changes for x in self.tasks))

    @cached_property
    def tasks(self) -> list[ControlTask]:
        """Tasks whose changes are a vehicle and a scenario as data."""
        car = {} if self.vehicle is None else make_vehicle(self.vehicle).to_dict()
        changes = {"vehicle": car, "nominal": car} if car else {}
        if not self.scenarios:
            return self._select_tasks(select_quick_tasks(list_scored_tasks()), changes)
        tasks: dict[ControlTask, ControlTask] = {}
        for source in self.scenarios:
            variants = [task for task in list_scored_tasks() if task.scenario == source]
            varied = changes
            if not variants:
                scenario = make_scenario(source)
                cars = TIERS["road" if car else "small car"]  # of whose tasks it has the rest
                variants = [ControlTask("", *variant, scenario.name) for variant in cars]
                varied = changes | {"scenario": scenario.to_dict()}
            for task in self._select_tasks(variants, varied):
                if tasks.setdefault(task, task).changes != varied:
                    name = f"{task.scenario!r}: give each a name of its own"
                    raise ValueError(f"two scenarios are called {name}")
        return list(tasks)

    def _select_tasks(
        self, tasks: Sequence[ControlTask], changes: dict[str, Any]
    ) -> list[ControlTask]:
        """Tasks of the id; one that no tier has takes the place of the id without steering."""
        env_id = self.env_id
        selected = [task for task in tasks if env_id in ("", task.env_id, task.world_id)]
        if not selected and env_id not in (YAW, STEERING):
            selected = [replace(task, env_id=env_id) for task in tasks if task.env_id == YAW]
        return [replace(task, changes=changes) for task in selected]


FILE = Path(__file__).with_name("baselines.json")
_BASELINES = tuple(map(Entry, (NOMINAL, STATE, "none")))
_AGENT_RIVALS = (Entry("esc", REFERENCE_FILTER),)
_RIVAL_FILTERS = ("multirate-kf, camera and gps", TRUTH)
_FILTER_RIVALS = tuple(Entry(REFERENCE_CONTROLLER, name) for name in _RIVAL_FILTERS)
_SAMPLE = 2  # episodes of a baseline that are driven again
_SAME = 1e-6  # relative difference of equal costs


@dataclass(frozen=True)
class BaselineRecord(TaskRecord):
    """A baseline's episodes in a task: an entry of the file; failures: codes of `FAILURES`."""

    estimator: str
    controller: str
    salt: str
    costs: list[float]
    failures: list[int]

    @property
    def case(self) -> ControlCase:
        """Who drove these episodes, in which task."""
        return ControlCase(self.task, Entry(self.controller, self.estimator))


def make_baseline_cases(
    tasks: Sequence[ControlTask], agents: bool = True, estimators: bool = True
) -> list[ControlCase]:
    """Make the baselines' cases, task by task.

    Args:
        tasks: Tasks that every entry drives.
        agents: Whether an agent's rivals are among them.
        estimators: Whether an estimator's rivals are among them.
    """
    entries = _BASELINES + _AGENT_RIVALS * agents + _FILTER_RIVALS * estimators
    return [ControlCase(task, entry) for task in tasks for entry in entries]


def _read_baselines(path: Path = FILE) -> dict[tuple[ControlTask, Entry], BaselineRecord]:
    """Read the records of a file that are of this world, by case; ValueError for others."""
    items = enumerate(read_objects(path), 1)
    records = (from_json(BaselineRecord, item, f"{path}: entry {i}") for i, item in items)
    return {record.case: record for record in records if record.world_version == WORLD_VERSION}


def find_baselines(
    wanted: Sequence[ControlCase], n: int, **options: Any
) -> tuple[str, Results] | None:
    """Find the salt and stored episodes of baselines, if each baseline has n of them.

    None, too, if a sample driven again (`_SAMPLE` episodes of each case, of slow entries the first
    alone) no longer reproduces any stored cost of a baseline.

    Args:
        wanted: Cases to look up.
        n: Number of episodes of each.
        options: Options of `measure`.
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
    results: Results = {}
    for case, record in matches.items():
        numbers = np.full((n, len(NUMBERS)), np.nan)  # of all that is not on file
        numbers[:, NUMBERS.index("cost")] = record.costs[:n]
        numbers[:, NUMBERS.index("failure")] = record.failures[:n]
        results[case] = DriveResult(numbers)
    return salt, results


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
