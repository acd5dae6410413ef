"""The compiled model is the vehicle's, exactly discretised, at every speed and step."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from sideslip.envs.engine.config import make_car
from sideslip.envs.numerics.jit import as_python
from sideslip.envs.record import FAST
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.vehicle.actuators import compute_yaw_moment
from sideslip.envs.vehicle.linear import make_course_model, make_vision_model
from sideslip.envs.vehicle.parameters import COMS, PASSENGER_CAR
from sideslip.estimators import make_estimator
from sideslip.estimators.core.model import build_model, discretise
from sideslip.estimators.design.assemble import _make_signals
from tests.envs.vehicle.test_linear import make_velocity_roll_model
from tests.estimators.filters.literal import car
from tests.estimators.simulation import CAMERA, GPS

STEPS = (0.001, 0.01, 0.033, 0.1, 0.2)


def model_of(name: Any, vehicle: Any, speed: Any, step: Any, sensors: Any) -> Any:
    """G (dense, n) and H of a filter whose step is the given one."""
    filter_ = make_estimator(name, vehicle=vehicle, sensors=sensors, speed=speed)
    f = filter_.filters[0]
    f.step = step
    discretise(f)
    return f.G[: f.dense, : f.n].copy(), f.H[: f.dense, :2].copy()


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("speed", [1.5, 5.0, 12.5, 60.0])
@pytest.mark.parametrize("vehicle", [COMS, PASSENGER_CAR], ids=["coms", "passenger-car"])
def test_discretisation_is_the_exact_zero_order_hold(vehicle: Any, speed: Any, step: Any) -> None:
    G, H = model_of("multirate-kf", vehicle, speed, step, {"camera": CAMERA})
    exact_G, exact_H = make_vision_model(vehicle, speed).discretise(step)
    assert np.abs(G - exact_G).max() < 1e-12 * max(1.0, np.abs(exact_G).max())
    assert np.abs(H - exact_H[:, :2]).max() < 1e-12 * np.abs(exact_H).max()


def test_below_walking_pace_the_model_stays() -> None:
    G, _ = model_of("multirate-kf", COMS, 0.0, 0.001, {"camera": CAMERA})
    np.testing.assert_allclose(G, make_vision_model(COMS, 1.5).discretise(0.001)[0], atol=1e-13)


def test_dakf_is_the_papers_discrete_model() -> None:
    """dakf-stability (5)-(17), written out."""
    V, T_c = 25.0 / 3.6, 0.001
    stiff = COMS.replace(front_stiffness=10000.0, rear_stiffness=10000.0)
    assert (COMS.mass, COMS.yaw_inertia, COMS.front_arm, COMS.rear_arm) == (380, 136.08, 0.8, 0.6)
    A, B = car(V, stiff)
    A_n, B_n = A[:3, :3], B[:3]  # (10), (11)
    D_n = np.array([[1.0, 0], [0, 1], [0, 0]])  # (7)
    grid = (np.arange(50) + 0.5) * T_c / 50
    integral = sum(expm(A_n * t) for t in grid) * T_c / 50  # (13)
    A_nd, B_nd, D_nd = expm(A_n * T_c), integral @ B_n, integral @ D_n
    with pytest.warns(UserWarning, match="cannot see"):
        filter_ = make_estimator("dakf", vehicle=stiff, sensors={"gps": GPS}, speed=V)
    f = filter_.filters[0]
    np.testing.assert_allclose(f.G[:3, :5], np.hstack([A_nd, D_nd]), atol=1e-9)
    np.testing.assert_allclose(f.H[:3, :2], B_nd, atol=1e-9)
    np.testing.assert_array_equal(f.decay[3:5], [1.0, 1.0])  # (14): a random walk
    np.testing.assert_array_equal(f.C_fast[0, :5], [0, 1, 0, 0, 0])  # (19)
    np.testing.assert_array_equal(f.C[1, 0, :5], [1, 0, 1, 0, 0])
    assert filter_.names == ("beta", "gamma", "psi", "d1", "d2")


def rank(A: Any, C: Any) -> Any:
    rows = [C]
    for _ in range(len(A) - 1):
        rows.append(rows[-1] @ A)
    return np.linalg.matrix_rank(np.vstack(rows), tol=1e-9)


def test_dakf_sees_four_of_five_directions() -> None:
    """The paper's IV.D claims five."""
    V = 25.0 / 3.6
    model = make_course_model(COMS, V)
    A = np.zeros((5, 5))
    A[:3, :3] = model.A
    A[0, 3] = A[1, 4] = 1.0
    C = np.hstack([model.C, np.zeros((2, 2))])
    assert rank(A, C) == 4
    assert rank(model.A, model.C) == 3
    with pytest.warns(UserWarning, match="cannot see"):
        (named,) = make_estimator("dakf", sensors={"gps": GPS}, speed=V).unobservable
    parts = dict(part.split() for part in named.split(", "))
    direction = np.array([float(parts.get(s, 0.0)) for s in ("beta", "gamma", "psi", "d1", "d2")])
    assert direction[0] == 1.0 and direction[2] == -1.0
    assert np.abs(C @ direction).max() < 1e-9
    assert np.abs(A @ direction).max() < 2e-3 * np.abs(direction).max()  # four digits are printed


def test_vision_sees_everything() -> None:
    model = make_vision_model(COMS, 25.0 / 3.6)
    assert rank(model.A, model.C) == 4
    assert rank(model.A, model.C[1:]) == 4  # from vision alone
    assert make_estimator("multirate-kf", sensors={"camera": CAMERA}, speed=7.0).unobservable == ()


def test_the_course_noise_grows_as_one_over_speed() -> None:
    def sd(**options: Any) -> Any:
        filter_ = make_estimator("course-kf", sensors={"gps": GPS}, **options)
        return math.degrees(math.sqrt(filter_.filters[0].r[1, 0]))

    assert sd(speed=60.0 / 3.6) == pytest.approx(0.14)
    assert sd(speed=25.0 / 3.6) == pytest.approx(0.336)
    assert sd(speed=25.0 / 3.6, course_noise=math.radians(0.5)) == pytest.approx(0.5)


def test_process_noise_means_the_same_at_every_tick() -> None:
    fine = make_estimator("bicycle-kf", speed=7.0, q_beta=1e-3)
    coarse = make_estimator("bicycle-kf", speed=7.0, q_beta=1e-3, dt=0.01)
    single = make_estimator(
        "single-rate-kf", speed=7.0, q_beta=1e-3, sensors={"camera": SlowSensor(0.033, (0.03,))}
    )
    assert fine.filters[0].Q[0, 0] == pytest.approx(1e-6)
    assert coarse.filters[0].Q[0, 0] == pytest.approx(1e-5)
    assert single.filters[0].Q[0, 0] == pytest.approx(33e-6)


@pytest.mark.parametrize("vehicle", [COMS, PASSENGER_CAR], ids=["coms", "passenger-car"])
def test_the_yaw_moment_of_a_fast_row_is_the_plants(vehicle: Any) -> None:
    row = np.random.default_rng(0).normal(size=len(FAST))
    found = sum(factor * row[column] for column, factor in _make_signals(vehicle)["N_z"])
    torques = row[FAST.torque_left], row[FAST.torque_right]
    wanted = as_python(compute_yaw_moment)(*torques, make_car(vehicle))
    assert found == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("turning", [0.0, 0.3, -1.2])
def test_the_second_layer_is_the_linear_model_at_every_yaw_rate(turning: float) -> None:
    """`build_model` writes double-layer-gps (42), which is the plant's Jacobian."""
    with pytest.warns(UserWarning, match="cannot see"):
        filter_ = make_estimator("double-layer", sensors={"gps": GPS}, speed=7.0)
    f = filter_.filters[1]
    build_model(f, 7.0, turning)
    model = make_velocity_roll_model(COMS, turning)
    G, H = model.discretise(float(f.step))
    np.testing.assert_allclose(f.G[:4, :4], G, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(f.H[:4, :2], H, rtol=1e-12, atol=1e-15)
