"""What a scenario's fields may be; a value out of place is refused by its field's name."""

import math
from typing import TYPE_CHECKING

from ..sensors.gps import HDOP_LAWS
from ..sensors.noise import Noise
from ..vehicle.tyres import TYRE_LAWS
from .draws import Draws
from .steering import STEERING_KINDS
from .tracks import PATHS

if TYPE_CHECKING:
    from .scenario import Scenario

SHORTEST_GPS_PERIOD = 0.05  # s; an env keeps room for its packets
SIDES = ("side", "wind_side")  # drawn, but no fields

_NUMBERS = (
    "disturbance_force",
    "disturbance_moment",
    "disturbance_time",
    "curve_start",
    "curve_ramp",
    "speed_change",
    "change_start",
    "change_length",
    "surge",
    "surge_frequency",
    "wind_height",
    "bank",
    "grade",
    "half_width",
    "hdop",
    "hdop_time",
    "driver_preview",
    "driver_gain",
    "driver_lag",
    "driver_rate",
)
_POSITIVE = (
    "disturbance_time",
    "curve_ramp",
    "half_width",
    "change_length",
    "surge_frequency",
    "hdop",
    "hdop_time",
    "driver_preview",
    "driver_gain",
    "driver_rate",
)
_POSITIVE_DRAWS = (
    "frequency",
    "frequency_3",
    "front_stiffness",
    "rear_stiffness",
    "friction",
    "front_change",
    "rear_change",
)
_POSITIVE_OR_NONE = ("path_speed", "friction_right", "tyre_change_time")


def check(scenario: "Scenario") -> None:
    """ValueError for a field out of place, with the scenario's name and the field's."""
    _check_names(scenario)
    _check_draws(scenario)
    _check_numbers(scenario)
    _check_motion(scenario)
    _check_sensors(scenario)


def _refuse(scenario: "Scenario", message: str) -> None:
    raise ValueError(f"scenario {scenario.name!r}: {message}")


def _check_names(scenario: "Scenario") -> None:
    for value, known, what in (
        (scenario.steering, STEERING_KINDS, "steering"),
        (scenario.path, PATHS, "path"),
        (scenario.hdop_law, HDOP_LAWS, "hdop_law"),
        (scenario.tyres, TYRE_LAWS, "tyres"),
    ):
        if value not in known:
            _refuse(scenario, f"unknown {what} {value!r}; known: {', '.join(known)}")
    unknown = sorted(set(scenario.noise) - set(Noise._fields))
    if unknown:
        _refuse(scenario, f"unknown noise {', '.join(unknown)}")
    if scenario.path != "road" and scenario.steering != "driver":
        _refuse(
            scenario,
            f"path {scenario.path!r} needs the steering 'driver', got {scenario.steering!r}",
        )
    if scenario.path_speed is not None and scenario.path == "road":
        _refuse(scenario, "path_speed needs a track as path; a road has no lengths to scale")


def _check_draws(scenario: "Scenario") -> None:
    for name in Draws._fields:
        if name in SIDES:
            continue
        low, high = scenario.range(name)
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            value = getattr(scenario, name)
            _refuse(scenario, f"{name} {value!r} is not finite, or its ends are swapped")
    for name in _POSITIVE_DRAWS:
        if scenario.range(name)[0] <= 0.0:
            _refuse(scenario, f"{name} must be positive")
    for name in _POSITIVE_OR_NONE:
        value = getattr(scenario, name)
        if value is not None and scenario.range(name)[0] <= 0.0:
            _refuse(scenario, f"{name} must be positive or None, got {value!r}")
    for name in ("front_change", "rear_change"):
        if scenario.tyre_change_time is None and scenario.range(name) != (1.0, 1.0):
            value = getattr(scenario, name)
            _refuse(scenario, f"{name} {value!r} needs a tyre_change_time, from which it acts")
    if scenario.steering in ("ramp", "sweep") and scenario.range("hold")[0] < 0.001:
        _refuse(scenario, f"hold of a {scenario.steering} is 1 ms or more, got {scenario.hold!r}")
    if scenario.steering == "sine-with-dwell" and scenario.range("hold")[0] < 0.0:
        _refuse(scenario, f"hold of a dwell is not negative, got {scenario.hold!r}")


def _check_numbers(scenario: "Scenario") -> None:
    if not (scenario.duration > 0.0 and math.isfinite(scenario.duration)):
        _refuse(scenario, f"duration {scenario.duration!r} s")
    numbers = {name: getattr(scenario, name) for name in _NUMBERS} | dict(scenario.noise)
    for name, value in (numbers | {"acceleration": scenario.acceleration or 0.0}).items():
        if not math.isfinite(value):
            _refuse(scenario, f"{name} {value!r} is not finite")
    for name in _POSITIVE:
        if not getattr(scenario, name) > 0.0:
            _refuse(scenario, f"{name} must be positive, got {getattr(scenario, name)!r}")
    if scenario.driver_lag < 0.0:
        _refuse(scenario, f"driver_lag is zero or more, got {scenario.driver_lag!r}")


def _check_motion(scenario: "Scenario") -> None:
    slowest = scenario.range("speed")[0]
    if slowest < 0.0 or slowest + scenario.speed_change < 0.0:
        _refuse(scenario, "speed must not be negative, with speed_change or without")
    if scenario.acceleration is not None and (scenario.speed_change or scenario.surge):
        _refuse(scenario, "speed_change and surge need the held speed (acceleration None)")
    if scenario.path_speed is not None and slowest <= 0.0:
        _refuse(scenario, "path_speed needs a speed above zero")
    if max(abs(scenario.bank), abs(scenario.grade)) > 0.5:
        _refuse(
            scenario,
            f"bank and grade are up to 0.5 rad, got {scenario.bank!r}, {scenario.grade!r}",
        )


def _check_sensors(scenario: "Scenario") -> None:
    if not 0.0 <= scenario.hdop_spread <= 1.0:
        _refuse(scenario, f"hdop_spread is 0 to 1, got {scenario.hdop_spread!r}")
    period = scenario.gps_period
    if period is not None and not period >= SHORTEST_GPS_PERIOD:
        _refuse(scenario, f"gps_period is {SHORTEST_GPS_PERIOD} s or more, got {period!r}")
    if scenario.camera_jitter and scenario.camera_delays is None:
        _refuse(scenario, "camera_jitter needs camera_delays")
