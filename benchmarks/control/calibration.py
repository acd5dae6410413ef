"""The clairvoyant's costs of each task, on seeds of their own that only the world's version salts.

An episode takes ten seconds to solve, so `sideslip calibrate` solves all once, into a file. The
baselines drive the same seeds when a table is made. An entry is refused that no longer fits.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
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
from ..harness.parallel import run_cases
from ..harness.results import read_objects, write_text
from .entries import Entry
from .run import hash_sources, measure
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


def _solve(case: tuple[ControlTask, int]) -> ClairvoyantEpisode:
    """Solve a task's episode of a seed from nominal's and the oracle's runs."""
    from ...agents.baselines import make_oracle
    from ...agents.clairvoyant.plan import compute_clairvoyant, record_actions

    (task, seed), starts = case, {}
    for name, oracle in ((NOMINAL, NOMINAL), (STATE, find_oracle(task))):
        driver = make_oracle(oracle, task.env_id, **task.env_options)
        starts[name] = record_actions(*driver, seed)
    env: CarEnv = gym.make(task.env_id, **task.env_options)
    result = compute_clairvoyant(env, seed, starts)
    plan = (result.cost, result.winner, result.costs, result.statuses, round(result.seconds, 1))
    return ClairvoyantEpisode(seed, *plan)


def calibrate(
    path: Path, tasks: Sequence[ControlTask], count: int = SEEDS, command: str = "",
    jobs: int | None = None, console: Console | None = None,
) -> list[CalibrationRecord]:  # fmt: skip
    """Solve the episodes of tasks, one task after the other, and write them to a file.

    Finished tasks of a stopped run lie in a file beside it, whose name follows the sources.

    Args:
        path: File, whose entries of other tasks stay.
        tasks: Tasks.
        count: Seeds of a task, two or more.
        command: Command line, for the records.
        jobs: Processes, None for all processors.
        console: Where progress is shown.

    Raises:
        ModuleNotFoundError: CasADi or OSQP is not installed.
        ValueError: There are fewer than two seeds, so that there is no interval.
    """
    if count < 2:
        raise ValueError(f"an interval needs two seeds or more, got {count}")
    with require_extra("mpc", "the clairvoyant needs CasADi and OSQP"):
        import casadi  # noqa: F401
        import osqp  # noqa: F401
    part = path.with_name(f".{path.name}.{hash_sources()[:12]}")
    finished = _read_calibration(part) if part.exists() else {}
    for i, task in enumerate(tasks, 1):
        seeds = _derive_seeds(task, count)
        if task not in finished or finished[task].seeds != seeds:
            title, cases = f"{task.name}, {i} of {len(tasks)}", [(task, seed) for seed in seeds]
            episodes = tuple(run_cases(_solve, cases, title, jobs, console))
            made: dict[str, Any] = task.record | {"world_version": WORLD_VERSION}
            finished[task] = CalibrationRecord(**made, command=command, episodes=episodes)
            _update(part, [finished[task]])
    records = [finished[task] for task in tasks]
    _update(path, records)
    part.unlink(missing_ok=True)
    return records


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


def _update(path: str | Path, new_records: Sequence[CalibrationRecord]) -> None:
    """Replace or add entries of a file, which is made if needed; its stale ones go."""
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


def measure_foresight(
    records: Mapping[ControlTask, CalibrationRecord], **options: Any
) -> dict[ControlTask, Array]:
    """Drive oracle-state on the clairvoyant's seeds.

    Args:
        records: Records by task.
        options: Options of `measure`.

    Returns:
        log(J / J_clairvoyant) on the seeds that it survives, shape (n,), by task.
    """
    cases = [(task, Entry(STATE)) for task in records]
    title, foresight = "control, the clairvoyant's seeds", dict[ControlTask, Array]()
    results = measure(cases, lambda task: records[task].seeds, title=title, **options)
    for (task, _), result in results.items():
        if not result.error and result.survived.any():
            best = records[task].costs[: len(result.costs)]
            foresight[task] = -compute_log_ratios(best, result)[result.survived]
    return foresight
