"""What a scenario's fields may be; a value out of place is refused by its field's name."""

import dataclasses
import math
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any

from ..arguments import check_choice, describe_unknown, is_finite, join_names, short_repr
from ..sensors.gps import HDOP_LAWS
from ..sensors.noise import Noise
from ..ticks import TICK
from ..vehicle.tyres import TYRE_LAWS
from ..vehicle.vehicle import Vehicle
from .draws import Draws, get_range
from .roads import ROADS
from .steering import STEERING_KINDS
from .tracks import PATHS

Fields = Mapping[str, Any]

MAX_SLIP = 1.5  # rad: a start beyond it has no speed along the car
MIN_GPS_PERIOD = 0.05  # s; an env keeps room for its packets
MAX_SAMPLES = 1_000_000  # of a trace
SIDES = ("side", "wind_side")  # drawn, but no fields

TIER_NAMES = ("", "1", "2a", "2b", "2c")

_CHOICES = {
    "steering": STEERING_KINDS,
    "path": PATHS,
    "road": ROADS,
    "hdop_law": HDOP_LAWS,
    "tyres": TYRE_LAWS,
    "tier": TIER_NAMES,
}
_PARAMETERS = [entry.name for entry in dataclasses.fields(Vehicle)]
_FLAGS = ("mirror", "small_angle", "lags", "roll")
_NUMBERS_OR_NONE = ("acceleration", "gps_period")
_DRAWS_OR_NONE = ("path_speed", "friction_right", "tyre_change_time")
_MAY_BE_INFINITE = ("half_width", "camera_heading", "camera_offset")
_TIMES_OR_NONE = {  # how many
    "camera_delays": (1, 2, 3, 4),
    "gps_delays": (1, 2, 3, 4),
    "camera_outage": (2,),
    "gps_outage": (2,),
}


def check_fields(fields: Fields, entries: Sequence[dataclasses.Field[Any]]) -> None:
    """Check the fields of a scenario; messages have its name and the field's.

    What is plausible above zero alone must be positive.

    Args:
        fields: Values by the names of fields.
        entries: Fields of the dataclass; those of type float are one number, neither drawn nor
            None.

    Raises:
        type: ValueError for a field out of place, TypeError for an unknown vehicle parameter.
    """
    numbers = [spec.name for spec in entries if spec.type is float]
    positive = {spec.name for spec in entries if spec.metadata.get("plausible", (0,))[0] > 0}
    try:
        _check_names(fields)
        _check_mappings(fields)
        _check_numbers(fields, numbers, positive)
        _check_draws(fields, positive)
        _check_motion(fields)
        _check_sensors(fields)
        _check_trace(fields)
    except (TypeError, ValueError) as error:
        raise type(error)(f"scenario {short_repr(fields['name'])}: {error}") from None


def _check_names(fields: Fields) -> None:
    if not isinstance(fields["name"], str):
        raise ValueError("name is no text")
    for what, known in _CHOICES.items():
        check_choice(what, fields[what], known)
    for name in _FLAGS:
        if not isinstance(fields[name], bool):
            raise ValueError(f"{name} is True or False, got {short_repr(fields[name])}")
    if fields["path"] != "road" and fields["steering"] != "driver":
        raise ValueError(
            f"path {fields['path']!r} needs the steering 'driver', got {fields['steering']!r}"
        )
    if fields["road"] == "nominal-path" and fields["steering"] == "driver":
        raise ValueError("road 'nominal-path' follows a programme's steering, not a driver's")
    if fields["road"] == "nominal-path" and get_range(fields["curvature"]) != (0.0, 0.0):
        raise ValueError(f"road 'nominal-path' has no curvature, got {fields['curvature']!r}")
    if fields["path_speed"] is not None and fields["path"] == "road":
        raise ValueError("path_speed needs a track as path; a road has no lengths to scale")


def _check_trace(fields: Fields) -> None:
    trace, steering = fields["trace"], fields["steering"]
    if not isinstance(trace, tuple) or not all(map(is_finite, trace)):
        raise ValueError(f"trace is angles in rad, finite ones, got {short_repr(trace)}")
    if (len(trace) > 1) != (steering == "trace") or len(trace) > MAX_SAMPLES:
        raise ValueError(
            f"trace has 2 to {MAX_SAMPLES} angles where the steering is 'trace', else none; got "
            f"{len(trace)} with {steering!r}"
        )
    if fields["trace_step"] < TICK:
        raise ValueError(f"trace_step is {TICK} s or more, got {fields['trace_step']!r}")


def _check_mappings(fields: Fields) -> None:
    for name in ("vehicle", "nominal", "noise"):
        values = fields[name]
        if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
            raise ValueError(f"{name} is a mapping of names to numbers, got {short_repr(values)}")
        if name != "noise" and (unknown := [key for key in values if key not in _PARAMETERS]):
            raise TypeError(describe_unknown(f"parameter of {name}", unknown, _PARAMETERS))
    unknown = sorted(set(fields["noise"]) - set(Noise._fields))
    if unknown:
        raise ValueError(f"unknown noise {join_names(unknown)}; known: {join_names(Noise._fields)}")
    for name, value in fields["noise"].items():
        _check_number(f"noise {name}", value)


def _check_number(name: str, value: Any) -> None:
    if not is_finite(value):
        raise ValueError(f"{name} {short_repr(value)} is not finite")


def _check_numbers(fields: Fields, numbers: Iterable[str], positive: Container[str]) -> None:
    for name in numbers:
        if name not in _MAY_BE_INFINITE:
            _check_number(name, fields[name])
    for name in _NUMBERS_OR_NONE:
        _check_number(name, 0.0 if fields[name] is None else fields[name])
    width = fields["half_width"]  # only compared with: it may be as wide as a float can be
    if not (is_finite(width) or (isinstance(width, float) and math.isfinite(width))):
        raise ValueError(f"half_width {short_repr(width)} is not finite")
    for name in ("camera_heading", "camera_offset"):
        if not (isinstance(fields[name], float) and fields[name] == math.inf):
            _check_number(name, fields[name])
    for name in numbers:
        if name in positive and not fields[name] > 0.0:
            raise ValueError(f"{name} must be positive, got {fields[name]!r}")
    if fields["duration"] < TICK:
        raise ValueError(f"duration {fields['duration']!r} s is less than {TICK}")
    if fields["driver_lag"] < 0.0:
        raise ValueError(f"driver_lag is zero or more, got {fields['driver_lag']!r}")


def _check_draws(fields: Fields, positive: Container[str]) -> None:
    for name in Draws._fields:
        if name in SIDES or (name in _DRAWS_OR_NONE and fields[name] is None):
            continue
        value = fields[name]
        ends = value if isinstance(value, tuple) else (value, value)
        if not (len(ends) == 2 and all(map(is_finite, ends)) and ends[0] <= ends[1]):
            raise ValueError(f"{name} {short_repr(value)} is not finite, or its ends are swapped")
        if name in positive and ends[0] <= 0.0:
            none_text = " or None" if name in _DRAWS_OR_NONE else ""
            raise ValueError(f"{name} must be positive{none_text}, got {value!r}")
    for name in ("front_change", "rear_change"):
        if fields["tyre_change_time"] is None and get_range(fields[name]) != (1.0, 1.0):
            raise ValueError(
                f"{name} {fields[name]!r} needs a tyre_change_time, from which it acts"
            )
    steering, hold = fields["steering"], fields["hold"]
    if steering in ("ramp", "sweep", "wander") and get_range(hold)[0] < TICK:
        raise ValueError(f"hold of a {steering} is 1 ms or more, got {hold!r}")
    if steering == "sine-with-dwell" and get_range(hold)[0] < 0.0:
        raise ValueError(f"hold of a dwell is not negative, got {hold!r}")


def _check_motion(fields: Fields) -> None:
    min_speed = get_range(fields["speed"])[0]
    if min_speed < 0.0 or min_speed + fields["speed_change"] < 0.0:
        raise ValueError("speed must not be negative, with speed_change or without")
    if not fields["change_length"] >= TICK:
        raise ValueError(f"change_length is {TICK:g} s at least, got {fields['change_length']!r}")
    if fields["acceleration"] is not None and (fields["speed_change"] or fields["surge"]):
        raise ValueError("speed_change and surge need the held speed (acceleration None)")
    if fields["path_speed"] is not None and min_speed <= 0.0:
        raise ValueError("path_speed needs a speed above zero")
    bank, grade = fields["bank"], fields["grade"]
    if max(map(abs, (*get_range(bank), grade))) > 0.5:
        raise ValueError(f"bank and grade are up to 0.5 rad, got {bank!r}, {grade!r}")
    beta = fields["initial_beta"]
    if max(map(abs, get_range(beta))) > MAX_SLIP:
        raise ValueError(f"initial_beta is up to {MAX_SLIP} rad, got {beta!r}")


def _check_sensors(fields: Fields) -> None:
    if not 0.0 <= fields["hdop_spread"] <= 1.0:
        raise ValueError(f"hdop_spread is 0 to 1, got {fields['hdop_spread']!r}")
    for name, counts in _TIMES_OR_NONE.items():
        value = fields[name]
        fits = isinstance(value, tuple) and len(value) in counts and all(map(is_finite, value))
        if value is not None and not (fits and min(value) >= 0.0):
            count_text = " to ".join(str(count) for count in sorted({counts[0], counts[-1]}))
            raise ValueError(
                f"{name} is {count_text} times in s, zero or more, got {short_repr(value)}"
            )
    period = fields["gps_period"]
    if period is not None and not period >= MIN_GPS_PERIOD:
        raise ValueError(f"gps_period is {MIN_GPS_PERIOD} s or more, got {period!r}")
    if get_range(fields["gps_latency"])[0] < 0.0:
        raise ValueError(f"gps_latency is zero or more, got {fields['gps_latency']!r}")
    if fields["camera_jitter"] < 0.0:
        raise ValueError(f"camera_jitter is zero or more, got {fields['camera_jitter']!r}")
    if not 0.0 <= fields["camera_loss"] < 1.0:
        raise ValueError(f"camera_loss is a probability below 1, got {fields['camera_loss']!r}")
    if fields["camera_jitter"] and fields["camera_delays"] is None:
        raise ValueError("camera_jitter needs camera_delays")
