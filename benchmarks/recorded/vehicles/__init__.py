"""Vehicles of recorded drives: files to read, and those that come with the package."""

import json
import tomllib
from pathlib import Path
from typing import Any

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
    except ValueError as error:  # of the decoder, of JSON or of TOML
        raise ValueError(f"{source}: expected TOML or JSON, but {error}") from None
    if not values:
        raise ValueError(f"{source}: the file names no parameter")
    for key, value in values.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if key not in ("name", "base") and not number:
            raise TypeError(f"{source}: {key}: expected a number, got {value!r}")
    return vehicle_from_file_values(values, str(source))
