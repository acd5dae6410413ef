"""Controllers over the same manoeuvre, and what they leave of the slip."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ....agents import make_agent
from ....agents.rollout import rollout
from ...harness.parallel import chunked
from . import lane_change, tracking
from .claim import Array, Example, Measured
from .simulations import FIRST, Numbers, rms, stacked

SIGNALS = ("beta", "gamma", "steer", "yaw_moment")


@dataclass(frozen=True)
class Slip:
    """Contestants of `lane_change` on the same seeds of a scenario.

    contestants: of `lane_change.CONTESTANTS`. options: more options of the agent, by contestant.
    Numbers of each: RMS and peak of the slip, the largest change of the yaw moment in a
    millisecond, the sum of all its changes and the share of time at its limit.
    """

    name: str
    scenario: str
    contestants: tuple[str, ...]
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return chunked(seeds, 2)

    def measure(self, seeds: tuple[int, ...]) -> Measured:
        """Drive every contestant on each seed."""
        lines, example = [], None
        for seed in seeds:
            numbers: Numbers = {}
            curves: dict[str, dict[str, Array]] = {}
            time = np.zeros(0)
            for label in self.contestants:
                time, curves[label], limit = self._drive(label, seed)
                numbers |= _effort(label, curves[label]["beta"], curves[label]["yaw_moment"], limit)
            lines.append(numbers)
            if seed == FIRST:
                example = Example(time, curves)
        return Measured(stacked(lines), example)

    def _drive(self, label: str, seed: int) -> tuple[Array, dict[str, Array], float]:
        """Times, signals, and the yaw moment's limit in N m."""
        known = {contestant.label: contestant for contestant in lane_change.CONTESTANTS}
        contestant = known[label.partition(",")[0]]
        env = lane_change.make_env(self.scenario, contestant)
        options: dict[str, Any] = dict(self.options.get(label, {}))
        if contestant.rate:
            options["rate"] = contestant.rate
        drive = rollout(env, make_agent(contestant.agent, env, **options), seed)
        base: Any = env.unwrapped
        return drive["t"], {name: drive[name] for name in SIGNALS}, base.vehicle.yaw_moment_limit


def _effort(label: str, slip: Array, moment: Array, limit: float) -> Numbers:
    change = np.abs(np.diff(moment))
    return {
        (label, "rms_slip"): rms(slip),
        (label, "peak_slip"): float(np.max(np.abs(slip))),
        (label, "largest_step"): float(np.max(change)),
        (label, "total_variation"): float(np.sum(change)),
        (label, "saturation"): float(np.mean(np.abs(moment) >= 0.999 * limit)),
    }


@dataclass(frozen=True)
class Following:
    """dakf-stability's controller by wire, with and without parts of it.

    agents: options of `tracking.drive` by label. share: of the seeds that are driven. Numbers of
    each: those of `tracking.Tracking`.
    """

    name: str
    scenario: str | Mapping[str, Any]
    agents: Mapping[str, Mapping[str, Any]]
    share: float = 1.0

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return chunked(max(1, round(self.share * seeds)), 2)

    def measure(self, seeds: tuple[int, ...]) -> Measured:
        """Drive every agent on each seed."""
        lines, example = [], None
        for seed in seeds:
            numbers: Numbers = {}
            curves: dict[str, dict[str, Array]] = {}
            time = np.zeros(0)
            for label, options in self.agents.items():
                drive = tracking.drive(seed, self.scenario, **options)
                found = tracking.tracking(drive)
                numbers |= {(label, name): float(value) for name, value in vars(found).items()}
                time = drive["t"]
                curves[label] = {name: drive[name] for name in SIGNALS}
                curves["reference"] = {name: drive[f"{name}_ref"] for name in ("beta", "gamma")}
            lines.append(numbers)
            if seed == FIRST:
                example = Example(time, curves)
        return Measured(stacked(lines), example)
