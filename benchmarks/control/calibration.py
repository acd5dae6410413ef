"""What 100 % means: the clairvoyant's mean cost on calibration seeds, scenario by scenario.

The seeds are the calibration's own; no test and no tuning sees them. An entry keeps every seed's
costs, so that means over other seeds or methods can be checked against it.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from ... import __version__
from ...agents import make_agent
from ...envs.arguments import is_finite
from ...envs.backend.cache import source_stamp
from ...envs.scenarios.manoeuvres import SCENARIOS
from ...estimators.wrappers.estimate import EstimateObservation
from ..harness.parallel import run_cases
from ..harness.results import made_of, read_objects, write_text

FILE = Path(__file__).with_name("calibration.json")
SALT, SEEDS = "calibration", 64
ENV_ID = "sideslip/YawFusion-v0"
START, ESTIMATOR = "two-dof", "exact-kf"
_FIRST = 2**30  # tests and tunings count their seeds from 0


@dataclass(frozen=True)
class Case:
    """One episode; start: the agent whose run the plan starts from besides zero."""

    env_id: str
    scenario: str
    seed: int
    start: str
    estimator: str
    folder: str  # of finished cases

    @property
    def path(self) -> Path:
        """The file of the finished case; other sources or another question give another name."""
        asked = [self.env_id, self.scenario, self.seed, self.start, self.estimator]
        stamp = json.dumps([*asked, source_stamp("agents"), __version__])
        return Path(self.folder) / f"{hashlib.sha256(stamp.encode()).hexdigest()[:24]}.json"


@dataclass(frozen=True)
class Episode:
    """What was found of one seed; the fields of `agents.clairvoyant.Ceiling` without actions."""

    seed: int
    cost: float
    winner: str
    costs: dict[str, float]
    statuses: dict[str, str]
    seconds: float


@dataclass(frozen=True)
class Entry:
    """The calibration of a scenario of an environment.

    clairvoyant, none: mean costs. clairvoyant_error, none_error: their standard errors. sources:
    the hash of the plant's sources. command: what made it.
    """

    env_id: str
    scenario: str
    env_version: str
    sources: str
    salt: str
    start: str
    estimator: str
    clairvoyant: float
    clairvoyant_error: float
    none: float
    none_error: float
    command: str
    episodes: tuple[Episode, ...]

    @property
    def stale(self) -> bool:
        """Whether the plant's sources have changed since."""
        return self.sources != source_stamp("envs")


def calibration_seeds(env_id: str, scenario: str, count: int) -> list[int]:
    """The first `count` seeds of a scenario's calibration; more seeds begin with the same ones."""
    return [_FIRST + _digits(f"{SALT} {env_id} {scenario} {i}") for i in range(count)]


def _digits(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4]) % _FIRST


def measure(case: Case) -> Episode:
    """The ceiling of one episode, from the folder of finished cases where it is there."""
    from ...agents.clairvoyant.plan import actions_of, ceiling

    done = _finished(case)
    if done is not None:
        return done
    env: gym.Env[Any, Any] = gym.make(case.env_id, scenario=case.scenario)
    starts = {}
    if case.start != "none":
        sensed = env
        if case.estimator:
            sensed = EstimateObservation(env, case.estimator)
        starts[case.start] = actions_of(sensed, make_agent(case.start, sensed), case.seed)
    found = ceiling(env, case.seed, starts)
    episode = Episode(
        case.seed, found.cost, found.winner, found.costs, found.statuses, round(found.seconds, 1)
    )
    write_text(case.path, json.dumps(asdict(episode)))
    return episode


def _finished(case: Case) -> Episode | None:
    """The episode of the case's file; None where it is absent or damaged."""
    try:
        entry = json.loads(case.path.read_text(encoding="utf-8"))
        episode = made_of(Episode, entry, str(case.path))
    except (OSError, ValueError, RecursionError):
        return None
    costs = [episode.cost, episode.costs.get("none", math.nan), episode.seconds]
    return episode if episode.seed == case.seed and all(map(is_finite, costs)) else None


def calibrate(
    scenarios: Sequence[str],
    folder: Path,
    env_id: str = ENV_ID,
    seeds: int = SEEDS,
    start: str = START,
    estimator: str = ESTIMATOR,
    command: str = "",
    jobs: int | None = None,
    console: Console | None = None,
) -> list[Entry]:
    """One entry a scenario.

    folder: of finished cases; a stopped run that is started again goes on from there.
    Raises ValueError for an unknown scenario and fewer than two seeds (no standard error).
    """
    unknown = [name for name in scenarios if name not in SCENARIOS]
    if unknown:
        raise ValueError(f"unknown scenario {', '.join(unknown)}; known: {', '.join(SCENARIOS)}")
    if seeds < 2:
        raise ValueError(f"a standard error needs two seeds or more, got {seeds}")
    import_solvers()
    folder.mkdir(exist_ok=True)
    cases = cases_of(scenarios, folder, env_id, seeds, start, estimator)
    episodes = run_cases(measure, cases, "calibration", jobs, console)
    entries = []
    for i, scenario in enumerate(scenarios):
        mine = episodes[i * seeds : (i + 1) * seeds]
        best = np.array([episode.cost for episode in mine])
        none = np.array([episode.costs["none"] for episode in mine])
        entries.append(
            Entry(
                env_id,
                scenario,
                f"{env_id} {__version__}",
                source_stamp("envs"),
                SALT,
                start,
                estimator,
                float(best.mean()),
                float(best.std(ddof=1) / math.sqrt(seeds)),
                float(none.mean()),
                float(none.std(ddof=1) / math.sqrt(seeds)),
                command,
                tuple(mine),
            )
        )
    return entries


def cases_of(
    scenarios: Sequence[str], folder: Path, env_id: str, seeds: int, start: str, estimator: str
) -> list[Case]:
    """Every episode, scenario by scenario."""
    return [
        Case(env_id, scenario, seed, start, estimator, str(folder))
        for scenario in scenarios
        for seed in calibration_seeds(env_id, scenario, seeds)
    ]


def forget(cases: Sequence[Case]) -> None:
    """Remove finished cases once their entries are written; those of other runs stay."""
    for case in cases:
        case.path.unlink(missing_ok=True)
    folder = Path(cases[0].folder)
    if not any(folder.iterdir()):
        folder.rmdir()


def import_solvers() -> None:
    """ModuleNotFoundError, with what to install, before the work rather than in a worker."""
    try:
        import casadi  # noqa: F401
        import osqp  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "the clairvoyant needs CasADi and OSQP: pip install 'sideslip[mpc]'"
        ) from None


def read_calibration(path: str | Path = FILE) -> dict[tuple[str, str], Entry]:
    """The entries of a file by (env id, scenario).

    Raises FileNotFoundError where there is none, ValueError, with file, entry and field, for one
    that is cut short or lacks something.
    """
    entries = {}
    for i, each in enumerate(read_objects(path), 1):
        where = f"{path}: entry {i}"
        episodes = each.get("episodes", ())
        if not isinstance(episodes, list):
            raise ValueError(f"{where}: episodes is no list")
        made = (made_of(Episode, one, f"{where}, episode {k}") for k, one in enumerate(episodes, 1))
        entry = made_of(Entry, each | {"episodes": tuple(made)}, where)
        entries[entry.env_id, entry.scenario] = entry
    return entries


def update(path: str | Path, made: Sequence[Entry]) -> None:
    """Replace or add entries of a file, which is made if it is not there."""
    entries = read_calibration(path) if Path(path).exists() else {}
    entries |= {(entry.env_id, entry.scenario): entry for entry in made}
    ordered = [asdict(entries[key]) for key in sorted(entries)]
    write_text(path, json.dumps(ordered, indent=1) + "\n")
