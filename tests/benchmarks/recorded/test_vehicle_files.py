"""Vehicle files are read, and refused where they are wrong."""

import json
from pathlib import Path

import pytest

from sideslip.benchmarks.recorded.vehicles import read_vehicle
from sideslip.envs.vehicle.vehicle import PASSENGER_CAR

from .slalom import VEHICLE


def test_a_vehicle_file_is_toml_or_json(tmp_path: Path) -> None:
    toml, other = tmp_path / "mine.toml", tmp_path / "mine.json"
    toml.write_text(VEHICLE)
    lines = (line.partition(" = ") for line in VEHICLE.splitlines())
    other.write_text(json.dumps({key: json.loads(value) for key, _, value in lines}))
    assert read_vehicle(toml) == read_vehicle(other)
    assert read_vehicle(toml) == PASSENGER_CAR.replace(name="mine", preview=PASSENGER_CAR.preview)


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        ("", ValueError, "names no parameter"),
        ("mass = ", ValueError, "expected TOML or JSON"),
        ('{"mass": }', ValueError, "expected TOML or JSON"),
        (VEHICLE.replace("_axle", ""), ValueError, "must say front_stiffness_per_tyre or"),
        (VEHICLE.replace("1500", "-1500"), ValueError, "mass: -1500 kg is not positive"),
        (VEHICLE.replace("1500", '"heavy"'), TypeError, "mass: expected a number, got 'heavy'"),
        (VEHICLE + "wings = 2\n", TypeError, "unknown vehicle parameter 'wings'"),
        (VEHICLE.replace("1500", "1" * 300), ValueError, "Vehicle.mass: 1111"),
        (VEHICLE.replace("1500", "1" * 5000), ValueError, "expected TOML or JSON, but Exceeds"),
        ("front_stiffness_axle = " + "1" * 400, ValueError, "front_stiffness_axle: .* number"),
        (VEHICLE.replace("1500", "1e-300"), ValueError, "mass: 1e-300 kg is not positive"),
        (VEHICLE.replace("1500", "true"), TypeError, "mass: expected a number, got True"),
        ("mass = " + "[" * 3000 + "]" * 3000, ValueError, "nested too deeply"),
        ('{"mass": ' + "[" * 99999 + "]" * 99999 + "}", ValueError, "nested too deeply"),
        ("mass" + ".mass" * 3000 + " = 1", TypeError, "mass: expected a number"),
        (f'"{"key " * 999}" = "text"', TypeError, "key key .*: expected a number"),
        ("".join(f"k{i} = 1\n" for i in range(999)), TypeError, "unknown vehicle parameter 'k0'"),
        ("name = 5", TypeError, "name: expected a text, got 5"),
        ("base = [1]", TypeError, "base: expected a text"),
    ],
    ids=range(19),
)
def test_a_bad_vehicle_file_is_refused(
    tmp_path: Path, content: str, error: type[Exception], message: str
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(content)
    with pytest.raises(error, match=message) as caught:
        read_vehicle(file)
    assert str(file) in str(caught.value) and len(str(caught.value)) < 500


def test_a_vehicle_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.toml.*ferrari-250lm-nominal"):
        read_vehicle(tmp_path / "nowhere.toml")
    with pytest.raises(ValueError, match="found a folder"):
        read_vehicle(tmp_path)


@pytest.mark.smoke
def test_the_vehicles_of_the_stanford_log_come_with_the_package() -> None:
    """Figures of the recording's source: axle stiffness is twice a tyre's."""
    nominal, fitted = map(read_vehicle, ("ferrari-250lm-nominal", "ferrari-250lm-fitted"))
    assert (nominal.mass, nominal.yaw_inertia) == (982.0, 1605.0)
    assert (nominal.front_stiffness, nominal.rear_stiffness) == (0.35e5, 0.6e5)
    assert (fitted.front_stiffness, fitted.rear_stiffness) == (2.165e4, 4.29e4)
    assert fitted.yaw_inertia == 1340.0
