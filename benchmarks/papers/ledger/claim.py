"""A claim of a paper, and the rule that turns what was measured into a verdict.

A claim has one or more parts. A part is one number a seed, what the paper states of that number
(`stated`) and the threshold that an honest implementation meets (`threshold`, docs/PAPERS.md
section 3); both are data. The rule:

- a part *holds* where at least nine in ten seeds meet what the paper states, holds *in the median*
  where at least the median over the seeds does, and *fails* otherwise;
- a claim is `reproduced` if all its parts hold, `not reproduced` if all fail, `partly` otherwise;
- a claim none of whose parts has a `stated` (the paper has no statement that could be false, or the
  ledger only shows a number) is `report only`.

A threshold is met if the median over the seeds meets it. It guards our implementation and has no
part in the verdict.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ....envs.record import Array


@dataclass
class Example:
    """Signals of the first seed, for figures.

    time: (K,) s. curves: by who ("truth", a filter, a controller, "reference") and signal, (K,).
    packets: by slow sensor, (count, PACKET_WIDTH).
    """

    time: Array
    curves: dict[str, dict[str, Array]]
    packets: dict[str, Array] = field(default_factory=dict)


@dataclass
class SimulationResult:
    """The result of a simulation or an analysis.

    numbers: (seeds,) by who and metric. example: None but for the chunk with the first seed.
    """

    numbers: dict[tuple[str, str], Array]
    example: Example | None = None


Results = Mapping[str, SimulationResult]
"""Results by the name of the simulation or analysis."""

MIN_AGREEMENT = 0.9  # of the seeds

_RELATIONS: dict[str, Callable[[Array, float], npt.NDArray[np.bool_]]] = {
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
    "=": np.equal,
}


@dataclass(frozen=True)
class Bound:
    """A relation and a number, such as "<= 0.75".

    Raises ValueError for an unknown relation or a number that is not finite.
    """

    relation: str
    value: float

    def __post_init__(self) -> None:
        if self.relation not in _RELATIONS or not math.isfinite(self.value):
            raise ValueError(
                f"expected one of {', '.join(_RELATIONS)} and a finite number, "
                f"got {self.relation!r} {self.value!r}"
            )

    def is_met(self, values: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of the values meet it; NaN never does."""
        return np.asarray(_RELATIONS[self.relation](np.asarray(values, float), self.value))

    def __str__(self) -> str:
        return f"{self.relation} {self.value:g}"


@dataclass(frozen=True)
class ClaimPart:
    """One measured number of a claim.

    label: who against whom. of: from the results to one number a seed. scenario: the name of the
    simulation or analysis it comes from. metric: of `METRICS`.
    """

    label: str
    scenario: str
    compute: Callable[[Results], Array]
    stated: Bound | None = None
    threshold: Bound | None = None
    metric: str = "ratio"


@dataclass(frozen=True)
class Claim:
    """paper: its short name. source: equation, figure or section. text: it in a line.

    note: what was found out about it, for the report. Raises ValueError for a claim without parts.
    """

    paper: str
    source: str
    text: str
    parts: tuple[ClaimPart, ...]
    note: str = ""

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError(f"{self.paper} {self.source}: a claim needs at least one part")


def make_claim_factory(paper: str) -> Callable[..., Claim]:
    """A maker of a paper's claims, from source, text, their parts and a note."""

    def make_claim(source: str, text: str, *parts: ClaimPart, note: str = "") -> Claim:
        return Claim(paper, source, text, parts, note)

    return make_claim


@dataclass(frozen=True)
class MeasuredPart:
    """A part with its numbers, (seeds,)."""

    part: ClaimPart
    values: Array

    @property
    def median(self) -> float:
        """Over the seeds."""
        return float(np.median(self.values))

    @property
    def low(self) -> float:
        """The least of the seeds."""
        return float(np.min(self.values))

    @property
    def high(self) -> float:
        """The most of the seeds."""
        return float(np.max(self.values))

    @property
    def agreement(self) -> float:
        """The share of seeds that meet what the paper states; NaN where that is nothing."""
        stated = self.part.stated
        return math.nan if stated is None else float(np.mean(stated.is_met(self.values)))

    @property
    def holds_in_median(self) -> bool:
        """Whether the median meets what the paper states."""
        return self.part.stated is not None and bool(self.part.stated.is_met(self.median))

    @property
    def meets_threshold(self) -> bool | None:
        """Whether the median meets the threshold; None where there is none."""
        threshold = self.part.threshold
        return None if threshold is None else bool(threshold.is_met(self.median))


def measure_parts(claim: Claim, results: Results) -> tuple[MeasuredPart, ...]:
    """Every part of a claim, measured. Raises ValueError for a part without numbers."""
    parts = []
    for part in claim.parts:
        values = np.atleast_1d(np.asarray(part.compute(results), np.float64))
        if values.ndim != 1 or not len(values):
            raise ValueError(f"{claim.paper} {claim.source}, {part.label}: {values.shape} numbers")
        parts.append(MeasuredPart(part, values))
    return tuple(parts)


def evaluate_claim(parts: Sequence[MeasuredPart]) -> str:
    """The verdict on a claim: the rule of this module."""
    stated_parts = [result for result in parts if result.part.stated is not None]
    if not stated_parts:
        return "report only"
    if all(result.agreement >= MIN_AGREEMENT for result in stated_parts):
        return "reproduced"
    if any(result.holds_in_median for result in stated_parts):
        return "partly"
    return "not reproduced"


def select_number(scenario: str, subject: str, metric: str) -> Callable[[Results], Array]:
    """A measured number as it stands."""
    return lambda results: results[scenario].numbers[subject, metric]


def make_number_part(
    label: str,
    scenario: str,
    subject: str,
    quantity: str,
    stated: Bound | None = None,
    threshold: Bound | None = None,
    metric: str = "ratio",
) -> ClaimPart:
    """A measured number as a part of a claim."""
    return ClaimPart(
        label, scenario, select_number(scenario, subject, quantity), stated, threshold, metric
    )


def select_ratio(
    scenario: str, one: str, other: str, metric: str = "beta"
) -> Callable[[Results], Array]:
    """One's number over the other's, seed by seed."""
    return compare_others(scenario, one, (other,), np.min, metric)


def compare_others(
    scenario: str, one: str, others: Sequence[str], pick: Callable[..., Array], metric: str = "beta"
) -> Callable[[Results], Array]:
    """One's number over the best (pick: np.min) or the poorest (np.max) of the others'."""

    def compute_ratio(results: Results) -> Array:
        numbers = results[scenario].numbers
        return np.asarray(
            numbers[one, metric] / pick([numbers[other, metric] for other in others], axis=0)
        )

    return compute_ratio


def make_smaller_part(
    label: str,
    scenario: str,
    one: str,
    other: str,
    max_ratio: float | None = None,
    metric: str = "beta",
) -> ClaimPart:
    """The paper has one's number smaller than the other's; most: the ratio's threshold."""
    threshold = None if max_ratio is None else Bound("<=", max_ratio)
    return ClaimPart(
        label, scenario, select_ratio(scenario, one, other, metric), Bound("<", 1.0), threshold
    )
