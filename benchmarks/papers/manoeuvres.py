"""Filters and controllers over the papers' manoeuvres."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import PACKET, Array, Log
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.scenarios.scenario import Scenario
from ...estimators.analysis.limits import compute_error_bound
from ..harness.drives import SETTLED, make_env, make_filter_arguments
from . import ledger
from .ledger import Example, Numbers, Outcomes, PaperFilter, Simulation

if TYPE_CHECKING:
    from ...estimators.estimator import Estimator


@dataclass(frozen=True)
class EstimationSimulation(Simulation):
    """Filters over the drives of a scenario, without control.

    Numbers of each filter: the RMSE of every state whose truth is known, from `SETTLED` on;
    "outage", that of beta while the GPS is out; "jump", the RMS change of beta in the milliseconds
    in which a packet arrives; "last", the mean of beta's error over the last second, its size.
    """

    env_id: str
    scenario: str | Mapping[str, Any]
    filters: tuple[PaperFilter, ...]
    bound: bool = False  # whether to add "bound", the RMS of the optimal standard deviation of beta
    control_period: int = 10  # ticks between rows of the truth, interpolated in between

    def _run(self, seeds: tuple[int, ...]) -> Outcomes:
        env = gym.make(self.env_id, scenario=self.scenario, control_period=self.control_period)
        base: Any = env.unwrapped
        estimators: dict[str, Estimator] = {}
        for seed in seeds:
            drive = rollout(env, seed=seed)
            if drive.failed:
                raise RuntimeError(f"{self.name}: the car of seed {seed} failed without control")
            log, truth = drive.log, drive.log.truth
            numbers: Numbers = {("truth", "beta"): _compute_settled_rms(truth["beta"], log)}
            curves = {"truth": truth}
            estimators = estimators or ledger.make_filters(self.filters, base)
            for label, estimator in estimators.items():
                estimates = estimator.run(log)
                curves[label] = {name: estimates[name] for name in estimates.names}
                numbers |= _compute_errors(label, curves[label], log, base.scenario)
            if self.bound:
                facts = make_filter_arguments(base) | {"vehicle": base.vehicle}
                std = compute_error_bound(record=log.record, **facts)
                numbers["bound", "beta"] = _compute_settled_rms(std, log)
            yield numbers, Example(log.time, curves)


def _rms(values: npt.ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _compute_settled_rms(values: Array, log: Log) -> float:
    return _rms(values[log.time >= SETTLED - 1e-9])


def _compute_errors(
    label: str, estimates: Mapping[str, Array], log: Log, scenario: Scenario
) -> Numbers:
    truth = log.truth
    errors = {name: estimates[name] - truth[name] for name in truth if name in estimates}
    numbers: Numbers = {(label, x): _compute_settled_rms(y, log) for x, y in errors.items()}
    if "beta" not in estimates:
        return numbers
    t, beta = log.time, estimates["beta"]
    numbers[label, "last"] = float(abs(np.mean(errors["beta"][t >= t[-1] - 1.0])))
    arrived = log.record.packets[:, PACKET.arrived].astype(int) - log.record.first
    arrived = arrived[(arrived > 0) & (t[np.minimum(arrived, len(t) - 1)] >= SETTLED)]
    numbers[label, "jump"] = _rms(beta[arrived] - beta[arrived - 1])
    if scenario.gps_outage is not None:
        start, end = scenario.gps_outage
        numbers[label, "outage"] = _rms(errors["beta"][(t >= start) & (t < end)])
    return numbers


_ENTRIES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "none": ("none", "", {}),
    "feedforward": ("feedforward", "", {}),
    "single-rate": ("two-dof", "single-rate-kf", {"rate": "camera"}),
    "multirate": ("two-dof", "multirate-kf", {"rate": "control"}),
    "multirate-residual": ("two-dof", "multirate-residual-kf", {"rate": "control"}),
}
"""tie-vision Fig. 8, by label: agent, the estimator it reads ("" for none) and its options."""
_NOISE = {"camera_psi": "psi_noise", "camera_y": "y_l_noise"}


@dataclass(frozen=True)
class _AgentSimulation(Simulation):
    """Controllers on each seed; `_run_episode` gives the numbers of one."""

    size: ClassVar[int] = 2
    scenario: str | Mapping[str, Any]
    entries: Sequence[str] | Mapping[str, Mapping[str, Any]]  # labels

    def _run(self, seeds: tuple[int, ...]) -> Outcomes:
        for seed in seeds:
            numbers: Numbers = {}
            curves: dict[str, dict[str, Array]] = {}
            for label in self.entries:
                episode, values = self._run_episode(label, seed)
                if episode.failed:  # fewer ticks are no better drive
                    raise RuntimeError(f"{label}: the car of seed {seed} failed")
                numbers |= {(label, name): value for name, value in values.items()}
                curves[label] = {name: episode[name] for name in ("beta", "gamma", "yaw_moment")}
            curves["reference"] = {name: episode[f"{name}_ref"] for name in ("beta", "gamma")}
            yield numbers, Example(episode["t"], curves)

    def _run_episode(self, label: str, seed: int) -> tuple[Rollout, dict[str, float]]:
        raise NotImplementedError


@dataclass(frozen=True)
class SlipSimulation(_AgentSimulation):
    """tie-vision's controllers on a lane change, each with a filter that knows the camera's noise.

    Entries are those of `_ENTRIES`, or have a remark behind a comma. Numbers of each: RMS
    and peak of the slip, the largest change of the yaw moment in 1 ms, the sum of all its changes
    and the fraction of time at its limit.
    """

    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # more ones of the agent

    def _run_episode(self, label: str, seed: int) -> tuple[Rollout, dict[str, float]]:
        agent, estimator, options = _ENTRIES[label.partition(",")[0]]
        noise = make_scenario(self.scenario).noise
        known = {option: noise[name] for name, option in _NOISE.items() if name in noise}
        how: dict[str, Any] = {"scenario": self.scenario, "control_period": 1}
        env = make_env("sideslip/YawVision-v0", estimator, {"options": known}, **how)
        more = self.options.get(label, {})
        drive = rollout(env, make_agent(agent, env, **{**options, **more}), seed)
        base: Any = env.unwrapped
        slip, moment, limit = drive["beta"], drive["yaw_moment"], base.vehicle.yaw_moment_limit
        change = np.abs(np.diff(moment))
        return drive, {
            "rms_slip": _rms(slip),
            "peak_slip": float(np.max(np.abs(slip))),
            "largest_step": float(np.max(change)),
            "total_variation": float(np.sum(change)),
            "saturation": float(np.mean(np.abs(moment) >= 0.999 * limit)),
        }


@dataclass(frozen=True)
class FollowingSimulation(_AgentSimulation):
    """dakf-stability's controller by wire on the GPS, with and without parts of it.

    Entries are options of the controller by label, "agent" another controller, at 1 ms. Numbers of
    each: RMS errors of slip and yaw rate, peak of the slip, and the fraction of ticks that command
    the whole yaw moment.
    """

    entries: Mapping[str, Mapping[str, Any]]

    def _run_episode(self, label: str, seed: int) -> tuple[Rollout, dict[str, float]]:
        options = {"agent": "model-following", **self.entries[label]}
        tuned = {"slow": "gps"} | ledger.PAPER_TUNINGS["dakf"]
        estimate = {"outputs": ("beta", "gamma", "d1", "d2"), "options": tuned}
        how: dict[str, Any] = {"scenario": self.scenario, "control_period": 1}
        env = make_env("sideslip/AfsYawFusion-v0", "dakf", estimate, **how)
        drive = rollout(env, make_agent(options.pop("agent"), env, **options), seed)
        return drive, {
            "rms_beta": _rms(drive["beta"] - drive["beta_ref"]),
            "rms_gamma": _rms(drive["gamma"] - drive["gamma_ref"]),
            "peak_beta": float(np.abs(drive["beta"]).max()),
            "saturated": float(np.mean(np.abs(drive["action_0"]) >= 1.0)),
        }
