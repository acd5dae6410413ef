"""Claims of the papers: the simulations that measure them and the rule of their verdicts.

A part of a claim is one number a seed, what the paper states of it, and the threshold of an honest
implementation: the median has to meet it, but it has no part in the verdict.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple

import numpy as np

from ...envs.record import Array
from ..harness.stats import Bound, Estimate, compute_range

Results = Mapping[str, Mapping[tuple[str, str], Array]]
"""Numbers (seeds,) by subject and quantity, by the name of the simulation or analysis."""
_MIN_AGREEMENT = 0.9  # of the seeds
CHUNK = 5  # seeds of a simulation in one process


@dataclass(frozen=True)
class ClaimPart:
    """One measured number of a claim: a subject's, or its ratio to rivals', seed by seed."""

    label: str  # what is measured, or compared with what
    scenario: str  # name of the simulation or analysis
    subject: str  # filter, controller or other name that has the number
    quantity: str = "beta"
    stated: Bound | None = None  # by the paper
    threshold: Bound | None = None  # of an honest implementation
    metric: str = "ratio"  # of `METRICS`
    _: KW_ONLY
    rivals: tuple[str, ...] = ()  # subjects of the denominator
    pick: Callable[..., Array] = np.min  # the best of the rivals; `np.max`: the poorest
    is_pooled: bool = False  # RMS values over all seeds together are divided

    def measure(self, results: Results) -> "MeasuredPart":
        """Measure the part.

        Args:
            results: Results of the part's simulation at least.
        """
        numbers = results[self.scenario]
        values = numbers[self.subject, self.quantity]
        others = [numbers[rival, self.quantity] for rival in self.rivals]
        if self.is_pooled:
            values = np.array([np.sqrt(np.mean(values**2) / np.mean(others[0] ** 2))])
        elif others:
            values = values / self.pick(others, axis=0)
        return MeasuredPart(self, values)


def compare(
    label: str, scenario: str, one: str, other: str, max_ratio: float | None = None,
    quantity: str = "beta",
) -> ClaimPart:  # fmt: skip
    """Make a part that states one's number smaller than the other's.

    Args:
        label: What is compared with what.
        scenario: Name of the simulation.
        one: Subject whose number is stated to be smaller.
        other: Subject whose number is larger.
        max_ratio: Threshold of the ratio, None for none.
        quantity: Name of the number.
    """
    threshold = None if max_ratio is None else Bound("<=", max_ratio)
    return ClaimPart(label, scenario, one, quantity, Bound("<", 1.0), threshold, rivals=(other,))


@dataclass(frozen=True)
class MeasuredPart:
    """A part with its numbers, shape (seeds,)."""

    part: ClaimPart
    values: Array

    @property
    def number(self) -> Estimate:
        """The median over the seeds, with their range as its bounds."""
        return compute_range(self.values)

    @property
    def agreement(self) -> float:
        """The fraction of seeds that meet what the paper states; NaN where it states nothing."""
        stated = self.part.stated
        return math.nan if stated is None else float(np.mean(stated.is_met(self.values)))

    @property
    def meets_threshold(self) -> bool | None:
        """Whether the median meets the threshold; None where there is none."""
        threshold = self.part.threshold
        return None if threshold is None else bool(threshold.is_met(self.number.value))


@dataclass(frozen=True)
class Claim:
    """A claim of a paper."""

    source: str  # equation, figure or section
    text: str
    parts: Sequence[ClaimPart]  # numbers that show it
    note: str = ""  # what was found, for the report


@dataclass(frozen=True)
class MeasuredClaim:
    """A claim with the numbers of its parts."""

    paper: str  # short name
    claim: Claim
    parts: Sequence[MeasuredPart]

    @property
    def source(self) -> str:
        """The paper, and the equation, figure or section."""
        return f"{self.paper} {self.claim.source}"

    @property
    def verdict(self) -> str:
        """The verdict, one of `VERDICTS`, by the parts of which the paper states something.

        "reproduced": all are as stated in at least nine of ten seeds; "not reproduced": none is,
        even in the median over the seeds; "partly": anything between; "report only": no such part.
        """
        stated = [(x, x.part.stated) for x in self.parts if x.part.stated is not None]
        if not stated:
            return "report only"
        if all(x.agreement >= _MIN_AGREEMENT for x, _ in stated):
            return "reproduced"
        is_any = any(bound.is_met(x.number.value) for x, bound in stated)
        return "partly" if is_any else "not reproduced"


Numbers = dict[tuple[str, str], float | Array]  # of one seed, by subject and quantity


class SeedResult(NamedTuple):
    """What a seed of a simulation gives; signals are for figures."""

    numbers: Numbers
    time: Array | None = None  # s, (K,)
    curves: Mapping[str, Mapping[str, Array]] = {}  # (K,) by subject (truth, ...) and signal


def join_numbers(results: Iterable[SeedResult]) -> dict[tuple[str, str], Array]:
    """Join the numbers of all seeds, shape (seeds,), or longer where one has several.

    Args:
        results: Results of a simulation, seed by seed.
    """
    lines = [result.numbers for result in results]
    return {x: np.concatenate([np.atleast_1d(line[x]) for line in lines]) for x in lines[0]}


@dataclass(frozen=True)
class Simulation:
    """A simulation with a unique name."""

    name: str
    _: KW_ONLY
    share: float = 1.0  # of the seeds; 0: once; above 1 where a ratio is close to its threshold

    def run(self, seeds: Iterable[int]) -> Iterator[SeedResult]:
        """Run seeds: the numbers and signals of each."""
        raise NotImplementedError


def run_simulation(case: tuple[Simulation, Sequence[int]]) -> list[SeedResult]:
    """Run a simulation on some seeds; only seed 0 leaves its signals.

    Args:
        case: Simulation and seeds.
    """
    simulation, seeds = case
    results = zip(seeds, simulation.run(seeds), strict=True)
    return [result if seed == 0 else SeedResult(result.numbers) for seed, result in results]


@dataclass(frozen=True)
class Analysis(Simulation):
    """A computation without noise of sensors."""

    function: Callable[[int], Numbers]  # of a seed

    def run(self, seeds: Iterable[int]) -> Iterator[SeedResult]:
        """Compute the numbers of each seed."""
        return (SeedResult(self.function(seed)) for seed in seeds)
