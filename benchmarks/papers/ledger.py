"""Claims of the papers: the simulations that measure them and the rule of their verdicts.

A part of a claim is one number a seed, what the paper states of it, and the threshold of an honest
implementation: the median has to meet it, but it has no part in the verdict.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from ...envs.record import Array
from ...estimators.design.options import read_tunings
from ...estimators.estimator import Estimator
from ...estimators.make import make_estimator
from ...estimators.wrappers.estimate import make_spec
from ..harness.drives import call_quietly, make_filter_arguments
from ..harness.stats import Bound, Estimate

if TYPE_CHECKING:
    from ...envs.stability import StabilityEnv


class Example(NamedTuple):
    """Signals of the first seed, for figures."""

    time: Array  # s, (K,)
    curves: dict[str, dict[str, Array]]  # (K,) by subject (truth, reference, ...) and signal


@dataclass
class SimulationResult:
    """The result of a simulation or an analysis."""

    numbers: dict[tuple[str, str], Array]  # (seeds,) by subject and quantity
    example: Example | None = None  # of the chunk with the first seed

    def __add__(self, later: "SimulationResult") -> "SimulationResult":
        """Join it with the result of later seeds."""
        joint = {x: np.concatenate([self.numbers[x], later.numbers[x]]) for x in self.numbers}
        return SimulationResult(joint, self.example or later.example)


Results = Mapping[str, SimulationResult]  # by the name of the simulation or analysis
_MIN_AGREEMENT = 0.9  # of the seeds


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

    def _measure(self, results: Results) -> Array:
        numbers = results[self.scenario].numbers
        one = numbers[self.subject, self.quantity]
        others = [numbers[rival, self.quantity] for rival in self.rivals]
        if self.is_pooled:
            return np.array([np.sqrt(np.mean(one**2) / np.mean(others[0] ** 2))])
        return np.asarray(one / self.pick(others, axis=0)) if others else one


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
        return Estimate(*(float(f(self.values)) for f in (np.median, np.min, np.max)))

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


class Claim:
    """A claim of a paper.

    Args:
        paper: Short name of the paper.
        source: Equation, figure or section.
        text: What is claimed.
        *parts: Numbers that show it.
        note: What was found, for the report.
    """

    def __init__(
        self, paper: str, source: str, text: str, *parts: ClaimPart, note: str = ""
    ) -> None:
        self.paper, self.source, self.text = paper, source, text
        self.parts, self.note = parts, note

    def measure(self, results: Results) -> "MeasuredClaim":
        """Measure every part.

        Args:
            results: Results of all simulations that the parts name.
        """
        parts = tuple(MeasuredPart(part, part._measure(results)) for part in self.parts)
        return MeasuredClaim(self, parts)


@dataclass(frozen=True)
class MeasuredClaim:
    """A claim with the numbers of its parts."""

    claim: Claim
    parts: tuple[MeasuredPart, ...]

    @property
    def source(self) -> str:
        """The paper, and the equation, figure or section."""
        return f"{self.claim.paper} {self.claim.source}"

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
Outcomes = Iterator[tuple[Numbers, Example | None]]  # numbers and signals, seed by seed


@dataclass(frozen=True)
class Simulation:
    """A simulation with a unique name; `_run` yields what each seed gives."""

    size: ClassVar[int] = 5  # seeds of a case
    name: str
    _: KW_ONLY
    share: float = 1.0  # of the seeds; 0: once; above 1 where a ratio is close to its threshold

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Measure numbers by subject and quantity, shape (seeds,) each, and the signals of seed 0.

        Args:
            seeds: Seeds of the case.
        """
        lines, example = list[Numbers](), None
        for seed, (line, signals) in zip(seeds, self._run(seeds), strict=True):
            lines.append(line)
            example = signals if seed == 0 else example
        numbers = {x: np.concatenate([np.atleast_1d(at[x]) for at in lines]) for x in lines[0]}
        return SimulationResult(numbers, example)

    def _run(self, seeds: tuple[int, ...]) -> Outcomes:
        raise NotImplementedError


@dataclass(frozen=True)
class Analysis(Simulation):
    """A computation without noise of sensors."""

    function: Callable[[int], Numbers]  # of a seed

    def _run(self, seeds: tuple[int, ...]) -> Outcomes:
        return ((self.function(seed), None) for seed in seeds)


PAPER_TUNINGS: dict[str, dict[str, float]] = {
    entry["estimator"]: {f"q_{state}": value for state, value in entry["q"].items()}
    for entry in read_tunings(Path(__file__).with_name("tunings.toml"))
}  # options by which a filter is tuned for its paper's simulation, by its name


@dataclass(frozen=True)
class PaperFilter:
    """A filter of a simulation."""

    label: str  # its name in tables
    name: str  # of `make_estimator`
    options: Mapping[str, Any] = field(default_factory=dict)  # of `make_estimator`
    vehicle: str = "nominal"  # or "true", for which it is built


def make_filters(filters: Sequence[PaperFilter], base: "StabilityEnv") -> dict[str, Estimator]:
    """Make filters, tuned for their papers, for the running episode of an env.

    Args:
        filters: Filters of a simulation.
        base: Env without wrappers, in an episode.
    """
    facts, present = make_filter_arguments(base), make_spec(base)
    cars = {"nominal": present.vehicle, "true": present.replace_vehicle(base.vehicle).vehicle}
    by_label = {}
    for spec in filters:
        options = {**PAPER_TUNINGS.get(spec.name, {}), **spec.options}
        facts["vehicle"] = cars[spec.vehicle]
        by_label[spec.label] = call_quietly(make_estimator, spec.name, **facts | options)
    return by_label
