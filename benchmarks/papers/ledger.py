"""Claims of the papers: the simulations that measure them and the rule of their verdicts.

A simulation gives one number a seed for each subject and metric. A part of a claim is such a
number, what the paper states of it and the threshold that an honest implementation meets
(docs/PAPERS.md section 3). The median over the seeds has to meet the threshold, which has no part
in the verdict.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...agents.rollout import rollout
from ...envs.record import PACKET, Array, Log
from ...envs.scenarios.manoeuvres import make_scenario
from ...estimators.analysis.bound import compute_error_bound
from ...estimators.design.options import read_tunings
from ...estimators.estimator import Estimator
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, call_quietly, make_filter_arguments
from ..harness.parallel import split_seeds


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
        """Tell which of the values meet it; NaN never does."""
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
    """Make a function that makes a paper's claims from source, text, parts and a note."""

    def make_claim(source: str, text: str, *parts: ClaimPart, note: str = "") -> Claim:
        return Claim(paper, source, text, parts, note)

    return make_claim


@dataclass(frozen=True)
class MeasuredPart:
    """A part with its numbers, shape (seeds,)."""

    part: ClaimPart
    values: Array

    @property
    def median(self) -> float:
        """The median over the seeds."""
        return float(np.median(self.values))

    @property
    def low(self) -> float:
        """The smallest number of the seeds."""
        return float(np.min(self.values))

    @property
    def high(self) -> float:
        """The largest number of the seeds."""
        return float(np.max(self.values))

    @property
    def agreement(self) -> float:
        """The fraction of seeds that meet what the paper states; NaN where it states nothing."""
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
    """Measure every part of a claim; ValueError for a part without numbers."""
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
    """
    stated_parts = [result for result in parts if result.part.stated is not None]
    if not stated_parts:
        return "report only"
    if all(result.agreement >= _MIN_AGREEMENT for result in stated_parts):
        return "reproduced"
    if any(result.holds_in_median for result in stated_parts):
        return "partly"
    return "not reproduced"


def select_number(scenario: str, subject: str, metric: str) -> Callable[[Results], Array]:
    """Select a measured number as it stands."""
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
    """Make a part of a claim of a measured number: a quantity of a subject in a scenario."""
    number = select_number(scenario, subject, quantity)
    return ClaimPart(label, scenario, number, stated, threshold, metric)


def select_ratio(
    scenario: str, one: str, other: str, metric: str = "beta"
) -> Callable[[Results], Array]:
    """Select one's number over the other's, seed by seed."""
    return compare_others(scenario, one, (other,), np.min, metric)


def compare_others(
    scenario: str, one: str, others: Sequence[str], pick: Callable[..., Array], metric: str = "beta"
) -> Callable[[Results], Array]:
    """Select one's number over the best (pick: np.min) or the poorest (np.max) of others'."""

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
    """Make a part that states one's number smaller than the other's; max_ratio: threshold."""
    threshold = None if max_ratio is None else Bound("<=", max_ratio)
    ratio = select_ratio(scenario, one, other, metric)
    return ClaimPart(label, scenario, ratio, Bound("<", 1.0), threshold)


FIRST = 0  # the seed of the figures
_CHUNK = 5  # seeds of a case that is over in seconds

Numbers = dict[tuple[str, str], float]
"""One seed's numbers, by who and metric."""


class Simulation(Protocol):
    """A simulation with a unique name: the seeds of its cases, and numbers on those of a case."""

    @property
    def name(self) -> str: ...  # noqa: D102

    def chunks(self, seeds: int) -> list[tuple[int, ...]]: ...  # noqa: D102

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult: ...  # noqa: D102


@dataclass(frozen=True)
class Analysis:
    """A computation without noise of sensors."""

    name: str
    function: Callable[[tuple[int, ...]], SimulationResult]  # of seeds, importable
    random: bool = True  # whether the seeds mean anything to it; else it is called once

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """Split the seeds into cases."""
        return split_seeds(seeds if self.random else 1, _CHUNK)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Call the function."""
        return self.function(seeds)


def rms(values: npt.ArrayLike) -> float:
    """Compute the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def collect_numbers(lines: list[Numbers]) -> dict[tuple[str, str], Array]:
    """Collect each number over the seeds, (seeds,), from the numbers of each seed."""
    return {name: np.array([line[name] for line in lines]) for name in lines[0]}


def join_results(chunks: list[SimulationResult]) -> SimulationResult:
    """Join the chunks of one simulation."""
    names = chunks[0].numbers
    numbers = {name: np.concatenate([chunk.numbers[name] for chunk in chunks]) for name in names}
    return SimulationResult(numbers, next((c.example for c in chunks if c.example), None))


_TUNED = {
    entry["estimator"]: {f"q_{state}": value for state, value in entry["q"].items()}
    for entry in read_tunings(Path(__file__).with_name("tunings.toml"))
}


def get_paper_tuning(name: str) -> Mapping[str, float]:
    """Get the options by which a filter is tuned for its paper's simulation; {}: the default."""
    return _TUNED.get(name, {})


@dataclass(frozen=True)
class PaperFilter:
    """A filter of a simulation."""

    label: str  # its name in tables
    name: str  # of `make_estimator`
    options: Mapping[str, Any] = field(default_factory=dict)  # of `make_estimator`
    vehicle: str = "nominal"  # or "true", for which it is built


def make_filters(filters: Sequence[PaperFilter], base: Any) -> dict[str, Estimator]:
    """Make filters by label, tuned for their papers, for the running episode of a base env."""
    cars, facts = {"nominal": base.nominal, "true": base.vehicle}, make_filter_arguments(base)
    by_label = {}
    for spec in filters:
        options = {**facts, "vehicle": cars[spec.vehicle]}
        options |= {**get_paper_tuning(spec.name), **spec.options}
        by_label[spec.label] = call_quietly(make_estimator, spec.name, **options)
    return by_label


@dataclass(frozen=True)
class EstimationSimulation:
    """Filters over the drives of a scenario, without control.

    Numbers of each filter: the RMSE of every state whose truth is known, from `SETTLED` on;
    "outage", that of beta while the GPS is out; "jump", the RMS change of beta in the milliseconds
    in which a packet arrives; "last", the mean of beta's error over the last second, its size.
    Raises ValueError for the bound of a car whose tyres change on the way.
    """

    name: str
    env_id: str
    scenario: str | Mapping[str, Any]
    filters: tuple[PaperFilter, ...]
    bound: bool = False  # whether to add "bound", the RMS of the optimal standard deviation of beta
    times: int = 1  # that many times the seeds, where a ratio is close to its threshold
    control_period: int = 10  # ticks between rows of the truth, interpolated in between

    def __post_init__(self) -> None:
        if self.bound and make_scenario(self.scenario).tyre_change_time is not None:
            raise ValueError(f"{self.name}: no bound is known where the tyres change on the way")

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """Split the seeds into cases."""
        return split_seeds(self.times * seeds, _CHUNK)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Drive each seed once and run every filter over its record."""
        options: dict[str, Any] = {"scenario": self.scenario, "control_period": self.control_period}
        env: gym.Env[Any, Any] = gym.make(self.env_id, **options)
        base: Any = env.unwrapped
        estimators: dict[str, Estimator] = {}
        lines, example = [], None
        for seed in seeds:
            drive = rollout(env, seed=seed)
            if drive.failed:
                raise RuntimeError(f"{self.name}: the car of seed {seed} failed without control")
            truth = drive.log.truth
            numbers: Numbers = {("truth", "beta"): _compute_settled_rms(truth["beta"], drive.log)}
            curves = {"truth": truth}
            estimators = estimators or make_filters(self.filters, base)
            for label, estimator in estimators.items():
                estimates = estimator.run(drive.log)
                curves[label] = {name: estimates[name] for name in estimates.names}
                numbers |= _compute_errors(label, curves[label], truth, drive.log, base.scenario)
            if self.bound:
                facts = make_filter_arguments(base) | {"vehicle": base.vehicle}
                std = compute_error_bound(record=drive.log.record, **facts)
                numbers["bound", "beta"] = _compute_settled_rms(std, drive.log)
            lines.append(numbers)
            if seed == FIRST:
                record = drive.log.record
                packets = {sensor: record.select_packets(sensor) for sensor in drive.log.slow}
                example = Example(drive.log.time, curves, packets)
        return SimulationResult(collect_numbers(lines), example)


def _compute_settled_rms(values: Array, log: Log) -> float:
    return rms(values[log.time >= SETTLED - 1e-9])


def _compute_errors(
    label: str, estimates: Mapping[str, Array], truth: Mapping[str, Array], log: Log, scenario: Any
) -> Numbers:
    errors = {name: estimates[name] - truth[name] for name in truth if name in estimates}
    numbers = {(label, name): _compute_settled_rms(error, log) for name, error in errors.items()}
    if "beta" not in estimates:
        return numbers
    t, beta = log.time, estimates["beta"]
    numbers[label, "last"] = float(abs(np.mean(errors["beta"][t >= t[-1] - 1.0])))
    arrived = log.record.packets[:, PACKET.arrived].astype(int) - log.record.first
    arrived = arrived[(arrived > 0) & (t[np.minimum(arrived, len(t) - 1)] >= SETTLED)]
    numbers[label, "jump"] = rms(beta[arrived] - beta[arrived - 1])
    if scenario.gps_outage is not None:
        start, end = scenario.gps_outage
        numbers[label, "outage"] = rms(errors["beta"][(t >= start) & (t < end)])
    return numbers
