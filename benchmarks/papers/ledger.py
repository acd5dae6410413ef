"""The means to measure claims: simulations, filters, controllers, plots, the verdicts' rule.

A claim of a paper, and the rule that turns what was measured into a verdict.

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

A simulation of the ledger: seeds in cases, and the numbers that they give.

A simulation is data and gives the same `SimulationResult` whatever it is: filters over one drive
(`filters`), controllers over the same manoeuvre (`controllers`), or a computation without a car
(`Analysis`).

Filters over the same uncontrolled drives, and how far off they are.
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
from ..harness.parallel import split_seeds
from ..harness.study import SETTLED, call_quietly, make_filter_arguments


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


_TUNED = {
    entry["estimator"]: {f"q_{state}": value for state, value in entry["q"].items()}
    for entry in read_tunings(Path(__file__).with_name("tunings.toml"))
}


def get_paper_tuning(name: str) -> Mapping[str, float]:
    """Options of `make_estimator` by which a filter is tuned for its paper's own simulation; none
    for one whose default tuning is that."""
    return _TUNED.get(name, {})


@dataclass(frozen=True)
class PaperFilter:
    """label: its name in tables. name, options: of `make_estimator`. vehicle: the "nominal" one or
    the "true" one, for which it is built."""

    label: str
    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    vehicle: str = "nominal"


def make_filters(filters: Sequence[PaperFilter], base: Any) -> dict[str, Estimator]:
    """The filters by label, tuned for their papers and built for the running episode of an env."""
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
    bound: whether to add "bound", the RMS of the optimal standard deviation of beta. times: that
    many times the seeds, where a ratio is close to its threshold. control_period: ticks between
    rows of the truth; in between it is interpolated.

    Raises ValueError for the bound of a car whose tyres change on the way.
    """

    name: str
    env_id: str
    scenario: str | Mapping[str, Any]
    filters: tuple[PaperFilter, ...]
    bound: bool = False
    times: int = 1
    control_period: int = 10

    def __post_init__(self) -> None:
        if self.bound and make_scenario(self.scenario).tyre_change_time is not None:
            raise ValueError(f"{self.name}: no bound is known where the tyres change on the way")

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return split_seeds(self.times * seeds, CHUNK)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Drive each seed once and run every filter over its record."""
        env: gym.Env[Any, Any] = gym.make(
            self.env_id, scenario=self.scenario, control_period=self.control_period
        )
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
                std = compute_error_bound(
                    record=drive.log.record,
                    **make_filter_arguments(base) | {"vehicle": base.vehicle},
                )
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
