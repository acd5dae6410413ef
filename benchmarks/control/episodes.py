"""Drive a cell: all its seeds at once, reduced to a few numbers an episode."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.arguments import actions_of
from ...envs.task.failures import FAILURES
from ...envs.ticks import TICK
from .build import make_contest
from .cells import Cell

Array = npt.NDArray[np.float64]

NUMBERS = (
    "cost",
    "rms_slip",
    "peak_slip",
    "rms_slip_error",
    "rms_yaw_error",
    "effort",
    "largest_step",
    "steer_effort",
    "largest_steer_step",
    "saturation",
    "failure",
)
"""What is kept of an episode, in this order; `failure` is a code of `FAILURES`.

effort: mean square share of the yaw moment that was delivered. steer_effort: of the added steering
that was asked for. largest_step (N m), largest_steer_step (rad): between two decisions. saturation:
share of the decisions that ask for all of an input.
"""
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
    """numbers: (seeds, NUMBERS). seconds: of CPU time. series: (k, 1 + SIGNALS) with the time
    first, of the first seed. error: why the cell could not be driven; its numbers are NaN."""

    numbers: Array
    seconds: float
    series: Array | None = None
    error: str = ""


class _Sums:
    """What accumulates while the episodes run; full: of each input, N m and rad."""

    def __init__(self, cars: int, full: Array) -> None:
        self.full = full
        self.alive = np.ones(cars, bool)
        self.steps = np.zeros(cars)
        self.sums = np.zeros((7, cars))
        self.peak, self.failure = np.zeros(cars), np.zeros(cars)
        self.before, self.largest = np.zeros((cars, 2)), np.zeros((cars, 2))

    def add(self, actions: Any, rewards: Any, ended: Any, infos: dict[str, Any]) -> None:
        on = self.alive
        asked = np.zeros((len(on), 2))
        shares = actions_of(actions, len(on), len(self.full), fail=True)
        asked[:, : len(self.full)] = np.clip(np.nan_to_num(shares), -1.0, 1.0)
        beta, gamma = infos["beta"], infos["gamma"]
        e_beta, e_gamma = beta - infos["beta_ref"], gamma - infos["gamma_ref"]
        terms = (
            -rewards,
            beta * beta,
            e_beta * e_beta,
            e_gamma * e_gamma,
            (infos["yaw_moment"] / self.full[0]) ** 2,
            asked[:, 1] ** 2,
            (np.abs(asked) >= FULL).any(axis=1),
        )
        self.sums += np.where(on, terms, 0.0)
        self.peak = np.where(on, np.maximum(self.peak, np.abs(beta)), self.peak)
        step = np.maximum(self.largest, np.abs(asked - self.before))
        self.largest = np.where(on[:, None], step, self.largest)
        self.failure = np.where(on & ended, infos["failure"], self.failure)
        self.steps += on
        self.before = asked
        self.alive = on & ~ended

    def numbers(self) -> Array:
        """(cars, NUMBERS)."""
        cost, *squares, effort, steer_effort, saturation = self.sums
        slip, slip_error, yaw_error = (np.sqrt(s / self.steps) for s in squares)
        largest = self.largest[:, : len(self.full)] * self.full
        return np.stack(
            [
                cost,
                slip,
                self.peak,
                slip_error,
                yaw_error,
                effort / self.steps,
                largest[:, 0],
                steer_effort / self.steps,
                largest[:, 1] if len(self.full) > 1 else np.zeros(len(cost)),
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
    begun = time.process_time()
    env, agent = make_contest(chunk.cell, len(chunk.seeds))
    base: Any = env.unwrapped
    car, width = base.vehicle[0], base.single_action_space.shape[0]
    full = np.array([car.yaw_moment_limit, car.steering_authority])[:width]
    sums = _Sums(len(chunk.seeds), full)
    seeds: Any = list(chunk.seeds)
    obs, infos = env.reset(seed=seeds)
    state, start = None, np.ones(len(chunk.seeds), bool)
    series = [_signals(infos)]
    while sums.alive.any():
        actions, state = agent.predict(obs, state, start, deterministic=True)
        obs, rewards, terminated, truncated, infos = env.step(actions)
        ended = terminated | truncated
        if chunk.keep and sums.alive[0]:
            series.append(_signals(infos))
        sums.add(actions, rewards, ended, infos)
        start = np.zeros(len(start), bool)
    env.close()
    return Driven(
        sums.numbers(), time.process_time() - begun, np.array(series) if chunk.keep else None
    )


def _signals(infos: dict[str, Any]) -> list[float]:
    return [float(infos[name][0]) for name in ("t", *SIGNALS)]


def rate_of(numbers: Array, failure: str) -> float:
    """The share of episodes that ended by a failure of this name; NaN where none was driven."""
    return float(failed_by(numbers, failure).mean())


def failed_by(numbers: Array, failure: str) -> Array:
    """(episodes,) 1 where an episode ended by a failure of this name, NaN where none was driven."""
    codes = numbers[:, NUMBERS.index("failure")]
    return np.where(np.isnan(codes), np.nan, codes == FAILURES.index(failure))


def control_period(cell: Cell) -> float:
    """Seconds between two decisions of a cell."""
    return int(cell.options.get("control_period", 10)) * TICK
