"""The compiled model is the vehicle's, exactly discretised, at every speed and step."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from sideslip.envs.engine.config import make_car
from sideslip.envs.numerics.jit import as_python
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.sensors.slow import CAMERA as CAMERA_PLACE
from sideslip.envs.sensors.slow import GPS as GPS_PLACE
from sideslip.envs.sensors.slow import SLOW, SLOW_NAMES
from sideslip.envs.vehicle.actuators import compute_yaw_moment
from sideslip.envs.vehicle.linear import make_vision_model
from sideslip.envs.vehicle.parameters import COMS, PASSENGER_CAR
from sideslip.estimators import make_estimator
from sideslip.estimators.core.model import build_model, discretise
from sideslip.estimators.design import assemble, kalman
from sideslip.estimators.design.assemble import _make_signals
from sideslip.estimators.design.models import (
    MEASUREMENTS,
    Measurement,
    MeasurementRow,
    select_states,
)
from tests.envs.vehicle.test_linear import make_velocity_roll_model
from tests.estimators.filters.literal import car
from tests.estimators.simulation import CAMERA, GPS, Drive, simulate

STEPS = (0.001, 0.01, 0.033, 0.1, 0.2)


def model_of(name: Any, vehicle: Any, speed: Any, step: Any, sensors: Any) -> Any:
    """G (dense, n) and H of a filter's record whose step is the given one."""
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
    assert found == pytest.approx(
        as_python(compute_yaw_moment)(*torques, make_car(vehicle)), rel=1e-12
    )


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


def some(seed: Any) -> Any:
    rng = np.random.default_rng(seed)
    A, C = rng.standard_normal((4, 4)), rng.standard_normal((2, 4))
    L = rng.standard_normal((2, 2))
    return rng, A @ A.T, C, L @ L.T


@pytest.mark.smoke
@pytest.mark.plain
def test_the_gain_is_conditioning_of_the_joint_gaussian() -> None:
    rng, P, C, R = some(0)
    x, y = rng.standard_normal(4), rng.standard_normal(2)
    joint = np.block([[P, P @ C.T], [C @ P, C @ P @ C.T + R]])
    S = np.linalg.inv(joint[4:, 4:])
    K = kalman.kalman_gain(P, C, R)
    mean, cov = x + K @ (y - C @ x), kalman.joseph_form(P, K, C, R)
    np.testing.assert_allclose(mean, x + joint[:4, 4:] @ S @ (y - C @ x), rtol=1e-10)
    np.testing.assert_allclose(cov, P - joint[:4, 4:] @ S @ joint[4:, :4], rtol=1e-9, atol=1e-12)


@pytest.mark.smoke
@pytest.mark.plain
def test_without_noise_the_gain_is_a_generalised_inverse() -> None:
    _, P, C, _ = some(3)
    zero = np.zeros((2, 2))
    np.testing.assert_allclose(
        kalman.kalman_gain(np.eye(4), C, zero), np.linalg.pinv(C), rtol=1e-10
    )
    np.testing.assert_allclose(C @ kalman.kalman_gain(P, C, zero), np.eye(2), atol=1e-12)
    ridge = np.linalg.solve(C.T @ C + 0.1 * np.eye(4), C.T)
    np.testing.assert_allclose(kalman.kalman_gain(np.eye(4), C, 0.1 * np.eye(2)), ridge, rtol=1e-9)


LATE = SlowSensor(0.1, (0.050,))

HDOP, SATELLITES = PACKET.value + 4, PACKET.value + 5


@pytest.fixture
def log() -> Any:
    """Late courses that start far off, at speeds that change, with HDOP and satellites."""
    log = simulate(Drive(duration=3.0), {"gps": LATE}, 2)
    packets, rng = log.record.packets, np.random.default_rng(0)
    packets[:, PACKET.value] += 2.0
    packets[:, HDOP] = rng.uniform(0.5, 6.0, len(packets))
    packets[:, SATELLITES] = rng.integers(2, 12, len(packets))
    wheels = [FAST.wheel_left, FAST.wheel_right]
    log.record.fast[:, wheels] *= np.linspace(0.5, 2.0, len(log.record.fast))[:, None]
    return log


@pytest.mark.parametrize("delay", ["clone", "buffer", "larsen", "stored", "ignore"])
def test_a_gps_in_the_cameras_place_has_its_bits(delay: str, log: Any, monkeypatch: Any) -> None:
    """Noise by 1/V at the capture, HDOP, satellites and the heading fix go with it."""
    table = None if delay == "larsen" else [(1.0, 1.0), (8.0, 8.0)]
    options: dict[str, Any] = {"delay": delay, "gains": "covariance", "hdop_table": table}
    options["Q"] = [1e-4] * 5  # tunings are found by the sensor's name
    ours = make_estimator("exact-kf", sensors={"gps": LATE}, **options)
    expected = ours.run(log.record)
    assert expected["psi"][-1] > 1.5 and ours.counts["poor"] > 0
    monkeypatch.setitem(MEASUREMENTS, "camera", MEASUREMENTS["gps"])
    monkeypatch.setattr(assemble, "SLOW", SLOW[::-1])
    log.record.packets[:, PACKET.sensor] = CAMERA_PLACE
    moved = make_estimator("exact-kf", sensors={"camera": LATE}, **options)
    found = moved.run(log.record)
    np.testing.assert_array_equal(found.x, expected.x)
    np.testing.assert_array_equal(found.std, expected.std)
    assert moved.counts == ours.counts


def test_a_sensor_is_what_its_entry_says(log: Any, monkeypatch: Any) -> None:
    """A lane offset alone in the GPS_PLACE's place: its states, its noise, no fix, angle or 1/V."""
    lane = Measurement((MeasurementRow(("y_l",), "y_l", 0.02),))
    monkeypatch.setitem(MEASUREMENTS, "gps", lane)
    assert select_states(("gps",)) == ("beta", "gamma", "psi", "y_l")
    filter_ = make_estimator("exact-kf", sensors={"gps": LATE}, speed=7.0, y_l_noise=0.3)
    f = filter_.filters[0]
    np.testing.assert_array_equal(f.C[GPS_PLACE, 0, : f.n], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert (f.rows[GPS_PLACE], f.r[GPS_PLACE, 0], f.first_slow) == (1, 0.3**2, GPS_PLACE)
    assert (
        not f.heading_fix[GPS_PLACE]
        and not f.angle[GPS_PLACE].any()
        and not f.noise_over_speed[GPS_PLACE].any()
    )
    packets, quiet = log.record.packets, [FAST.gyro, FAST.steer]
    packets[:, PACKET.value], log.record.fast[:, quiet] = 3.0, 0.0
    packets[:, SATELLITES] = 12.0
    assert filter_.run(log)["y_l"][-1] == pytest.approx(3.0, abs=0.3)


def test_every_slow_sensor_has_an_entry() -> None:
    """Whose rows are the packet's first values, in states that a bicycle has."""
    assert tuple(MEASUREMENTS) == SLOW_NAMES
    for kind in SLOW:
        rows = MEASUREMENTS[kind.name].rows
        assert len(rows) <= len(kind.values)
        assert select_states((kind.name,))[:2] == ("beta", "gamma")
    f = make_estimator(
        "joint", sensors={"camera": SlowSensor(0.04), "gps": SlowSensor(0.2)}
    ).filters[0]
    assert (f.hdop_column[GPS_PLACE], f.satellites_column[GPS_PLACE]) == (HDOP, SATELLITES)
    assert (
        f.hdop_column[CAMERA_PLACE]
        == f.satellites_column[CAMERA_PLACE]
        == f.speed_column[CAMERA_PLACE]
        == 0
    )
