"""Filters over the same uncontrolled drives, and how far off they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ....agents.rollout import rollout
from ....envs.record import PACKET, Array, Log
from ....envs.scenarios.manoeuvres import make_scenario
from ....estimators.analysis.bound import compute_error_bound
from ....estimators.design.tunings import read_tunings
from ....estimators.estimator import Estimator
from ....estimators.make import make_estimator
from ...harness.drives import SETTLED, call_quietly, make_filter_arguments
from ...harness.parallel import split_seeds
from .claim import Example, SimulationResult
from .simulations import CHUNK, FIRST, Numbers, collect_numbers, rms

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
