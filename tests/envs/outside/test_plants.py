"""Outside plants: they turn, lean and feel like the vehicle that is told."""

import numpy as np
import pytest

from sideslip.envs.vehicle.dynamics import Motion
from sideslip.envs.vehicle.linear import LinearModel, make_bicycle_model

pytest.importorskip("vehiclemodels")
from sideslip.envs.outside.plants import OUTSIDE_PLANTS, OutsideInputs, make_outside_vehicle

from .cars import MODELS, STEP, V, driven, outside


def test_the_single_track_is_the_bicycle_of_the_vehicle_that_is_told() -> None:
    acting = OutsideInputs(0.01, -60.0, 60.0)
    moment = 60.0 / make_outside_vehicle().motor_torque * make_outside_vehicle().yaw_moment_limit
    model = make_bicycle_model(make_outside_vehicle(), V)
    expected = model.discretise(0.2)[1] @ [0.01, moment]
    motion = driven("single-track", acting, 0.2).motion
    found = [np.arctan2(motion.v_y, motion.v_x), motion.gamma]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize("model", MODELS)
def test_near_straight_ahead_every_model_turns_like_that_bicycle(model: str) -> None:
    linear = make_bicycle_model(make_outside_vehicle(), V)
    steady = -np.linalg.solve(linear.A, linear.B)[1]
    calm = driven(model, OutsideInputs(0.0)).motion.gamma
    steered = driven(model, OutsideInputs(0.005)).motion.gamma - calm
    assert steered == pytest.approx(0.005 * steady[0], rel=0.05)
    torque = 0.1 * make_outside_vehicle().motor_torque
    moment = 0.1 * make_outside_vehicle().yaw_moment_limit
    turned = driven(model, OutsideInputs(0.0, -torque, torque)).motion.gamma - calm
    assert turned == pytest.approx(moment * steady[1], rel=0.05)


@pytest.mark.parametrize("model", MODELS)
def test_what_disturbs_the_car_acts_to_the_left_in_newtons(model: str) -> None:
    """F_y and N_z move the car as they do the bicycle, N_x leans the body that rolls.

    After 50 ms: left alone for longer, the multi-body car sways by 1 mrad. F_y moves its sprung
    mass first.
    """
    car = make_outside_vehicle()
    bare = make_bicycle_model(car, V)
    push = np.diag([1.0 / (car.mass * V), 1.0 / car.yaw_inertia])
    told = LinearModel(bare.A, push, bare.C, bare.states, ("F_y", "N_z"), ())
    expected = told.discretise(0.05)[1] @ np.diag([200.0, 200.0])
    calm = driven(model, OutsideInputs(0.0), 0.05).motion
    pushed = driven(model, OutsideInputs(0.0, F_y=200.0), 0.05).motion
    slip = (pushed.v_y - calm.v_y) / V
    assert slip == pytest.approx(expected[0, 0], rel=0.005 if model != "multi-body" else 0.12)
    turned = driven(model, OutsideInputs(0.0, N_z=200.0), 0.05).motion.gamma - calm.gamma
    assert turned == pytest.approx(expected[1, 1], rel=0.02)
    leaning = driven(model, OutsideInputs(0.0, N_x=1000.0)).motion.phi
    stiffness = car.roll_stiffness - 9.81 * car.roll_moment_arm
    steady = 1000.0 / stiffness if model == "multi-body" else 0.0
    assert leaning == pytest.approx(steady, rel=0.05)


@pytest.mark.parametrize("model", ["single-track", "drift"])
def test_at_walking_pace_and_below_a_car_rolls_steers_and_gathers_speed(model: str) -> None:
    car = make_outside_vehicle()
    for speed in (0.05, 0.5):
        rolling = driven(model, OutsideInputs(0.0), 0.06, speed).motion
        assert rolling.v_x == pytest.approx(speed, abs=0.02)  # the wheels settle by slip
        steered = driven(model, OutsideInputs(0.05), 0.06, speed).motion
        assert steered.psi == pytest.approx(0.05 / car.wheelbase * steered.X, rel=0.15)
        pulled = driven(model, OutsideInputs(0.0, 40.0, 40.0), 0.06, speed).motion
        expected = 0.06 * 80.0 / car.wheel_radius / car.mass
        assert pulled.v_x - rolling.v_x == pytest.approx(expected, rel=0.1)


def test_the_multi_body_model_is_driven_from_1_m_s_on() -> None:
    """There it gathers speed as the others do."""
    pulled = driven("multi-body", OutsideInputs(0.0, 40.0, 40.0), 0.2, 1.0).motion
    expected = 0.2 * 80.0 / make_outside_vehicle().wheel_radius / make_outside_vehicle().mass
    assert pulled.v_x - 1.0 == pytest.approx(expected, rel=0.1)
    env = outside("multi-body", scenario=STEP | {"speed": 1.0})
    env.reset(seed=0, options={"state": {"v_x": 1.0}})
    assert not env.step([0.0])[2]


def test_tyres_that_are_linear_know_no_friction() -> None:
    one, other = (OUTSIDE_PLANTS["single-track"](friction=mu) for mu in (0.3, 0.9))
    for plant in (one, other):
        plant.start(Motion(V, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        for _ in range(500):
            plant.step(OutsideInputs(0.04), 1e-3)
    np.testing.assert_allclose(one.x, other.x, rtol=1e-12)
    env = outside("single-track", scenario=STEP | {"friction": 0.3})
    env.reset(seed=0)
    assert env.vehicle.friction == 0.3


@pytest.mark.parametrize("model", MODELS)
def test_an_accelerometer_feels_the_rate_of_the_motion(model: str) -> None:
    acting = OutsideInputs(0.02, 40.0, 40.0)
    before, after = driven(model, acting, 0.299), driven(model, acting, 0.301)
    m, a, b = driven(model, acting, 0.3), before.motion, after.motion
    a_x = (b.v_x - a.v_x) / 2e-3 - m.motion.gamma * m.motion.v_y
    a_y = (b.v_y - a.v_y) / 2e-3 + m.motion.gamma * m.motion.v_x + 9.81 * np.sin(m.motion.phi)
    np.testing.assert_allclose(m.specific_force, [a_x, a_y], rtol=2e-3, atol=2e-3)


def test_the_multi_body_car_leans_out_of_the_curve_as_ours_does() -> None:
    """By M_s h_s a_y / (K_x - M_s g h_s) in steady state."""
    plant = driven("multi-body", OutsideInputs(0.01), 2.0)
    car, motion = make_outside_vehicle(), plant.motion
    a_y = motion.gamma * motion.v_x
    expected = car.roll_moment_arm * a_y / (car.roll_stiffness - 9.81 * car.roll_moment_arm)
    assert motion.phi > 0.0
    assert motion.phi == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("model", MODELS)
def test_a_derivative_leaves_the_state_alone(model: str) -> None:
    plant = driven(model, OutsideInputs(0.02), 0.1)
    plant.x[plant.wheels] = -1.0
    before = plant.x.copy()
    plant._compute_derivative(plant.x, OutsideInputs(0.1, -50.0, 50.0))
    np.testing.assert_array_equal(plant.x, before)


@pytest.mark.parametrize("model", ["drift", "multi-body"])
def test_friction_is_what_the_tyres_can_hold(model: str) -> None:
    plant = OUTSIDE_PLANTS[model](friction=0.3)
    plant.start(Motion(V, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    pulled = []
    for _ in range(1500):
        plant.step(OutsideInputs(0.04), 1e-3)
        pulled.append(plant.specific_force[1] / 9.81 - plant.motion.phi)
    assert 0.27 < max(pulled) < 0.31
