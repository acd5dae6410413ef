"""Plausible ranges: what is there passes, a number in another unit is refused by its name."""

import dataclasses
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.envs import COMS, PASSENGER_CAR, SCENARIOS, VEHICLES, StabilityEnv, make_vehicle
from sideslip.envs.scenarios.scenario import Scenario
from sideslip.envs.validation import check_plausible
from sideslip.envs.vehicle.parameters import Vehicle

NAMES = "mass", "yaw_inertia", "front_arm", "rear_arm", "front_stiffness", "rear_stiffness"


def make_car(kind: str, *values: float) -> dict[str, float]:
    """A car by its stiffnesses per tyre or per axle."""
    keys = [name.replace("stiffness", f"stiffness_{kind}") for name in NAMES]
    return dict(zip(keys, values, strict=True))


CAR = make_car("per_tyre", *(getattr(PASSENGER_CAR, name) for name in NAMES))
MODEL = make_car("per_tyre", 0.041, 2.78e-5, 0.029, 0.033, 0.5, 0.5)  # at 1:43
LORRY = make_car("axle", 18e3, 1.3e5, 3.5, 2.3, 4e5, 8e5)


@pytest.mark.plain
@pytest.mark.parametrize("name", VEHICLES)
def test_every_vehicle_is_plausible(name: str) -> None:
    check_plausible(VEHICLES[name])


@pytest.mark.plain
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_is_plausible_with_its_cars(name: str) -> None:
    scenario = SCENARIOS[name]
    check_plausible(scenario)
    car = PASSENGER_CAR if scenario.tier.startswith("2") or name == "wet-evasion" else COMS
    for change in (scenario.vehicle, scenario.nominal):
        check_plausible(car.replace(**change))


@pytest.mark.plain
@pytest.mark.parametrize("car", [CAR, MODEL, LORRY, CAR | {"friction": 1.9}])
def test_small_and_large_cars_are_plausible(car: dict[str, Any]) -> None:
    assert make_vehicle(car).mass == car["mass"]


@pytest.mark.plain
@pytest.mark.parametrize("kind", [Vehicle, Scenario])
def test_every_number_has_a_unit_and_a_range_around_its_default(kind: Any) -> None:
    """But times and places that may stand for never and nowhere, and what is refused anyway."""
    without = {"name", "trace", "onset", "hold", "change_start", "wind_start",
               "wind_length", "disturbance_time", "curve_start", "curve_ramp", "half_width", "hdop",
               "hdop_time", "hdop_spread", "bank", "grade", "camera_loss", "camera_heading",
               "camera_offset", "camera_outage", "gps_outage"}  # fmt: skip
    for entry in dataclasses.fields(kind):
        words = (str, bool) if entry.default is not None else ()
        is_word = isinstance(entry.default, words) or "Mapping" in str(entry.type)
        if entry.name in without or is_word:
            continue
        low, high = entry.metadata["plausible"]
        assert entry.metadata["unit"] and entry.metadata["text"] and low < high
        if isinstance(entry.default, float):
            assert low <= entry.default <= high


VEHICLE_MISTAKES = [
    ({"mass": 1.5}, "front_stiffness: 55000.0 N/rad .* 4.5 to 900 for its mass"),  # t
    ({"mass": 1.5e6}, r"mass: 1500000.0 kg"),  # g
    ({"front_arm": 1200.0}, r"front_arm: 1200.0 m .* 0.01 to 10 \(is it in mm\?\)"),
    ({"front_arm": 120.0, "rear_arm": 150.0}, r"front_arm: 120.0 m .*\(is it in mm or cm\?\)"),
    ({"yaw_inertia": 2.4}, "yaw_inertia: 2.4 kg m2"),  # t m2
    ({"front_stiffness_per_tyre": 55.0}, r"front_stiffness: 55.0 N/rad.*for its mass .*kN/rad"),
    ({"rear_stiffness_axle": 120.0}, r"rear_stiffness: 60.0 N/rad .*kN/rad"),
    ({"rear_stiffness_per_tyre": 1047.0}, r"rear_stiffness: 1047.0 N/rad .*N/deg"),
    ({"front_track": 1550.0}, r"front_track: 1550.0 m .*mm"),
    ({"wheel_radius": 310.0}, r"wheel_radius: 310.0 m .*mm"),
    ({"gravity_height": 550.0}, r"gravity_height: 550.0 m .*mm"),
    ({"motor_lag": 5.0}, r"motor_lag: 5.0 s .*ms"),
    ({"steering_stop": 34.0}, r"steering_stop: 34.0 rad .*deg"),
    ({"steering_authority": 5.7}, r"steering_authority: 5.7 rad .*deg"),
    ({"steering_rate": 46.0}, r"steering_rate: 46.0 rad/s .*deg/s"),
    ({"preview": 5135.0}, r"preview: 5135.0 m .*mm"),
    ({"friction": 90.0}, r"friction: 90.0 is outside the plausible 0.02 to 2.5 \(is it in %\?\)"),
    ({"width": 1800.0}, r"width: 1800.0 m .*mm"),
    ({"antenna_ahead": -1200.0}, r"antenna_ahead: -1200.0 m .*mm"),
]


@pytest.mark.plain
@pytest.mark.parametrize(("change", "message"), VEHICLE_MISTAKES, ids=lambda each: str(each)[:30])
def test_a_parameter_in_another_unit_is_refused(change: dict[str, float], message: str) -> None:
    values = {name: value for name, value in CAR.items() if name.replace("per_tyre", "axle")
              not in change}  # fmt: skip
    source = values | change
    with pytest.raises(ValueError, match=rf"^Vehicle\.{message}.*; strict=False takes it$"):
        make_vehicle(source)
    loose = make_vehicle(source, strict=False)
    straight = {"base": "straight", "roll": False}
    for argument in ("vehicle", "nominal"):
        for given in (source, loose):
            arguments: dict[str, Any] = {"scenario": straight, argument: given}
            with pytest.raises(ValueError, match=message):
                StabilityEnv(**arguments)
            StabilityEnv(strict=False, **arguments)
    env = StabilityEnv(scenario=straight)
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0, options={"vehicle": source})


SCENARIO_MISTAKES = [
    ({"friction": 80.0}, r"friction: 80.0 is outside .*\(is it in %\?\)"),
    ({"friction_right": (20.0, 30.0)}, r"friction_right: 20.0 is .*%"),
    ({"speed": 300.0}, r"speed: 300.0 m/s .*\(is it in km/h\?\)"),
    ({"speed": (60.0, 150.0)}, r"speed: 150.0 m/s .*km/h"),
    ({"duration": 10_000.0}, r"duration: 10000.0 s .* 0 to 3600 .*ms"),
    ({"steering": "step", "amplitude": 5.0}, r"amplitude: 5.0 rad .*deg"),
    ({"initial_gamma": 30.0}, r"initial_gamma: 30.0 rad/s .*deg/s"),
    ({"front_stiffness": 6000.0}, "front_stiffness: 6000.0 is"),  # it is a factor
    ({"gps_latency": (100.0, 200.0)}, r"gps_latency: 100.0 s .*ms"),
    ({"camera_delays": (0.02, 15.0)}, r"camera_delays: 15.0 s .*ms"),
    ({"gps_period": 100.0}, r"gps_period: 100.0 s .*ms"),
    ({"gyro_bias": 1.0}, r"gyro_bias: 1.0 rad/s .*deg/s"),
    ({"curvature": 200.0}, "curvature: 200.0 1/m"),
    ({"driver_preview": 800.0}, r"driver_preview: 800.0 s .*ms"),
    ({"wind_arm": 200.0}, r"wind_arm: 200.0 m .*mm"),
]


@pytest.mark.parametrize(("change", "message"), SCENARIO_MISTAKES, ids=lambda each: str(each)[:30])
def test_a_field_in_another_unit_is_refused(change: dict[str, Any], message: str) -> None:
    scenario = {"base": "straight"} | change
    with pytest.raises(ValueError, match=rf"^Scenario\.{message}.*; strict=False takes it$"):
        gym.make("sideslip/YawFusion-v0", scenario=scenario)
    with pytest.raises(ValueError, match=message):
        gym.make_vec("sideslip/YawFusion-v0", 2, scenario=["straight", scenario])
    env = gym.make("sideslip/YawFusion-v0")
    with pytest.raises(ValueError, match=message):
        env.reset(options={"scenario": scenario})
    assert env.spec is not None and "strict" not in env.spec.kwargs
    if "delays" in message or "latency" in message:  # more packets under way than there is room for
        return
    loose = gym.make("sideslip/YawFusion-v0", scenario=scenario, strict=False)
    assert loose.spec is not None
    again = gym.make(gym.envs.registration.EnvSpec.from_json(loose.spec.to_json()))
    for each in (loose, again):
        each.reset(seed=0, options={"duration": 1e4})
        assert each.get_wrapper_attr("scenario").duration == 1e4


def test_options_of_reset_are_checked() -> None:
    env = StabilityEnv()
    for option, value in {"friction": 80.0, "duration": 1e4}.items():
        with pytest.raises(ValueError, match=f"^Scenario.{option}: {value:g}"):
            env.reset(options={option: value})


@pytest.mark.parametrize("width", [1, 2])
@pytest.mark.parametrize("count", [1, 3, 200])
def test_an_action_far_outside_is_clipped_with_one_warning(count: int, width: int) -> None:
    single = StabilityEnv(steering=width == 2)
    rows = gym.make_vec("sideslip/YawVision-v0", count, steering=width == 2)
    far, near = np.zeros((count, width), np.float32), np.full((count, width), 9.9, np.float32)
    far[-1, -1] = -500.0
    for env, large, small in ((single, far[-1], near[-1]), (rows, far, near)):
        env.reset(seed=0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env.step(small)
            env.step(np.ones_like(small))
        with pytest.warns(UserWarning, match="an action of 500 is clipped to 1"):
            env.step(large)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env.step(large)
            env.reset(seed=1)
            env.step(large)


def test_what_is_not_finite_is_refused_and_not_warned_of() -> None:
    env = StabilityEnv()
    env.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for value in (np.inf, -np.inf, np.nan):
            with pytest.raises(ValueError, match="is not finite"):
                env.step([value])
