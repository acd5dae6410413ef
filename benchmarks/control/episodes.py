"""The episodes of a cell: all seeds at once, reduced to a few numbers an episode."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...agents.rollout import EpisodeStep, iterate_steps
from ...envs.arguments import parse_actions
from ...envs.record import FAST, Array
from ...envs.task.failures import FAILURES
from ...envs.ticks import TICK
from ...envs.vehicle.dynamics import Motion
from ...estimators.user_files import describe_error
from ..harness.dissipation import compute_dissipation
from ..harness.metrics import EPISODE, REDUCTIONS, StepSample
from .build import make_cars
from .cells import ControlEntry

NUMBERS = tuple(metric.name for metric in EPISODE)
_INFO = ("t", "beta", "gamma", "beta_ref", "gamma_ref", "yaw_moment", "steer", "psi")
_PLACE = ("X", "Y")
SIGNALS = (*_INFO[1:], *_PLACE)


@dataclass(frozen=True)
class Chunk:
    """A case: some seeds of a cell. keep: whether it returns the first seed's time series."""

    entry: ControlEntry
    seeds: tuple[int, ...]
    keep: bool = False


@dataclass
class DriveResult:
    """Episodes of a cell in the order of their seeds.

    numbers: (seeds, NUMBERS). seconds: of CPU time. series: (k, 1 + SIGNALS) with the time first,
    of the first seed. error: why the cell could not be driven; its numbers are NaN.
    """

    numbers: Array
    seconds: float
    series: Array | None = None
    error: str = ""

    def __getitem__(self, name: str) -> Array:
        """(seeds,) one of NUMBERS."""
        return self.numbers[:, NUMBERS.index(name)]

    @property
    def costs(self) -> Array:
        """(seeds,)."""
        return self["cost"]

    def mark_failures(self, cause: str) -> Array:
        """(seeds,) 1 where an episode ended by this failure, NaN where none was driven."""
        return np.where(np.isnan(self["failure"]), np.nan, self["failure"] == FAILURES.index(cause))


class _MetricAccumulator:
    """The metrics of all cars while their episodes run; reset: the first of their steps."""

    def __init__(self, base: Any, reset: EpisodeStep) -> None:
        car, self.width = base.vehicle[0], base.single_action_space.shape[0]
        self.full_scale = np.array([car.yaw_moment_limit, car.steering_authority])
        self.full_scale[self.width :] = 0.0
        self.dt = base.control_period * TICK
        self.base, self.radius = base, car.wheel_radius
        self.last, self.last_command = reset.info, np.zeros((base.num_envs, 2))
        self.turned, self.lateral_deviation = np.zeros((2, base.num_envs))
        self.steps, self.totals = np.zeros(base.num_envs), np.zeros((len(EPISODE), base.num_envs))

    def add(self, step: EpisodeStep) -> None:
        command = np.zeros_like(self.last_command)
        shares = parse_actions(step.action, len(command), self.width, fail=True)
        command[:, : self.width] = np.clip(np.nan_to_num(shares), -1.0, 1.0)
        info, speed = step.info, self.base.motion[:, Motion._fields.index("v_x")]
        self.turned += (info["gamma"] - info["gamma_ref"]) * self.dt
        self.lateral_deviation += speed * (self.turned + info["beta"] - info["beta_ref"]) * self.dt
        torques = self.base.rows[:, -1, [FAST.torque_left, FAST.torque_right]]
        power = np.abs(torques).sum(axis=1) * speed / self.radius
        tyre_dissipation = compute_dissipation(
            self.base.params, self.base.states, self.base.switches
        )
        moment = StepSample(
            *(
                command,
                self.last_command,
                step.reward,
                info,
                self.last,
                self.full_scale,
                self.dt,
                self.lateral_deviation,
            ),
            *(power, tyre_dissipation),
        )
        for metric, total in zip(EPISODE, self.totals, strict=True):
            added = REDUCTIONS[metric.reduction].add(total, metric.compute(moment))
            np.copyto(total, added, where=step.running)
        self.steps += step.running
        self.last, self.last_command = step.info, command

    def numbers(self) -> Array:
        """(cars, NUMBERS)."""
        folds = [REDUCTIONS[metric.reduction] for metric in EPISODE]
        done = [f.finish(t, self.steps) for f, t in zip(folds, self.totals, strict=True)]
        return np.stack(done, axis=1)


def run_chunk(chunk: Chunk) -> DriveResult:
    """Drive one episode a seed; the reason why a cell cannot be built or driven is its `error`."""
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
    """The time and SIGNALS of the first car."""
    motion = env.unwrapped.motion[0]
    place = [float(motion[Motion._fields.index(name)]) for name in _PLACE]
    return [float(step.info[name][0]) for name in _INFO] + place


def get_control_period(entry: ControlEntry) -> float:
    """Seconds between two decisions of a cell."""
    return int(entry.options.get("control_period", 10)) * TICK
