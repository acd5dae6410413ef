"""The papers' simulations: driven once a seed, and every number that claims need taken from them.

A simulation is data and gives the same `Measured` whatever it is: filters over one drive
(`Estimation`), controllers over the same lane (`Control`), or a computation without a car
(`Analysis`).
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import PACKET, Log
from ...envs.vehicle import Vehicle
from ...estimators import UnobservableWarning, make_estimator
from ...estimators.bound import bound
from .. import control
from .claim import Array, Example, Measured

SETTLED = 2.0  # s: errors count from here on
FIRST = 0  # the seed of the figures
_CHUNK = 5

Numbers = dict[tuple[str, str], float]


@dataclass(frozen=True)
class Filter:
    """label: its name in the ledger. name, options: of `make_estimator`. told: the "nominal"
    vehicle or the "truth"."""

    label: str
    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    told: str = "nominal"


@dataclass(frozen=True)
class Estimation:
    """Filters over the same uncontrolled drives.

    Numbers of each filter: the RMSE of every state whose truth is known, from `SETTLED` on;
    "outage", that of beta while the GPS is out; "jump", the RMS change of beta in the milliseconds
    in which a packet arrives; "last", the mean of beta's error over the last second, its size.
    bound: whether "bound" is wanted, the RMS of the optimal standard deviation. times: that many
    times the seeds, where a ratio is close to its threshold. control_period: ticks between rows of
    the truth; in between it is interpolated.
    """

    name: str
    env_id: str
    scenario: str | Mapping[str, Any]
    filters: tuple[Filter, ...]
    bound: bool = False
    times: int = 1
    control_period: int = 1

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return _chunks(range(self.times * seeds))

    def measure(self, seeds: tuple[int, ...]) -> Measured:
        """Drive each seed once and run every filter over its record."""
        env: gym.Env[Any, Any] = gym.make(
            self.env_id, scenario=self.scenario, control_period=self.control_period
        )
        base: Any = env.unwrapped
        estimators: dict[str, Any] = {}
        lines, example = [], None
        for seed in seeds:
            drive = rollout(env, seed=seed)
            truth = _truth(drive, base.vehicle, base.held_speed)
            told = {"nominal": base.nominal, "truth": base.vehicle}
            common = {"sensors": drive.log.slow, "dt": base.dt, "speed": base.held_speed}
            numbers: Numbers = {}
            curves = {"truth": truth}
            for each in self.filters:
                if each.label not in estimators:
                    estimators[each.label] = _built(each, told[each.told], common)
                estimates = estimators[each.label].run(drive.log)
                curves[each.label] = {name: estimates[name] for name in estimates.names}
                numbers |= _errors(each.label, curves[each.label], truth, drive.log, base.scenario)
            if self.bound:
                std = bound(base.vehicle, record=drive.log.record, **common)
                late = drive.log.time >= SETTLED - 1e-9
                numbers["bound", "beta"] = float(np.sqrt(np.mean(std[late] ** 2)))
            lines.append(numbers)
            if seed == FIRST:
                record = drive.log.record
                packets = {sensor: record.packets_of(sensor) for sensor in drive.log.slow}
                example = Example(drive.log.time, curves, packets)
        return Measured(_stacked(lines), example)


@dataclass(frozen=True)
class Control:
    """Contestants of the suite `control` on the same seeds of a scenario.

    Numbers of each: RMS and peak of the slip, the largest change of the yaw moment in a
    millisecond and the sum of all its changes.
    """

    name: str
    scenario: str
    contestants: tuple[str, ...]

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return [(seed,) for seed in range(seeds)]

    def measure(self, seeds: tuple[int, ...]) -> Measured:
        """Drive every contestant on each seed."""
        known = {contestant.label: contestant for contestant in control.CONTESTANTS}
        lines, example = [], None
        for seed in seeds:
            numbers: Numbers = {}
            curves: dict[str, dict[str, Array]] = {}
            time = np.zeros(0)
            for label in self.contestants:
                env = control.make_env(self.scenario, known[label])
                rate = known[label].rate
                agent = make_agent(known[label].agent, env, **({"rate": rate} if rate else {}))
                drive = rollout(env, agent, seed)
                time = drive["t"]
                curves[label] = {name: drive[name] for name in ("beta", "yaw_moment", "steer")}
                numbers |= _effort(label, drive["beta"], drive["yaw_moment"])
            lines.append(numbers)
            if seed == FIRST:
                example = Example(time, curves)
        return Measured(_stacked(lines), example)


@dataclass(frozen=True)
class Analysis:
    """A computation without noise of sensors. function: importable, from seeds to `Measured`.

    random: whether the seeds mean anything to it; else it is called once.
    """

    name: str
    function: Callable[[tuple[int, ...]], Measured]
    random: bool = True

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return _chunks(range(seeds if self.random else 1))

    def measure(self, seeds: tuple[int, ...]) -> Measured:
        """What the function gives."""
        return self.function(seeds)


Simulation = Estimation | Control | Analysis


def joined(chunks: list[Measured]) -> Measured:
    """The chunks of one simulation as one."""
    names = chunks[0].numbers
    numbers = {name: np.concatenate([chunk.numbers[name] for chunk in chunks]) for name in names}
    return Measured(numbers, next((c.example for c in chunks if c.example is not None), None))


def _chunks(seeds: range) -> list[tuple[int, ...]]:
    return [tuple(seeds[k : k + _CHUNK]) for k in range(0, len(seeds), _CHUNK)]


def _built(each: Filter, vehicle: Vehicle, common: Mapping[str, Any]) -> Any:
    with warnings.catch_warnings():  # what dakf cannot see is a claim of its own
        warnings.simplefilter("ignore", UnobservableWarning)
        return make_estimator(each.name, vehicle=vehicle, **common, **each.options)


def _truth(drive: Rollout, vehicle: Vehicle, speed: float | None) -> dict[str, Array]:
    """The truth of the log and, on a straight road at a held speed, the lateral offset y_l."""
    truth = dict(drive.log.truth)
    if speed is not None and "y_l" not in truth:
        drift = speed * (truth["psi"] + truth["beta"])  # tie-vision (5)
        steps = 0.5 * (drift[1:] + drift[:-1]) * drive.log.record.dt
        y_cg = np.concatenate([[0.0], np.cumsum(steps)])
        truth["y_l"] = y_cg + vehicle.preview * truth["psi"]  # tie-vision (4)
    return truth


def _errors(
    label: str, estimates: Mapping[str, Array], truth: Mapping[str, Array], log: Log, scenario: Any
) -> Numbers:
    t, beta = log.time, estimates["beta"]
    late = t >= SETTLED - 1e-9
    numbers = {
        (label, name): float(np.sqrt(np.mean((estimates[name] - truth[name])[late] ** 2)))
        for name in truth
        if name in estimates
    }
    error = beta - truth["beta"]
    numbers[label, "last"] = float(abs(np.mean(error[t >= t[-1] - 1.0])))
    arrived = log.record.packets[:, PACKET.arrived].astype(int) - log.record.first
    arrived = arrived[(arrived > 0) & (t[np.minimum(arrived, len(t) - 1)] >= SETTLED)]
    numbers[label, "jump"] = float(np.sqrt(np.mean((beta[arrived] - beta[arrived - 1]) ** 2)))
    if scenario.gps_outage is not None:
        start, end = scenario.gps_outage
        out = (t >= start) & (t < end)
        numbers[label, "outage"] = float(np.sqrt(np.mean(error[out] ** 2)))
    return numbers


def _effort(label: str, slip: Array, moment: Array) -> Numbers:
    change = np.abs(np.diff(moment))
    return {
        (label, "rms_slip"): float(np.sqrt(np.mean(slip**2))),
        (label, "peak_slip"): float(np.max(np.abs(slip))),
        (label, "largest_step"): float(np.max(change)),
        (label, "total_variation"): float(np.sum(change)),
    }


def _stacked(lines: list[Numbers]) -> dict[tuple[str, str], Array]:
    return {name: np.array([line[name] for line in lines]) for name in lines[0]}
