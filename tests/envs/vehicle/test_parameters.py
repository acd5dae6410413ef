"""Vehicles: their numbers, and the reader of names, files and mappings; what is refused."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from sideslip.envs import COMS, PASSENGER_CAR, VEHICLES, Vehicle, critical_speed, make_vehicle
from sideslip.envs.io import write_document
from sideslip.envs.vehicle.parameters import MIN_RELAXATION

pytestmark = pytest.mark.plain

NUMBERS = [entry.name for entry in dataclasses.fields(Vehicle) if entry.name != "name"]
MAY_BE_ZERO = ("motor_lag", "steering_lag", "motor_power", "transfer_height", "relaxation")
PLACES = ("antenna_ahead", "antenna_left")


@pytest.mark.smoke
def test_coms_is_table_i() -> None:
    assert COMS.lateral == (380.0, 136.08, 0.8, 0.6, 6000.0, 6000.0)
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
@pytest.mark.parametrize("value", [-1.0, 0.0, math.nan, math.inf])
def test_values_that_cannot_be_are_refused_by_name(name: str, value: float) -> None:
    """Zero is for some only, a negative number for places alone."""
    allowed = {-1.0: PLACES, 0.0: PLACES + MAY_BE_ZERO}
    if name in allowed.get(value, ()):
        assert getattr(COMS.replace(**{name: value}), name) == value
        return
    rule = "zero or more and " if name in MAY_BE_ZERO else "positive and "
    rule = "" if name in PLACES else rule
    with pytest.raises(ValueError, match=rf"Vehicle\.{name}: {value!r} .* is not {rule}finite"):
        COMS.replace(**{name: value})


def test_a_relaxation_that_a_tick_cannot_follow_is_refused() -> None:
    assert COMS.replace(relaxation=0.05).relaxation == 0.05
    with pytest.raises(ValueError, match=r"Vehicle\.relaxation: 0\.01 m is neither 0 nor 0\.05"):
        COMS.replace(relaxation=0.01)


def test_a_complete_mapping_of_an_older_file_has_no_relaxation() -> None:
    old = {key: value for key, value in COMS.to_dict().items() if key != "relaxation"}
    assert make_vehicle(old) == COMS.replace(relaxation=0.0)


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


TOML = """\
name = "mine"
mass = 1500
yaw_inertia = 2400
front_arm = 1.2
rear_arm = 1.5
front_stiffness_axle = 110000.0
rear_stiffness_per_tyre = 60000.0
"""


def test_a_file_is_toml_or_json(tmp_path: Path) -> None:
    toml, other = tmp_path / "mine.toml", tmp_path / "mine.json"
    toml.write_text(TOML)
    lines = [line.partition(" = ") for line in TOML.splitlines()]
    values = {key: json.loads(value) for key, _, value in lines}
    other.write_text(json.dumps(values))
    expected = PASSENGER_CAR.replace(name="mine")
    assert make_vehicle(toml) == make_vehicle(str(other)) == make_vehicle(values) == expected
    toml.write_text(TOML.partition("\n")[2])
    assert make_vehicle(toml).name == "mine"  # the file's
    other.write_text('{"base": "mine.toml", "mass": 1600}')  # beside it
    assert make_vehicle(other) == expected.replace(mass=1600)


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES)
def test_round_trip(tmp_path: Path, vehicle: Vehicle) -> None:
    assert make_vehicle(json.loads(json.dumps(vehicle.to_dict()))) == vehicle
    assert make_vehicle(vehicle.name) is make_vehicle(vehicle) is vehicle
    keys = {f"{axle}_stiffness": f"{axle}_stiffness_per_tyre" for axle in ("front", "rear")}
    values = {keys.get(key, key): value for key, value in vehicle.to_dict().items()}
    for ending in ("toml", "json"):
        write_document(tmp_path / f"car.{ending}", values)
        assert make_vehicle(tmp_path / f"car.{ending}") == vehicle


def test_a_mapping_may_start_from_another_vehicle() -> None:
    assert make_vehicle({"base": "coms", "mass": 400.0}) == COMS.replace(mass=400.0)
    assert make_vehicle({"base": COMS}) == COMS
    axle = {"front_stiffness_axle": 9000.0, "rear_stiffness_per_tyre": 5000.0}
    assert make_vehicle({"base": "coms"} | axle).front_stiffness == 4500.0
    assert make_vehicle({"base": "coms"} | axle).rear_stiffness == 5000.0


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ("comms", ValueError, "unknown vehicle 'comms'; did you mean 'coms'"),
        ({"base": "coms", "masss": 1.0}, TypeError, "parameter 'masss'; did you mean 'mass'"),
        ({"mass": 380.0}, ValueError, "missing yaw_inertia, front_arm, .* or front_stiffness_axle"),
        ({"front_stiffness": 1e4, "front_stiffness_axle": 2e4}, ValueError, "exclude each other"),
        ({"base": "coms", "rear_stiffness": 1e4}, ValueError,
         "rear_stiffness must name its convention: rear_stiffness_per_tyre or rear_stiffness_ax"),
        (5, TypeError, "a vehicle is a name, the path of"),
    ],
)  # fmt: skip
def test_what_is_no_vehicle(values: object, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make_vehicle(values)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        ("", ValueError, "holds nothing"),
        ("mass = ", ValueError, "expected TOML, but"),
        (TOML.replace("_axle", ""), ValueError, "front_stiffness must name its convention: front_"),
        (TOML + "front_stiffness_per_tyre = 55000.0", ValueError,
         "front_stiffness_per_tyre and front_stiffness_axle exclude each other"),
        (TOML.replace("1500", "-1500"), ValueError, "mass: -1500 kg is not positive"),
        (TOML.replace("1500", '"heavy"'), TypeError, "mass: expected a number, got 'heavy'"),
        (TOML + "wings = 2\n", TypeError, "unknown vehicle parameter 'wings'"),
        (TOML.replace("1500", "1" * 300), ValueError, "Vehicle.mass: 1111"),
        (TOML.replace("1500", "1" * 5000), ValueError, "expected TOML, but Exceeds"),
        (TOML.replace("110000.0", "1" * 400), ValueError, "front_stiffness: 111"),
        (TOML.replace("1500", "1e-300"), ValueError, "mass: 1e-300 kg is not positive"),
        (TOML.replace("1500", "true"), TypeError, "mass: expected a number, got True"),
        ("mass = " + "[" * 3000 + "]" * 3000, ValueError, "nested too deeply"),
        (TOML.replace("mass", "mass" + ".mass" * 3000), TypeError, "mass: expected a number"),
        (f'"{"key " * 999}" = "text"', TypeError, "unknown vehicle parameter 'key key"),
        ("".join(f"k{i} = 1\n" for i in range(999)), TypeError, "unknown vehicle parameter 'k0'"),
        (TOML.replace('"mine"', "5"), TypeError, "name: expected a text, got 5"),
        ("base = [1]", TypeError, "a vehicle is a name"),
        ('base = "tank"', ValueError, "unknown vehicle 'tank'"),
        ('base = "mine.toml"', ValueError, "its base is the file itself"),
    ],
    ids=range(20),
)  # fmt: skip
def test_a_bad_file_is_refused(
    tmp_path: Path, content: str, error: type[Exception], message: str
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(content)
    with pytest.raises(error, match=message) as caught:
        make_vehicle(file)
    assert str(file) in str(caught.value) and len(str(caught.value)) < 700


def test_a_file_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    refusals: list[tuple[str, type[Exception], str]] = [
        ("nowhere.toml", FileNotFoundError, r"nowhere\.toml: there is no such vehicle file"),
        ("", ValueError, r"ends in \.toml or \.json"),
        ("folder.toml", ValueError, "found a folder"),
    ]
    for name, error, message in refusals:
        with pytest.raises(error, match=message):
            make_vehicle(tmp_path / name)


@pytest.mark.smoke
def test_the_vehicles_of_the_stanford_log_come_with_the_package() -> None:
    """Figures of the recording's source: axle stiffness is twice a tyre's."""
    nominal, fitted = map(make_vehicle, ("ferrari-250lm-nominal", "ferrari-250lm-fitted"))
    assert (nominal.mass, nominal.yaw_inertia) == (982.0, 1605.0)
    assert (nominal.front_stiffness, nominal.rear_stiffness) == (0.35e5, 0.6e5)
    assert (fitted.front_stiffness, fitted.rear_stiffness) == (2.165e4, 4.29e4)
    assert fitted.yaw_inertia == 1340.0


def test_an_env_takes_what_the_reader_takes_and_is_built_again(tmp_path: Path) -> None:
    soft = COMS.scale_stiffness(0.8)
    env = gym.make("sideslip/YawVision-v0", vehicle=soft.to_dict())
    assert env.spec is not None
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.get_wrapper_attr("config").vehicle == soft
    file = tmp_path / "mine.toml"
    file.write_text(TOML)
    env = gym.make("sideslip/YawVision-v0", vehicle=str(file))
    assert env.get_wrapper_attr("config").vehicle.name == "mine"
    scenario = {"base": "straight", "vehicle": {"front_stiffness": 7000.0}}  # as of `Vehicle`
    env = gym.make("sideslip/YawVision-v0", scenario=scenario)
    assert env.get_wrapper_attr("_episode").vehicle.front_stiffness == 7000.0


def test_a_length_that_no_tick_follows_is_drawn_as_the_shortest() -> None:
    """Doubled ranges begin at 0, and the oracles build the drawn car."""
    world = {"base": "v1", "relaxation": (0.0, 0.3)}
    env: Any = gym.make("sideslip/YawFusion-v0", world=world).unwrapped
    lengths = [env.reset(seed=seed) and env.vehicle.relaxation for seed in range(30)]
    assert min(lengths) == MIN_RELAXATION < max(lengths)
