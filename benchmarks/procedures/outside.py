"""Outside plants: the check with CommonRoad's drift model, and episodes of our controllers.

The check (FMVSS 126 at 80 km/h, steering prescribed): without control the car fails at 5 A. With at
most 500 N m, by the yaw rate's error against a neutral car's within friction, it passes at 6.5 A.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...agents.rollout import rollout
from ...envs.numerics.functions import TICK
from ...envs.outside.plants import OUTSIDE_PLANTS, OutsideInputs, make_outside_vehicle
from ...envs.record import Array
from ...envs.scenarios import driver as profiles
from ...envs.scenarios.scenario import Scenario
from ...envs.scenarios.world import Draws
from ...envs.vehicle.dynamics import Motion
from ...envs.vehicle.parameters import GRAVITY
from . import fmvss126
from .drive import CALM, POSE, DriveFunction, Fields, ProcedureEntry, Series, TestCar

MODEL, _ENV_ID = "drift", "sideslip/Outside-v0"
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

_SPEED_GAIN = 10.0  # 1/s, of the speed that an outside plant's driver holds


def _compute_limited_moment(motion: Motion, steer: float) -> float:
    """Compute the law's yaw moment (N m) from the true motion and the steering angle."""
    car = make_outside_vehicle()
    max_yaw_rate = 0.85 * GRAVITY * car.friction / motion.v_x
    goal = min(max(motion.v_x * steer / car.wheelbase, -max_yaw_rate), max_yaw_rate)
    return float(min(max(_GAIN * (goal - motion.gamma), -_LIMIT), _LIMIT))


def _make_plant_drive(is_controlled: bool) -> DriveFunction:
    """Make drives of the plant alone, straight ahead at first, its steering prescribed."""

    def run_drive(fields: Fields) -> Series:
        scenario, plant = Scenario(**(CALM | dict(fields))), OUTSIDE_PLANTS[MODEL](None)
        profile, speed = _make_steering_profile(scenario), scenario.range("speed")[0]
        hold = scenario.acceleration is None  # a force keeps the speed; 0: the car coasts
        plant.start(Motion(speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        rows = [[0.0, 0.0, *plant.motion[:POSE]]]  # no steering begins at once
        for k in range(round(scenario.duration / TICK)):
            t, motion = k * TICK, plant.motion
            steer = float(profiles.compute_steering(t / TICK, profile))
            moment = _compute_limited_moment(motion, steer) if is_controlled else 0.0
            push = plant.p.m * plant.p.R_w * _SPEED_GAIN * (speed - motion.v_x) if hold else 0.0
            turn = plant.p.R_w / plant.p.T_r * moment
            plant.step(OutsideInputs(steer, 0.5 * push - turn, 0.5 * push + turn), TICK)
            if not plant.is_finite:
                break
            rows.append([(k + 1) * TICK, steer, *plant.motion[:POSE]])
        return replace(Series(*np.array(rows).T), failed=not plant.is_finite)

    return run_drive


def _make_steering_profile(scenario: Scenario) -> Array:
    """Make the numbers that `compute_steering` reads, of a scenario that draws none."""
    profile, kind = np.zeros(profiles.STEERING_WIDTH), scenario.steering
    draws = Draws(*scenario.get_draw_ranges()[0].tolist())
    profiles.write_steering(profiles.STEERING_KINDS.index(kind), draws, profile)
    return profile


def run_check() -> list[fmvss126.SineDwellResult]:
    """Drive the check without control and with the law, to both sides; A is the former's."""
    car = TestCar(make_outside_vehicle(), 80.0 / 3.6, 16.0, 4.508, 0.8)  # a BMW 320i
    none, law = map(_make_plant_drive, (False, True))
    A = fmvss126.measure_reference_angle(none, car)
    pairs = ((none, _FAILS_AT), (law, _PASSES_AT))
    return [fmvss126.run(drive, car, A, [multiple]) for drive, multiple in pairs]


def run_episodes(model: str, entry: ProcedureEntry, seeds: Sequence[int]) -> Array:
    """Run episodes: cost, 1 if failed, largest sideslip angle (rad) of each seed, shape (seeds, 3).

    Args:
        model: Name of the plant, of `OUTSIDE_PLANTS`.
        entry: Controller with its estimator.
        seeds: Seeds of the episodes.
    """
    options: dict[str, Any] = {"model": model, "scenario": _SCENARIO, "reference": "limited"}
    options |= {"steering": True, "sensors": "fusion"}
    env, agent = entry.make(model, _ENV_ID, **options)
    rollouts = [rollout(env, agent, seed) for seed in seeds]
    return np.array([[x.cost, x.failed, np.abs(x["beta"]).max()] for x in rollouts])
