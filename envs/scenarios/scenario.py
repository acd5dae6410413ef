"""`Scenario`: a manoeuvre as a frozen dataclass, with the checks of its fields."""

import dataclasses
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np

from ..io import write_document
from ..numerics.functions import TICK
from ..record import Array
from ..sensors.inertial import Noise
from ..sensors.slow import HDOP_LAWS
from ..validation import check_choice, describe_unknown, is_finite, quantity, short_repr
from ..vehicle.parameters import Vehicle
from ..vehicle.tyres import TYRE_LAWS
from .driver import STEERING_KINDS
from .road import PATHS, ROADS
from .world import IDEAL, KMH, Draws, Range, World, get_range

Fields = dict[str, Any]
"""Fields of a `Scenario` by name, each of a type of its own."""
_Times = tuple[float, ...] | None
_MAX_SLIP = 1.5  # rad: a start beyond it has no speed along the car
MIN_GPS_PERIOD = 0.05  # s; an env keeps room for its packets
_MAX_SAMPLES = 1_000_000  # of a trace
_SIDES = ("side", "wind_side")  # drawn, but no fields
_TIER_NAMES = ("", "1", "2a", "2b", "2c", "small car", "road", "limit")
_PARAMETERS = [entry.name for entry in dataclasses.fields(Vehicle)]


def _choose(text: str, default: object, *known: str) -> Any:
    """Make a field without a unit: a known name, a flag, or a `dict` of numbers by name."""
    metadata = {"text": text, "known": known}
    if default is dict:
        return field(default_factory=dict, metadata=metadata)
    return field(default=default, metadata=metadata)


def _check_field(entry: dataclasses.Field[object], value: Any) -> None:
    """Check a value by its field's type; what is plausible above zero alone must be positive."""
    name, kind, got = entry.name, entry.type, short_repr(value)
    if value is None and entry.default is None:
        return
    if known := entry.metadata.get("known"):
        check_choice(name, value, known)
    elif kind is bool and not isinstance(value, bool):
        raise ValueError(f"{name} is True or False, got {got}")
    elif kind is str and not isinstance(value, str):
        raise ValueError(f"{name} is no text")
    elif name == "trace" and not (isinstance(value, tuple) and all(map(is_finite, value))):
        raise ValueError(f"trace is angles in rad, finite ones, got {got}")
    elif kind == _Times:
        counts = (2,) if name.endswith("outage") else (1, 2, 3, 4)
        fits = isinstance(value, tuple) and len(value) in counts and all(map(is_finite, value))
        if not (fits and min(value) >= 0.0):
            number = " to ".join(map(str, sorted({counts[0], counts[-1]})))
            raise ValueError(f"{name} is {number} times in s, zero or more, got {got}")
        if len(counts) == 1 and value[0] >= value[1]:
            raise ValueError(f"{name} is (from, to), from before to, got {got}")
    elif kind == Mapping[str, float]:
        _check_mapping(name, value)
    elif "plausible" in entry.metadata:
        is_drawn = name in Draws._fields
        ends = value if is_drawn and isinstance(value, tuple) else (value, value)
        is_any_float = name == "half_width" and isinstance(value, float) and math.isfinite(value)
        is_infinite = entry.default == inf and isinstance(value, float) and value == inf
        is_number = len(ends) == 2 and all(map(is_finite, ends))
        if not (is_number or is_any_float or is_infinite) or (is_drawn and ends[0] > ends[1]):
            raise ValueError(f"{name} {got} is not finite" + is_drawn * ", or its ends are swapped")
        if entry.metadata["plausible"][0] > 0 and ends[0] <= 0.0 and kind != float | None:
            none_text = " or None" if entry.default is None else ""
            raise ValueError(f"{name} must be positive{none_text}, got {value!r}")


def _check_mapping(name: str, values: object) -> None:
    """Check replaced vehicle parameters or noise."""
    if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
        raise ValueError(f"{name} is a mapping of names to numbers, got {short_repr(values)}")
    known = list(Noise._fields) if name == "noise" else _PARAMETERS
    if name == "vehicle" and "friction" in values:
        raise ValueError("vehicle has no friction here: the scenario's `friction` is the road's")
    if unknown := [key for key in values if key not in known]:
        raise TypeError(describe_unknown(f"parameter of {name}", unknown, known))
    if name == "noise" and (bad := [key for key in values if not is_finite(values[key])]):
        raise ValueError(f"noise {bad[0]} {short_repr(values[bad[0]])} is not finite")


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A manoeuvre: what happens in an episode. A (low, high) range is drawn from by the seed.

    Numbers must be plausible, which environments check unless `strict=False`. A value out of place
    raises ValueError and names the field. `make_scenario` takes a mapping over a named scenario.
    `Scenario.__dataclass_fields__[name].metadata` describes a field: text, unit, plausible range.

    Steering "random" is two pairs of sines, "driver" keeps to `path` by preview, and "wander" is a
    zero-mean Ornstein-Uhlenbeck process of standard deviation amplitude and corner frequency
    `frequency`, held for `hold` from one angle to the next. Road "nominal-path" bends as the
    nominal linear car would drive the steering profile at the wanted speed; its camera reports y_l
    without that bend. Draws of an unstable car are drawn again. The stamps of GPS packets are true:
    `slow_sensors` describes the range of their latency as a delay and a jitter.

    >>> Scenario(name="mine", steering="step", amplitude=(0.02, 0.05)).range("amplitude")
    (0.02, 0.05)
    """

    name: str
    duration: float = quantity("s", 0, 3600, "length of the episode", 10.0)
    steering: str = _choose("kind of the steering profile", "straight", *STEERING_KINDS)
    trace: tuple[float, ...] = ()  # rad at the wheels, for "trace": lines between, the last stays
    trace_step: float = quantity("s", 0, 10, "time between the angles of a trace", 0.01)
    onset: Range = quantity("s", -inf, inf, "time at which steering or a track begins", 0.0)
    amplitude: Range = quantity("rad", -1.6, 1.6, "amplitude at the wheels", 0.0)
    amplitude_2: Range = quantity("rad", -1.6, 1.6, "of a random steering's second pair", 0.0)
    frequency: Range = quantity("Hz", 1e-4, 50, "frequency of the steering", 0.5)
    frequency_2: Range = quantity("Hz", 0, 50, "second of a random steering, or a sweep's end", 0.5)
    frequency_3: Range = quantity("Hz", 1e-4, 50, "third of a random steering", 0.5)
    frequency_4: Range = quantity("Hz", 0, 50, "fourth of a random steering", 0.5)
    hold: Range = quantity("s", -inf, inf, "of step, dwell, ramp, sweep; between lane changes", 1.5)
    mirror: bool = _choose("whether the seed draws the sides of car and wind", False)
    path: str = _choose(
        "path of the driver: the road, or a track from the onset on", "road", *PATHS
    )
    path_speed: Range | None = quantity("m/s", 0.01, 120, "a track's own; None: any", None)
    driver_preview: float = quantity("s", 0.01, 20, "preview time of the driver", 0.8)
    driver_gain: float = quantity("-", 1e-12, 100, "gain of the driver", 1.0)
    driver_lag: float = quantity("s", 0, 5, "time constant of the driver's arms", 0.1)
    driver_rate: float = quantity("rad/s", 0.001, 100, "largest rate of the driver's angle", 0.8)
    initial_beta: Range = quantity("rad", -1.6, 1.6, "sideslip angle at the start", 0.0)
    initial_gamma: Range = quantity("rad/s", -10, 10, "yaw rate at the start", 0.0)
    speed: Range = quantity("m/s", 0, 120, "speed at the start", 25.0 * KMH)
    acceleration: float | None = quantity("m/s2", -50, 50, "None holds the speed", None)
    speed_change: float = quantity("m/s", -120, 120, "of the held speed, at an even rate", 0.0)
    change_start: float = quantity("s", -inf, inf, "time at which that change begins", 0.0)
    change_length: float = quantity("s", 0, 3600, "time that it takes", 10.0)
    surge: float = quantity("m/s2", -50, 50, "amplitude of a sine added to the acceleration", 0.0)
    surge_frequency: float = quantity("Hz", 1e-4, 50, "its frequency", 0.1)
    friction: Range = quantity("-", 0.02, 2.5, "of the road, replaces the vehicle's", 0.9)
    friction_right: Range | None = quantity("-", 0.02, 2.5, "of the right side; None: both", None)
    front_stiffness: Range = quantity("-", 0.01, 20, "factor on the front tyres' stiffness", 1.0)
    rear_stiffness: Range = quantity("-", 0.01, 20, "factor on the rear tyres' stiffness", 1.0)
    tyre_change_time: Range | None = quantity("s", 1e-12, inf, "None: they never change", None)
    front_change: Range = quantity("-", 0.01, 20, "further factor on the front from then on", 1.0)
    rear_change: Range = quantity("-", 0.01, 20, "further factor on the rear from then on", 1.0)
    friction_change: Range = quantity("-", 0.01, 20, "further factor on friction from then on", 1.0)
    wind_force: Range = quantity("N", -1e5, 1e5, "force of a side wind", 0.0)
    wind_arm: Range = quantity("m", -10, 10, "its arm ahead of the centre of gravity", 0.0)
    wind_start: Range = quantity("s", -inf, inf, "time at which it begins", 0.0)
    wind_length: Range = quantity("s", -inf, inf, "time that it lasts", 0.0)
    wind_height: float = quantity("m", -10, 10, "its height above the roll axis", 0.0)
    disturbance_force: float = quantity("N", -1e5, 1e5, "standard deviation of a force", 50.0)
    disturbance_moment: float = quantity("N m", -1e5, 1e5, "standard deviation of a moment", 20.0)
    disturbance_time: float = quantity("s", 1e-12, inf, "time constant of both (O.-U.)", 0.3)
    road: str = _choose("law of the road's bends", "straight", *ROADS)
    curvature: Range = quantity("1/m", -2, 2, "curvature of the bend, left positive", 0.0)
    curve_start: float = quantity("m", -inf, inf, "where curvature, bank and grade begin", 20.0)
    curve_ramp: float = quantity("m", 1e-12, inf, "length over which they come in", 20.0)
    bank: Range = quantity("rad", -inf, inf, "left side up", 0.0)
    grade: float = quantity("rad", -inf, inf, "uphill", 0.0)
    half_width: float = quantity("m", 0.01, inf, "from the path; the end beyond it", 50.0)
    camera_delays: _Times = quantity("s", 0, 5, "repeating, replace the id's", None)
    camera_jitter: float = quantity("s", 0, 5, "jitter of these delays", 0.0)
    camera_loss: float = quantity("-", -inf, inf, "probability of a lost frame; 0: the id's", 0.0)
    camera_heading: float = quantity("rad", 0.001, inf, "beyond which no lane is in view", inf)
    camera_offset: float = quantity("m", 0.001, inf, "from the lane's centre, likewise", inf)
    camera_outage: _Times = quantity("s", -inf, inf, "(from, to) without packets", None)
    gps_period: float | None = quantity("s", 0.05, 60, "replaces the id's", None)
    gps_delays: _Times = quantity("s", 0, 30, "repeating, replace the id's", None)
    gps_outage: _Times = quantity("s", -inf, inf, "(from, to) without packets", None)
    gps_latency: Range = quantity("s", 0, 30, "further delay of all GPS packets", 0.0)
    gyro_bias: Range = quantity("rad/s", -0.5, 0.5, "added to the noise's bias", 0.0)
    accel_y_bias: Range = quantity("m/s2", -10, 10, "added to the noise's bias", 0.0)
    hdop: float = quantity("-", 0.1, inf, "median of the GPS's HDOP", 1.4)
    hdop_spread: float = quantity("-", -inf, inf, "standard deviation of its logarithm", 0.5)
    hdop_time: float = quantity("s", 0.001, inf, "correlation time of its logarithm", 20.0)
    hdop_law: str = _choose("how much of the GPS's noise follows HDOP", "half", *HDOP_LAWS)
    small_angle: bool = _choose("whether the plant is of small angles", False)
    tyres: str = _choose("tyre law; magic-formula may relax", "fiala", *TYRE_LAWS)
    lags: bool = _choose("whether motors and steering have lags", True)
    roll: bool = _choose("whether the body rolls", True)
    tier: str = _choose("in whose score it may stand", "", *_TIER_NAMES)
    vehicle: Mapping[str, float] = _choose("replaced parameters of the env's vehicle", dict)
    nominal: Mapping[str, float] = _choose("replaced parameters of the nominal vehicle", dict)
    noise: Mapping[str, float] = _choose("numbers that replace the default `Noise`", dict)

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, list | Mapping):  # a copy: who passed it may change it
                kind = tuple if isinstance(value, list) else dict
                object.__setattr__(self, entry.name, kind(value))
        try:
            for entry in dataclasses.fields(self):
                _check_field(entry, getattr(self, entry.name))
            self._check_rules()
        except (TypeError, ValueError) as error:
            raise type(error)(f"scenario {short_repr(self.name)}: {error}") from None

    def _check_rules(self) -> None:
        """Check what several fields have to fit, or one beyond its type and sign."""
        path, steering, trace, period = self.path, self.steering, self.trace, self.gps_period
        is_nominal, min_speed = self.road == "nominal-path", self.range("speed")[0]
        n_angles = f"2 to {_MAX_SAMPLES} angles where the steering is 'trace', else none"
        has_angles = (len(trace) > 1) == (steering == "trace") and len(trace) <= _MAX_SAMPLES
        max_slope = max(map(abs, (*self.range("bank"), self.grade)))
        rules = [
            (path == "road" or steering == "driver",
             f"path {path!r} needs the steering 'driver', got {steering!r}"),
            (not is_nominal or steering != "driver",
             "road 'nominal-path' follows a programme's steering, not a driver's"),
            (not is_nominal or self.range("curvature") == (0.0, 0.0),
             f"road 'nominal-path' has no curvature, got {self.curvature!r}"),
            (self.path_speed is None or path != "road",
             "path_speed needs a track as path; a road has no lengths to scale"),
            (self.duration >= TICK, f"duration {self.duration!r} s is less than {TICK}"),
            *((self.tyre_change_time is not None or self.range(name) == (1.0, 1.0),
               f"{name} {getattr(self, name)!r} needs a tyre_change_time, from which it acts")
              for name in ("front_change", "rear_change", "friction_change")),
            (steering not in ("ramp", "sweep", "wander") or self.range("hold")[0] >= TICK,
             f"hold of a {steering} is 1 ms or more, got {self.hold!r}"),
            (steering != "sine-with-dwell" or self.range("hold")[0] >= 0.0,
             f"hold of a dwell is not negative, got {self.hold!r}"),
            (min_speed >= 0.0 and min_speed + self.speed_change >= 0.0,
             "speed must not be negative, with speed_change or without"),
            (self.change_length >= TICK,
             f"change_length is {TICK:g} s at least, got {self.change_length!r}"),
            (self.acceleration is None or not (self.speed_change or self.surge),
             "speed_change and surge need the held speed (acceleration None)"),
            (self.path_speed is None or min_speed > 0.0, "path_speed needs a speed above zero"),
            (max_slope <= 0.5,
             f"bank and grade are up to 0.5 rad, got {self.bank!r}, {self.grade!r}"),
            (max(map(abs, self.range("initial_beta"))) <= _MAX_SLIP,
             f"initial_beta is up to {_MAX_SLIP} rad, got {self.initial_beta!r}"),
            (0.0 <= self.hdop_spread <= 1.0, f"hdop_spread is 0 to 1, got {self.hdop_spread!r}"),
            (period is None or period >= MIN_GPS_PERIOD,
             f"gps_period is {MIN_GPS_PERIOD} s or more, got {period!r}"),
            *((self.range(name)[0] >= 0.0, f"{name} is zero or more, got {getattr(self, name)!r}")
              for name in ("driver_lag", "gps_latency", "camera_jitter", "wind_length")),
            (0.0 <= self.camera_loss < 1.0,
             f"camera_loss is a probability below 1, got {self.camera_loss!r}"),
            (not self.camera_jitter or self.camera_delays is not None,
             "camera_jitter needs camera_delays"),
            (has_angles, f"trace has {n_angles}; got {len(trace)} with {steering!r}"),
            (self.trace_step >= TICK, f"trace_step is {TICK} s or more, got {self.trace_step!r}"),
        ]  # fmt: skip
        for holds, message in rules:
            if not holds:
                raise ValueError(message)

    def range(self, name: str) -> tuple[float, float]:
        """Get the ends (low, high) of a drawn quantity, equal for a number; zeros where it is None.

        Args:
            name: Name of the field.
        """
        return get_range(getattr(self, name))

    def get_draw_ranges(self, world: World = IDEAL) -> tuple[Array, Array]:
        """Collect the ends (low, high) of all quantities of `Draws`, each of shape (len(Draws),).

        Args:
            world: Errors of car and sensors.
        """
        sides = (0.0, 1.0) if self.mirror else (1.0, 1.0)
        ranges = vars(self) | vars(world) | dict.fromkeys(_SIDES, sides)
        ranges["phase"] = (0.0, float(not world.is_ideal))
        low, high = np.array([get_range(ranges[name]) for name in Draws._fields]).T.copy()
        return low, high

    @property
    def held_speed(self) -> float | None:
        """The speed in m/s where it is one number and held exactly, else None."""
        low, high = self.range("speed")
        varies = self.speed_change or self.surge or self.grade or self.roll
        is_fixed = low == high and self.acceleration is None and self.small_angle and not varies
        return low if is_fixed else None

    def replace(self, **changes: Any) -> "Scenario":
        """Copy the scenario with some fields changed; TypeError on an unknown field.

        Args:
            changes: New values by the names of fields.
        """
        return dataclasses.replace(self, **changes)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a TOML or JSON file that `make_scenario` reads back.

        Args:
            path: Path of the file, whose ending chooses the format.
        """
        write_document(path, self.to_dict())

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON types without defaults, which `make_scenario` reads back."""
        values: dict[str, object] = {}
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if value != ({} if entry.default_factory is dict else entry.default):
                value = dict(value) if isinstance(value, Mapping) else value
                values[entry.name] = list(value) if isinstance(value, tuple) else value
        return values
