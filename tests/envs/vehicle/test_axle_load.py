"""Drive force moves load between the axles: F_x h / l, by what the motors ask for."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR, StabilityEnv
from sideslip.envs.engine.config import make_car
from sideslip.envs.vehicle.dynamics import CarParams, Motion
from sideslip.envs.vehicle.parameters import GRAVITY
from sideslip.envs.vehicle.tyres import (
    FIALA,
    TyreInputs,
    TyreLoad,
    compute_tyre_forces,
    compute_tyre_load,
    has_load_shift,
)

from ..helpers import FULL, bits, play

pytestmark = pytest.mark.plain

FLAT = (COMS, PASSENGER_CAR)
HIGH = [car.replace(transfer_height=car.gravity_height) for car in FLAT]
torques = st.floats(-3e3, 3e3)
hundreds = st.integers(-30, 30).map(lambda each: 100.0 * each)
cars = st.sampled_from(HIGH)


def plain_shift(car: CarParams, T_l: float, T_r: float) -> float:
    """F_x h / l in N, where F_x is what friction lets a standing car's rear wheels pass on."""
    per_wheel = 0.5 * car.m * GRAVITY * car.l_f / (car.l_f + car.l_r)
    limits = (car.mu * per_wheel, car.mu_r * per_wheel)
    pairs = zip((T_l, T_r), limits, strict=True)
    F_x = sum(min(max(torque / car.r, -limit), limit) for torque, limit in pairs)
    return float(F_x * car.h_x / (car.l_f + car.l_r))


@given(cars, torques, torques, st.floats(0.1, 1.2), st.floats(0.1, 1.2))
def test_the_axles_exchange_F_x_h_over_l(
    vehicle: Any, T_l: float, T_r: float, mu: float, mu_r: float
) -> None:
    car = make_car(vehicle)._replace(mu=mu, mu_r=mu_r)
    still, load = (
        compute_tyre_load(TyreInputs(0.0, *T), car, 0, 1) for T in ((0.0, 0.0), (T_l, T_r))
    )
    moved = plain_shift(car, T_l, T_r)
    mean = 0.5 * (mu + mu_r)
    for ours, theirs in (
        (2.0 * (load.limit_f - still.limit_f) / mean, -moved),
        (2.0 * (load.rear_l - still.rear_l) / mu, moved),
        (2.0 * (load.rear_r - still.rear_r) / mu_r, moved),
    ):
        assert ours == pytest.approx(theirs, abs=1e-10)  # roundings of some 1e4 N
    # what the ground bears is the car's weight
    loads = 2.0 * load.limit_f / mean + load.rear_l / mu + load.rear_r / mu_r
    assert loads == pytest.approx(car.m * GRAVITY, rel=1e-14)
    assert min(load.limit_f, load.rear_l, load.rear_r) > 0.0


def rear_force(car: CarParams, T: float, roll: int) -> float:
    """N of the rear axle's lateral force at a large slip, both motors at T."""
    load: TyreLoad = compute_tyre_load(
        TyreInputs(0.0, T, T), car, 0, has_load_shift(0, FIALA, roll)
    )
    sliding = Motion(15.0, -6.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return float(compute_tyre_forces(sliding, load, car, 0.0, 0, FIALA, roll)[1])


@pytest.mark.parametrize("roll", [0, 1])
@pytest.mark.parametrize("vehicle", HIGH, ids=lambda car: str(car.name))
def test_hard_braking_unloads_the_rear_and_driving_loads_it(vehicle: Any, roll: int) -> None:
    flat = make_car(vehicle.replace(transfer_height=0.0))
    T = 0.4 * vehicle.motor_torque
    assert rear_force(flat, -T, roll) == rear_force(flat, T, roll)  # the friction circle alone
    assert rear_force(make_car(vehicle), -T, roll) < 0.97 * rear_force(flat, -T, roll)
    assert rear_force(make_car(vehicle), T, roll) > 1.01 * rear_force(flat, T, roll)


@given(hundreds, hundreds, st.sampled_from([0, 1]), st.sampled_from([0, 1]))
def test_without_a_height_and_at_small_angles_nothing_moves(
    T_l: float, T_r: float, small_angle: int, shifting: int
) -> None:
    inputs = TyreInputs(0.03, T_l, T_r)
    for flat, high in zip(FLAT, HIGH, strict=True):
        none = compute_tyre_load(inputs, make_car(flat), small_angle, shifting)
        some = compute_tyre_load(inputs, make_car(high), small_angle, shifting)
        rests = small_angle or plain_shift(make_car(high), T_l, T_r) == 0.0
        assert (bits(none) == bits(some)) == bool(rests)


def test_a_car_that_brakes_in_a_turn_turns_in() -> None:
    """The loaded front and the unloaded rear turn it more than the friction circle alone does."""
    turning = {"steering": "step", "amplitude": 0.09, "onset": 0.0, "hold": 9.0, "friction": 0.5}
    braking = {"speed_change": -4.0, "change_start": 1.0, "change_length": 1.5, "speed": 8.0}
    rates = []
    for height in (0.0, COMS.gravity_height):
        scenario = FULL | turning | braking | {"vehicle": {"transfer_height": height}}
        env = StabilityEnv(scenario=scenario, control_period=10)
        env.reset(seed=0)
        rates.append(max(moment.info["gamma"] for moment in play(env, [0.0] * 250)[100:]))
    assert rates[1] > 1.02 * rates[0]
