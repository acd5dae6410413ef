"""The clairvoyant's costs, contest by contest, on seeds of their own that only the version salts.

Solving for it takes ten seconds an episode, so it is done once, by `sideslip calibrate`, and lies
in a file. The rungs of the ladder drive the same seeds when a table is made. An entry that no
longer fits, by its version, its contest, or what the uncontrolled car costs on its seeds, is
refused.
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
from ...envs.io import from_json
from ...envs.record import Array
from ...envs.validation import is_finite
from ..harness.parallel import run_cases
from ..harness.results import read_objects, write_text
from .entries import ControlEntry
from .run import Results, hash_sources, measure
from .score import compute_log_ratios, survival_mask
from .tasks import NOMINAL, STATE, ControlTask, find_oracle

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
    """What was found of one seed; the fields of `agents.clairvoyant.ClairvoyantResult` without
    actions."""

    seed: int
    cost: float
    winner: str
    costs: dict[str, float]
    statuses: dict[str, str]
    seconds: float


@dataclass(frozen=True)
class CalibrationRecord:
    """A contest's episodes, and the command that made them."""

    tier: str
    env_id: str
    vehicle: str
    reference: str
    scenario: str
    env_version: str
    command: str
    episodes: tuple[ClairvoyantEpisode, ...]

    @property
    def task(self) -> ControlTask:
        """Of which these are the costs."""
        return ControlTask(self.tier, self.env_id, self.vehicle, self.reference, self.scenario)

    @property
    def costs(self) -> Array:
        """(n,) the clairvoyant's."""
        return np.array([episode.cost for episode in self.episodes])


def derive_seeds(task: ControlTask, count: int = SEEDS) -> list[int]:
    """The first `count` seeds of a contest's calibration; more seeds begin with the same ones."""
    texts = [f"clairvoyant {__version__} {task.seed_text} {i}" for i in range(count)]
    digests = [hashlib.sha256(text.encode()).digest() for text in texts]
    return [_FIRST + int.from_bytes(digest[:4]) % _FIRST for digest in digests]


def solve(case: CalibrationCase) -> ClairvoyantEpisode:
    """The best of the plans from nominal's and the oracle's runs; from the folder of finished cases
    where it is there."""
    from ...agents.baselines import make_oracle
    from ...agents.clairvoyant.plan import compute_clairvoyant, record_actions

    done = _read_finished(case)
    if done is not None:
        return done
    task, starts = case.task, {}
    for name, oracle in ((NOMINAL, NOMINAL), (STATE, find_oracle(task))):
        driver = make_oracle(oracle, task.env_id, **task.env_options)
        starts[name] = record_actions(*driver, case.seed)
    env: gym.Env[Any, Any] = gym.make(task.env_id, **task.env_options)
    result = compute_clairvoyant(env, case.seed, starts)
    seconds = round(result.seconds, 1)
    episode = ClairvoyantEpisode(
        case.seed, result.cost, result.winner, result.costs, result.statuses, seconds
    )
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
    """One entry a contest; folder: of finished cases, from which a stopped run goes on.

    Raises ValueError for fewer than two seeds (no interval), ModuleNotFoundError, with what to
    install, before the work rather than in a worker.
    """
    if seeds < 2:
        raise ValueError(f"an interval needs two seeds or more, got {seeds}")
    try:
        import casadi  # noqa: F401
        import osqp  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "the clairvoyant needs CasADi and OSQP: pip install 'sideslip[mpc]'"
        ) from None
    folder.mkdir(parents=True, exist_ok=True)
    cases = make_cases(tasks, folder, seeds)
    episodes = run_cases(solve, cases, "calibration", jobs, console)
    return [
        CalibrationRecord(
            **asdict(task),
            env_version=__version__,
            command=command,
            episodes=tuple(episodes[i * seeds : (i + 1) * seeds]),
        )
        for i, task in enumerate(tasks)
    ]


def make_cases(tasks: Sequence[ControlTask], folder: Path, seeds: int) -> list[CalibrationCase]:
    """Every episode, contest by contest."""
    return [CalibrationCase(c, seed, str(folder)) for c in tasks for seed in derive_seeds(c, seeds)]


def remove_cases(cases: Sequence[CalibrationCase]) -> None:
    """Remove finished cases once their entries are written; those of other runs stay."""
    for case in cases:
        case.path.unlink(missing_ok=True)
    folder = Path(cases[0].folder)
    if not any(folder.iterdir()):
        folder.rmdir()


def read_calibration(
    path: str | Path = FILE, stale: bool = False
) -> dict[ControlTask, CalibrationRecord]:
    """The entries of a file by contest. stale: those of another version or of other seeds are left
    out instead of refused.

    Raises FileNotFoundError where there is none, ValueError, with file, entry and field, for one
    that is cut short or lacks something, of another version or of other seeds.
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
    """Replace or add entries of a file, which is made if it is not there; its stale ones go."""
    records = read_calibration(path, stale=True) if Path(path).exists() else {}
    records |= {record.task: record for record in new_records}
    ordered = sorted(records.values(), key=lambda record: record.task.name)
    write_text(path, json.dumps([asdict(record) for record in ordered], indent=1) + "\n")


def check_current(
    records: Mapping[ControlTask, CalibrationRecord], path: str | Path = FILE
) -> None:
    """ValueError, with the contest, where the uncontrolled car no longer costs what it did."""
    for task, record in records.items():
        control_entry, seeds = (
            ControlEntry(task, "", "none"),
            [episode.seed for episode in record.episodes],
        )
        now = measure([control_entry], seeds, jobs=1).outcomes[control_entry]
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
    """The cells of calibrated contests on the clairvoyant's seeds; options: of `measure`."""
    seeds = {
        task: [episode.seed for episode in record.episodes] for task, record in records.items()
    }
    task_entries = [
        control_entry
        for task in records
        for control_entry in control_entries
        if control_entry.task == task
    ]
    return measure(
        task_entries, seeds.__getitem__, title="control, the clairvoyant's seeds", **options
    )


def compute_regrets(
    records: Mapping[ControlTask, CalibrationRecord], results: Results
) -> dict[ControlEntry, Array]:
    """(n,) log(J / J_clairvoyant) of each cell on the seeds that it survives."""
    regrets = {}
    for entry, result in results.outcomes.items():
        if not result.error and survival_mask(result).any():
            best = records[entry.task].costs[: len(result.costs)]
            regrets[entry] = -compute_log_ratios(best, result)[survival_mask(result)]
    return regrets
