"""A simulation of the ledger: seeds in cases, and the numbers that they give.

A simulation is data and gives the same `SimulationResult` whatever it is: filters over one drive
(`filters`), controllers over the same manoeuvre (`controllers`), or a computation without a car
(`Analysis`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ....envs.record import Array
from ...harness.parallel import split_seeds
from .claim import SimulationResult

FIRST = 0  # the seed of the figures
CHUNK = 5  # seeds of a case that is over in seconds

Numbers = dict[tuple[str, str], float]
"""One seed's numbers, by who and metric."""


class Simulation(Protocol):
    """name: unique. chunks: the seeds of each case, of so many. measure: on a case's seeds."""

    @property
    def name(self) -> str: ...  # noqa: D102

    def chunks(self, seeds: int) -> list[tuple[int, ...]]: ...  # noqa: D102

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult: ...  # noqa: D102


@dataclass(frozen=True)
class Analysis:
    """A computation without noise of sensors. function: importable, from seeds to
    `SimulationResult`.

    random: whether the seeds mean anything to it; else it is called once.
    """

    name: str
    function: Callable[[tuple[int, ...]], SimulationResult]
    random: bool = True

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return split_seeds(seeds if self.random else 1, CHUNK)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """The function's result."""
        return self.function(seeds)


def rms(values: npt.ArrayLike) -> float:
    """The root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def collect_numbers(lines: list[Numbers]) -> dict[tuple[str, str], Array]:
    """(seeds,) of each number, from the numbers of each seed."""
    return {name: np.array([line[name] for line in lines]) for name in lines[0]}


def join_results(chunks: list[SimulationResult]) -> SimulationResult:
    """The chunks of one simulation as one."""
    names = chunks[0].numbers
    numbers = {name: np.concatenate([chunk.numbers[name] for chunk in chunks]) for name in names}
    return SimulationResult(
        numbers, next((c.example for c in chunks if c.example is not None), None)
    )
