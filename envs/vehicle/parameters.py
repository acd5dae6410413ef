"""The vehicle's parameters with units and plausible ranges; vehicles by name, file or mapping."""

import dataclasses
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..io import is_document, read_document
from ..validation import (
    MAX_NUMBER,
    check_choice,
    check_plausible,
    describe_unknown,
    is_finite,
    quantity,
    short_repr,
)

GRAVITY = 9.81
LATERAL_FIELDS = (
    "mass", "yaw_inertia", "front_arm", "rear_arm", "front_stiffness", "rear_stiffness",
)  # fmt: skip
"""Parameters of a linear bicycle, in the order of `linear.Bicycle`."""
_POINT_INERTIA = ("mass", "front_arm", "rear_arm")  # inertia of two points over the axles
MIN_RELAXATION = 0.05  # m: a tick of 1 ms follows no shorter one at 100 m/s
_MIN_NUMBER = 1.0 / MAX_NUMBER  # a parameter below it counts as zero: it is divided by


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """A car with two in-wheel motors at the rear axle.

    Cornering stiffness is per tyre, as in the papers (an axle has 2 C). Letters of the papers
    stand in the descriptions: `Vehicle.__dataclass_fields__[name].metadata` has text and unit,
    and the plausible range that `make_vehicle` and environments check.

    Raises ValueError on a value that is not finite or not positive (lags, motor_power,
    transfer_height and relaxation may be zero, the antenna's place may be negative), or a
    relaxation too short for the plant's steps.
    """

    name: str = "vehicle"
    mass: float = quantity("kg", 0.01, 1e5, "m")
    yaw_inertia: float = quantity("kg m2", 0.1, 10, "I about the vertical axis", per=_POINT_INERTIA)
    front_arm: float = quantity("m", 0.01, 10, "l_f, centre of gravity to front axle")
    rear_arm: float = quantity("m", 0.01, 10, "l_r, centre of gravity to rear axle")
    front_stiffness: float = quantity("N/rad", 3, 600, "C_f, one front tyre", per=("mass",))
    rear_stiffness: float = quantity("N/rad", 3, 600, "C_r, one rear tyre", per=("mass",))
    front_track: float = quantity("m", 0.01, 5, "d_f, between the front wheels")
    rear_track: float = quantity("m", 0.01, 5, "d_r, between the rear wheels")
    wheel_radius: float = quantity("m", 0.005, 2, "r")
    gravity_height: float = quantity("m", 0.005, 5, "h, height of the centre of gravity")
    motor_torque: float = quantity("N m", 0.001, 5e4, "T_max, limit of one motor")
    motor_lag: float = quantity("s", 0, 1, "time constant of the motors", 0.005)
    steering_lag: float = quantity("s", 0, 1, "time constant of the steering actuator", 0.03)
    steering_stop: float = quantity("rad", 0.01, 1.6, "largest angle that steering adds up to", 0.6)
    steering_authority: float = quantity("rad", 0.001, 1.6, "largest added to the driver's", 0.1)
    steering_rate: float = quantity("rad/s", 0.01, 30, "how fast the added angle may change", 0.8)
    preview: float = quantity("m", 0.05, 200, "l_pre, the camera's preview distance", 5.135)
    friction: float = quantity("-", 0.02, 2.5, "mu, tyre to road (a scenario has its own)", 0.9)
    width: float = quantity("m", 0.01, 5, "over all; the lanes of test tracks go by it", 1.8)
    sprung_mass: float = quantity("kg", 0.005, 1e5, "M_s, the part of the mass that rolls")
    roll_arm: float = quantity("m", 0.001, 5, "h_s, centre of gravity above the roll axis")
    roll_inertia: float = quantity("kg m2", 1e-7, 1e6, "I_x, about the roll axis")
    roll_stiffness: float = quantity("N m/rad", 0.001, 1e8, "K_x, of the suspension")
    roll_damping: float = quantity("N m s/rad", 1e-5, 1e7, "C_x, of the suspension")
    antenna_ahead: float = quantity("m", -20, 20, "GPS antenna ahead of the centre of gravity", 0.0)
    antenna_left: float = quantity("m", -20, 20, "GPS antenna left of the centre of gravity", 0.0)
    motor_power: float = quantity("W", 0, 1e7, "limit of one motor, also braking; 0: none", 0.0)
    transfer_height: float = quantity("m", 0, 5, "where drive force moves load between axles", 0.0)
    relaxation: float = quantity("m", 0, 3, "length of magic-formula tyres: 0, or 0.05 up", 0.0)

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if entry.name == "name":
                if not isinstance(value, str):
                    raise TypeError(f"Vehicle.name: expected a text, got {short_repr(value)}")
                continue
            if not isinstance(value, int | float) or isinstance(value, bool):
                raise TypeError(f"Vehicle.{entry.name}: expected a number, got {short_repr(value)}")
            requirement, is_low_ok = "positive and ", value > _MIN_NUMBER
            if entry.metadata["plausible"][0] == 0:
                requirement, is_low_ok = "zero or more and ", value > _MIN_NUMBER or value == 0.0
            elif entry.metadata["plausible"][0] < 0:
                requirement, is_low_ok = "", True
            if not (is_finite(value) and is_low_ok):
                got = f"{short_repr(value)} {entry.metadata['unit']}"
                raise ValueError(f"Vehicle.{entry.name}: {got} is not {requirement}finite")
        if 0.0 < self.relaxation < MIN_RELAXATION:
            got, rule = short_repr(self.relaxation), f"neither 0 nor {MIN_RELAXATION} or more"
            raise ValueError(f"Vehicle.relaxation: {got} m is {rule}")

    def replace(self, **changes: Any) -> "Vehicle":
        """Copy the vehicle with some parameters changed; TypeError on an unknown name.

        Args:
            changes: New values by the names of fields.
        """
        return dataclasses.replace(self, **changes)

    def scale_stiffness(self, front: float, rear: float | None = None) -> "Vehicle":
        """Copy the vehicle with its cornering stiffnesses scaled.

        Args:
            front: Factor on the front stiffness.
            rear: Factor on the rear stiffness; None for `front`.
        """
        return self.replace(
            front_stiffness=self.front_stiffness * front,
            rear_stiffness=self.rear_stiffness * (front if rear is None else rear),
        )

    @property
    def lateral(self) -> tuple[float, ...]:
        """The parameters of `LATERAL_FIELDS`."""
        return tuple(getattr(self, name) for name in LATERAL_FIELDS)

    @property
    def wheelbase(self) -> float:
        """l = l_f + l_r in m."""
        return self.front_arm + self.rear_arm

    @property
    def roll_moment_arm(self) -> float:
        """M_s h_s in kg m: the roll moment of 1 m/s2."""
        return self.sprung_mass * self.roll_arm

    def check_roll(self) -> None:
        """Check that the body stays upright and its inertia suits its mass; else ValueError."""
        low = self.roll_moment_arm * GRAVITY
        if self.roll_stiffness <= low:
            got = f"{self.roll_stiffness!r} N m/rad does not hold the body upright"
            rule = f"its weight takes M_s g h_s = {low:.6g}"
            raise ValueError(f"Vehicle.roll_stiffness: {got}; {rule}")
        low = self.roll_moment_arm**2 / self.mass
        if self.roll_inertia <= low:
            got = f"{self.roll_inertia!r} kg m2 about the roll axis"
            body = f"a sprung mass of {self.sprung_mass!r} kg at {self.roll_arm!r} m"
            rule = f"{body} on a car of {self.mass!r} kg has more than {low:.6g}"
            raise ValueError(f"Vehicle.roll_inertia: {got}; {rule}")

    @property
    def yaw_moment_limit(self) -> float:
        """The largest yaw moment of the two motors in N m (372.7 for the COMS)."""
        return self.motor_torque * self.rear_track / self.wheel_radius

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON types, which `make_vehicle` reads."""
        return dataclasses.asdict(self)


def critical_speed(vehicle: Vehicle) -> float:
    """Compute the speed (m/s) above which the linear vehicle is unstable; inf if it understeers.

    Args:
        vehicle: Vehicle with stiffnesses and arms.
    """
    excess = vehicle.front_stiffness * vehicle.front_arm - vehicle.rear_stiffness * vehicle.rear_arm
    if excess <= 0.0:
        return math.inf
    product = 2.0 * vehicle.front_stiffness * vehicle.rear_stiffness * vehicle.wheelbase**2
    return math.sqrt(product / (vehicle.mass * excess))


_PRESETS = Path(__file__).parent / "presets"
PASSENGER_CAR = Vehicle(**read_document(_PRESETS / "passenger-car.toml", "vehicle"))


VehicleSource = str | os.PathLike[str] | Mapping[str, Any] | Vehicle
"""A vehicle's name, file, parameters or itself, as `make_vehicle` takes it."""

_STIFFNESS = ("front_stiffness", "rear_stiffness")
WIRE_TABLES = ("steering", "latency", "noise", "at")
"""Tables of a vehicle's file that are of its sensors: `sideslip identify` writes them."""
_CONVENTIONS = {"_per_tyre": 1.0, "_axle": 0.5}  # tyres' share of the number
_FIELDS = [entry.name for entry in dataclasses.fields(Vehicle)]
_YOUNGER = ("relaxation",)  # parameters that complete mappings in older files lack


def make_vehicle(source: VehicleSource, strict: bool = True) -> Vehicle:
    """Make a vehicle from its name, a TOML or JSON file, or a mapping of parameters.

    Keys are those of `Vehicle`. A cornering stiffness is `front_stiffness_per_tyre` or
    `front_stiffness_axle` (both tyres together), and so for the rear; `front_stiffness` is per
    tyre in a mapping that has every parameter, as `Vehicle.to_dict` makes one, and else refused.
    What is left out is that of the vehicle under `base` (a name or another file); without one it is
    the passenger car's, except for mass, inertia, arms and stiffnesses, which must be present. A
    file without a `name` has that of the file. Messages name the file. An unreadable one raises
    FileNotFoundError or ValueError; an unknown name, a missing parameter, a value out of place, and
    a stiffness of no convention or of two ValueError; an unknown parameter, one that is no number,
    and another kind of source TypeError.

    Args:
        source: Name in `VEHICLES`, path, mapping of parameters, or a `Vehicle`, returned as it is.
        strict: Whether implausible numbers of a file or a mapping are refused.
    """
    if isinstance(source, Vehicle):
        return source
    if isinstance(source, Mapping):
        is_complete = all(name in source for name in _FIELDS if name not in _YOUNGER)
        older = dict.fromkeys(_YOUNGER, 0.0) if is_complete else {}
        return _parse_vehicle(older | dict(source), strict, is_complete)
    if is_document(source):
        return _read_vehicle(Path(source), strict)
    if not isinstance(source, str):
        rule = "a name, the path of a TOML or JSON file or a mapping of parameters"
        raise TypeError(f"a vehicle is {rule}, got {short_repr(source)}")
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
    """Key of a parameter in a message, or both keys of a stiffness."""
    return " or ".join(map(name.__add__, _CONVENTIONS)) if name in _STIFFNESS else name


def _parse_vehicle(values: dict[str, Any], strict: bool, is_complete: bool = False) -> Vehicle:
    """Vehicle of a mapping; its stiffnesses name their convention unless it is complete."""
    has_base = "base" in values
    base = make_vehicle(values.pop("base", PASSENGER_CAR.replace(name="vehicle")), strict)
    for name in _STIFFNESS:
        present = [key for key in (name, *map(name.__add__, _CONVENTIONS)) if key in values]
        if len(present) > 1:
            raise ValueError(f"{' and '.join(present)} exclude each other: one convention an axle")
        if name in present and not is_complete:
            raise ValueError(f"{name} must name its convention: {_format_key(name)}")
        for convention, share in _CONVENTIONS.items():
            if name + convention in values:
                value = values.pop(name + convention)
                values[name] = value * share if is_finite(value) else value  # refused by `Vehicle`
    if unknown := [key for key in values if key not in _FIELDS]:
        suffixed = [name + suffix for name in _STIFFNESS for suffix in _CONVENTIONS]
        known = [*_FIELDS, "base", *suffixed]
        raise TypeError(describe_unknown("vehicle parameter", unknown, known))
    missing = ", ".join(_format_key(name) for name in LATERAL_FIELDS if name not in values)
    if missing and not has_base:
        raise ValueError(f"missing {missing} (or name a vehicle under 'base')")
    vehicle = base.replace(**values)
    if strict:
        check_plausible(vehicle)
    return vehicle


COMS = _read_vehicle(_PRESETS / "coms.toml")
VEHICLES: dict[str, Vehicle] = {"coms": COMS, "passenger-car": PASSENGER_CAR}
"""Vehicles by name: two presets, and those of recorded drives."""
for _path in sorted({*_PRESETS.glob("*.toml")} - {_PRESETS / f"{name}.toml" for name in VEHICLES}):
    VEHICLES[_path.stem] = _read_vehicle(_path)
