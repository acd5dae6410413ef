"""Episodes of the control benchmark: driven, reduced to metrics, timed, kept as finished cases.

A chunk drives all its seeds at once in a vector env; a folder keeps finished ones by their hash.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from rich.console import Console

from ...agents.env_info import list_configs
from ...agents.learned.policy import hash_policy
from ...agents.rollout import EpisodeStep, iterate_steps
from ...envs.io import atomic_file
from ...envs.numerics.functions import TICK
from ...envs.numerics.kernel_cache import hash_experiment
from ...envs.record import FAST, Array
from ...envs.task import FAILURES
from ...envs.validation import parse_actions
from ...envs.vehicle.dynamics import Motion
from ...estimators.make import describe_error
from ..harness.metrics import EPISODE, REDUCTIONS, StepSample, compute_dissipation
from ..harness.parallel import run_cases
from .entries import SLOW_EPISODES, ControlCase, Entry
from .tasks import ControlTask, Seeds, make_salt

NUMBERS = tuple(metric.name for metric in EPISODE)
_INFO = ("t", "beta", "gamma", "beta_ref", "gamma_ref", "yaw_moment", "steer", "psi")
_PLACE = ("X", "Y")
SIGNALS = (*_INFO[1:], *_PLACE)


@dataclass(frozen=True)
class Chunk:
    """Some seeds of a task; keep: whether the first seed's time series is returned too."""

    task: ControlTask
    entry: Entry
    seeds: tuple[int, ...]
    keep: bool = False

    @property
    def case(self) -> ControlCase:
        """Task and entry."""
        return ControlCase(self.task, self.entry)


@dataclass
class DriveResult:
    """Episodes of an entry in the order of their seeds."""

    numbers: Array  # metrics, shape (seeds, NUMBERS); NaN where the entry was not driven
    series: Array | None = None  # time and SIGNALS of the first seed, shape (k, 1 + SIGNALS)
    error: str = ""  # why the entry could not be driven

    def __getitem__(self, name: str) -> Array:
        """One of NUMBERS, shape (seeds,)."""
        return self.numbers[:, NUMBERS.index(name)]

    @property
    def costs(self) -> Array:
        """Cost of each episode, shape (seeds,)."""
        return self["cost"]

    @property
    def survived(self) -> npt.NDArray[np.bool_]:
        """Whether each episode ended by no failure, shape (seeds,)."""
        return np.asarray(self["failure"] == 0.0)

    def mark_failures(self, cause: str) -> Array:
        """Mark the episodes that ended by a failure: 1, else 0, NaN where nothing was driven.

        Args:
            cause: Failure, of `FAILURES`.
        """
        return np.where(np.isnan(self["failure"]), np.nan, self["failure"] == FAILURES.index(cause))


class _MetricAccumulator:
    """The metrics of all cars while their episodes run; reset: their step 0, after the reset."""

    def __init__(self, base: Any, reset: EpisodeStep) -> None:
        car, self.width = base.vehicle[0], base.single_action_space.shape[0]
        self.full_scale = np.array([car.yaw_moment_limit, car.steering_authority])
        self.full_scale[self.width :] = 0.0
        self.dt = base.control_period * TICK
        self.lead_in = list_configs(base)[0].lead_in  # s; what happens before is not measured
        self.base, self.radius = base, car.wheel_radius
        self.last, self.last_command = reset.info, np.zeros((base.num_envs, 2))
        self.heading_error, self.lateral_deviation = np.zeros((2, base.num_envs))  # rad, m
        self.steps, self.totals = np.zeros(base.num_envs), np.zeros((len(EPISODE), base.num_envs))

    def add(self, step: EpisodeStep) -> None:
        judged = step.running & (np.asarray(step.info["t"]) > self.lead_in + 0.5 * TICK)
        command = np.zeros_like(self.last_command)
        shares = parse_actions(step.action, len(command), self.width, fail=True)
        command[:, : self.width] = np.clip(np.nan_to_num(shares), -1.0, 1.0)
        info, speed = step.info, self.base.motion[:, Motion._fields.index("v_x")]
        # heading error (rad): int (gamma - gamma_ref) dt; course error e (rad): that plus beta -
        # beta_ref; lateral deviation (m): int v_x e dt, for small angles
        self.heading_error += judged * (info["gamma"] - info["gamma_ref"]) * self.dt
        course_error = self.heading_error + info["beta"] - info["beta_ref"]
        self.lateral_deviation += judged * speed * course_error * self.dt
        torques = self.base.rows[:, -1, [FAST.torque_left, FAST.torque_right]]
        power = np.abs(torques).sum(axis=1) * speed / self.radius
        params, states, switches, *_ = self.base.engine.arrays
        sample = StepSample(
            command, self.last_command, step.reward, info, self.last, self.full_scale, self.dt,
            self.lateral_deviation, power, compute_dissipation(params, states, switches),
        )  # fmt: skip
        for metric, total in zip(EPISODE, self.totals, strict=True):
            added = REDUCTIONS[metric.reduction].add(total, metric.compute(sample))
            is_counted = step.running if metric.name in ("cost", "failure") else judged
            np.copyto(total, added, where=is_counted)
        self.steps += judged
        self.last, self.last_command = step.info, command

    def numbers(self) -> Array:
        """Metrics of all episodes, shape (cars, NUMBERS)."""
        reductions = [REDUCTIONS[metric.reduction] for metric in EPISODE]
        steps = np.maximum(self.steps, 1.0)  # a car may be lost before anything is measured
        values = [r.finish(t, steps) for r, t in zip(reductions, self.totals, strict=True)]
        return np.stack(values, axis=1)


def run_chunk(chunk: Chunk) -> DriveResult:
    """Drive one episode a seed; why an entry cannot be built or driven is the `error`."""
    try:
        env, agent = chunk.entry.make(chunk.task, len(chunk.seeds))
        steps = iterate_steps(env, agent, list(chunk.seeds))
        reset = next(steps)
        tally, series = _MetricAccumulator(env.unwrapped, reset), [_read_signals(env, reset)]
        for step in steps:
            if chunk.keep and step.running[0]:
                series.append(_read_signals(env, step))
            tally.add(step)
        env.close()
    except Exception as error:
        empty = np.full((len(chunk.seeds), len(NUMBERS)), np.nan)
        return DriveResult(empty, error=describe_error(error))
    return DriveResult(tally.numbers(), np.array(series) if chunk.keep else None)


def _read_signals(env: Any, step: EpisodeStep) -> list[float]:
    """Read time (s) and SIGNALS of the first car."""
    motion = env.unwrapped.motion[0]
    place = [float(motion[Motion._fields.index(name)]) for name in _PLACE]
    return [float(step.info[name][0]) for name in _INFO] + place


_STEPS = 200  # of which a decision's time is the median


def _time_calls(owner: Any, name: str) -> list[float]:
    """Let a method note how long each of its calls takes, in the list (s of wall time)."""
    method, seconds = getattr(owner, name), list[float]()

    def call(*args: object, **kwargs: object) -> object:
        start_time = time.perf_counter()
        result = method(*args, **kwargs)
        seconds.append(time.perf_counter() - start_time)
        return result

    setattr(owner, name, call)
    return seconds


def measure_decision_time(case: ControlCase) -> float:
    """Measure the wall time (us) of a decision of one car: predict, and the estimator's part."""
    env, agent = case.entry.make(case.task, 1)
    bare: Any = gym.make_vec(case.task.env_id, num_envs=1, **case.env_options)
    bare.reset(seed=0)
    seconds = _time_calls(agent, "predict"), _time_calls(env, "step"), _time_calls(bare, "step")
    for step in islice(iterate_steps(env, agent, 0), 1, _STEPS + 1):
        bare.step(np.zeros_like(step.action))
    predict, with_estimator, without_estimator = map(np.median, seconds)
    return 1e6 * float(predict + max(with_estimator - without_estimator, 0.0))


CHUNK = 64  # episodes of a finished case at most: a longer run takes up the cases of a shorter one
Results = dict[tuple[ControlTask, Entry], DriveResult]  # episodes by task and entry


def measure(
    cases: Iterable[tuple[ControlTask, Entry]], seeds: Seeds, *, jobs: int | None = None,
    console: Console | None = None, keep: Path | None = None,
    runner: Callable[[Chunk], DriveResult] | None = None, title: str = "control",
) -> Results:  # fmt: skip
    """Drive every case on its task's seeds, slow entries on the first of them.

    Args:
        cases: Tasks and who drives them.
        seeds: Seeds of all tasks, or a function of the task.
        jobs: Processes, None for all processors.
        console: Where progress is shown.
        keep: Folder (no `Chunk.keep`) in which finished cases stay, so that a stopped run goes on.
        runner: Function that drives a chunk instead of `run_chunk`, and keeps nothing.
        title: Title of the progress bar.
    """
    seeds_by_case: dict[ControlCase, Sequence[int]] = {}
    for case in (ControlCase(task, entry) for task, entry in cases):
        task_seeds = seeds(case.task) if callable(seeds) else seeds
        seeds_by_case[case] = task_seeds[:SLOW_EPISODES] if case.is_slow else task_seeds
    if not seeds_by_case:
        return {}
    chunks = [  # the first of every case before the second of any: a stopped run has them all
        Chunk(*case, tuple(case_seeds[first : first + CHUNK]), keep=first == 0)
        for first in range(0, max(map(len, seeds_by_case.values())), CHUNK)
        for case, case_seeds in seeds_by_case.items()
        if first < len(case_seeds)
    ]
    if runner is None:  # a worker of a cluster runs in another folder
        runner = run_chunk if keep is None else _StoredDrives(keep.absolute())
    results = run_cases(runner, chunks, title, jobs, console)
    parts: dict[ControlCase, list[DriveResult]] = {}
    for chunk, item in zip(chunks, results, strict=True):
        parts.setdefault(chunk.case, []).append(item)
    return {
        case: DriveResult(
            np.concatenate([part.numbers for part in items]),
            items[0].series,
            next((part.error for part in items if part.error), ""),
        )
        for case, items in parts.items()
    }


@cache
def hash_sources() -> str:
    """Hash all files that an episode's numbers depend on, tuned options and weights too."""
    digest = hashlib.sha256((hash_experiment() + make_salt()).encode())
    for name in ("entries.py", "tasks.py", "run.py", "../harness/metrics.py"):
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class _StoredDrives:
    """A function of a chunk, `run_chunk`, behind a folder of its results."""

    folder: Path
    function: Callable[[Chunk], DriveResult] = run_chunk

    def __call__(self, chunk: Chunk) -> DriveResult:
        """Return a chunk's result, from the folder if it is there."""
        path = self.folder / f"{_hash_chunk(chunk)}.npz"
        # whatever NumPy, zipfile or zlib find wrong: the chunk is run anew
        with suppress(Exception), np.load(path, allow_pickle=False) as archive:
            return DriveResult(archive["numbers"], archive.get("series"))
        result = self.function(chunk)
        if not result.error:  # which is worth another try
            arrays: dict[str, Any] = {"numbers": result.numbers}
            arrays |= {} if result.series is None else {"series": result.series}
            with suppress(OSError):  # a full disk loses the file, not the run
                path.parent.mkdir(parents=True, exist_ok=True)
                with atomic_file(path) as file:
                    np.savez_compressed(file, **arrays)
        return result


def _hash_chunk(chunk: Chunk) -> str:
    """Hash a chunk, a policy's weights, and all sources that its numbers depend on."""
    weights, driver = hash_policy(chunk.entry.agent), chunk.case.driver
    key = json.dumps([hash_sources(), weights, driver, asdict(chunk)], sort_keys=True)
    return hashlib.sha256(key.encode()).hexdigest()[:24]
