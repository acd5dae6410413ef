"""exact-kf with the accelerometer, the roll rate and a gyro bias."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.envs import COMS, PASSENGER_CAR
from sideslip.envs.engine.config import make_car
from sideslip.envs.scenarios.manoeuvres import make_scenario
from sideslip.envs.vehicle.dynamics import DisturbanceForces, Motion, RoadParams, derivative
from sideslip.envs.vehicle.parameters import GRAVITY
from sideslip.envs.vehicle.tyres import LINEAR, PlantVariant, TyreInputs, compute_tyre_load
from sideslip.estimators import EstimateObservation, make_estimator, vector
from tests.estimators.drives import Drives, told
from tests.estimators.simulation import CAMERA, GPS

FUSION = "sideslip/YawFusion-v0"
INERTIAL = ["gyro", "accel_y", "roll_rate"]
ALL: dict[str, Any] = {"slow": ["camera", "gps"], "fast": INERTIAL, "bias_sd": 0.01}
ALL |= {"camera_yaw_sd": 0.005, "steer_offset_sd": 0.002}
STATES = (
    *("beta", "gamma", "psi", "y_l", "phi", "phi_rate", "F_d", "N_d"),
    *("bias", "camera_yaw", "steer_offset"),
)


def slope(x: Any, steer: float, F_d: float, vehicle: Any, V: float) -> Any:
    """(beta', gamma', phi', phi'', a_y) of the plant, small angles, linear tyres, rolling."""
    beta, gamma, phi, phi_rate = x
    car = make_car(vehicle)
    at = Motion(V, V * beta, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, phi, phi_rate)
    load = compute_tyre_load(TyreInputs(steer, 0.0, 0.0), car, PlantVariant(1, LINEAR))
    push, road = DisturbanceForces(F_d, 0.0), RoadParams(0.0, 0.0, 1.0)
    rate = derivative(at, load, push, car, road, PlantVariant(1, LINEAR, 1))
    a_y = rate.v_y + V * gamma + GRAVITY * phi
    return np.array([rate.v_y / V, rate.gamma, rate.phi, rate.phi_dot, a_y])


@pytest.mark.parametrize("vehicle", [COMS, PASSENGER_CAR], ids=lambda each: each.name)
def test_body_and_accelerometer_are_the_plants_jacobian(vehicle: Any) -> None:
    V, sensors = 8.0, {"camera": CAMERA}
    filter_ = make_estimator(
        "exact-kf", vehicle=vehicle, sensors=sensors, speed=V, fast=INERTIAL, steer_offset_sd=0.01
    )
    f, rows, offset = filter_.filters[0], [0, 1, 4, 5], filter_.names.index("steer_offset")
    size = [0.01, 0.05, 0.01, 0.05, 0.01, 10.0, 0.01]  # the four states, steering, F_d, offset
    found = np.zeros((5, 7))
    for j in range(7):  # what acts is the measured angle less the offset
        step = np.eye(7)[j] * size[j]
        found[:, j] = slope(step[:4], step[4] - step[6], step[5], vehicle, V)
    exact = np.zeros((5, 7))
    exact[:4, 6], exact[4, 6] = f.B[rows, 4 + offset - f.dense], f.C_fast[1, offset]
    exact[:4, :4], exact[:4, 4], exact[:4, 5] = f.A[np.ix_(rows, rows)], f.B[rows, 0], f.B[rows, 4]
    exact[4, :6] = [*f.C_fast[1, rows], f.D_fast[1, 0], f.C_fast[1, filter_.names.index("F_d")]]
    exact *= size
    np.testing.assert_allclose(found, exact, atol=1e-12 * np.abs(exact).max())


BIAS = math.radians(0.5)
RUNS = 48


def test_a_bias_is_recovered_by_the_state_alone() -> None:
    """NEES of beta and gamma, and the bias within its own deviation; the plain one is far off."""
    fig7 = make_scenario("tie-vision-fig7").replace(duration=4.0, noise={"gyro_bias": BIAS})
    drives = Drives(fig7)
    logs = [drives.run(seed) for seed in range(RUNS)]
    common: Any = {"vehicle": drives.vehicle, "speed": drives.speed}
    common["sensors"] = told(logs[0], "camera", "gps")
    biased, plain = (
        make_estimator("exact-kf", slow=["camera", "gps"], bias_sd=sd, **common)
        for sd in (BIAS, 0.0)
    )
    nees: dict[Any, list[float]] = {biased: [], plain: []}
    left = []
    for log in logs:
        for filter_, each in nees.items():
            estimates = filter_.run(log)
            e = estimates.x[-1, :2] - [log.truth["beta"][-1], log.truth["gamma"][-1]]
            each.append(float(e @ np.linalg.solve(filter_.P[:2, :2], e)) / 2.0)
        left.append((biased.x[-1] - BIAS, math.sqrt(biased.P[-1, -1])))
    error, sd = np.array(left).T
    assert sd.max() < 0.1 * BIAS and np.mean((error / sd) ** 2) < 1.7  # chi-square of 48, 99.9 %
    assert 0.6 < np.mean(nees[biased]) < 1.5  # of 96
    assert np.mean(nees[plain]) > 5.0


def drive(env: Any, rows: int, steps: int, estimator: str, **options: Any) -> Any:
    """beta and its estimate, (steps, rows)."""
    fleet = gym.make_vec(FUSION, rows, scenario=env)
    env = vector.EstimateObservation(fleet, estimator, options=options)
    env.reset(seed=7)
    still = np.zeros((rows, 1), np.float32)
    infos = [env.step(still)[4] for _ in range(steps)]
    return [np.array([info[key] for info in infos]) for key in ("beta", "beta_hat")]


def spread(error: Any) -> Any:
    return np.median(np.sqrt(np.mean(error**2, 0)))


GYRO, ACCEL = ({"slow": ["camera", "gps"], "fast": INERTIAL[:n]} for n in (1, 2))
STEERED = {"base": "random-steering", "duration": 6.0}


@pytest.mark.parametrize(
    ("scenario", "less", "more", "score"),
    [
        # on the plant with Fiala's tyres and a body that rolls, told the nominal car
        ("random-steering", GYRO, ACCEL, spread),
        ("slalom", GYRO, ACCEL, spread),
        # a bias of 0.3 m/s2 costs a filter that believes its accelerometer most of its accuracy
        (STEERED | {"noise": {"accel_y_bias": 0.3}}, ACCEL, ACCEL | {"accel_bias_sd": 0.3}, spread),
        # a crossfall of 0.03 all along leaves the mean of beta's error to a filter without a state
        (
            STEERED | {"bank": 0.03, "curve_start": -100.0},
            ACCEL | {"bank_sd": 0.0},
            ACCEL | {"bank_sd": 0.03},
            lambda error: abs(np.mean(error)),
        ),
    ],
    ids=["accelerometer", "accelerometer, slalom", "accelerometer's bias", "road's bank"],
)
def test_a_sensor_or_a_state_for_it_halves_the_error_of_beta(
    scenario: Any, less: Any, more: Any, score: Any
) -> None:
    errors = []
    for options in (less, more):
        beta, found = drive(scenario, 24, 600, "exact-kf", **options)
        errors.append(score((found - beta)[200:]))
    assert errors[1] < 0.5 * errors[0], errors


def test_all_states_are_outputs_and_a_row_has_the_bits_of_a_single_env() -> None:
    one = EstimateObservation(gym.make(FUSION), "exact-kf", outputs=STATES, options=ALL)
    many = vector.EstimateObservation(gym.make_vec(FUSION, 3), "exact-kf", STATES, options=ALL)
    assert one.estimator.names == STATES and one.layout[-12].name == "steer_offset_hat"
    single, batch = one.reset(seed=5)[0], many.reset(seed=4)[0]
    for _ in range(40):
        np.testing.assert_array_equal(single, batch[1])
        single = one.step(np.array([0.2], np.float32))[0]
        batch = many.step(np.full((3, 1), 0.2, np.float32))[0]


def test_a_constant_bias_is_seen_and_no_warning_is_about_it(recwarn: Any) -> None:
    """By the model with the camera or the GPS; dakf keeps the one direction it cannot see."""
    sensors = {"camera": CAMERA, "gps": GPS}
    for slow in sensors:
        filter_ = make_estimator("exact-kf", sensors=sensors, slow=slow, bias_sd=0.01)
        assert filter_.unobservable == () and filter_.spectral_radius < 1.0
    assert len(recwarn) == 0
    with pytest.warns(UserWarning, match="cannot see: beta 1, psi -1, [^;]*$") as found:
        make_estimator("dakf", sensors=sensors, bias_sd=0.01)
    assert "bias" not in str(found[0].message)
