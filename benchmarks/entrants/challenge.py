"""The request of an open benchmark: a user's entries, and the tasks in which they drive."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym

from ...agents import AGENTS
from ...agents.learned.policy import ZIP, is_policy, list_shipped, load_policy
from ...agents.training.export import check_trusted
from ...envs.scenarios.manoeuvres import make_scenario
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
    Entry,
    select_quick_tasks,
)
from ..control.tasks import STEERING, TIERS, YAW, ControlTask, list_scored_tasks, make_salted_seeds
from .worker import LIMIT

EPISODES = 64
_IDS = [name for name in gym.registry if name.startswith("sideslip/") and "Outside" not in name]
_TAKEN = {*ORACLE_NAMES, *CONTROLLERS[YAW], REFERENCE_CONTROLLER, "none", TRUTH, JOINT}


def make_user_entry(agent: object, estimator: object, trust: bool = False) -> Entry:
    """Make the entry of a user's agent and estimator.

    Args:
        agent: Name, file's class or path of `make_agent`, or an object or factory.
        estimator: The same of `make_estimator`, or a name in `SETUPS`, "" for none.
        trust: Whether a zip may be read.
    """
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
    """Choose the estimator of an agent: a policy's own, none for what saw an env alone.

    Args:
        agent: Name, file's class or path.

    Returns:
        Name of the estimator, "" for none.
    """
    if is_policy(agent):
        return load_policy(agent).card.estimator or ""
    if agent.endswith(ZIP):
        return ""
    return JOINT if agent in ADAPTIVE else REFERENCE_FILTER


@dataclass(frozen=True)
class ComparisonRequest:
    """A user's entries and where they drive; ValueError for what cannot be compared.

    A scenario's name that is scored means its tasks; another one is driven in both ids with a yaw
    moment on camera and GPS, by the COMS, or by `vehicle` with the passenger car's references.
    """

    entries: tuple[Entry, ...]
    vehicle: Any = None  # as for `make_vehicle`, instead of the tasks' cars, true and nominal
    scenarios: tuple[Any, ...] = ()  # as for `make_scenario`; empty: some tasks of every tier
    env_id: str = ""  # id whose tasks alone are driven
    episodes: int = EPISODES  # of a task
    seeds: tuple[int, ...] | None = None  # instead of salted ones
    fresh: bool = False  # seeds are drawn after the user's files are hashed, and all drive anew
    salt: str = ""  # of a fresh request that is repeated
    limit: float = LIMIT  # wall time of an entry in a task (s)

    def __post_init__(self) -> None:
        for entry in self.entries:
            _check_entry(entry)
        if self.env_id:
            check_choice("env", self.env_id, _IDS)
        if len(self.seeds or range(self.episodes)) < 2:
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
