"""What is measured once and kept in files: what tasks demand, and what the clairvoyant costs.

An episode of the clairvoyant takes ten seconds to solve, so `sideslip calibrate` solves all once,
on seeds of their own that only the world's version salts. An entry is refused that no longer fits.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ...agents.env_info import CarEnv
from ...envs.io import from_json
from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.scenarios.world import WORLD_VERSION
from ..harness.parallel import run_cases
from ..harness.results import read_objects, write_text
from .entries import Entry
from .run import Results, hash_sources, measure
from .score import PairedDrives, compute_log_ratios
from .tables import compute_gaps
from .tasks import FILE as TASKS_FILE
from .tasks import (
    LIMIT,
    NOMINAL,
    ORACLES,
    PARAMETERS,
    QUICK_LEAD_IN,
    STATE,
    ControlTask,
    TaskMeasurement,
    TaskRecord,
    find_oracle,
    list_candidates,
    make_tuning_seeds,
)

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


Records = dict[ControlTask, CalibrationRecord]


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
    Raises ModuleNotFoundError without CasADi or OSQP.

    Args:
        path: File, whose entries of other tasks stay.
        tasks: Tasks.
        count: Seeds of a task, two or more for an interval, else ValueError.
        command: Command line, for the records.
        jobs: Processes, None for all processors.
        console: Where progress is shown.
    """
    if count < 2:
        raise ValueError(f"an interval needs two seeds or more, got {count}")
    with require_extra("mpc", "the clairvoyant needs CasADi and OSQP"):
        import casadi  # noqa: F401
        import osqp  # noqa: F401
    question = hash_sources().encode() + TASKS_FILE.read_bytes() + Path(__file__).read_bytes()
    part = path.with_name(f".{path.name}.{hashlib.sha256(question).hexdigest()[:12]}")
    finished = _read_calibration(part) if part.exists() else {}
    for i, task in enumerate(tasks, 1):
        seeds = _derive_seeds(task, count)
        if task not in finished or finished[task].seeds != seeds:
            title, cases = f"{task.name}, {i} of {len(tasks)}", [(task, seed) for seed in seeds]
            episodes = tuple(run_cases(_solve, cases, title, jobs, console))
            made: dict[str, Any] = task.record | {"world_version": WORLD_VERSION}
            finished[task] = CalibrationRecord(**made, command=command, episodes=episodes)
            _update(part, [finished[task]])
    _update(path, list(finished.values()))  # those of a stopped run too
    part.unlink(missing_ok=True)
    return [finished[task] for task in tasks]


def _read_calibration(path: str | Path = FILE, stale: bool = False) -> Records:
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


def read_current(path: Path | None, tasks: Sequence[ControlTask]) -> Records:
    """Read records of tasks; ValueError where the uncontrolled car no longer costs what it did."""
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


def measure_foresight(records: Records, **options: Any) -> dict[ControlTask, Array]:
    """Measure log(J / J_clairvoyant) of oracle-state by task, shape (n,), on seeds it survives.

    Args:
        records: Records of the clairvoyant by task.
        options: Options of `measure`.
    """
    cases = [(task, Entry(STATE)) for task in records]
    title, foresight = "control, the clairvoyant's seeds", dict[ControlTask, Array]()
    results = measure(cases, lambda task: records[task].seeds, title=title, **options)
    for (task, _), result in results.items():
        if not result.error and result.survived.any():
            best = records[task].costs[: len(result.costs)]
            foresight[task] = -compute_log_ratios(best, result)[result.survived]
    return foresight


# Tasks are scored where a car without control slips or is lost, never by who gains: this module's
# command, with --write, measures all candidates on tuning seeds.
_SHORT = {"lead_in": QUICK_LEAD_IN}  # what a manoeuvre demands does not depend on it
MIN_PEAK = 2.0  # deg, median peak of the slip angle without control; below it nobody needs help
MIN_LOST = 0.3  # of the cars without control, at the limit
MAX_SHARE = 0.5  # of these, that the best baseline may lose: what nobody saves separates nobody
_NUMBERS = ("peak_slip", "lost", "lost_nominal", "lost_oracle", "slip_gap", "yaw_rate_gap")
_BASELINES = ("none", NOMINAL, *ORACLES[PARAMETERS], *ORACLES[STATE])


def _measure_task(results: Results, task: ControlTask) -> TaskMeasurement:
    """Measure what a candidate demands; what could not be driven is in its verdict."""
    drives = {name: results[task, Entry(name)] for name in _BASELINES}
    none, nominal = drives["none"], drives[NOMINAL]
    pairs = {x: PairedDrives(nominal, drive, task.cost_floor) for x, drive in drives.items()}
    errors = [f"{x}: {drives[x].error}" for x in ("none", NOMINAL) if drives[x].error]
    best = dict[str, str]()
    for kind, candidates in ORACLES.items():
        driven = [name for name in candidates if not drives[name].error]
        if not driven:
            errors.append(f"{candidates[0]}: {drives[candidates[0]].error}")
        best[kind] = candidates[0]
        if driven and not errors:
            best[kind] = max(driven, key=lambda name: pairs[name].compute_scores().mean())
    facts: dict[str, Any] = {**task.record, "world_version": WORLD_VERSION}
    facts |= {"oracle": best[STATE], "knowing": best[PARAMETERS], "n": len(nominal.costs)}
    if errors:
        facts |= dict.fromkeys(_NUMBERS, 0.0)
        return TaskMeasurement(**facts, verdict="; ".join(errors))
    lost = {name: float(np.mean(~drive.survived)) for name, drive in drives.items()}
    peak = float(np.degrees(np.median(none["peak_slip"])))
    gaps = compute_gaps(pairs[best[STATE]], task)
    numbers = (peak, lost["none"], lost[NOMINAL], lost[best[STATE]], *gaps)
    rounded = (round(float(np.nan_to_num(x)), 4) for x in numbers)
    facts |= dict(zip(_NUMBERS, rounded, strict=True))
    lost_by_best = min(lost[name] for name in (NOMINAL, *best.values()))
    verdict = _describe_verdict(task.tier, peak, lost["none"], lost_by_best)
    return TaskMeasurement(**facts, verdict=verdict)


def _describe_verdict(tier: str, peak: float, lost: float, lost_by_best: float) -> str:
    """Describe whether a candidate demands enough, and whether a baseline meets the demand."""
    if tier != LIMIT:
        low = f"the slip angle peaks at {peak:.1f} deg uncontrolled"
        return "scored" if peak > MIN_PEAK else low
    if lost < MIN_LOST:
        return f"{100.0 * lost:.0f} % of the cars are lost uncontrolled"
    if lost_by_best > MAX_SHARE * lost:
        return f"the best baseline loses {100.0 * lost_by_best:.0f} % of the cars"
    return "scored"


def _main(
    write: bool = False, episodes: int = 32, jobs: int | None = None, keep: Path | None = None
) -> None:
    """Measure which tasks are scored: what they demand of a car, on tuning seeds (2 or more)."""
    console = Console()
    candidates = [replace(task, changes=_SHORT) for task in list_candidates()]
    cases = [(task, Entry(name)) for task in candidates for name in _BASELINES]
    results = measure(cases, make_tuning_seeds(episodes), jobs=jobs, console=console, keep=keep)
    measurements = [_measure_task(results, task) for task in candidates]
    table = Table("task", "peak slip / deg", "lost: none, nominal, oracle / %", "verdict")
    for m in measurements:
        lost = (f"{100.0 * share:.0f}" for share in (m.lost, m.lost_nominal, m.lost_oracle))
        table.add_row(m.task.name, f"{m.peak_slip:.1f}", ", ".join(lost), m.verdict)
    console.print(table)
    if write:
        write_text(TASKS_FILE, json.dumps([asdict(m) for m in measurements], indent=1) + "\n")


if __name__ == "__main__":
    typer.run(_main)
