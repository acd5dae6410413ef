"""The clairvoyant's costs of each task, on seeds of their own that only the version salts.

An episode takes ten seconds to solve, so `sideslip calibrate` solves all once, into a file. The
baselines drive the same seeds when a table is made. An entry is refused that no longer fits: by
its version, its task, or what the uncontrolled car costs on its seeds.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from ... import __version__
from ...agents.env_info import CarEnv
from ...envs.io import from_json
from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.validation import is_finite
from ..harness.parallel import run_cases
from ..harness.results import read_objects, write_text
from .entries import ControlEntry
from .run import Results, hash_sources, measure
from .score import compute_log_ratios, survival_mask
from .tasks import NOMINAL, STATE, ControlTask, TaskRecord, find_oracle

FILE = Path(__file__).with_name("clairvoyant.json")
SEEDS = 64
_FIRST = 2**30  # tests and tunings count their seeds from 0
_SAME = 1e-9  # of a cost


@dataclass(frozen=True)
class CalibrationCase:
    """One episode of a contest."""

    task: ControlTask
    seed: int
    folder: str  # of finished cases

    @property
    def path(self) -> Path:
        """The file of the finished case; other sources or another question give another name."""
        oracle = find_oracle(self.task)  # with which the search begins
        key = [asdict(self.task), oracle, self.seed, hash_sources(), __version__]
        digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()
        return Path(self.folder) / f"{digest[:24]}.json"


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
    """A contest's episodes, and the command that made them."""

    env_version: str
    command: str
    episodes: tuple[ClairvoyantEpisode, ...]

    @property
    def costs(self) -> Array:
        """Costs of the clairvoyant, shape (n,)."""
        return np.array([episode.cost for episode in self.episodes])


def derive_seeds(task: ControlTask, count: int = SEEDS) -> list[int]:
    """Derive the seeds of a task's calibration; more of them begin with the same ones.

    Args:
        task: Task whose `seed_text` enters the seeds.
        count: Number of seeds.

    Returns:
        Seeds.
    """
    texts = [f"clairvoyant {__version__} {task.seed_text} {i}" for i in range(count)]
    digests = [hashlib.sha256(text.encode()).digest() for text in texts]
    return [_FIRST + int.from_bytes(digest[:4]) % _FIRST for digest in digests]


def solve(case: CalibrationCase) -> ClairvoyantEpisode:
    """Solve from nominal's and the oracle's runs, or read the folder of finished cases.

    Args:
        case: Episode to solve.

    Returns:
        Costs of the plans.
    """
    from ...agents.baselines import make_oracle
    from ...agents.clairvoyant.plan import compute_clairvoyant, record_actions

    done = _read_finished(case)
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


def _read_finished(case: CalibrationCase) -> ClairvoyantEpisode | None:
    """The episode of the case's file; None where it is absent or damaged."""
    try:
        entry = json.loads(case.path.read_text(encoding="utf-8"))
        episode = from_json(ClairvoyantEpisode, entry, str(case.path))
    except (OSError, ValueError, RecursionError):
        return None
    costs = [episode.cost, episode.costs.get("none", math.nan), episode.seconds]
    return episode if episode.seed == case.seed and all(map(is_finite, costs)) else None


def calibrate(
    tasks: Sequence[ControlTask],
    folder: Path,
    seeds: int = SEEDS,
    command: str = "",
    jobs: int | None = None,
    console: Console | None = None,
) -> list[CalibrationRecord]:
    """Calibrate each task; a stopped run goes on from the folder of finished cases.

    Args:
        tasks: Tasks to calibrate.
        folder: Folder of finished cases.
        seeds: Seeds of a task.
        command: Command line, for the records.
        jobs: Processes, None for all processors.
        console: Where progress is shown.

    Returns:
        Record of each task.

    Raises:
        ValueError: There are fewer than two seeds, so that there is no interval.
        ModuleNotFoundError: CasADi or OSQP is not installed.
    """
    if seeds < 2:
        raise ValueError(f"an interval needs two seeds or more, got {seeds}")
    with require_extra("mpc", "the clairvoyant needs CasADi and OSQP"):
        import casadi  # noqa: F401
        import osqp  # noqa: F401
    folder.mkdir(parents=True, exist_ok=True)
    cases = make_cases(tasks, folder, seeds)
    episodes = run_cases(solve, cases, "calibration", jobs, console)
    parts = (tuple(episodes[i * seeds : (i + 1) * seeds]) for i in range(len(tasks)))
    return [
        CalibrationRecord(**asdict(task), env_version=__version__, command=command, episodes=part)
        for task, part in zip(tasks, parts, strict=True)
    ]


def make_cases(tasks: Sequence[ControlTask], folder: Path, seeds: int) -> list[CalibrationCase]:
    """Make the case of every episode, task by task.

    Args:
        tasks: Tasks to calibrate.
        folder: Folder of finished cases.
        seeds: Seeds of a task.

    Returns:
        Cases.
    """
    return [CalibrationCase(c, seed, str(folder)) for c in tasks for seed in derive_seeds(c, seeds)]


def remove_cases(cases: Sequence[CalibrationCase]) -> None:
    """Remove finished cases once their entries are written; those of other runs stay.

    Args:
        cases: Cases of a run.
    """
    for case in cases:
        case.path.unlink(missing_ok=True)
    folder = Path(cases[0].folder)
    if not any(folder.iterdir()):
        folder.rmdir()


def read_calibration(
    path: str | Path = FILE, stale: bool = False
) -> dict[ControlTask, CalibrationRecord]:
    """Read the entries of a file by task.

    Args:
        path: File.
        stale: Whether what does not fit is left out instead of refused.

    Returns:
        Records by task.

    Raises:
        FileNotFoundError: There is no file.
        ValueError: An entry is cut short or lacks something, is of another version or of other
            seeds.
    """
    records = {}
    for i, item in enumerate(read_objects(path), 1):
        where = f"{path}: entry {i}"
        episodes = item.get("episodes", ())
        if not isinstance(episodes, list):
            raise ValueError(f"{where}: episodes is no list")
        parsed = (
            from_json(ClairvoyantEpisode, one, f"{where}, episode {k}")
            for k, one in enumerate(episodes, 1)
        )
        record = from_json(CalibrationRecord, item | {"episodes": tuple(parsed)}, where)
        seeds, why = [one.seed for one in record.episodes], ""
        if record.env_version != __version__:
            why = f"of version {record.env_version}, not {__version__}"
        elif seeds != derive_seeds(record.task, len(seeds)):
            why = "its seeds are not this contest's"
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
    records = read_calibration(path, stale=True) if Path(path).exists() else {}
    records |= {record.task: record for record in new_records}
    ordered = sorted(records.values(), key=lambda record: record.task.name)
    write_text(path, json.dumps([asdict(record) for record in ordered], indent=1) + "\n")


def check_current(
    records: Mapping[ControlTask, CalibrationRecord], path: str | Path = FILE
) -> None:
    """Check that the uncontrolled car costs what it did.

    Args:
        records: Records by task.
        path: Their file.

    Raises:
        ValueError: It costs something else in a task.
    """
    for task, record in records.items():
        entry, seeds = ControlEntry(task, "", "none"), [one.seed for one in record.episodes]
        now = measure([entry], seeds, jobs=1).outcomes[entry]
        then = np.array([episode.costs["none"] for episode in record.episodes])
        if now.error or not np.allclose(now.costs, then, rtol=_SAME, atol=0.0):
            raise ValueError(
                f"{path}: {task.name} is stale: the uncontrolled car costs {now.costs[0]:.6g} "
                f"on its first seed, {then[0]:.6g} when it was calibrated; run sideslip calibrate"
            )


def measure_calibrated(
    records: Mapping[ControlTask, CalibrationRecord],
    control_entries: Sequence[ControlEntry],
    **options: Any,
) -> Results:
    """Drive the entries of calibrated tasks on the clairvoyant's seeds.

    Args:
        records: Records by task.
        control_entries: Entries, of other tasks too.
        options: Options of `measure`.

    Returns:
        Episodes by entry.
    """
    seeds = {task: [one.seed for one in record.episodes] for task, record in records.items()}
    selected = [entry for task in records for entry in control_entries if entry.task == task]
    title = "control, the clairvoyant's seeds"
    return measure(selected, seeds.__getitem__, title=title, **options)


def compute_regrets(
    records: Mapping[ControlTask, CalibrationRecord], results: Results
) -> dict[ControlEntry, Array]:
    """Compute the costs over the clairvoyant's on the seeds that an entry survives.

    Args:
        records: Records by task.
        results: Episodes by entry.

    Returns:
        log(J / J_clairvoyant), shape (n,), by entry.
    """
    regrets = {}
    for entry, result in results.outcomes.items():
        if not result.error and survival_mask(result).any():
            best = records[entry.task].costs[: len(result.costs)]
            regrets[entry] = -compute_log_ratios(best, result)[survival_mask(result)]
    return regrets
