"""Vehicles: Table I, the critical speed, and what is refused."""

import dataclasses
import json
import math
from typing import Any

import pytest

from sideslip.envs import COMS, PASSENGER_CAR, VEHICLES, Vehicle, critical_speed, vehicle_from
from sideslip.envs.vehicle.vehicle import vehicle_from_file_values

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
    soft = COMS.scaled(0.7)
    assert (soft.front_stiffness, soft.rear_stiffness) == (4200.0, 4200.0)
    apart = COMS.scaled(0.7, 1.3)
    assert (apart.front_stiffness, apart.rear_stiffness) == (4200.0, 7800.0)
    assert apart.replace(front_stiffness=6000.0, rear_stiffness=6000.0) == COMS


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES)
def test_round_trip_through_json(vehicle: Vehicle) -> None:
    assert vehicle_from(json.loads(json.dumps(vehicle.to_dict()))) == vehicle
    assert vehicle_from(vehicle.name) is vehicle
    assert vehicle_from(vehicle) is vehicle


def test_a_mapping_may_start_from_a_preset() -> None:
    assert vehicle_from({"base": "coms", "mass": 400.0}) == COMS.replace(mass=400.0)
    assert vehicle_from({"base": COMS}) == COMS


def test_unknown_vehicle_and_parameter_are_refused() -> None:
    with pytest.raises(ValueError, match=r"unknown vehicle 'comms'; known: coms, passenger-car"):
        vehicle_from("comms")
    with pytest.raises(TypeError, match="unknown vehicle parameter 'masss'"):
        vehicle_from({"base": "coms", "masss": 1.0})
    with pytest.raises(TypeError, match="yaw_inertia"):
        vehicle_from({"mass": 380.0})
    with pytest.raises(TypeError, match="masss"):
        COMS.replace(masss=1.0)


def test_a_file_names_its_stiffness_convention() -> None:
    per_tyre = {"front_stiffness_per_tyre": 2e4, "rear_stiffness_per_tyre": 3e4}
    axle = {"front_stiffness_axle": 4e4, "rear_stiffness_axle": 6e4}
    expected = PASSENGER_CAR.scaled(2e4 / 55000.0, 3e4 / 60000.0)
    for values in (per_tyre, axle):
        read = vehicle_from_file_values({"base": "passenger-car", **values}, "car.json")
        assert read.front_stiffness == pytest.approx(expected.front_stiffness, rel=1e-15)
        assert read.rear_stiffness == pytest.approx(expected.rear_stiffness, rel=1e-15)
        assert read.mass == PASSENGER_CAR.mass
    assert vehicle_from_file_values({"base": "coms"}, "car.json") == COMS


def test_bad_vehicle_files_are_refused_with_their_name() -> None:
    for key in ("front_stiffness", "rear_stiffness"):
        with pytest.raises(ValueError, match=rf"car\.json: '{key}' must say {key}_per_tyre or"):
            vehicle_from_file_values({key: 4e4}, "car.json")
    with pytest.raises(
        ValueError, match=r"car\.json: missing mass, yaw_inertia, front_arm, rear_arm"
    ):
        vehicle_from_file_values(
            {"front_stiffness_axle": 4e4, "rear_stiffness_axle": 5e4}, "car.json"
        )
    twice = {"front_stiffness_axle": 4e4, "front_stiffness_per_tyre": 2e4}
    with pytest.raises(ValueError, match=r"car\.json: front_stiffness is given twice"):
        vehicle_from_file_values(twice, "car.json")
    with pytest.raises(TypeError, match=r"car\.json: unknown vehicle parameter 'colour'"):
        vehicle_from_file_values({"colour": "red"}, "car.json")
    with pytest.raises(ValueError, match=r"car\.json: Vehicle\.mass: -1\.0 kg"):
        vehicle_from_file_values({"mass": -1.0}, "car.json")
    with pytest.raises(ValueError, match=r"car\.json: unknown vehicle 'tank'"):
        vehicle_from_file_values({"base": "tank"}, "car.json")
    with pytest.raises(TypeError, match=r"car\.json: .*front_stiffness_axle"):
        vehicle_from_file_values({"front_stiffness_axle": "stiff"}, "car.json")


def test_a_body_that_falls_over_or_has_no_inertia_cannot_roll() -> None:
    for vehicle in VEHICLES.values():
        vehicle.check_roll()
    with pytest.raises(ValueError, match=r"roll_stiffness: 1000.0 .* M_s g h_s = 1030.05"):
        COMS.replace(roll_stiffness=1000.0).check_roll()
    with pytest.raises(ValueError, match=r"roll_inertia: 29.0 .* more than 29.01"):
        COMS.replace(roll_inertia=29.0).check_roll()
