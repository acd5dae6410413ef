"""What no controller can be built with, or on, is refused, and the message says why."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.controllers.lqr import Lqr
from sideslip.agents.design.sampled_model import DesignSpec, make_design_model
from sideslip.envs import COMS, PASSENGER_CAR
from sideslip.envs.task import MODEL
from sideslip.estimators import EstimateObservation

YAW, AFS = "sideslip/YawFusion-v0", "sideslip/AfsYawFusion-v0"
VISION = "sideslip/YawVision-v0"
RATES, LANE = ["beta", "gamma", "d1", "d2"], ["beta", "gamma", "psi", "y_l"]
ENVS: dict[str, Callable[[], Any]] = {
    "bare": lambda: gym.make(YAW),
    "slip": lambda: EstimateObservation(gym.make(VISION), "bicycle-kf"),
    "steered": lambda: EstimateObservation(gym.make(AFS), "exact-kf"),
    "no rates": lambda: EstimateObservation(gym.make(AFS), "course-kf", outputs=["beta"]),
    "rates": lambda: EstimateObservation(gym.make(AFS), "dakf", outputs=RATES),
    "unsteered": lambda: EstimateObservation(gym.make("sideslip/YawGps-v0"), "dakf", outputs=RATES),
    "unsteered lane": lambda: EstimateObservation(gym.make(VISION), "multirate-kf", outputs=LANE),
}
Refusal = tuple[str, str, dict[str, Any], str]
VALUES: list[Refusal] = [
    ("esc", "slip", {"bandwidth": 0.0}, "is a positive number"),
    ("esc", "slip", {"slip": -1.0}, "is a positive number"),
    ("esc", "slip", {"band": -0.1}, "band is a number of zero or more"),
    *(
        ("sliding-mode", "slip", {name: 0.0}, f"{name} is a positive number")
        for name in ("pole", "rate", "layer")
    ),
    ("sliding-mode", "bare", {}, r"beta_hat.*EstimateObservation"),
    ("model-following", "no rates", {}, r"needs d1_hat, d2_hat .*EstimateObservation"),
    ("model-following", "unsteered", {}, "action steers"),
    *(
        ("model-following", "rates", {"bandwidth": wrong}, "two positive numbers")
        for wrong in ((5.0,), (5.0, 0.0), (5.0, np.inf), (np.nan, 5.0), (1.0, 2.0, 3.0))
    ),
    ("lane-keeping", "unsteered lane", {}, "action steers"),
    ("lane-keeping", "slip", {}, r"psi_hat, y_l_hat.*EstimateObservation"),
    ("lqr", "bare", {}, r"beta_hat.*EstimateObservation"),
    ("lqr", "steered", {"disturbance_time": 0.0}, "disturbance_time is a positive number"),
    ("lqr", "steered", {"stiffness": ["a"]}, "names two entries or none"),
    ("lqr", "steered", {"knots": 1}, "knots is at least 2, got 1"),
    *(("lqr", "steered", {"grip": x}, "grip is a positive number") for x in (0.0, -1.0, np.nan)),
    ("adaptive-lqr", "steered", {}, "AdaptiveLqr needs front_tyres_hat, rear_tyres_hat"),
    *(
        (name, "slip", {option: wrong}, f"{option} is (at least 1|a number of)")
        for name, option in (("mpc", "horizon"), ("mpc", "iterations"), ("nmpc", "iterations"))
        for wrong in (0, 2.5, True)
    ),
    ("nmpc", "slip", {"horizon": -1.0}, "horizon is a positive number"),
    ("two-dof", "bare", {}, r"beta_hat.*EstimateObservation"),
    ("two-dof", "slip", {"feedforward": "none"}, "unknown feedforward 'none'"),
    ("two-dof", "slip", {"rate": "fast"}, "unknown rate 'fast'; known: control, camera"),
    ("two-dof", "slip", {"pole": -1.0}, "pole is a positive number"),
    ("lqr", "slip", {"vehicle": "lorry"}, "lorry"),
    ("pid", "slip", {}, "unknown agent 'pid'"),
    ("nmpc", "slip", {"horizn": 0.4}, "unknown option 'horizn'; did you mean 'horizon'"),
    ("lqr", "slip", {"weight": 3.0}, "weight"),
    ("two-dof", "slip", {"speed": 3.0}, "speed"),
]


@pytest.mark.parametrize(
    ("name", "env", "options", "message"), VALUES, ids=[f"{x[0]} {x[1]} {x[2]}" for x in VALUES]
)
def test_what_no_controller_can_be_built_with_is_refused(
    name: str, env: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        make_agent(name, ENVS[env](), **options)


def test_a_vehicle_of_the_design_is_named_as_everywhere() -> None:
    cars = "passenger-car", PASSENGER_CAR
    named, stated = (make_agent("lqr", ENVS["slip"](), vehicle=car) for car in cars)
    assert isinstance(named, Lqr) and isinstance(stated, Lqr)
    assert named.vehicle == stated.vehicle == PASSENGER_CAR
    with pytest.raises(TypeError, match="disturbance_time is a number, got 'x'"):
        make_agent("lqr", ENVS["slip"](), disturbance_time="x")


def test_a_car_at_rest_has_no_design() -> None:
    with pytest.raises(ValueError, match="positive speed"):
        make_design_model(COMS, 0.0, DesignSpec(10, COMS.yaw_moment_limit, True, MODEL, "forces"))
