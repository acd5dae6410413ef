"""The options of a reset, and the arguments of the constructor, each by its effect."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.envs import COMS, PASSENGER_CAR, SCENARIOS, Scenario, StabilityEnv
from sideslip.envs.record import FAST

from .helpers import FULL, LINEAR, bits, play

pytestmark = pytest.mark.plain


@pytest.fixture
def env() -> StabilityEnv:
    return StabilityEnv()


def test_scenario_is_that_episodes_only(env: StabilityEnv) -> None:
    assert env.scenario.name == "random-steering"
    env.reset(seed=0, options={"scenario": "tie-vision-fig8-stiff"})
    assert env.scenario is SCENARIOS["tie-vision-fig8-stiff"]
    assert env.vehicle.front_stiffness == 7200.0
    assert env.held_speed == 25.0 / 3.6
    assert len(play(env, [0.0] * 1000)) == 500
    env.reset(seed=0)
    assert env.scenario.name == "random-steering"
    assert env.held_speed is None
    fresh = StabilityEnv()
    fresh.reset(seed=0)
    assert bits(play(env, [0.1] * 20)) == bits(play(fresh, [0.1] * 20))


def test_an_option_gives_what_the_argument_gives(env: StabilityEnv) -> None:
    for name, value in (("scenario", "slalom"), ("vehicle", "passenger-car")):
        arguments: dict[str, Any] = {name: value}
        built = StabilityEnv(**arguments, nominal="coms")
        start = bits(built.reset(seed=1))
        assert bits(env.reset(seed=1, options={name: value})) == start
        assert bits(play(env, [0.3] * 30)) == bits(play(built, [0.3] * 30))


def test_vehicle_is_the_true_one_and_leaves_the_nominal_alone(env: StabilityEnv) -> None:
    env.reset(seed=0, options={"vehicle": {"base": "coms", "mass": 450.0}})
    assert env.vehicle.mass == 450.0
    assert env.nominal == COMS
    env.reset(seed=0, options={"vehicle": "passenger-car"})
    (moment,) = play(env, [1.0])
    # full scale is the vehicle's own; the lags leave exp(-10 / 5) of it
    assert moment.info["yaw_moment"] > 0.8 * PASSENGER_CAR.yaw_moment_limit
    env.reset(seed=0)
    assert env.vehicle.mass == 380.0


def test_friction_is_exact_and_drawn_otherwise(env: StabilityEnv) -> None:
    env.reset(seed=0, options={"friction": 0.3})
    assert env.vehicle.friction == 0.3
    stiffness = env.vehicle.front_stiffness
    env.reset(seed=0)
    assert 0.7 <= env.vehicle.friction <= 1.0
    assert env.vehicle.front_stiffness == stiffness  # the other draws stay


def test_low_friction_limits_the_lateral_force() -> None:
    env = StabilityEnv(scenario=FULL | {"steering": "sine", "amplitude": 0.3, "frequency": 0.3})
    most = {}
    for friction in (0.2, 0.9):
        env.reset(seed=0, options={"friction": friction})
        rows = np.concatenate([moment.record.fast for moment in play(env, [0.0] * 300)])
        most[friction] = np.abs(rows[:, FAST.accel_y]).max()
    assert most[0.2] <= 0.2 * 9.81 * (1.0 + 1e-3) < most[0.9]  # a mean over 1 ms in turning axes


def test_state_sets_what_it_names_and_leaves_the_defaults() -> None:
    env = StabilityEnv("gps", scenario=LINEAR)
    state = {"v_x": 9.0, "v_y": 0.3, "gamma": 0.1, "psi": 0.2, "X": 5.0, "Y": -4.0, "y": 2.0}
    _, info = env.reset(seed=0, options={"state": state})
    assert (info["gamma"], info["psi"]) == (0.1, 0.2)
    assert info["beta"] == 0.3 / 9.0
    assert env.record.packets[0, 7:9].tolist() == [5.0, -4.0]
    _, info = env.reset(seed=0, options={"state": {"gamma": 0.1}})
    assert (info["gamma"], info["psi"], info["beta"]) == (0.1, 0.0, 0.0)
    assert env.record.fast[0, FAST.wheel_left] == 25.0 / 3.6 - 0.42 * 0.1
    _, info = env.reset(seed=0)
    assert info["gamma"] == 0.0


def test_state_may_start_on_a_bend() -> None:
    bend = LINEAR | {"curvature": 0.01, "curve_start": 0.0, "curve_ramp": 10.0}
    env = StabilityEnv(scenario=bend, camera={"delays": [0.0]})
    env.reset(seed=0, options={"state": {"s": 50.0, "theta": 0.45, "psi": 0.5, "y": 1.0}})
    psi, y_l = env.record.packets[0, 5:7]
    assert psi == pytest.approx(0.05, abs=1e-15)
    expected = 1.0 + 5.135 * 0.05 - 0.01 * 5.135**2 / 2.0  # tie-vision (4) with curvature
    assert y_l == pytest.approx(expected, abs=1e-14)


def test_duration_is_in_seconds(env: StabilityEnv) -> None:
    for duration, steps in ((0.5, 50), (0.101, 11), (0.0101, 1)):
        env.reset(seed=0, options={"duration": duration})
        moments = play(env, [0.0] * 100)
        assert (len(moments), moments[-1].truncated) == (steps, True)
    env.reset(seed=0, options={"duration": 100.0})
    assert not play(env, [0.0] * 1001)[-1].truncated


def test_options_combine(env: StabilityEnv) -> None:
    options = {"scenario": "straight", "duration": 0.2, "friction": 0.4, "state": {"y": 49.99}}
    env.reset(seed=0, options=options)
    assert env.vehicle.friction == 0.4
    assert len(play(env, [0.0] * 100)) <= 20
    assert options["state"] == {"y": 49.99}  # the caller's mapping is not emptied


def test_nominal_is_what_the_references_use() -> None:
    turning = LINEAR | {"steering": "sine", "amplitude": 0.05}
    seen = []
    for nominal in (None, "coms", COMS.scale_stiffness(1.5, 1.0)):
        env = StabilityEnv(scenario=turning, nominal=nominal, reference="model")
        env.reset(seed=0)
        seen.append(play(env, [0.0] * 100)[-1].info)
    assert seen[0] == seen[1]
    assert seen[2]["gamma_ref"] != seen[0]["gamma_ref"]
    assert seen[2]["gamma"] == seen[0]["gamma"]


def test_annotations_are_for_drawing_and_end_with_the_episode(env: StabilityEnv) -> None:
    env.reset(seed=0)
    env.annotate("mine", 0.1, 0.02)
    env.annotate("mine", 0.2, 0.01)
    env.annotate("another", 0.3, 0.01)
    assert env.annotations == {"mine": (0.2, 0.01), "another": (0.3, 0.01)}
    env.reset()
    assert env.annotations == {}


def test_before_the_first_reset_the_env_can_be_asked(env: StabilityEnv) -> None:
    assert env.vehicle == env.nominal == COMS
    assert env.scenario.name == "random-steering"
    assert env.dt == 0.001
    assert list(env.slow_sensors) == ["camera"]
    assert len(env.record.fast) == len(env.record.packets) == 0


def test_a_car_that_starts_at_another_speed_holds_none() -> None:
    """Estimators are told a speed only where it is really held from the start."""
    env = StabilityEnv(scenario="tie-vision-fig7")
    env.reset(seed=0)
    assert env.held_speed == pytest.approx(25 / 3.6)
    env.reset(seed=0, options={"state": {"v_x": 5.0}})
    assert env.held_speed is None
    env.reset(seed=0)
    assert env.held_speed == pytest.approx(25 / 3.6)


def test_what_was_passed_in_may_change_afterwards() -> None:
    camera, car = {"period": 0.05}, {"mass": 400.0}
    scenario = Scenario(name="mine", vehicle=car)
    env: Any = gym.make("sideslip/YawVision-v0", scenario=scenario, camera=camera).unwrapped
    camera["period"], car["mass"] = 0.1, 800.0
    env.reset(seed=1, options={"friction": 0.8})
    assert env.slow_sensors["camera"].period == 0.05 and env.vehicle.mass == 400.0


def test_a_scored_scenario_keeps_what_a_car_states_itself() -> None:
    car = {"base": "passenger-car", "motor_power": 80000.0, "transfer_height": 0.25}
    for vehicle, power, height in ((car, 80000.0, 0.25), ("coms", 2000.0, 0.45)):
        env: Any = gym.make("sideslip/YawFusion-v1", scenario="coms-slalom", vehicle=vehicle)
        env.reset(seed=0)
        for told in (env.unwrapped.vehicle, env.unwrapped.nominal):
            assert (told.motor_power, told.transfer_height) == (power, height)
