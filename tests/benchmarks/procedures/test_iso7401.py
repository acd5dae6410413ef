"""ISO 7401: the numbers of a step, and a measured frequency response against the true one."""

import math

import numpy as np
import pytest
from scipy.signal import chirp, lsim

from sideslip.benchmarks.procedures import iso
from sideslip.benchmarks.procedures.drive import Series, TestCar
from sideslip.envs import COMS, PASSENGER_CAR, Vehicle
from sideslip.envs.vehicle.linear import make_bicycle_model

V = 20.0


def linear(vehicle: Vehicle, speed: float, t: np.ndarray, steer: np.ndarray) -> Series:
    """The linear car under a steering angle, exact between samples that a line joins."""
    model = make_bicycle_model(vehicle, speed)
    x = lsim((model.A, model.B[:, :1], np.eye(2), np.zeros((2, 1))), steer, t)[1]
    zero, beta, gamma = np.zeros_like(t), x[:, 0], x[:, 1]
    return Series(t, steer, zero + speed, speed * beta, gamma, zero, zero, zero, zero)


def test_numbers_of_a_second_order_step_are_the_textbooks() -> None:
    omega, zeta, gain = 5.0, 0.3, 2.5
    t = np.arange(0.0, 20.0, 1e-4)
    steer = np.where(t >= 1.0, 0.1, 0.0)
    system = ([gain * omega**2], [1.0, 2.0 * zeta * omega, omega**2])
    output = lsim(system, steer, t)[1]
    found = iso._compute_step_response(t, steer, output)
    damped = omega * math.sqrt(1.0 - zeta**2)
    assert found.gain == pytest.approx(gain, rel=1e-6)
    assert found.peak_time == pytest.approx(math.pi / damped, abs=2e-4)
    assert found.overshoot == pytest.approx(math.exp(-math.pi * zeta * omega / damped), rel=1e-4)
    again = iso._compute_step_response(t, -steer, -output)
    assert vars(again) == pytest.approx(vars(found))


def test_a_first_order_step_has_no_overshoot_and_its_90_percent_at_2_3_time_constants() -> None:
    t = np.arange(0.0, 10.0, 1e-4)
    steer = np.where(t >= 1.0, 0.1, 0.0)
    output = np.where(t >= 1.0, 1.0 - np.exp(-(t - 1.0) / 0.3), 0.0)
    found = iso._compute_step_response(t, steer, output)
    assert found.response_time == pytest.approx(0.3 * math.log(10.0), abs=2e-4)
    assert found.overshoot == pytest.approx(0.0, abs=1e-6)


def test_times_count_from_half_the_steering() -> None:
    t = np.arange(0.0, 10.0, 1e-3)
    late = iso._compute_step_response(t, np.clip(t - 1.0, 0.0, 1.0), np.clip(t - 3.0, 0.0, 1.0))
    assert late.response_time == pytest.approx(3.9 - 1.5, abs=1e-6)


def test_without_a_step_there_is_no_response() -> None:
    t = np.arange(0.0, 3.0, 0.01)
    with pytest.raises(ValueError, match="needs a steering angle at its end"):
        iso._compute_step_response(t, 0.0 * t, t)


@pytest.mark.parametrize("vehicle", [COMS, PASSENGER_CAR], ids=lambda car: car.name)
def test_the_frequency_response_of_the_linear_car_is_the_matrices(vehicle: Vehicle) -> None:
    speed = 10.0 if vehicle is COMS else V
    t = np.arange(0.0, 104.0, 0.01)
    steer = np.where(t < 100.0, 0.02 * chirp(t, 0.05, 100.0, 2.5, phi=-90.0), 0.0)
    driven = linear(vehicle, speed, t, steer)
    for name in iso.OUTPUTS:
        found = iso._estimate_frequency_response(driven.t, driven.steer, getattr(driven, name))
        theory = iso._compute_linear_response(vehicle, speed, found.frequency)[name]
        assert found.frequency[[0, -1]].tolist() == pytest.approx([0.2, 2.0])
        assert (np.abs(found.H - theory) < 2.0 * found.sd).all()
        np.testing.assert_allclose(found.H, theory, rtol=0.02)


def test_the_standard_deviation_is_that_of_estimates_in_noise() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 200.0, 0.02)
    steer = rng.standard_normal(len(t))
    errors, claimed = [], []
    for _ in range(60):
        found = iso._estimate_frequency_response(
            t, steer, 2.0 * steer + rng.standard_normal(len(t))
        )
        errors.append(found.H - 2.0)
        claimed.append(found.sd)
    each = np.sqrt(np.mean(np.real(errors) ** 2, axis=0) + np.mean(np.imag(errors) ** 2, axis=0))
    ratio = each / math.sqrt(2.0) / np.mean(claimed, axis=0)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)


def test_a_drive_shorter_than_a_segment_is_refused() -> None:
    t = np.arange(0.0, 5.0, 0.01)
    with pytest.raises(ValueError, match=r"longer than the 5.0 s driven"):
        iso._estimate_frequency_response(t, np.sin(t), np.sin(t))


def test_the_linear_step_is_that_of_a_linear_drive() -> None:
    t = np.arange(0.0, 5.0, 0.001)
    driven = linear(PASSENGER_CAR, V, t, 0.01 * np.clip((t - 1.0) / 0.2, 0.0, 1.0))
    theory = iso._compute_linear_step(PASSENGER_CAR, V, driven)
    found = iso._compute_step_response(driven.t, driven.steer, driven.gamma)
    assert vars(theory["gamma"]) == pytest.approx(vars(found), rel=1e-9)
    model = make_bicycle_model(PASSENGER_CAR, V)
    steady = -np.linalg.solve(model.A, model.B)[1, 0]
    assert found.gain == pytest.approx(steady, rel=1e-3)
    a_y = iso._compute_step_response(driven.t, driven.steer, driven.a_y)
    assert theory["a_y"].gain == pytest.approx(a_y.gain, rel=1e-3)


CARS = pytest.mark.parametrize("vehicle", [COMS, PASSENGER_CAR], ids=lambda car: car.name)


def make_car(vehicle: Vehicle) -> TestCar:
    return TestCar(vehicle, 10.0, 16.0, 4.0, 0.8)


def steady(vehicle: Vehicle, steer: float, fastest: float) -> Series:
    """The linear car's steady states at rising speeds."""
    t = np.arange(0.0, 30.0, 0.01)
    zero, speed = np.zeros_like(t), np.linspace(2.0, fastest, len(t))
    states = [
        -np.linalg.solve(make_bicycle_model(vehicle, v).A, make_bicycle_model(vehicle, v).B)[:, 0]
        for v in speed
    ]
    beta, gamma = steer * np.array(states).T
    return Series(t, zero + steer, speed, speed * beta, gamma, zero, zero, zero, zero)


@CARS
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_steady_states_of_the_linear_car_have_its_gradient(vehicle: Vehicle, side: float) -> None:
    found = iso._compute_handling(steady(vehicle, 0.06 * side, 13.0), make_car(vehicle))
    assert found.theory == pytest.approx(make_car(vehicle).understeer_gradient)
    np.testing.assert_allclose(found.K, found.theory, rtol=1e-6)
    np.testing.assert_allclose(found.angle, -found.theory * found.a_y, atol=1e-12)


@CARS
def test_the_gradient_is_the_weights_over_the_stiffnesses(vehicle: Vehicle) -> None:
    """delta_f = l/R + (m/l) (l_r / 2 C_f - l_f / 2 C_r) a_y; the COMS oversteers."""
    front = vehicle.rear_arm / (2.0 * vehicle.front_stiffness)
    rear = vehicle.front_arm / (2.0 * vehicle.rear_stiffness)
    expected = vehicle.mass / vehicle.wheelbase * (front - rear)
    assert make_car(vehicle).understeer_gradient == pytest.approx(expected)
    assert (expected > 0.0) is (vehicle is PASSENGER_CAR)


def test_a_circle_without_lateral_acceleration_is_refused() -> None:
    with pytest.raises(ValueError, match=r"circle reached .* m/s2, not 2.45"):
        iso._compute_handling(steady(PASSENGER_CAR, 0.001, 10.0), make_car(PASSENGER_CAR))
