"""Drive a cell: all its seeds at once, reduced to a few numbers an episode."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs import FAILURES
from ...envs.record import TICK
from .contest import make_contest
from .contestants import Cell

Array = npt.NDArray[np.float64]

NUMBERS = (
    "cost",
    "rms_slip",
    "peak_slip",
    "rms_slip_error",
    "rms_yaw_error",
    "effort",
    "largest_step",
    "saturation",
    "failure",
)
"""What is kept of an episode, in this order; `failure` is a code of `FAILURES`."""
SIGNALS = ("beta", "gamma", "beta_ref", "gamma_ref", "yaw_moment", "steer")
FULL = 0.999  # of the yaw moment: saturated


@dataclass(frozen=True)
class Chunk:
    """A case: some seeds of a cell. keep: whether to keep the first seed's time series."""

    cell: Cell
    seeds: tuple[int, ...]
    keep: bool = False


@dataclass
class Driven:
    """numbers: (seeds, NUMBERS). us: CPU us per env-step, everything included. series: (k, 1 +
    SIGNALS) with the time first, of the first seed. error: why the cell could not be driven."""

    numbers: Array
    us: float
    series: Array | None = None
    error: str = ""


class _Sums:
    """What accumulates while the episodes run."""

    def __init__(self, cars: int, full_scale: float) -> None:
        self.full_scale = full_scale
        self.alive = np.ones(cars, bool)
        self.steps = np.zeros(cars)
        self.sums = np.zeros((6, cars))  # cost, slip, slip error, yaw error, effort, saturation
        self.peak, self.largest = np.zeros(cars), np.zeros(cars)
        self.failure = np.zeros(cars)
        self.before = np.zeros(cars)

    def add(self, actions: Any, rewards: Any, ended: Any, infos: dict[str, Any]) -> None:
        on = self.alive
        asked = np.nan_to_num(np.asarray(actions, np.float64)[:, 0])
        beta, gamma = infos["beta"], infos["gamma"]
        e_beta, e_gamma = beta - infos["beta_ref"], gamma - infos["gamma_ref"]
        terms = (
            -rewards,
            beta * beta,
            e_beta * e_beta,
            e_gamma * e_gamma,
            (infos["yaw_moment"] / self.full_scale) ** 2,
            np.abs(asked) >= FULL,
        )
        self.sums += np.where(on, terms, 0.0)
        self.peak = np.where(on, np.maximum(self.peak, np.abs(beta)), self.peak)
        step = np.abs(asked - self.before)
        self.largest = np.where(on, np.maximum(self.largest, step), self.largest)
        self.failure = np.where(on & ended, infos["failure"], self.failure)
        self.steps += on
        self.before = asked
        self.alive = on & ~ended

    def numbers(self) -> Array:
        """(cars, NUMBERS)."""
        cost, *squares, effort, saturation = self.sums
        slip, slip_error, yaw_error = (np.sqrt(s / self.steps) for s in squares)
        return np.stack(
            [
                cost,
                slip,
                self.peak,
                slip_error,
                yaw_error,
                effort / self.steps,
                self.largest * self.full_scale,
                saturation / self.steps,
                self.failure,
            ],
            axis=1,
        )


def drive(chunk: Chunk) -> Driven:
    """Drive one episode a seed; a cell that cannot be built or driven says why in `error`."""
    try:
        return _drive(chunk)
    except Exception as error:
        empty = np.full((len(chunk.seeds), len(NUMBERS)), np.nan)
        return Driven(empty, np.nan, error=f"{type(error).__name__}: {error}")


def _drive(chunk: Chunk) -> Driven:
    env, agent = make_contest(chunk.cell, len(chunk.seeds))
    base: Any = env.unwrapped
    sums = _Sums(len(chunk.seeds), base.vehicle[0].yaw_moment_limit)
    seeds: Any = list(chunk.seeds)
    obs, infos = env.reset(seed=seeds)
    state, start = None, np.ones(len(chunk.seeds), bool)
    series = [_signals(infos)]
    begun, steps = time.process_time(), 0
    while sums.alive.any():
        actions, state = agent.predict(obs, state, start, deterministic=True)
        obs, rewards, terminated, truncated, infos = env.step(actions)
        ended = terminated | truncated
        if chunk.keep and sums.alive[0]:
            series.append(_signals(infos))
        sums.add(actions, rewards, ended, infos)
        start = np.zeros(len(start), bool)
        steps += 1
    us = 1e6 * (time.process_time() - begun) / (steps * len(chunk.seeds))
    env.close()
    return Driven(sums.numbers(), us, np.array(series) if chunk.keep else None)


def _signals(infos: dict[str, Any]) -> list[float]:
    return [float(infos[name][0]) for name in ("t", *SIGNALS)]


def rate_of(numbers: Array, failure: str) -> float:
    """The share of episodes that ended by a failure of this name."""
    return float(np.mean(numbers[:, NUMBERS.index("failure")] == FAILURES.index(failure)))


def control_period(cell: Cell) -> float:
    """Seconds between two decisions of a cell."""
    return int(cell.options.get("control_period", 10)) * TICK
