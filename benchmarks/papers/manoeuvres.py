"""Filters and controllers over the papers' manoeuvres."""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import PACKET, Array, Log
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.scenarios.scenario import Scenario
from ...estimators.analysis.limits import compute_error_bound
from ...estimators.design.options import read_tunings
from ...estimators.estimator import Estimator
from ...estimators.make import make_estimator
from ...estimators.wrappers.estimate import make_spec
from ..harness.drives import SETTLED, call_quietly, make_env, make_filter_arguments
from .ledger import Numbers, SeedResult, Simulation

if TYPE_CHECKING:
    from ...envs.stability import StabilityEnv

BOUND = "the bound"
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
    nominal, made = make_spec(base), dict[str, Estimator]()
    specs = {"nominal": nominal, "true": nominal.replace_vehicle(base.vehicle)}
    for x in filters:
        facts = specs[x.vehicle]._asdict() | PAPER_TUNINGS.get(x.name, {}) | dict(x.options)
        made[x.label] = call_quietly(make_estimator, x.name, dt=base.dt, **facts)
    return made


@dataclass(frozen=True)
class EstimationSimulation(Simulation):
    """Filters over the drives of a scenario that draws no car, without control.

    Numbers of each filter: the RMSE of every state whose truth is known, from `SETTLED` on, and
    "square", the mean square of beta's error (rad2); "outage", beta's RMSE while the GPS is out;
    "jump", the RMS change of beta in the milliseconds in which a packet arrives; "last", the mean
    of beta's error over the last second, its size; "us_per_tick" of CPU time.
    """

    env_id: str
    scenario: str | Mapping[str, Any]
    filters: Sequence[PaperFilter]
    bound: bool = False  # whether to add `BOUND`, whose error is beta's optimal standard deviation
    control_period: int = 10  # ticks between rows of the truth, interpolated in between

    def make_env(self) -> gym.Env[Any, Any]:
        """Make the env in which all seeds are driven."""
        return gym.make(self.env_id, scenario=self.scenario, control_period=self.control_period)

    def run(self, seeds: Iterable[int]) -> Iterator[SeedResult]:
        """Drive, and run the filters; RuntimeError where a car fails."""
        env = self.make_env()
        base: Any = env.unwrapped
        estimators: dict[str, Estimator] = {}
        for seed in seeds:
            drive = rollout(env, seed=seed)
            if drive.failed:
                raise RuntimeError(f"{self.name}: the car of seed {seed} failed without control")
            log, truth = drive.log, drive.log.truth
            settled = log.time >= SETTLED - 1e-9
            numbers: Numbers = {("truth", "beta"): _rms(truth["beta"][settled])}
            curves = {"truth": truth}
            if not estimators:
                estimators = make_filters(self.filters, base)
                for estimator in estimators.values():
                    estimator.run(log)  # gains are designed, and kernels loaded, at the first use
            for label, estimator in estimators.items():
                start = time.process_time()
                estimates = estimator.run(log)
                numbers[label, "us_per_tick"] = (time.process_time() - start) / len(settled) * 1e6
                curves[label] = {name: estimates[name] for name in estimates.names}
                numbers |= _compute_errors(label, curves[label], log, base.scenario)
            if self.bound:
                facts = make_filter_arguments(base) | {"vehicle": base.vehicle}
                std = compute_error_bound(record=log.record, **facts)
                numbers[BOUND, "beta"] = _rms(std[settled])
                numbers[BOUND, "square"] = float(np.mean(std[settled] ** 2))
            yield SeedResult(numbers, log.time, curves)


def _rms(values: npt.ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _compute_errors(
    label: str, estimates: Mapping[str, Array], log: Log, scenario: Scenario
) -> Numbers:
    truth = log.truth
    errors = {name: estimates[name] - truth[name] for name in truth if name in estimates}
    t, settled = log.time, log.time >= SETTLED - 1e-9
    numbers: Numbers = {(label, x): _rms(y[settled]) for x, y in errors.items()}
    if "beta" not in estimates:
        return numbers
    beta = estimates["beta"]
    numbers[label, "square"] = float(np.mean(errors["beta"][settled] ** 2))
    numbers[label, "last"] = float(abs(np.mean(errors["beta"][t >= t[-1] - 1.0])))
    arrived = log.record.packets[:, PACKET.arrived].astype(int) - log.record.first
    arrived = arrived[(arrived > 0) & (t[np.minimum(arrived, len(t) - 1)] >= SETTLED)]
    numbers[label, "jump"] = _rms(beta[arrived] - beta[arrived - 1])
    if scenario.gps_outage is not None:
        start, end = scenario.gps_outage
        numbers[label, "outage"] = _rms(errors["beta"][(t >= start) & (t < end)])
    return numbers


_NOISE = {"camera_psi": "psi_noise", "camera_y": "y_l_noise"}  # a scenario's, and an option


class Driver(NamedTuple):
    """A controller of a simulation."""

    agent: str  # name of `make_agent`
    estimator: str = ""  # that it reads, "" for none
    options: Mapping[str, Any] = {}  # of the agent


@dataclass(frozen=True)
class ControlSimulation(Simulation):
    """Controllers at 1 ms over the drives of a scenario; their filters know the camera's noise,
    unless `estimate` has options.

    Numbers of each: RMS of the slip, and of slip's and yaw rate's errors; peak of the slip; of the
    yaw moment the largest change in 1 ms, the sum of all changes, and the fractions of time at
    its limit and with a command of all of it.
    """

    env_id: str
    scenario: str | Mapping[str, Any]
    drivers: Mapping[str, Driver]  # by label
    estimate: Mapping[str, Any] = field(default_factory=dict)  # to `EstimateObservation`

    def run(self, seeds: Iterable[int]) -> Iterator[SeedResult]:
        """Let every controller drive; RuntimeError where a car fails."""
        for seed in seeds:
            numbers: Numbers = {}
            curves: dict[str, dict[str, Array]] = {}
            for label in self.drivers:
                episode, values = self.drive(label, seed)
                if episode.failed:  # fewer ticks are no better drive
                    raise RuntimeError(f"{label}: the car of seed {seed} failed")
                numbers |= {(label, name): value for name, value in values.items()}
                curves[label] = {name: episode[name] for name in ("beta", "gamma", "yaw_moment")}
            curves["reference"] = {name: episode[f"{name}_ref"] for name in ("beta", "gamma")}
            yield SeedResult(numbers, episode["t"], curves)

    def drive(self, label: str, seed: int) -> tuple[Rollout, dict[str, float]]:
        """Drive an episode, and measure its numbers by quantity.

        Args:
            label: Label of the controller.
            seed: Seed of the reset.
        """
        agent, estimator, options = self.drivers[label]
        noise = make_scenario(self.scenario).noise
        known = {option: noise[name] for name, option in _NOISE.items() if name in noise}
        how: dict[str, Any] = {"scenario": self.scenario, "control_period": 1}
        env = make_env(self.env_id, estimator, {"options": known} | dict(self.estimate), **how)
        drive = rollout(env, make_agent(agent, env, **options), seed)
        base: Any = env.unwrapped
        slip, moment, limit = drive["beta"], drive["yaw_moment"], base.vehicle.yaw_moment_limit
        change = np.abs(np.diff(moment))
        command = next(x for name, x in drive.columns.items() if name.startswith("action"))
        return drive, {
            "rms_slip": _rms(slip),
            "rms_slip_error": _rms(slip - drive["beta_ref"]),
            "rms_yaw_error": _rms(drive["gamma"] - drive["gamma_ref"]),
            "peak_slip": float(np.max(np.abs(slip))),
            "largest_step": float(np.max(change)),
            "total_variation": float(np.sum(change)),
            "saturation": float(np.mean(np.abs(moment) >= 0.999 * limit)),
            "full_command": float(np.mean(np.abs(command) >= 1.0)),
        }
