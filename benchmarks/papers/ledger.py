"""Claims of the papers: the simulations that measure them and the rule of their verdicts.

A simulation gives one number a seed for each subject and metric. A part of a claim is such a
number, what the paper states of it and the threshold that an honest implementation meets
(docs/PAPERS.md section 3). The median over the seeds has to meet the threshold, which has no part
in the verdict.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...estimators.design.options import read_tunings
from ...estimators.estimator import Estimator
from ...estimators.make import make_estimator
from ..harness.drives import call_quietly, make_filter_arguments
from ..harness.parallel import split_seeds
from ..harness.stats import Estimate

if TYPE_CHECKING:
    from ...envs.stability import StabilityEnv


@dataclass
class Example:
    """Signals of the first seed, for figures."""

    time: Array  # s, (K,)
    curves: dict[str, dict[str, Array]]  # (K,) by subject (truth, reference, ...) and signal
    packets: dict[str, Array] = field(default_factory=dict)  # (count, PACKET_WIDTH) by slow sensor


@dataclass
class SimulationResult:
    """The result of a simulation or an analysis."""

    numbers: dict[tuple[str, str], Array]  # (seeds,) by subject and metric
    example: Example | None = None  # of the chunk with the first seed


Results = Mapping[str, SimulationResult]
"""Results by the name of the simulation or analysis."""

_MIN_AGREEMENT = 0.9  # of the seeds

_RELATIONS: dict[str, Callable[[Array, float], npt.NDArray[np.bool_]]] = {
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
    "=": np.equal,
}


@dataclass(frozen=True)
class Bound:
    """A relation and a number, such as "<= 0.75"; ValueError for an unknown or infinite one."""

    relation: str
    value: float

    def __post_init__(self) -> None:
        if self.relation not in _RELATIONS or not math.isfinite(self.value):
            raise ValueError(
                f"expected one of {', '.join(_RELATIONS)} and a finite number, "
                f"got {self.relation!r} {self.value!r}"
            )

    def is_met(self, values: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Tell which of the values meet it; NaN never does.

        Args:
            values: Numbers of any shape.

        Returns:
            Whether each one does, of the same shape.
        """
        return np.asarray(_RELATIONS[self.relation](np.asarray(values, float), self.value))

    def __str__(self) -> str:
        return f"{self.relation} {self.value:g}"


@dataclass(frozen=True)
class ClaimPart:
    """One measured number of a claim."""

    label: str  # what is compared with what
    scenario: str  # name of the simulation or analysis
    compute: Callable[[Results], Array]  # one number a seed, (seeds,)
    stated: Bound | None = None  # by the paper
    threshold: Bound | None = None  # of an honest implementation
    metric: str = "ratio"  # of `METRICS`


@dataclass(frozen=True)
class Claim:
    """A claim of a paper; ValueError without parts."""

    paper: str  # its short name
    source: str  # equation, figure or section
    text: str
    parts: tuple[ClaimPart, ...]
    note: str = ""  # on what was found, for the report

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError(f"{self.paper} {self.source}: a claim needs at least one part")


def make_claim_factory(paper: str) -> Callable[..., Claim]:
    """Make a function that makes a paper's claims from source, text, parts and a note.

    Args:
        paper: Short name of the paper.

    Returns:
        The function.
    """

    def make_claim(source: str, text: str, *parts: ClaimPart, note: str = "") -> Claim:
        return Claim(paper, source, text, parts, note)

    return make_claim


@dataclass(frozen=True)
class MeasuredPart:
    """A part with its numbers, shape (seeds,)."""

    part: ClaimPart
    values: Array

    @property
    def number(self) -> Estimate:
        """The median over the seeds, with their range as its bounds."""
        values = np.median(self.values), np.min(self.values), np.max(self.values)
        return Estimate(*map(float, values))

    @property
    def agreement(self) -> float:
        """The fraction of seeds that meet what the paper states; NaN where it states nothing."""
        stated = self.part.stated
        return math.nan if stated is None else float(np.mean(stated.is_met(self.values)))

    @property
    def holds_in_median(self) -> bool:
        """Whether the median meets what the paper states."""
        return self.part.stated is not None and bool(self.part.stated.is_met(self.number.value))

    @property
    def meets_threshold(self) -> bool | None:
        """Whether the median meets the threshold; None where there is none."""
        threshold = self.part.threshold
        return None if threshold is None else bool(threshold.is_met(self.number.value))


def measure_parts(claim: Claim, results: Results) -> tuple[MeasuredPart, ...]:
    """Measure every part of a claim; ValueError for a part without numbers.

    Args:
        claim: Claim of a paper with its parts.
        results: Results of all simulations that its parts name.

    Returns:
        Its parts with their numbers.
    """
    parts = []
    for part in claim.parts:
        values = np.atleast_1d(np.asarray(part.compute(results), np.float64))
        if values.ndim != 1 or not len(values):
            raise ValueError(f"{claim.paper} {claim.source}, {part.label}: {values.shape} numbers")
        parts.append(MeasuredPart(part, values))
    return tuple(parts)


def evaluate_claim(parts: Sequence[MeasuredPart]) -> str:
    """Evaluate a claim by the parts of which the paper states something.

    "reproduced": all are as stated in at least nine of ten seeds; "not reproduced": none is, even
    in the median over the seeds; "partly": anything between; "report only": no such part.

    Args:
        parts: Parts with their numbers.

    Returns:
        Verdict, one of `VERDICTS`.
    """
    stated_parts = [result for result in parts if result.part.stated is not None]
    if not stated_parts:
        return "report only"
    if all(result.agreement >= _MIN_AGREEMENT for result in stated_parts):
        return "reproduced"
    if any(result.holds_in_median for result in stated_parts):
        return "partly"
    return "not reproduced"


def make_number_part(
    label: str,
    scenario: str,
    subject: str,
    quantity: str,
    stated: Bound | None = None,
    threshold: Bound | None = None,
    metric: str = "ratio",
) -> ClaimPart:
    """Make a part of a claim of a measured number as it stands.

    Args:
        label: What is measured.
        scenario: Name of the simulation or analysis.
        subject: Filter, controller or other name that has the number.
        quantity: Name of the number.
        stated: What the paper states of it.
        threshold: What an honest implementation meets.
        metric: Metric of the row.

    Returns:
        Part.
    """

    def select_number(results: Results) -> Array:
        return results[scenario].numbers[subject, quantity]

    return ClaimPart(label, scenario, select_number, stated, threshold, metric)


def select_ratio(
    scenario: str,
    one: str,
    *others: str,
    metric: str = "beta",
    pick: Callable[..., Array] = np.min,
) -> Callable[[Results], Array]:
    """Select one's number over the best or the poorest of others', seed by seed.

    Args:
        scenario: Name of the simulation.
        one: Subject of the numerator.
        *others: Subjects of the denominator, one or more.
        metric: Name of the number.
        pick: `np.min` for the best of them, `np.max` for the poorest.

    Returns:
        Function of all results.
    """

    def compute_ratio(results: Results) -> Array:
        numbers = results[scenario].numbers
        rival = pick([numbers[other, metric] for other in others], axis=0)
        return np.asarray(numbers[one, metric] / rival)

    return compute_ratio


def make_smaller_part(
    label: str,
    scenario: str,
    one: str,
    other: str,
    max_ratio: float | None = None,
    metric: str = "beta",
) -> ClaimPart:
    """Make a part that states one's number smaller than the other's.

    Args:
        label: What is compared with what.
        scenario: Name of the simulation.
        one: Subject whose number is stated to be smaller.
        other: Subject whose number is larger.
        max_ratio: Threshold of the ratio, None for none.
        metric: Name of the number.

    Returns:
        Part.
    """
    threshold = None if max_ratio is None else Bound("<=", max_ratio)
    ratio = select_ratio(scenario, one, other, metric=metric)
    return ClaimPart(label, scenario, ratio, Bound("<", 1.0), threshold)


Numbers = dict[tuple[str, str], float | Array]
"""One seed's numbers, by subject and metric."""
SeedFunction = Callable[[int], tuple[Numbers, Example | None]]
"""From a seed to its numbers and signals."""


@dataclass(frozen=True)
class Simulation:
    """A simulation with a unique name, whose seeds are split into cases; `prepare` is its own."""

    size: ClassVar[int] = 5  # seeds of a case
    name: str
    _: KW_ONLY
    share: float = 1.0  # of the seeds; 0: once; above 1 where a ratio is close to its threshold

    def split(self, seeds: int) -> list[tuple[int, ...]]:
        """Split the share of some seeds into cases.

        Args:
            seeds: Number of seeds of the suite.

        Returns:
            Seeds of each case.
        """
        return split_seeds(max(1, round(self.share * seeds)), self.size)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Measure the numbers of a case, and keep the signals of seed 0.

        Args:
            seeds: Seeds of the case.

        Returns:
            Numbers by subject and metric, shape (seeds,) each, and the example.
        """
        measure_seed, lines, example = self.prepare(), list[Numbers](), None
        for seed in seeds:
            line, signals = measure_seed(seed)
            lines.append(line)
            example = signals if seed == 0 else example
        numbers = {x: np.concatenate([np.atleast_1d(at[x]) for at in lines]) for x in lines[0]}
        return SimulationResult(numbers, example)

    def prepare(self) -> SeedFunction:
        """Prepare a case: make the function that measures one of its seeds."""
        raise NotImplementedError


@dataclass(frozen=True)
class Analysis(Simulation):
    """A computation without noise of sensors."""

    function: SeedFunction

    def prepare(self) -> SeedFunction:
        """Return the function of a seed."""
        return self.function


def rms(values: npt.ArrayLike) -> float:
    """Compute the root of the mean square.

    Args:
        values: Numbers of any shape.

    Returns:
        Root of the mean square.
    """
    return float(np.sqrt(np.mean(np.square(values))))


def join_results(chunks: list[SimulationResult]) -> SimulationResult:
    """Join the results of one simulation's cases.

    Args:
        chunks: Results in the order of their seeds.

    Returns:
        Result of all seeds.
    """
    names = chunks[0].numbers
    numbers = {name: np.concatenate([chunk.numbers[name] for chunk in chunks]) for name in names}
    return SimulationResult(numbers, next((c.example for c in chunks if c.example), None))


_TUNED = {
    entry["estimator"]: {f"q_{state}": value for state, value in entry["q"].items()}
    for entry in read_tunings(Path(__file__).with_name("tunings.toml"))
}


def get_paper_tuning(name: str) -> Mapping[str, float]:
    """Get the options by which a filter is tuned for its paper's simulation.

    Args:
        name: Name of the filter.

    Returns:
        Options of `make_estimator`, {} for the default.
    """
    return _TUNED.get(name, {})


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

    Returns:
        Estimators by label.
    """
    cars, facts = {"nominal": base.nominal, "true": base.vehicle}, make_filter_arguments(base)
    by_label = {}
    for spec in filters:
        options = {**facts, "vehicle": cars[spec.vehicle]}
        options |= {**get_paper_tuning(spec.name), **spec.options}
        by_label[spec.label] = call_quietly(make_estimator, spec.name, **options)
    return by_label
