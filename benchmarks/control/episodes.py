"""The episodes of a cell: all seeds at once, reduced to a few numbers an episode."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...agents.rollout import Step, steps_of
from ...envs.arguments import actions_of
from ...envs.record import FAST
from ...envs.task.failures import FAILURES
from ...envs.ticks import TICK
from ...envs.vehicle.dynamics import Motion
from ...estimators.user_files import reason_of
from ..harness.dissipation import dissipated
from ..harness.metrics import EPISODE, FOLDS, Moment
from .build import make_cars
from .cells import Cell

Array = npt.NDArray[np.float64]

NUMBERS = tuple(metric.name for metric in EPISODE)
_INFO = ("t", "beta", "gamma", "beta_ref", "gamma_ref", "yaw_moment", "steer", "psi")
_PLACE = ("X", "Y")
SIGNALS = (*_INFO[1:], *_PLACE)


@dataclass(frozen=True)
class Chunk:
    """A case: some seeds of a cell. keep: whether it returns the first seed's time series."""

    cell: Cell
    seeds: tuple[int, ...]
    keep: bool = False


@dataclass
class Driven:
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

    def failed(self, by: str) -> Array:
        """(seeds,) 1 where an episode ended by this failure, NaN where none was driven."""
        return np.where(np.isnan(self["failure"]), np.nan, self["failure"] == FAILURES.index(by))


class _Tally:
    """The metrics of all cars while their episodes run; reset: the first of their steps."""

    def __init__(self, base: Any, reset: Step) -> None:
        car, self.width = base.vehicle[0], base.single_action_space.shape[0]
        self.full = np.array([car.yaw_moment_limit, car.steering_authority])
        self.full[self.width :] = 0.0
        self.dt = base.control_period * TICK
        self.base, self.radius = base, car.wheel_radius
        self.last, self.before = reset.info, np.zeros((base.num_envs, 2))
        self.turned, self.aside = np.zeros((2, base.num_envs))
        self.steps, self.totals = np.zeros(base.num_envs), np.zeros((len(EPISODE), base.num_envs))

    def add(self, step: Step) -> None:
        asked = np.zeros_like(self.before)
        shares = actions_of(step.action, len(asked), self.width, fail=True)
        asked[:, : self.width] = np.clip(np.nan_to_num(shares), -1.0, 1.0)
        info, speed = step.info, self.base.motion[:, Motion._fields.index("v_x")]
        self.turned += (info["gamma"] - info["gamma_ref"]) * self.dt
        self.aside += speed * (self.turned + info["beta"] - info["beta_ref"]) * self.dt
        torques = self.base.rows[:, -1, [FAST.torque_left, FAST.torque_right]]
        power = np.abs(torques).sum(axis=1) * speed / self.radius
        heat = dissipated(self.base.params, self.base.states, self.base.switches)
        moment = Moment(
            *(asked, self.before, step.reward, info, self.last, self.full, self.dt, self.aside),
            *(power, heat),
        )
        for metric, total in zip(EPISODE, self.totals, strict=True):
            added = FOLDS[metric.fold].add(total, metric.of(moment))
            np.copyto(total, added, where=step.running)
        self.steps += step.running
        self.last, self.before = step.info, asked

    def numbers(self) -> Array:
        """(cars, NUMBERS)."""
        folds = [FOLDS[metric.fold] for metric in EPISODE]
        done = [f.finish(t, self.steps) for f, t in zip(folds, self.totals, strict=True)]
        return np.stack(done, axis=1)


def drive(chunk: Chunk) -> Driven:
    """Drive one episode a seed; the reason why a cell cannot be built or driven is its `error`."""
    try:
        return _drive(chunk)
    except Exception as error:
        empty = np.full((len(chunk.seeds), len(NUMBERS)), np.nan)
        return Driven(empty, np.nan, error=reason_of(error))


def _drive(chunk: Chunk) -> Driven:
    begun = time.process_time()
    env, agent = make_cars(chunk.cell, len(chunk.seeds))
    steps = steps_of(env, agent, list(chunk.seeds))
    reset = next(steps)
    tally, series = _Tally(env.unwrapped, reset), [_signals(env, reset)]
    for step in steps:
        if chunk.keep and step.running[0]:
            series.append(_signals(env, step))
        tally.add(step)
    env.close()
    spent = time.process_time() - begun
    return Driven(tally.numbers(), spent, np.array(series) if chunk.keep else None)


def _signals(env: Any, step: Step) -> list[float]:
    """The time and SIGNALS of the first car."""
    motion = env.unwrapped.motion[0]
    place = [float(motion[Motion._fields.index(name)]) for name in _PLACE]
    return [float(step.info[name][0]) for name in _INFO] + place


def control_period(cell: Cell) -> float:
    """Seconds between two decisions of a cell."""
    return int(cell.options.get("control_period", 10)) * TICK
