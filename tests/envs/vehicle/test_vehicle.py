"""Vehicles: Table I, the critical speed, and what is refused."""

import dataclasses
import math
from typing import Any

import pytest

from sideslip.envs import COMS, PASSENGER_CAR, VEHICLES, Vehicle, critical_speed

pytestmark = pytest.mark.plain

NUMBERS = [entry.name for entry in dataclasses.fields(Vehicle) if entry.name != "name"]
MAY_BE_ZERO = ("motor_lag", "steering_lag", "motor_power", "transfer_height")
PLACES = ("antenna_ahead", "antenna_left")


@pytest.mark.smoke
def test_coms_is_table_i() -> None:
    assert COMS.mass == 380.0
    assert (COMS.front_arm, COMS.rear_arm) == (0.8, 0.6)
    assert (COMS.front_stiffness, COMS.rear_stiffness) == (6000.0, 6000.0)
    assert COMS.yaw_inertia == 136.08
    assert (COMS.rear_track, COMS.wheel_radius, COMS.motor_torque) == (0.82, 0.22, 100.0)
    assert COMS.preview == 5.135
    assert COMS.wheelbase == pytest.approx(1.4, rel=1e-15)


@pytest.mark.smoke
def test_critical_speed_of_the_coms_is_63_3_kmh() -> None:
    assert round(critical_speed(COMS) * 3.6, 1) == 63.3


def test_an_understeering_car_has_no_critical_speed() -> None:
    assert critical_speed(PASSENGER_CAR) == math.inf
    neutral = COMS.replace(front_arm=0.7, rear_arm=0.7)
    assert critical_speed(neutral) == math.inf


@pytest.mark.parametrize("name", NUMBERS)
def test_every_parameter_has_a_unit_and_a_description(name: str) -> None:
    metadata = Vehicle.__dataclass_fields__[name].metadata
    assert metadata["unit"]
    assert metadata["text"]


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_values_that_cannot_be_are_refused_by_name(name: str, value: float) -> None:
    if name in PLACES and value == -1.0:
        assert getattr(COMS.replace(**{name: value}), name) == value
        return
    with pytest.raises(ValueError, match=rf"Vehicle\.{name}: {value!r} .* is not"):
        COMS.replace(**{name: value})


@pytest.mark.parametrize("name", NUMBERS)
def test_zero_is_for_some_only(name: str) -> None:
    if name in MAY_BE_ZERO + PLACES:
        assert getattr(COMS.replace(**{name: 0.0}), name) == 0.0
    else:
        with pytest.raises(ValueError, match=name):
            COMS.replace(**{name: 0.0})


@pytest.mark.parametrize("value", ["380", None, True, [380.0]])
def test_what_is_no_number_is_refused(value: Any) -> None:
    with pytest.raises(TypeError, match=r"Vehicle\.mass: expected a number"):
        COMS.replace(mass=value)


def test_scaled_scales_the_stiffness_only() -> None:
    soft = COMS.scale_stiffness(0.7)
    assert (soft.front_stiffness, soft.rear_stiffness) == (4200.0, 4200.0)
    apart = COMS.scale_stiffness(0.7, 1.3)
    assert (apart.front_stiffness, apart.rear_stiffness) == (4200.0, 7800.0)
    assert apart.replace(front_stiffness=6000.0, rear_stiffness=6000.0) == COMS


def test_a_body_that_falls_over_or_has_no_inertia_cannot_roll() -> None:
    for vehicle in VEHICLES.values():
        vehicle.check_roll()
    with pytest.raises(ValueError, match=r"roll_stiffness: 1000.0 .* M_s g h_s = 1030.05"):
        COMS.replace(roll_stiffness=1000.0).check_roll()
    with pytest.raises(ValueError, match=r"roll_inertia: 29.0 .* more than 29.01"):
        COMS.replace(roll_inertia=29.0).check_roll()
