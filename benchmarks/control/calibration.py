"""The clairvoyant's costs of each task, on seeds of their own that only the world's version salts.

An episode takes ten seconds to solve, so `sideslip calibrate` solves all once, into a file. The
baselines drive the same seeds when a table is made. An entry is refused that no longer fits.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from ...agents.env_info import CarEnv
from ...envs.io import from_json
from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.scenarios.world import WORLD_VERSION
from ...envs.validation import is_finite
from ..harness.parallel import run_cases
from ..harness.results import read_objects, write_text
from .entries import ControlCase, Entry
from .run import Results, hash_sources, measure
from .score import compute_log_ratios
from .tasks import NOMINAL, STATE, ControlTask, TaskRecord, find_oracle

FILE = Path(__file__).with_name("clairvoyant.json")
SEEDS = 64
_FIRST = 2**30  # tests and tunings count their seeds from 0
_SAME = 1e-9  # of a cost


@dataclass(frozen=True)
class ClairvoyantEpisode:
    """The result of one seed: the fields of `agents.clairvoyant.ClairvoyantResult`, no actions."""

    seed: int
    cost: float
    winner: str
    costs: dict[str, float]
    statuses: dict[str, str]
    seconds: float


@dataclass(frozen=True)
class CalibrationRecord(TaskRecord):
    """A task's episodes, and the command that made them."""

    world_version: int
    command: str
    episodes: tuple[ClairvoyantEpisode, ...]

    @property
    def costs(self) -> Array:
        """Costs of the clairvoyant, shape (n,)."""
        return np.array([episode.cost for episode in self.episodes])

    @property
    def seeds(self) -> list[int]:
        """Seeds of the episodes."""
        return [episode.seed for episode in self.episodes]


def _derive_seeds(task: ControlTask, count: int = SEEDS) -> list[int]:
    """Derive the seeds of a task's calibration; more of them begin with the same ones."""
    texts = [f"clairvoyant {WORLD_VERSION} {task.seed_text} {i}" for i in range(count)]
    digests = [hashlib.sha256(text.encode()).digest() for text in texts]
    return [_FIRST + int.from_bytes(digest[:4]) % _FIRST for digest in digests]


@dataclass(frozen=True)
class _CalibrationCase:
    """One episode of a task."""

    task: ControlTask
    seed: int
    folder: Path  # of finished cases

    @property
    def path(self) -> Path:
        """The file of the finished case; other sources or another question give another name."""
        oracle = find_oracle(self.task)  # with which the search begins
        key = [self.task.record, oracle, self.seed, hash_sources(), WORLD_VERSION]
        digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()
        return self.folder / f"{digest[:24]}.json"

    def read_finished(self) -> ClairvoyantEpisode | None:
        """The episode of the file; None where it is absent or damaged."""
        try:
            entry = json.loads(self.path.read_text(encoding="utf-8"))
            episode = from_json(ClairvoyantEpisode, entry, str(self.path))
        except (OSError, ValueError, RecursionError):
            return None
        costs = [episode.cost, episode.costs.get("none", math.nan), episode.seconds]
        return episode if episode.seed == self.seed and all(map(is_finite, costs)) else None


def _solve(case: _CalibrationCase) -> ClairvoyantEpisode:
    """Solve from nominal's and the oracle's runs, or read the folder of finished cases."""
    from ...agents.baselines import make_oracle
    from ...agents.clairvoyant.plan import compute_clairvoyant, record_actions

    done = case.read_finished()
    if done is not None:
        return done
    task, starts = case.task, {}
    for name, oracle in ((NOMINAL, NOMINAL), (STATE, find_oracle(task))):
        driver = make_oracle(oracle, task.env_id, **task.env_options)
        starts[name] = record_actions(*driver, case.seed)
    env: CarEnv = gym.make(task.env_id, **task.env_options)
    result = compute_clairvoyant(env, case.seed, starts)
    plan = (result.cost, result.winner, result.costs, result.statuses, round(result.seconds, 1))
    episode = ClairvoyantEpisode(case.seed, *plan)
    write_text(case.path, json.dumps(asdict(episode)))
    return episode


@dataclass(frozen=True)
class Calibration:
    """The calibration of tasks; a stopped run goes on from the folder of finished cases.

    Raises:
        ValueError: There are fewer than two seeds, so that there is no interval.
    """

    tasks: Sequence[ControlTask]
    folder: Path  # of finished cases
    seeds: int = SEEDS  # of a task, two or more

    def __post_init__(self) -> None:
        if self.seeds < 2:
            raise ValueError(f"an interval needs two seeds or more, got {self.seeds}")

    @cached_property
    def cases(self) -> list[_CalibrationCase]:
        """The case of every episode, task by task."""
        pairs = ((task, seed) for task in self.tasks for seed in _derive_seeds(task, self.seeds))
        return [_CalibrationCase(*pair, self.folder) for pair in pairs]

    def run(
        self, command: str = "", jobs: int | None = None, console: Console | None = None
    ) -> list[CalibrationRecord]:
        """Solve every case that is not finished.

        Args:
            command: Command line, for the records.
            jobs: Processes, None for all processors.
            console: Where progress is shown.

        Raises:
            ModuleNotFoundError: CasADi or OSQP is not installed.
        """
        with require_extra("mpc", "the clairvoyant needs CasADi and OSQP"):
            import casadi  # noqa: F401
            import osqp  # noqa: F401
        self.folder.mkdir(parents=True, exist_ok=True)
        episodes = run_cases(_solve, self.cases, "calibration", jobs, console)
        rows = zip(*[iter(episodes)] * self.seeds, strict=True)
        made: dict[str, Any] = {"world_version": WORLD_VERSION, "command": command}
        pairs = zip(self.tasks, rows, strict=True)
        return [CalibrationRecord(**made | task.record, episodes=row) for task, row in pairs]

    def remove_cases(self) -> None:
        """Remove finished cases once their entries are written; those of other runs stay."""
        for case in self.cases:
            case.path.unlink(missing_ok=True)
        if not any(self.folder.iterdir()):
            self.folder.rmdir()


def _read_calibration(
    path: str | Path = FILE, stale: bool = False
) -> dict[ControlTask, CalibrationRecord]:
    """Read the entries of a file by task; stale ones are refused, or left out if `stale`."""
    records = {}
    for i, item in enumerate(read_objects(path), 1):
        where = f"{path}: entry {i}"
        episodes = item.get("episodes", ())
        if not isinstance(episodes, list):
            raise ValueError(f"{where}: episodes is no list")
        places = ((one, f"{where}, episode {k}") for k, one in enumerate(episodes, 1))
        parsed = tuple(from_json(ClairvoyantEpisode, *place) for place in places)
        record = from_json(CalibrationRecord, item | {"episodes": parsed}, where)
        seeds, why = record.seeds, ""
        if record.world_version != WORLD_VERSION:
            why = f"of world {record.world_version}, not {WORLD_VERSION}"
        elif seeds != _derive_seeds(record.task, len(seeds)):
            why = "its seeds are not this task's"
        if why and not stale:
            raise ValueError(f"{where}, {record.task.name}, is stale: {why}")
        if not why:
            records[record.task] = record
    return records


def update(path: str | Path, new_records: Sequence[CalibrationRecord]) -> None:
    """Replace or add entries of a file, which is made if needed; its stale ones go.

    Args:
        path: File.
        new_records: Records.
    """
    records = _read_calibration(path, stale=True) if Path(path).exists() else {}
    records |= {record.task: record for record in new_records}
    ordered = sorted(records.values(), key=lambda record: record.task.name)
    write_text(path, json.dumps([asdict(record) for record in ordered], indent=1) + "\n")


def read_current(
    path: Path | None, tasks: Sequence[ControlTask]
) -> dict[ControlTask, CalibrationRecord]:
    """Read the records of tasks; ValueError where the uncontrolled car no longer costs what it did.

    Args:
        path: File; None: the package's, if there is one.
        tasks: Tasks.
    """
    if path is None and not FILE.is_file():
        return {}
    path, none = path or FILE, Entry("none")
    records = {task: record for task, record in _read_calibration(path).items() if task in tasks}
    for task, record in records.items():
        (now,) = measure([(task, none)], record.seeds, jobs=1).values()
        then = np.array([episode.costs["none"] for episode in record.episodes])
        if now.error or not np.allclose(now.costs, then, rtol=_SAME, atol=0.0):
            raise ValueError(
                f"{path}: {task.name} is stale: the uncontrolled car costs {now.costs[0]:.6g} "
                f"on its first seed, {then[0]:.6g} when it was calibrated; run sideslip calibrate"
            )
    return records


def measure_regrets(
    records: Mapping[ControlTask, CalibrationRecord], cases: Iterable[ControlCase], **options: Any
) -> tuple[dict[tuple[ControlTask, Entry], Array], Results]:
    """Drive the cases of calibrated tasks on the clairvoyant's seeds.

    Args:
        records: Records by task.
        cases: Cases, of other tasks too.
        options: Options of `measure`.

    Returns:
        log(J / J_clairvoyant) on the seeds that an entry survives, shape (n,), by case; episodes.
    """
    # as they were calibrated: tasks are equal whatever their changes are, a short lead-in too
    selected = [case._replace(task=task) for task in records for case in cases if case.task == task]
    title = "control, the clairvoyant's seeds"
    results = measure(selected, lambda task: records[task].seeds, title=title, **options)
    regrets = {}
    for (task, entry), result in results.items():
        if not result.error and result.survived.any():
            best = records[task].costs[: len(result.costs)]
            regrets[task, entry] = -compute_log_ratios(best, result)[result.survived]
    return regrets, results
