"""Episodes of the control benchmark: driven, reduced to metrics, and kept as finished cases.

A chunk drives all its seeds at once in a vector env. A folder keeps finished chunks, by a hash of
everything that their numbers depend on.
"""

import contextlib
import hashlib
import inspect
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ...agents.learned.policy import hash_policy
from ...agents.rollout import EpisodeStep, iterate_steps
from ...envs.io import atomic_file
from ...envs.numerics.kernel_cache import hash_experiment
from ...envs.record import FAST, Array
from ...envs.task import FAILURES
from ...envs.ticks import TICK
from ...envs.validation import parse_actions
from ...envs.vehicle.dynamics import Motion
from ...estimators.registry import describe_error
from ..harness.metrics import EPISODE, REDUCTIONS, StepSample, compute_dissipation
from ..harness.parallel import run_cases
from .entries import SLOW_EPISODES, ControlEntry, make_cars
from .tasks import ControlTask, Seeds, make_salt

NUMBERS = tuple(metric.name for metric in EPISODE)
_INFO = ("t", "beta", "gamma", "beta_ref", "gamma_ref", "yaw_moment", "steer", "psi")
_PLACE = ("X", "Y")
SIGNALS = (*_INFO[1:], *_PLACE)


@dataclass(frozen=True)
class Chunk:
    """Some seeds of an entry; keep: whether the first seed's series is returned, no folder."""

    entry: ControlEntry
    seeds: tuple[int, ...]
    keep: bool = False


@dataclass
class DriveResult:
    """Episodes of an entry in the order of their seeds."""

    numbers: Array  # metrics, shape (seeds, NUMBERS); NaN where the entry was not driven
    seconds: float  # CPU time (s)
    series: Array | None = None  # time and SIGNALS of the first seed, shape (k, 1 + SIGNALS)
    error: str = ""  # why the entry could not be driven

    def __getitem__(self, name: str) -> Array:
        """One of NUMBERS, shape (seeds,)."""
        return self.numbers[:, NUMBERS.index(name)]

    @property
    def costs(self) -> Array:
        """Cost of each episode, shape (seeds,)."""
        return self["cost"]

    def mark_failures(self, cause: str) -> Array:
        """Mark the episodes that ended by a failure.

        Args:
            cause: Failure, of `FAILURES`.

        Returns:
            1 where it did, NaN where nothing was driven, shape (seeds,).
        """
        return np.where(np.isnan(self["failure"]), np.nan, self["failure"] == FAILURES.index(cause))


class _MetricAccumulator:
    """The metrics of all cars while their episodes run; reset: their step 0, after the reset."""

    def __init__(self, base: Any, reset: EpisodeStep) -> None:
        car, self.width = base.vehicle[0], base.single_action_space.shape[0]
        self.full_scale = np.array([car.yaw_moment_limit, car.steering_authority])
        self.full_scale[self.width :] = 0.0
        self.dt = base.control_period * TICK
        self.base, self.radius = base, car.wheel_radius
        self.last, self.last_command = reset.info, np.zeros((base.num_envs, 2))
        self.heading_error, self.lateral_deviation = np.zeros((2, base.num_envs))  # rad, m
        self.steps, self.totals = np.zeros(base.num_envs), np.zeros((len(EPISODE), base.num_envs))

    def add(self, step: EpisodeStep) -> None:
        command = np.zeros_like(self.last_command)
        shares = parse_actions(step.action, len(command), self.width, fail=True)
        command[:, : self.width] = np.clip(np.nan_to_num(shares), -1.0, 1.0)
        info, speed = step.info, self.base.motion[:, Motion._fields.index("v_x")]
        # heading error (rad): int (gamma - gamma_ref) dt; course error e (rad): that plus beta -
        # beta_ref; lateral deviation (m): int v_x e dt, for small angles
        self.heading_error += (info["gamma"] - info["gamma_ref"]) * self.dt
        course_error = self.heading_error + info["beta"] - info["beta_ref"]
        self.lateral_deviation += speed * course_error * self.dt
        torques = self.base.rows[:, -1, [FAST.torque_left, FAST.torque_right]]
        power = np.abs(torques).sum(axis=1) * speed / self.radius
        base, commands = self.base, (command, self.last_command)
        infos, scales = (info, self.last), (self.full_scale, self.dt)
        dissipation = compute_dissipation(base.params, base.states, base.switches)
        motion = (self.lateral_deviation, power, dissipation)
        sample = StepSample(*commands, step.reward, *infos, *scales, *motion)
        for metric, total in zip(EPISODE, self.totals, strict=True):
            added = REDUCTIONS[metric.reduction].add(total, metric.compute(sample))
            np.copyto(total, added, where=step.running)
        self.steps += step.running
        self.last, self.last_command = step.info, command

    def numbers(self) -> Array:
        """Metrics of all episodes, shape (cars, NUMBERS)."""
        reductions = [REDUCTIONS[metric.reduction] for metric in EPISODE]
        values = [r.finish(t, self.steps) for r, t in zip(reductions, self.totals, strict=True)]
        return np.stack(values, axis=1)


def run_chunk(chunk: Chunk) -> DriveResult:
    """Drive one episode a seed.

    Args:
        chunk: Seeds of an entry.

    Returns:
        Episodes; why an entry cannot be built or driven is its `error`.
    """
    try:
        return _run_chunk(chunk)
    except Exception as error:
        empty = np.full((len(chunk.seeds), len(NUMBERS)), np.nan)
        return DriveResult(empty, np.nan, error=describe_error(error))


def _run_chunk(chunk: Chunk) -> DriveResult:
    start_time = time.process_time()
    env, agent = make_cars(chunk.entry, len(chunk.seeds))
    steps = iterate_steps(env, agent, list(chunk.seeds))
    reset = next(steps)
    tally, series = _MetricAccumulator(env.unwrapped, reset), [_read_signals(env, reset)]
    for step in steps:
        if chunk.keep and step.running[0]:
            series.append(_read_signals(env, step))
        tally.add(step)
    env.close()
    spent = time.process_time() - start_time
    return DriveResult(tally.numbers(), spent, np.array(series) if chunk.keep else None)


def _read_signals(env: Any, step: EpisodeStep) -> list[float]:
    """Read time (s) and SIGNALS of the first car."""
    motion = env.unwrapped.motion[0]
    place = [float(motion[Motion._fields.index(name)]) for name in _PLACE]
    return [float(step.info[name][0]) for name in _INFO] + place


def get_control_period(entry: ControlEntry) -> float:
    """Return the time between two decisions of an entry.

    Args:
        entry: Entry whose options may name the period.

    Returns:
        Period (s).
    """
    return int(entry.options.get("control_period", 10)) * TICK


CHUNK = 64
"""Episodes of a finished case at most: a longer run takes up the cases of a shorter one."""
_LENGTH = 24  # hexadecimal digits of a case's file name


@dataclass
class Results:
    """Episodes by entry."""

    outcomes: dict[ControlEntry, DriveResult] = field(default_factory=dict)

    def select(self, task: ControlTask, controller: str, estimator: str = "") -> DriveResult:
        """Return one entry's episodes.

        Args:
            task: Task that was driven.
            controller: Name of the controller.
            estimator: Name of the estimator.

        Returns:
            Episodes.

        Raises:
            KeyError: It was not asked for.
        """
        return self.outcomes[ControlEntry(task, estimator, controller)]


def measure(
    entries: Sequence[ControlEntry],
    seeds: Seeds,
    *,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    runner: Callable[[Chunk], DriveResult] | None = None,
    title: str = "control",
) -> Results:
    """Drive every entry on its task's seeds, slow ones on the first of them.

    Args:
        entries: Entries to drive.
        seeds: Seeds of all tasks, or a function of the task.
        jobs: Processes, None for all processors.
        console: Where progress is shown.
        keep: Folder (no `Chunk.keep`) in which finished cases stay, so that a stopped run goes on.
        runner: Function that drives a chunk instead of `run_chunk`.
        title: Title of the progress bar.

    Returns:
        Episodes of all entries.
    """
    if not entries:
        return Results()
    seeds_by_entry: dict[ControlEntry, Sequence[int]] = {}
    for entry in entries:
        task_seeds = seeds(entry.task) if callable(seeds) else seeds
        seeds_by_entry[entry] = task_seeds[:SLOW_EPISODES] if entry.slow else task_seeds
    chunks = [  # the first of every cell before the second of any: a stopped run has them all
        Chunk(entry, tuple(entry_seeds[first : first + CHUNK]), keep=first == 0)
        for first in range(0, max(map(len, seeds_by_entry.values())), CHUNK)
        for entry, entry_seeds in seeds_by_entry.items()
        if first < len(entry_seeds)
    ]
    cached = CachedDrive(keep and keep.absolute(), runner)  # a worker of a cluster runs elsewhere
    results = run_cases(cached, chunks, title, jobs, console)
    parts: dict[ControlEntry, list[DriveResult]] = {}
    for chunk, item in zip(chunks, results, strict=True):
        parts.setdefault(chunk.entry, []).append(item)
    return Results({entry: _join_results(item) for entry, item in parts.items()})


def _join_results(parts: list[DriveResult]) -> DriveResult:
    return DriveResult(
        np.concatenate([part.numbers for part in parts]),
        sum(part.seconds for part in parts),
        parts[0].series,
        next((part.error for part in parts if part.error), ""),
    )


@dataclass(frozen=True)
class CachedDrive:
    """`run_chunk`, or another runner, behind a folder of results; None caches nothing.

    A result is taken only where sources (those of the plant and the benchmark too) and a policy's
    weights are the same.
    """

    folder: Path | None
    runner: Callable[[Chunk], DriveResult] | None = None

    def __call__(self, chunk: Chunk) -> DriveResult:
        """Return the chunk's result, from the folder if it is there."""
        if self.folder is None:
            return self._run_chunk(chunk)
        path = self._make_path(chunk)
        cached = _read_finished(path, chunk, entire=self.runner is None)
        if cached is not None:
            return cached
        result = self._run_chunk(chunk)
        if not result.error:  # an error is worth another try
            _write_finished(path, result)
        return result

    def _run_chunk(self, chunk: Chunk) -> DriveResult:
        return run_chunk(chunk) if self.runner is None else self.runner(chunk)

    def _make_path(self, chunk: Chunk) -> Path:
        assert self.folder is not None
        weights = hash_policy(chunk.entry.controller)
        source_text = "" if self.runner is None else Path(inspect.getfile(self.runner)).read_text()
        key = [hash_sources(), source_text, weights, chunk.entry.oracle, asdict(chunk)]
        text = json.dumps(key, sort_keys=True)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:_LENGTH]}.npz"


@cache
def hash_sources() -> str:
    """Hash all files that an episode's numbers depend on, tuned options and weights too."""
    digest = hashlib.sha256((hash_experiment() + make_salt()).encode())
    for name in ("entries.py", "tasks.py", "run.py", "../harness/metrics.py"):
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()


def _read_finished(path: Path, chunk: Chunk, entire: bool = True) -> DriveResult | None:
    """Read a finished chunk's result; None where the file is absent, damaged or another's."""
    shapes: dict[str, tuple[int, ...]] = {"numbers": (len(chunk.seeds), len(NUMBERS))}
    shapes["seconds"] = ()
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        if chunk.keep and entire:
            shapes["series"] = len(arrays["series"]), 1 + len(SIGNALS)
        if not all(_has_shape(arrays[name], shape, entire) for name, shape in shapes.items()):
            return None
    except Exception:  # whatever NumPy, zipfile and zlib find wrong with it
        return None
    return DriveResult(arrays["numbers"], float(arrays["seconds"]), arrays.get("series"))


def _has_shape(array: Array, shape: tuple[int, ...], entire: bool) -> bool:
    """Whether an array has a shape and finite numbers: all if it is to be entire, else any."""
    finite = np.isfinite(array)
    is_valid = finite.all() if entire else finite.any()
    return array.dtype == np.float64 and array.shape == shape and bool(is_valid)


def _write_finished(path: Path, result: DriveResult) -> None:
    """Write a file of `_read_finished`; a full disk loses the file, not the run."""
    arrays: dict[str, Any] = {"numbers": result.numbers, "seconds": np.array(result.seconds)}
    if result.series is not None:
        arrays["series"] = result.series
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            np.savez_compressed(file, **arrays)
