"""Outside plants: what they share with ours, and the environment around them."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sideslip.agents import make_agent
from sideslip.agents.rollout import rollout
from sideslip.envs import FAILURES
from sideslip.envs.dynamics import Motion
from sideslip.envs.layout import Drive, Z
from sideslip.envs.linear import LinearModel, bicycle
from sideslip.estimators import EstimateObservation

from .helpers import SILENT

pytest.importorskip("vehiclemodels")
from sideslip.envs.outside import OUTSIDE_PLANTS, Acting, outside_vehicle
from sideslip.envs.outside_env import OutsideEnv

MODELS = tuple(OUTSIDE_PLANTS)
V = 80.0 / 3.6
CALM: dict[str, Any] = {
    "duration": 2.0,
    "speed": V,
    "friction": 1.0489,
    "disturbance_force": 0.0,
    "disturbance_moment": 0.0,
    "noise": SILENT,
}
STEP = CALM | {"steering": "step", "amplitude": 0.02}


def outside(model: str, **changes: Any) -> OutsideEnv:
    env = gym.make("sideslip/Outside-v0", model=model, **changes).unwrapped
    assert isinstance(env, OutsideEnv)
    return env


def driven(model: str, acting: Acting, seconds: float = 1.0, speed: float = V) -> Any:
    """The plant after so long of the same inputs from straight ahead at 80 km/h."""
    plant = OUTSIDE_PLANTS[model]()
    plant.start(Motion(speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    for _ in range(round(1e3 * seconds)):
        plant.step(acting, 1e-3)
    return plant


def test_the_single_track_is_the_bicycle_of_the_vehicle_that_is_told() -> None:
    acting = Acting(0.01, -60.0, 60.0)
    moment = 60.0 / outside_vehicle().motor_torque * outside_vehicle().yaw_moment_limit
    model = bicycle(outside_vehicle(), V)
    expected = model.discrete(0.2)[1] @ [0.01, moment]
    motion = driven("single-track", acting, 0.2).motion
    found = [np.arctan2(motion.v_y, motion.v_x), motion.gamma]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize("model", MODELS)
def test_near_straight_ahead_every_model_turns_like_that_bicycle(model: str) -> None:
    linear = bicycle(outside_vehicle(), V)
    steady = -np.linalg.solve(linear.A, linear.B)[1]
    calm = driven(model, Acting(0.0)).motion.gamma
    steered = driven(model, Acting(0.005)).motion.gamma - calm
    assert steered == pytest.approx(0.005 * steady[0], rel=0.05)
    torque = 0.1 * outside_vehicle().motor_torque
    moment = 0.1 * outside_vehicle().yaw_moment_limit
    turned = driven(model, Acting(0.0, -torque, torque)).motion.gamma - calm
    assert turned == pytest.approx(moment * steady[1], rel=0.05)


@pytest.mark.parametrize("model", MODELS)
def test_what_disturbs_the_car_acts_to_the_left_in_newtons(model: str) -> None:
    """F_y and N_z move the car as they do the bicycle, N_x leans the body that rolls.

    After 50 ms: left alone for longer, the multi-body car sways by 1 mrad. F_y moves its sprung
    mass first.
    """
    car = outside_vehicle()
    bare = bicycle(car, V)
    push = np.diag([1.0 / (car.mass * V), 1.0 / car.yaw_inertia])
    told = LinearModel(bare.A, push, bare.C, bare.states, ("F_y", "N_z"), ())
    expected = told.discrete(0.05)[1] @ np.diag([200.0, 200.0])
    calm = driven(model, Acting(0.0), 0.05).motion
    pushed = driven(model, Acting(0.0, F_y=200.0), 0.05).motion
    slip = (pushed.v_y - calm.v_y) / V
    assert slip == pytest.approx(expected[0, 0], rel=0.005 if model != "multi-body" else 0.12)
    turned = driven(model, Acting(0.0, N_z=200.0), 0.05).motion.gamma - calm.gamma
    assert turned == pytest.approx(expected[1, 1], rel=0.02)
    leaning = driven(model, Acting(0.0, N_x=1000.0)).motion.phi
    stiffness = car.roll_stiffness - 9.81 * car.roll_moment_arm
    steady = 1000.0 / stiffness if model == "multi-body" else 0.0
    assert leaning == pytest.approx(steady, rel=0.05)


@pytest.mark.parametrize("model", ["single-track", "drift"])
def test_at_walking_pace_and_below_a_car_rolls_steers_and_gathers_speed(model: str) -> None:
    car = outside_vehicle()
    for speed in (0.05, 0.5):
        rolling = driven(model, Acting(0.0), 0.1, speed).motion
        assert rolling.v_x == pytest.approx(speed, abs=0.02)  # the wheels settle by slip
        steered = driven(model, Acting(0.05), 0.1, speed).motion
        assert steered.psi == pytest.approx(0.05 / car.wheelbase * steered.X, rel=0.15)
        pulled = driven(model, Acting(0.0, 40.0, 40.0), 0.1, speed).motion
        expected = 0.1 * 80.0 / car.wheel_radius / car.mass
        assert pulled.v_x - rolling.v_x == pytest.approx(expected, rel=0.1)


def test_the_multi_body_model_is_not_driven_where_it_stands_still() -> None:
    """At 1 m/s it gathers speed as the others do; what comes down to less is refused."""
    pulled = driven("multi-body", Acting(0.0, 40.0, 40.0), 0.2, 1.0).motion
    expected = 0.2 * 80.0 / outside_vehicle().wheel_radius / outside_vehicle().mass
    assert pulled.v_x - 1.0 == pytest.approx(expected, rel=0.1)
    slow: list[dict[str, Any]] = [
        {"speed": (0.99, 20.0)},
        {"speed": 10.0, "speed_change": -9.5},
        {"speed": 10.0, "acceleration": -1.0, "duration": 9.5},
    ]
    for scenario in slow:
        with pytest.raises(
            ValueError, match=r"'custom': its speed comes down to 0.* needs 1.0 m/s"
        ):
            outside("multi-body", scenario=scenario)
        outside("drift", scenario=scenario)
    env = outside("multi-body", scenario=STEP | {"speed": 1.0})
    for options in ({"scenario": slow[0]}, {"scenario": slow[2] | {"duration": 1.0}}):
        with pytest.raises(ValueError, match="comes down to 0"):
            env.reset(options=options | {"duration": 9.5})
    for v_x in (0.9, -5.0):
        with pytest.raises(ValueError, match=f"v_x is {v_x} m/s; the multi-body model needs 1.0"):
            env.reset(options={"state": {"v_x": v_x}})
    env.reset(seed=0, options={"state": {"v_x": 1.0}})
    assert not env.step([0.0])[2]


def test_tyres_that_are_linear_know_no_friction() -> None:
    one, other = (OUTSIDE_PLANTS["single-track"](friction=mu) for mu in (0.3, 0.9))
    for plant in (one, other):
        plant.start(Motion(V, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        for _ in range(500):
            plant.step(Acting(0.04), 1e-3)
    np.testing.assert_allclose(one.x, other.x, rtol=1e-12)
    env = outside("single-track", scenario=STEP | {"friction": 0.3})
    env.reset(seed=0)
    assert env.vehicle.friction == 0.3
    with pytest.raises(ValueError, match="friction: the single-track model's tyres are linear"):
        env.reset(options={"friction": 0.5})
    outside("drift", scenario=STEP).reset(seed=0, options={"friction": 0.5})


@pytest.mark.parametrize(
    ("model", "field", "message"),
    [
        ("single-track", {"wind_height": 0.4}, "wind_height 0.4 rolls the body; the single-track"),
        ("drift", {"wind_height": -0.4}, "wind_height -0.4 rolls the body; the drift"),
        ("multi-body", {"roll": False}, "roll False; the multi-body model always rolls"),
    ],
)
def test_a_body_that_does_not_roll_or_always_does_is_not_told_otherwise(
    model: str, field: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        outside(model, scenario=CALM | field)
    allowed = {"wind_height": 0.4} if model == "multi-body" else {"roll": False}
    outside(model, scenario=CALM | allowed).reset(seed=0)


@pytest.mark.parametrize("model", MODELS)
def test_an_accelerometer_feels_the_rate_of_the_motion(model: str) -> None:
    acting = Acting(0.02, 40.0, 40.0)
    before, after = driven(model, acting, 0.299), driven(model, acting, 0.301)
    m, a, b = driven(model, acting, 0.3), before.motion, after.motion
    a_x = (b.v_x - a.v_x) / 2e-3 - m.motion.gamma * m.motion.v_y
    a_y = (b.v_y - a.v_y) / 2e-3 + m.motion.gamma * m.motion.v_x + 9.81 * np.sin(m.motion.phi)
    np.testing.assert_allclose(m.specific_force, [a_x, a_y], rtol=2e-3, atol=2e-3)


def test_the_multi_body_car_leans_out_of_the_curve_as_ours_does() -> None:
    """By M_s h_s a_y / (K_x - M_s g h_s) in steady state."""
    plant = driven("multi-body", Acting(0.01), 2.0)
    car, motion = outside_vehicle(), plant.motion
    a_y = motion.gamma * motion.v_x
    expected = car.roll_moment_arm * a_y / (car.roll_stiffness - 9.81 * car.roll_moment_arm)
    assert motion.phi > 0.0
    assert motion.phi == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("model", MODELS)
def test_a_derivative_leaves_the_state_alone(model: str) -> None:
    plant = driven(model, Acting(0.02), 0.1)
    plant.x[plant.wheels] = -1.0
    before = plant.x.copy()
    plant.derivative(plant.x, Acting(0.1, -50.0, 50.0))
    np.testing.assert_array_equal(plant.x, before)


@pytest.mark.parametrize("model", ["drift", "multi-body"])
def test_friction_is_what_the_tyres_can_hold(model: str) -> None:
    plant = OUTSIDE_PLANTS[model](friction=0.3)
    plant.start(Motion(V, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    pulled = []
    for _ in range(1500):
        plant.step(Acting(0.04), 1e-3)
        pulled.append(plant.specific_force[1] / 9.81 - plant.motion.phi)
    assert 0.27 < max(pulled) < 0.31


@pytest.mark.parametrize("model", MODELS)
def test_the_environment_keeps_gymnasiums_contract(model: str) -> None:
    env = outside(model, scenario=STEP | {"duration": 0.3})
    check_env(env, skip_render_check=True)


@pytest.mark.parametrize("model", MODELS)
def test_sensors_and_disturbances_draw_what_ours_draw(model: str) -> None:
    scenario = STEP | {"noise": {}, "duration": 0.2}
    scenario |= {"disturbance_force": 300.0, "disturbance_moment": 100.0}
    vehicle = outside_vehicle().to_dict()
    ours: Any = gym.make("sideslip/YawFusion-v0", scenario=scenario, vehicle=vehicle).unwrapped
    env = outside(model, scenario=scenario)
    errors, disturbances = [], []
    for each in (ours, env):
        each.reset(seed=5)
        for _ in range(10):
            each.step([0.0])
        errors.append(each.record.fast[-1, 0] - each.motion.gamma)
        drive = Drive(*each.get_state()["state"][Z.drive : Z.drive + len(Drive._fields)])
        disturbances.append((drive.F_d, drive.N_d))
        assert each.ticks_done == 10
    assert errors[0] == pytest.approx(errors[1], abs=1e-15)
    assert disturbances[0] == disturbances[1]
    assert 0.0 not in disturbances[0]
    assert ours.layout == env.layout


@pytest.mark.parametrize("model", MODELS)
def test_a_snapshot_continues_bit_for_bit(model: str) -> None:
    env = outside(model, scenario=STEP)
    env.reset(seed=1)
    env.step([0.3])
    snapshot = env.get_state()
    first = [env.step([0.5])[0] for _ in range(5)]
    env.reset(seed=2)
    env.set_state(snapshot)
    np.testing.assert_array_equal([env.step([0.5])[0] for _ in range(5)], first)


@pytest.mark.parametrize("model", MODELS)
def test_yaw_moment_acts_and_is_told(model: str) -> None:
    env = outside(model, scenario=CALM | {"lags": False})
    env.reset(seed=0)
    for _ in range(10):
        *_, info = env.step([0.5])
    assert info["yaw_moment"] == pytest.approx(0.5 * outside_vehicle().yaw_moment_limit, rel=1e-3)
    assert info["gamma"] > 0.01


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.long
def test_estimators_and_controllers_run_on_it(model: str) -> None:
    scenario = {"base": "lane-change", "speed": 20.0, "duration": 3.0, "front_stiffness": 1.0}
    scenario |= {"rear_stiffness": 1.0, "friction": 1.0, "amplitude": 0.03}
    env = EstimateObservation(outside(model, scenario=scenario), "exact-kf")
    drive = rollout(env, make_agent("two-dof", env), 3)
    assert not drive.failed
    error, slip = drive["obs_beta_hat"] - drive["beta"], np.sqrt(np.mean(drive["beta"] ** 2))
    assert slip > 2e-3  # rad
    assert np.sqrt(np.mean(error**2)) < 0.4 * slip  # the multi-body car's roll is not modelled


@pytest.mark.parametrize("model", MODELS)
def test_our_driver_keeps_it_on_a_track(model: str) -> None:
    track = CALM | {"steering": "driver", "path": "iso-3888-1", "speed": 12.0, "duration": 12.0}
    env = outside(model, scenario=track | {"half_width": 1.0})
    env.reset(seed=0)
    over, left = False, 0.0
    while not over:
        *_, terminated, over, _ = env.step([0.0])
        left = max(left, env.motion.Y)
        assert not terminated
    assert left > 3.0
    assert env.motion.X > 130.0


def test_a_spin_ends_the_episode_and_the_rest_is_charged() -> None:
    env = outside("drift", scenario=CALM)
    env.reset(seed=0, options={"state": {"v_y": -0.45 * V, "gamma": 2.0}})
    over, cost = False, 0.0
    while not over:
        _, reward, terminated, truncated, info = env.step([0.0])
        over, cost = terminated or truncated, cost - reward
    assert FAILURES[info["failure"]] == "spin"
    assert cost > 100.0 * (2.0 - info["t"]) > 0.0


@pytest.mark.parametrize("model", MODELS)
def test_a_state_that_is_no_number_ends_the_episode_with_numbers(model: str) -> None:
    env = outside(model, scenario=STEP)
    env.reset(seed=0)
    env.step([0.0])
    env.plant.x[3] = np.nan
    obs, reward, terminated, _, info = env.step([0.0])
    assert terminated
    assert FAILURES[info["failure"]] == "not-finite"
    assert np.isfinite([*obs, reward, *map(float, info.values())]).all()
    assert np.isfinite(env.record.fast).all()


@pytest.mark.parametrize(("place", "value"), [(3, 1e200), (5, -1e200), (3, 0.0), (6, math.inf)])
@pytest.mark.parametrize("model", MODELS)
def test_no_state_makes_a_step_raise(model: str, place: int, value: float) -> None:
    """What is set between ticks: squares that overflow, a car at rest in a turn, no angle."""
    env = outside(model, scenario=STEP)
    env.reset(seed=0)
    env.step([0.0])
    env.plant.x[5], env.plant.x[place] = 1.0, value
    obs, reward, terminated, _, info = env.step([0.0])
    if value != 0.0:
        assert terminated
        assert FAILURES[info["failure"]] == "not-finite"
    assert np.isfinite([*obs, reward, *map(float, info.values())]).all()
    assert np.isfinite(env.record.fast).all()


def test_a_state_whose_squares_are_no_numbers_is_not_finite() -> None:
    """As in our kernel: the references and sensors take them."""
    for model, places in (("drift", (3, 5)), ("multi-body", (3, 5, 10))):
        for place in places:
            plant = driven(model, Acting(0.0), 0.001)
            assert plant.finite
            plant.x[place] = 1e160
            assert not plant.finite


def test_a_force_that_cannot_be_told_makes_the_state_no_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The derivative at the end of a step is asked for by the accelerometers alone."""
    env = outside("multi-body", scenario=STEP)
    env.reset(seed=0)
    env.step([0.0])

    def nothing(acting: Acting) -> tuple[float, float]:
        raise ZeroDivisionError

    monkeypatch.setattr(env.plant, "felt", nothing)
    *_, info = env.step([0.0])
    assert FAILURES[info["failure"]] == "not-finite"
    assert np.isfinite(env.record.fast).all()


def test_a_wheel_at_rest_in_a_spin_makes_the_state_no_number() -> None:
    plant = driven("multi-body", Acting(0.0), 0.01)
    plant.x[3], plant.x[5] = 1.0, 2.0 / plant.p.T_r  # the inner rear wheel stands still
    plant.step(Acting(0.0), 1e-3)
    assert not plant.finite


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("curvature", 0.01),
        ("bank", 0.05),
        ("grade", 0.05),
        ("small_angle", True),
        ("linear_tyres", True),
        ("vehicle", {"mass": 1500.0}),
        ("friction_right", 0.3),
        ("tyre_change_time", 1.0),
    ],
)
def test_a_scenario_of_our_own_plant_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} .* is of our own plant"):
        outside("drift", scenario={field: value})
    env = outside("drift", scenario=STEP)
    with pytest.raises(ValueError, match=field):
        env.reset(options={"scenario": {field: value}})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vehicle": "coms"}, "its own vehicle"),
        ({"state": {"s": 1.0}}, "s follows from X and Y"),
        ({"state": {"phi": 0.1}}, "drift model has no roll"),
        ({"wheels": 3}, "unknown reset option wheels"),
    ],
)
def test_an_option_that_has_no_meaning_is_refused(options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        outside("drift", scenario=STEP).reset(options=options)


def test_unknown_models_and_vehicles_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown model 'brick'; known: single-track, drift"):
        outside("brick")
    with pytest.raises(TypeError, match="its own vehicle"):
        outside("drift", vehicle="coms")
    env, other = outside("drift", scenario=STEP), outside("single-track", scenario=STEP)
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(ValueError, match="'drift', not 'single-track'"):
        other.set_state(env.get_state())


def test_a_bad_action_is_refused_or_fails_as_in_every_environment() -> None:
    env = outside("drift", scenario=STEP)
    env.reset(seed=0)
    before = env.plant.x.copy()
    with pytest.raises(ValueError, match="not finite; nothing was stepped"):
        env.step([np.nan])
    np.testing.assert_array_equal(env.plant.x, before)
    env = outside("drift", scenario=STEP, on_bad_action="fail")
    env.reset(seed=0)
    assert FAILURES[env.step([np.nan])[4]["failure"]] == "bad-action"
