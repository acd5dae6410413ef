"""What is compared: a user's contestants, and the contests in which they meet the package's own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym

from ...agents import AGENTS
from ...agents.learned.files import ZIP, is_policy, load_policy, shipped
from ...agents.training.zips import check_trusted
from ...agents.tuned import tuned
from ...envs.arguments import check_choice
from ...envs.scenarios.manoeuvres import scenario_from
from ...envs.vehicle.vehicles import vehicle_from
from ...estimators.make import ESTIMATORS
from ...estimators.user_files import find_class, is_user_file
from ..control.cells import REFERENCE_CONTROLLER, REFERENCE_FILTER, SETUPS, TRUTH, Cell, some_of
from ..control.contests import NOMINAL, STEERING, TIERS, YAW, Contest, contests
from ..control.seeds import salted_seeds
from .worker import LIMIT

EPISODES = 64
_IDS = tuple(
    name for name in gym.registry if name.startswith("sideslip/") and "Outside" not in name
)
_COMS, _CAR = "1", "2a"  # tiers, of which a scenario without one has car and reference


@dataclass(frozen=True)
class Pair:
    """A contestant. agent: a name, a file's class or a path, of `make_agent`, or an object or
    factory; estimator: the same of `make_estimator`, or a name of the matrix, "" for none. trust:
    of `make_agent`, for a zip."""

    agent: Any
    estimator: Any = REFERENCE_FILTER
    trust: bool = False

    @property
    def label(self) -> str:
        """As `Cell.label`."""
        return self.cell(Contest()).label

    def cell(self, contest: Contest, options: Mapping[str, Any] | None = None) -> Cell:
        """The cell of a contest. options: of the env, beside the contest's."""
        parts = {"controller": self.agent, "estimator": self.estimator}
        objects = {part: each for part, each in parts.items() if not isinstance(each, str)}
        estimator, agent = _label(self.estimator), _label(self.agent)
        best = (
            tuned(contest.kind, NOMINAL) | {"controller": {"trust": True}} if self.trust else None
        )
        return Cell(contest, estimator, agent, dict(options or {}), best, objects)

    @property
    def files(self) -> list[Path]:
        """The user's files that it is made of."""
        texts = [each for each in (self.agent, self.estimator) if isinstance(each, str)]
        paths = [find_class(text)[0] if is_user_file(text) else Path(text) for text in texts]
        return [path for path in paths if path.is_file()]

    def check(self) -> None:
        """FileNotFoundError or ValueError for a name, file or class that there is not,
        PermissionError for a zip without trust."""
        for each, known in ((self.agent, AGENTS), (self.estimator, ESTIMATORS)):
            if not isinstance(each, str):
                continue
            if is_user_file(each):
                find_class(each)
            elif known is AGENTS and is_policy(each):
                load_policy(each)
            elif known is AGENTS and each.endswith(ZIP):
                check_trusted(Path(each), self.trust)
            elif each not in ("", TRUTH, *SETUPS) and ":" not in each:
                known.load(each, shipped() if known is AGENTS else SETUPS)


def _label(each: Any) -> str:
    kind = each if isinstance(each, type) or hasattr(each, "__qualname__") else type(each)
    return each if isinstance(each, str) else str(kind.__qualname__)


def pairs_of(agents: Sequence[str], estimators: Sequence[str], trust: bool = False) -> list[Pair]:
    """Every agent on every estimator, or on the usual one, and the reference controller on every
    estimator. trust: of zips."""
    pairs = [
        Pair(agent, each, trust and agent.endswith(ZIP))
        for agent in agents
        for each in estimators or [usual_estimator(agent)]
    ]
    pairs += [Pair(REFERENCE_CONTROLLER, each) for each in estimators if each]
    return list(dict.fromkeys(pairs))


def usual_estimator(agent: str) -> str:
    """The estimator for an agent: a policy's own, none for what saw an env alone."""
    if is_policy(agent):
        return load_policy(agent).card.estimator or ""
    return "" if agent.endswith(ZIP) else REFERENCE_FILTER


@dataclass(frozen=True)
class Challenge:
    """A user's contestants and where they drive.

    vehicle: as `vehicle_from` takes it, instead of the contests' cars, true and nominal. scenarios:
    as `scenario_from` takes them; none: some contests of every tier. A scenario's name that is
    scored means its contests; another one is driven in both ids with a yaw moment on camera and
    GPS, by the COMS, or by `vehicle` with the references of the passenger car. env_id: the
    contests of one id alone. episodes: a contest. seeds: instead of salted ones. fresh: the seeds
    are drawn after the user's files are hashed, and everybody drives anew. salt: of a fresh
    challenge that is repeated. limit: s of wall time a cell.

    Raises ValueError for an unknown id, less than two episodes, a fresh challenge without files,
    or a salt beside other seeds, and what `Pair.check`, `vehicle_from` and `scenario_from` raise.
    """

    pairs: tuple[Pair, ...]
    vehicle: Any = None
    scenarios: tuple[Any, ...] = ()
    env_id: str = ""
    episodes: int = EPISODES
    seeds: tuple[int, ...] | None = None
    fresh: bool = False
    salt: str = ""
    limit: float = LIMIT

    def __post_init__(self) -> None:
        for pair in self.pairs:
            pair.check()
        if self.env_id:
            check_choice("env", self.env_id, _IDS)
        if len(self.seeds or range(self.episodes)) < 2:
            raise ValueError("an interval needs two episodes or more")
        if self.fresh and not self.files:
            raise ValueError("fresh seeds follow the files of the contestants, and there is none")
        if self.salt:
            salted_seeds(self.salt, 1)
            if self.fresh or self.seeds:
                raise ValueError("a salt repeats its seeds: no fresh ones, and no others beside it")
        if not self.limit > 0.0:
            raise ValueError(f"a limit is in s and above 0, got {self.limit!r}")
        _ = self.contests

    @property
    def files(self) -> list[Path]:
        """The user's files, once each."""
        return list(dict.fromkeys(path for pair in self.pairs for path in pair.files))

    @property
    def is_as_shipped(self) -> bool:
        """Whether all contests are the package's own, on its seeds."""
        return not (self.fresh or self.salt or self.seeds or any(self.contests.values()))

    @cached_property
    def contests(self) -> dict[Contest, dict[str, Any]]:
        """Every contest with the env's options beside its own, a vehicle and a scenario as data."""
        car = {} if self.vehicle is None else vehicle_from(self.vehicle).to_dict()
        options = {"vehicle": car, "nominal": car} if car else {}
        if not self.scenarios:
            return {contest: options for contest in self._allowed(some_of(contests()))}
        found: dict[Contest, dict[str, Any]] = {}
        for each in self.scenarios:
            scored = [contest for contest in contests() if contest.scenario == each]
            if scored:
                found |= {contest: options for contest in self._allowed(scored)}
                continue
            scenario = scenario_from(each)
            data = options | {"scenario": scenario.to_dict()}
            tier = _CAR if car else _COMS
            own = [Contest("", *driven, scenario.name) for driven in TIERS[tier]]
            if any(found.get(contest, data) != data for contest in self._allowed(own)):
                raise ValueError(
                    f"two scenarios are called {scenario.name!r}: give each a name of its own"
                )
            found |= {contest: data for contest in self._allowed(own)}
        return found

    def _allowed(self, those: Sequence[Contest]) -> list[Contest]:
        """Those of the id; another than the tiers' takes the place of the one without steering."""
        if self.env_id in ("", YAW, STEERING):
            return [each for each in those if self.env_id in ("", each.env_id)]
        return [replace(each, env_id=self.env_id) for each in those if each.env_id == YAW]
