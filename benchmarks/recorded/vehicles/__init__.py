"""Vehicles of recorded drives: files to read, and those that come with the package."""

import json
import tomllib
from pathlib import Path
from typing import Any

from ....envs.arguments import brief
from ....envs.vehicle.vehicle import Vehicle, vehicle_from_file_values

_HERE = Path(__file__).parent

SHIPPED = {path.stem: path for path in sorted(_HERE.glob("*.toml"))}
"""The files that come with the package, by name."""


def read_vehicle(path: str | Path) -> Vehicle:
    """A vehicle from a TOML or JSON file, or by the name of one that comes with the package.

    Keys are `Vehicle`'s parameters; stiffnesses are called `..._per_tyre` or `..._axle`, what is
    left out comes from the preset under `base` (the passenger car).

    Raises FileNotFoundError, ValueError for a file that is neither or holds a bad value, TypeError
    for an unknown parameter and one that is no number.
    """
    source = SHIPPED.get(str(path), Path(path))
    if not source.exists():
        raise FileNotFoundError(
            f"no vehicle file {source}; those that come with the package: {', '.join(SHIPPED)}"
        )
    if not source.is_file():
        raise ValueError(f"{source}: expected a vehicle file, found a folder")
    try:
        text = source.read_text(encoding="utf-8")
        values: Any = json.loads(text) if text.lstrip().startswith("{") else tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"{source}: expected TOML or JSON, but it is nested too deeply") from None
    except (ValueError, OSError) as error:  # of the decoder, of JSON or of TOML
        raise ValueError(f"{source}: expected TOML or JSON, but {error}") from None
    if not values:
        raise ValueError(f"{source}: the file names no parameter")
    for key, value in values.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        fits = isinstance(value, str) if key in ("name", "base") else number
        if not fits:
            wanted = "a text" if key in ("name", "base") else "a number"
            raise TypeError(f"{source}: {key:.80}: expected {wanted}, got {brief(value)}")
    return vehicle_from_file_values(values, str(source))
