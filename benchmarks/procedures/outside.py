"""Outside plants: the check with CommonRoad's drift model, and episodes of our controllers.

The check (FMVSS 126 at 80 km/h, steering angle prescribed): without control the car fails at 5 A;
with a yaw moment of at most 500 N m it passes at 6.5 A. The law is a saturating feedback of the
true yaw rate's error against a neutral car's within the friction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ...agents import make_agent
from ...agents.rollout import rollout
from ...envs.outside.plants import make_outside_vehicle
from ...envs.vehicle.dynamics import Motion
from ...envs.vehicle.parameters import GRAVITY
from ..harness.drives import make_env
from . import fmvss126
from .drive import OUTSIDE_ID, ProcedureEntry, make_outside_car, make_plant_drive

MODEL = "drift"
_LIMIT = 500.0  # N m
_GAIN = 2e4  # N m s/rad
_FAILS_AT, _PASSES_AT = 5.0, 6.5  # of A

_SCENARIO: dict[str, Any] = {
    "name": "outside-lane-change", "steering": "lane-change", "duration": 5.0, "mirror": True,
    "onset": (0.5, 1.0), "amplitude": (0.03, 0.08), "frequency": (0.4, 0.7),
    "speed": (60.0 / 3.6, 90.0 / 3.6), "front_stiffness": (0.8, 1.2),
    "rear_stiffness": (0.8, 1.2), "friction": (0.7, 1.0),
}  # fmt: skip
"""A lane change within what the outside car was made for, drawn by the seed."""


def _compute_limited_moment(motion: Motion, steer: float) -> float:
    """Compute the check's yaw moment (N m)."""
    car = make_outside_vehicle()
    max_yaw_rate = 0.85 * GRAVITY * car.friction / motion.v_x
    goal = min(max(motion.v_x * steer / car.wheelbase, -max_yaw_rate), max_yaw_rate)
    return float(min(max(_GAIN * (goal - motion.gamma), -_LIMIT), _LIMIT))


@dataclass(frozen=True)
class OutsideCheck:
    """Both halves of the check, each steered to both sides."""

    none: fmvss126.SineDwellResult
    law: fmvss126.SineDwellResult

    @property
    def reproduced(self) -> bool:
        """Whether no control fails at 5 A and the law passes at 6.5 A."""
        return not any(run.passed for run in self.none.runs) and self.law.passed


def run_check() -> OutsideCheck:
    """Drive the check; A is the uncontrolled car's."""
    car, none = make_outside_car(), make_plant_drive(MODEL)
    law = make_plant_drive(MODEL, _compute_limited_moment)
    A = fmvss126.measure_reference_angle(none, car)
    pairs = ((none, _FAILS_AT), (law, _PASSES_AT))
    return OutsideCheck(*(fmvss126.run(drive, car, A, [multiple]) for drive, multiple in pairs))


@dataclass(frozen=True)
class OutsideEpisode:
    """An episode of one seed."""

    cost: float
    failed: bool
    peak: float  # rad, of the sideslip angle


def run_episodes(model: str, entry: ProcedureEntry, seeds: Sequence[int]) -> list[OutsideEpisode]:
    """Run the episodes of a controller on an outside plant.

    Args:
        model: Name of the plant, of `OUTSIDE_PLANTS`.
        entry: Controller with its estimator.
        seeds: Seeds of the episodes.

    Returns:
        Episodes in the order of their seeds.
    """
    options: dict[str, Any] = {"model": model, "scenario": _SCENARIO, "reference": "limited"}
    agent_name, estimator, estimate = entry.get_configuration(model)
    env = make_env(OUTSIDE_ID, estimator, estimate, **options)
    agent = make_agent(agent_name, env)
    rollouts = [rollout(env, agent, seed) for seed in seeds]
    return [OutsideEpisode(d.cost, d.failed, float(abs(d["beta"]).max())) for d in rollouts]
