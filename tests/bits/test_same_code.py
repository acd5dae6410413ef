"""The gate of renames and moves: it passes what only has other names, and finds each fault."""

from pathlib import Path

import pytest

from .same_code import main

OLD = {
    "__init__.py": "",
    "envs/__init__.py": "",
    "envs/cars.py": '''
"""Cars."""
from dataclasses import dataclass

import numpy as np

RATIOS = {"front": 0.4, "rear": 0.6}


@dataclass
class Car:
    """A car."""

    mass: float = 1.0
    long: "float" = 2.0

    def pull_of(self, a: float, b: float) -> float:
        """The pull."""
        first, second = a * self.mass, b * self.long
        return np.hypot(first, second) - abs(first)


def share(part: str, of: "Car") -> float:
    return RATIOS[part] * of.mass


def other(part: str, of: "Car") -> float:
    return RATIOS[part] * of.long
''',
    "envs/drive.py": """
from . import cars
from .cars import Car, share

_LIMITS = (1.0, 2.0)


def drive(car: Car, x: float) -> float:
    from .cars import other

    parts = [share(part=each, of=car) for each in ("front", "rear")]
    return cars.share("front", car) + other("rear", car) + car.pull_of(x, sum(parts)) + _LIMITS[1]
""",
}
NEW = {
    "__init__.py": "",
    "envs/__init__.py": "",
    "envs/vehicle.py": '''
from dataclasses import dataclass

import numpy as np

AXLE_SHARES = {"front": 0.4, "rear": 0.6}
DRIVE_LIMITS = (1.0, 2.0)


@dataclass
class Vehicle:
    """Another text."""

    mass: float = 1.0
    length: "float" = 2.0

    def compute_pull(self, x: float, y: float) -> float:
        along, across = x * self.mass, y * self.length
        return np.hypot(along, across) - abs(along)


def simulate(vehicle: Vehicle, x: float) -> float:
    parts = [compute_share(axle=x, vehicle=vehicle) for x in ("front", "rear")]
    return (
        compute_share("front", vehicle)
        + other("rear", vehicle)
        + vehicle.compute_pull(x, sum(parts))
        + DRIVE_LIMITS[1]
    )


def compute_share(axle: str, vehicle: "Vehicle") -> float:
    return AXLE_SHARES[axle] * vehicle.mass


def other(axle: str, vehicle: "Vehicle") -> float:
    return AXLE_SHARES[axle] * vehicle.length
''',
}
RENAMES = """file,old,new
envs/cars.py,RATIOS,AXLE_SHARES
envs/cars.py,Car,Vehicle
envs/cars.py,Car.long,length
envs/cars.py,Car.pull_of,compute_pull
envs/cars.py,share,compute_share
envs/drive.py,drive,simulate
envs/drive.py,_LIMITS,DRIVE_LIMITS
"""
MOVES = "old,new\nenvs/cars.py,envs/vehicle.py\nenvs/drive.py,envs/vehicle.py\n"


def compared(folder: Path, old: dict[str, str], new: dict[str, str], renames: str) -> int:
    """The exit status for two trees, whose files are written first."""
    for name, files in {"old": old, "new": new}.items():
        for file, text in files.items():
            path = folder / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    (folder / "renames.csv").write_text(renames)
    (folder / "moves.csv").write_text(MOVES)
    return main(*(folder / each for each in ("old", "new", "renames.csv", "moves.csv")))


def test_a_renamed_and_moved_tree_is_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compared(tmp_path, OLD, NEW, RENAMES) == 0, capsys.readouterr().out


FAULTS = {
    "swapped arguments": ("compute_pull(x, sum(parts))", "compute_pull(sum(parts), x)", "Call"),
    "swapped locals": (
        "hypot(along, across) - abs(along)",
        "hypot(along, across) - abs(across)",
        "",
    ),
    "another key": ('"rear": 0.6', '"back": 0.6', "string 'rear' is now 'back'"),
    "another constant of a table": ("(1.0, 2.0)", "(1.0, 2.5)", "2.0 is now 2.5"),
    "a constant of another type": ("(1.0, 2.0)", "(1, 2.0)", "1.0 is now 1"),
    "another operator": ("- abs", "+ abs", "Sub is now Add"),
    "another function": ('+ other("rear"', '+ compute_share("rear"', "'other') is now"),
    "another string": ('compute_share("front"', 'compute_share("rear"', "string 'front' is now"),
    "another keyword": ("vehicle=vehicle)", "mass=vehicle)", "keyword 'of' is now 'mass'"),
    "another field": ("self.length", "self.mass", "attribute 'long' is now 'mass'"),
    "a default": ("mass: float = 1.0", "mass: float = 1.5", "1.0 is now 1.5"),
    "what is gone": ("def other(", "def others(", "gone, expected as"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found(fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, other, said = FAULTS[fault]
    file = NEW["envs/vehicle.py"]
    assert file.count(text) == 1
    assert compared(tmp_path, OLD, NEW | {"envs/vehicle.py": file.replace(text, other)}, RENAMES)
    assert said in capsys.readouterr().out


def test_two_definitions_of_one_name_are_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for renames in ("drive,simulate", "drive,other"), ("share,compute_share", "share,other"):
        assert compared(tmp_path, OLD, NEW, RENAMES.replace(*renames))
        assert "one name for several" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("envs/cars.py,lost,found", "there is no lost"),
        ("envs/drive.py,drive,ride", "drive has two new names"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(row: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=said):
        compared(tmp_path, OLD, NEW, f"{RENAMES}{row}\n")
