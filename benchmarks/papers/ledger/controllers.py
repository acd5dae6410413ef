"""Controllers over the same manoeuvre, and what they leave of the slip."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ....agents import make_agent
from ....agents.rollout import Rollout, rollout
from ....envs.record import Array
from ....envs.scenarios.manoeuvres import make_scenario
from ...harness.drives import make_env
from ...harness.parallel import split_seeds
from . import tracking
from .claim import Example, SimulationResult
from .simulations import FIRST, Numbers, collect_numbers, rms

SIGNALS = ("beta", "gamma", "steer", "yaw_moment")
CONTESTANTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "none": ("none", "", {}),
    "feedforward": ("feedforward", "", {}),
    "single-rate": ("two-dof", "single-rate-kf", {"rate": "camera"}),
    "multirate": ("two-dof", "multirate-kf", {"rate": "control"}),
    "multirate-residual": ("two-dof", "multirate-residual-kf", {"rate": "control"}),
}
"""tie-vision Fig. 8: agent, the estimator it reads ("" for none) and its options, by label."""
_NOISE = {"camera_psi": "psi_noise", "camera_y": "y_l_noise"}


@dataclass(frozen=True)
class SlipSimulation:
    """tie-vision's controllers on the same seeds of a lane change, each with a filter that knows
    the camera's noise.

    contestants: of `CONTESTANTS`, or with a remark behind a comma. options: more options of the
    agent, by contestant.
    Numbers of each: RMS and peak of the slip, the largest change of the yaw moment in a
    millisecond, the sum of all its changes and the share of time at its limit.
    """

    name: str
    scenario: str
    contestants: tuple[str, ...]
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """The seeds of each case."""
        return split_seeds(seeds, 2)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Drive every contestant on each seed."""
        return _measure_agents(seeds, self.contestants, self._run_episode)

    def _run_episode(self, label: str, seed: int) -> tuple[Rollout, dict[str, float]]:
        agent, estimator, options = CONTESTANTS[label.partition(",")[0]]
        noise = make_scenario(self.scenario).noise
        known = {option: noise[name] for name, option in _NOISE.items() if name in noise}
        how: dict[str, Any] = {"scenario": self.scenario, "control_period": 1}
        env = make_env("sideslip/YawVision-v0", estimator, {"options": known}, **how)
        more = self.options.get(label, {})
        drive = rollout(env, make_agent(agent, env, **{**options, **more}), seed)
        base: Any = env.unwrapped
        return drive, _compute_effort(
            drive["beta"], drive["yaw_moment"], base.vehicle.yaw_moment_limit
        )


def _compute_effort(slip: Array, moment: Array, limit: float) -> dict[str, float]:
    change = np.abs(np.diff(moment))
    return {
        "rms_slip": rms(slip),
        "peak_slip": float(np.max(np.abs(slip))),
        "largest_step": float(np.max(change)),
        "total_variation": float(np.sum(change)),
        "saturation": float(np.mean(np.abs(moment) >= 0.999 * limit)),
    }


def _measure_agents(
    seeds: tuple[int, ...],
    labels: Iterable[str],
    drive: Callable[[str, int], tuple[Rollout, dict[str, float]]],
) -> SimulationResult:
    """The numbers of every contestant on each seed, and the signals of the first seed."""
    lines, example = [], None
    for seed in seeds:
        numbers: Numbers = {}
        curves: dict[str, dict[str, Array]] = {}
        for label in labels:
            episode, values = drive(label, seed)
            if episode.failed:  # fewer ticks are no better drive
                raise RuntimeError(f"{label}: the car of seed {seed} failed")
            numbers |= {(label, name): value for name, value in values.items()}
            curves[label] = {name: episode[name] for name in SIGNALS}
        lines.append(numbers)
        if seed == FIRST:
            curves["reference"] = {name: episode[f"{name}_ref"] for name in ("beta", "gamma")}
            example = Example(episode["t"], curves)
    return SimulationResult(collect_numbers(lines), example)


@dataclass(frozen=True)
class FollowingSimulation:
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
        return split_seeds(max(1, round(self.share * seeds)), 2)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Drive every agent on each seed."""
        return _measure_agents(seeds, self.agents, self._run_episode)

    def _run_episode(self, label: str, seed: int) -> tuple[Rollout, dict[str, float]]:
        drive = tracking.run_episode(seed, self.scenario, **self.agents[label])
        values = vars(tracking.measure_tracking(drive))
        return drive, {name: float(value) for name, value in values.items()}
