"""What a simulation of the ledger is: seeds in cases, and the numbers that they give.

A simulation is data and gives the same `Measured` whatever it is: filters over one drive
(`estimation`), controllers over the same manoeuvre (`controlled`), or a computation without a car
(`Analysis`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...agents.rollout import Rollout
from .claim import Array, Measured

FIRST = 0  # the seed of the figures
CHUNK = 5  # seeds of a case that is over in seconds

Numbers = dict[tuple[str, str], float]
"""One seed's numbers, by who and metric."""

TRUTH = ("beta", "gamma", "psi", "v_x", "v_y", "phi", "y_l")
"""The states whose truth is known, named as the filters name them."""


class Simulation(Protocol):
    """name: unique. chunks: the seeds of each case, of so many. measure: on a case's seeds."""

    @property
    def name(self) -> str: ...  # noqa: D102

    def chunks(self, seeds: int) -> list[tuple[int, ...]]: ...  # noqa: D102

    def measure(self, seeds: tuple[int, ...]) -> Measured: ...  # noqa: D102


@dataclass(frozen=True)
class Analysis:
    """A computation without noise of sensors. function: importable, from seeds to `Measured`.

    random: whether the seeds mean anything to it; else it is called once.
    """

    name: str
    function: Callable[[tuple[int, ...]], Measured]
    random: bool = True

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return chunked(seeds if self.random else 1)

    def measure(self, seeds: tuple[int, ...]) -> Measured:
        """What the function gives."""
        return self.function(seeds)


class ToldMotion(gym.Wrapper[Any, Any, Any, Any]):
    """Adds the true v_x, v_y (m/s), phi (rad) and y_l (m) to `info`, beside beta, gamma and psi."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Reset the env; `info` is that of tick 0."""
        obs, info = self.env.reset(**options)
        return obs, info | self._told()

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One env-step; `info` is that after it."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated, truncated, info | self._told()

    def _told(self) -> dict[str, float]:
        base: Any = self.env.unwrapped
        motion = base.motion
        return {
            "v_x": motion.v_x,
            "v_y": motion.v_y,
            "phi": motion.phi,
            "y_l": motion.y + base.vehicle.preview * (motion.psi - motion.theta),  # tie-vision (4)
        }


def truth_of(drive: Rollout) -> dict[str, Array]:
    """The truth at every tick of a drive, (K,) each, interpolated between the env's steps."""
    return {name: np.interp(drive.log.time, drive["t"], drive[name]) for name in TRUTH}


def rms(values: npt.ArrayLike) -> float:
    """The root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def chunked(seeds: int, size: int = CHUNK) -> list[tuple[int, ...]]:
    """The seeds 0 .. seeds-1 in tuples of at most some."""
    return [tuple(range(k, min(k + size, seeds))) for k in range(0, seeds, size)]


def stacked(lines: list[Numbers]) -> Mapping[tuple[str, str], Array]:
    """(seeds,) of each number, from the numbers of each seed."""
    return {name: np.array([line[name] for line in lines]) for name in lines[0]}


def joined(chunks: list[Measured]) -> Measured:
    """The chunks of one simulation as one."""
    names = chunks[0].numbers
    numbers = {name: np.concatenate([chunk.numbers[name] for chunk in chunks]) for name in names}
    return Measured(numbers, next((c.example for c in chunks if c.example is not None), None))
