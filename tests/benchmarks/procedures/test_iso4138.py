"""ISO 4138: the understeer gradient of a car that goes round in circles slowly faster."""

import numpy as np
import pytest

from sideslip.benchmarks.procedures import iso4138
from sideslip.benchmarks.procedures.drive import Series, TestCar
from sideslip.envs import COMS, PASSENGER_CAR, Vehicle
from sideslip.envs.vehicle.linear import make_bicycle_model

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
    found = iso4138._compute_handling(steady(vehicle, 0.06 * side, 13.0), make_car(vehicle))
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
        iso4138._compute_handling(steady(PASSENGER_CAR, 0.001, 10.0), make_car(PASSENGER_CAR))
