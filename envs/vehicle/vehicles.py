"""Vehicles by name, from files and from mappings: one reader for whatever takes a vehicle."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..arguments import check_choice, describe_unknown, is_finite, short_repr
from ..documents import is_document, read_document
from ..quantities import check_plausible
from .vehicle import COMS, LATERAL_FIELDS, PASSENGER_CAR, Vehicle

VehicleSource = str | os.PathLike[str] | Mapping[str, Any] | Vehicle
"""What `make_vehicle` takes."""

_STIFFNESS = ("front_stiffness", "rear_stiffness")
WIRE_TABLES = ("steering", "latency", "noise")
"""Tables that a vehicle's file may hold beside the car: what `sideslip identify` found of its
wires, which `sideslip replay` applies and everybody else leaves alone."""
_CONVENTIONS = {"_per_tyre": 1.0, "_axle": 0.5}  # tyres' share of the number
_FIELDS = [entry.name for entry in dataclasses.fields(Vehicle)]


def make_vehicle(source: VehicleSource, strict: bool = True) -> Vehicle:
    """Make a vehicle from its name, a TOML or JSON file, or a mapping of parameters.

    Keys are those of `Vehicle`. A cornering stiffness is `front_stiffness_per_tyre` or
    `front_stiffness_axle` (both tyres together), and so for the rear; `front_stiffness` is per
    tyre in a mapping that has every parameter, as `Vehicle.to_dict` makes one, and else refused.
    What is left out is that of the vehicle under `base` (a name or another file); without one it is
    the passenger car's, except for mass, inertia, arms and stiffnesses, which must be present. A
    file without a `name` has that of the file. An unreadable file raises FileNotFoundError or
    ValueError, a value out of place ValueError; messages name the file.

    Args:
        source: Name in `VEHICLES`, path, mapping of parameters, or a `Vehicle`, returned as it is.
        strict: Whether implausible numbers of a file or a mapping are refused.

    Returns:
        The vehicle.

    Raises:
        TypeError: For an unknown parameter, one that is no number, or another kind of source;
            ValueError for an unknown name, a missing parameter, or a stiffness of no convention or
            of two.
    """
    if isinstance(source, Vehicle):
        return source
    if isinstance(source, Mapping):
        return _parse_vehicle(
            dict(source), strict, is_complete=all(name in source for name in _FIELDS)
        )
    if is_document(source):
        return _read_vehicle(Path(source), strict)
    if not isinstance(source, str):
        raise TypeError(
            "a vehicle is a name, the path of a TOML or JSON file or a mapping of parameters, "
            f"got {short_repr(source)}"
        )
    check_choice("vehicle", source, VEHICLES)
    return VEHICLES[source]


def _read_vehicle(path: Path, strict: bool = True) -> Vehicle:
    values = read_document(path, "vehicle")
    values = {name: value for name, value in values.items() if name not in WIRE_TABLES}
    try:
        return _parse_vehicle({"name": path.stem} | values, strict)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{path}: {error}") from None


def _format_key(name: str) -> str:
    """A parameter's key, both where a stiffness has two."""
    return " or ".join(map(name.__add__, _CONVENTIONS)) if name in _STIFFNESS else name


def _parse_vehicle(values: dict[str, Any], strict: bool, is_complete: bool = False) -> Vehicle:
    """A vehicle of a mapping, whose stiffnesses become those of a tyre, and are if it is whole."""
    has_base = "base" in values
    base = make_vehicle(values.pop("base", PASSENGER_CAR.replace(name="vehicle")), strict)
    for name in _STIFFNESS:
        present_keys = [key for key in (name, *map(name.__add__, _CONVENTIONS)) if key in values]
        if len(present_keys) > 1:
            raise ValueError(
                f"{' and '.join(present_keys)} exclude each other: one convention an axle"
            )
        if name in present_keys and not is_complete:
            raise ValueError(f"{name} must name its convention: {_format_key(name)}")
        for convention, share in _CONVENTIONS.items():
            if name + convention in values:
                value = values.pop(name + convention)
                values[name] = value * share if is_finite(value) else value  # refused by `Vehicle`
    if unknown := [key for key in values if key not in _FIELDS]:
        keys = [
            *_FIELDS,
            "base",
            *(name + suffix for name in _STIFFNESS for suffix in _CONVENTIONS),
        ]
        raise TypeError(describe_unknown("vehicle parameter", unknown, keys))
    missing = [name for name in LATERAL_FIELDS if name not in values]
    if missing and not has_base:
        raise ValueError(
            f"missing {', '.join(map(_format_key, missing))} (or name a vehicle under 'base')"
        )
    vehicle = base.replace(**values)
    if strict:
        check_plausible(vehicle)
    return vehicle


VEHICLES: dict[str, Vehicle] = {"coms": COMS, "passenger-car": PASSENGER_CAR}
"""Every vehicle that has a name: two presets, and those of recorded drives, from files."""

for _path in sorted((Path(__file__).parent / "presets").glob("*.toml")):
    VEHICLES[_path.stem] = _read_vehicle(_path)
