"""`Scenario`: a manoeuvre as a frozen dataclass, with the checks of its fields."""

import dataclasses
import math
import os
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..io import write_document
from ..record import Array
from ..sensors.gps import HDOP_LAWS
from ..sensors.inertial import Noise
from ..ticks import TICK
from ..validation import check_choice, describe_unknown, is_finite, join_names, quantity, short_repr
from ..vehicle.parameters import Vehicle
from ..vehicle.tyres import TYRE_LAWS
from .draws import DRAWS_WIDTH, KMH, Draws, Range, get_range
from .road import PATHS, ROADS
from .steering import STEERING_KINDS

Fields = dict[str, Any]
"""Fields of a `Scenario` by name, each of a type of its own."""
_MAX_SLIP = 1.5  # rad: a start beyond it has no speed along the car
MIN_GPS_PERIOD = 0.05  # s; an env keeps room for its packets
_MAX_SAMPLES = 1_000_000  # of a trace
_SIDES = ("side", "wind_side")  # drawn, but no fields
_TIER_NAMES = ("", "1", "2a", "2b", "2c")
_CHOICES = {
    "steering": STEERING_KINDS, "path": PATHS, "road": ROADS, "hdop_law": HDOP_LAWS,
    "tyres": TYRE_LAWS, "tier": _TIER_NAMES,
}  # fmt: skip
_PARAMETERS = [entry.name for entry in dataclasses.fields(Vehicle)]
_FLAGS = ("mirror", "small_angle", "lags", "roll")
_NUMBERS_OR_NONE = ("acceleration", "gps_period")
_DRAWS_OR_NONE = ("path_speed", "friction_right", "tyre_change_time")
_MAY_BE_INFINITE = ("half_width", "camera_heading", "camera_offset")
_TIMES_OR_NONE = {  # how many
    "camera_delays": (1, 2, 3, 4), "gps_delays": (1, 2, 3, 4),
    "camera_outage": (2,), "gps_outage": (2,),
}  # fmt: skip


def _check_fields(fields: Fields, entries: Sequence[dataclasses.Field[object]]) -> None:
    """Check a scenario's values by field; errors name scenario and field."""
    # a field of type float is one number, neither drawn nor None
    numbers = [spec.name for spec in entries if spec.type is float]
    # what is plausible above zero alone must be positive
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
    """Check names, choices, flags, and that steering, path and road fit."""
    if not isinstance(fields["name"], str):
        raise ValueError("name is no text")
    for what, known in _CHOICES.items():
        check_choice(what, fields[what], known)
    for name in _FLAGS:
        if not isinstance(fields[name], bool):
            raise ValueError(f"{name} is True or False, got {short_repr(fields[name])}")
    path, road, steering = fields["path"], fields["road"], fields["steering"]
    if path != "road" and steering != "driver":
        raise ValueError(f"path {path!r} needs the steering 'driver', got {steering!r}")
    if road == "nominal-path" and steering == "driver":
        raise ValueError("road 'nominal-path' follows a programme's steering, not a driver's")
    if road == "nominal-path" and get_range(fields["curvature"]) != (0.0, 0.0):
        raise ValueError(f"road 'nominal-path' has no curvature, got {fields['curvature']!r}")
    if fields["path_speed"] is not None and path == "road":
        raise ValueError("path_speed needs a track as path; a road has no lengths to scale")


def _check_trace(fields: Fields) -> None:
    """Check the recorded steering angles."""
    trace, steering = fields["trace"], fields["steering"]
    if not isinstance(trace, tuple) or not all(map(is_finite, trace)):
        raise ValueError(f"trace is angles in rad, finite ones, got {short_repr(trace)}")
    if (len(trace) > 1) != (steering == "trace") or len(trace) > _MAX_SAMPLES:
        rule = f"2 to {_MAX_SAMPLES} angles where the steering is 'trace', else none"
        raise ValueError(f"trace has {rule}; got {len(trace)} with {steering!r}")
    if fields["trace_step"] < TICK:
        raise ValueError(f"trace_step is {TICK} s or more, got {fields['trace_step']!r}")


def _check_mappings(fields: Fields) -> None:
    """Check replaced vehicle parameters and noise."""
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


def _check_number(name: str, value: object) -> None:
    if not is_finite(value):
        raise ValueError(f"{name} {short_repr(value)} is not finite")


def _check_numbers(fields: Fields, numbers: Iterable[str], positive: Container[str]) -> None:
    """Check that undrawn numbers are finite and in range."""
    for name in numbers:
        if name not in _MAY_BE_INFINITE:
            _check_number(name, fields[name])
    for name in _NUMBERS_OR_NONE:
        _check_number(name, 0.0 if fields[name] is None else fields[name])
    width = fields["half_width"]  # only compared with: any finite float will do
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
    """Check that numbers and ranges that are drawn from are in range."""
    for name in Draws._fields:
        if name in _SIDES or (name in _DRAWS_OR_NONE and fields[name] is None):
            continue
        value = fields[name]
        ends = value if isinstance(value, tuple) else (value, value)
        if not (len(ends) == 2 and all(map(is_finite, ends)) and ends[0] <= ends[1]):
            raise ValueError(f"{name} {short_repr(value)} is not finite, or its ends are swapped")
        if name in positive and ends[0] <= 0.0:
            none_text = " or None" if name in _DRAWS_OR_NONE else ""
            raise ValueError(f"{name} must be positive{none_text}, got {value!r}")
    for name in ("front_change", "rear_change"):
        value = fields[name]
        if fields["tyre_change_time"] is None and get_range(value) != (1.0, 1.0):
            raise ValueError(f"{name} {value!r} needs a tyre_change_time, from which it acts")
    steering, hold = fields["steering"], fields["hold"]
    if steering in ("ramp", "sweep", "wander") and get_range(hold)[0] < TICK:
        raise ValueError(f"hold of a {steering} is 1 ms or more, got {hold!r}")
    if steering == "sine-with-dwell" and get_range(hold)[0] < 0.0:
        raise ValueError(f"hold of a dwell is not negative, got {hold!r}")


def _check_motion(fields: Fields) -> None:
    """Check speed, road slope and start."""
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
    if max(map(abs, get_range(beta))) > _MAX_SLIP:
        raise ValueError(f"initial_beta is up to {_MAX_SLIP} rad, got {beta!r}")


def _check_sensors(fields: Fields) -> None:
    """Check clocks, delays and losses of the slow sensors."""
    if not 0.0 <= fields["hdop_spread"] <= 1.0:
        raise ValueError(f"hdop_spread is 0 to 1, got {fields['hdop_spread']!r}")
    for name, counts in _TIMES_OR_NONE.items():
        value = fields[name]
        fits = isinstance(value, tuple) and len(value) in counts and all(map(is_finite, value))
        if value is not None and not (fits and min(value) >= 0.0):
            number = " to ".join(str(count) for count in sorted({counts[0], counts[-1]}))
            got = short_repr(value)
            raise ValueError(f"{name} is {number} times in s, zero or more, got {got}")
    period = fields["gps_period"]
    if period is not None and not period >= MIN_GPS_PERIOD:
        raise ValueError(f"gps_period is {MIN_GPS_PERIOD} s or more, got {period!r}")
    for name in ("gps_latency", "camera_jitter"):
        if get_range(fields[name])[0] < 0.0:
            raise ValueError(f"{name} is zero or more, got {fields[name]!r}")
    if not 0.0 <= fields["camera_loss"] < 1.0:
        raise ValueError(f"camera_loss is a probability below 1, got {fields['camera_loss']!r}")
    if fields["camera_jitter"] and fields["camera_delays"] is None:
        raise ValueError("camera_jitter needs camera_delays")


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A manoeuvre: what happens in an episode. A (low, high) range is drawn from by the seed.

    Numbers must be plausible, which environments check unless `strict=False`. A value out of place
    raises ValueError and names the field. `make_scenario` takes a mapping over a named scenario.

    >>> Scenario(name="mine", steering="step", amplitude=(0.02, 0.05)).range("amplitude")
    (0.02, 0.05)

    Attributes:
        name, duration: Name, and length of the episode (s).
        steering: Kind of the steering profile, of `STEERING_KINDS`. "random" is two pairs of sines,
            of amplitude and amplitude_2. "driver" keeps to `path` by preview. "wander" is a
            zero-mean Ornstein-Uhlenbeck process of standard deviation amplitude and corner
            frequency `frequency`, held for `hold` from one angle to the next.
        trace, trace_step: Angles at the wheels (rad) for "trace", interpolated linearly, the last
            of which stays, and the time between them (s).
        onset, amplitude: Time at which steering begins (s), and amplitude at the wheels (rad).
        amplitude_2: Amplitude of the second pair of a random steering (rad).
        frequency: Frequency (Hz).
        frequency_2: Second frequency of a random steering, or the end of a sweep (Hz).
        frequency_3, frequency_4: Further frequencies of a random steering (Hz).
        hold: Time of a step, dwell, ramp or sweep, or from one lane change to the next (s).
        mirror: Whether the seed draws the side of steering, track, bend, bank, friction_right and
            start, and that of the wind.
        path: Path of the driver, of `PATHS`: the road's centre line, or a track for the vehicle's
            width that begins where the car is at the onset at the speed it starts with.
        path_speed: Speed (m/s) at which a track has its standard's lengths, which grow with the
            speed drawn; None: these lengths at every speed.
        driver_preview, driver_gain: Preview time (s) and gain of the driver.
        driver_lag, driver_rate: Time constant of the driver's arms (s), and largest rate of the
            driver's angle at the wheels (rad/s).
        initial_beta, initial_gamma: Sideslip angle (rad) and yaw rate (rad/s) at the start.
        speed, acceleration: Speed at the start (m/s); acceleration (m/s2), None holds the speed.
        speed_change: Change of the held speed at an even rate (m/s).
        change_start, change_length: Time at which that change begins, and that it takes (s).
        surge, surge_frequency: Amplitude (m/s2) and frequency (Hz) of a sine of the driver's
            acceleration, which the held speed follows.
        friction: Friction of the road, which replaces the vehicle's.
        friction_right: Friction under the right wheels; None: as on the left.
        front_stiffness, rear_stiffness: Factors on the tyres' stiffness; draws of an unstable car
            are drawn again.
        tyre_change_time: Time at which the tyres change (s); None: never.
        front_change, rear_change: Further factors on the stiffness from then on.
        wind_force, wind_arm, wind_height: Force of a side wind (N), its arm ahead of the centre of
            gravity, and its height above the roll axis (m).
        wind_start, wind_length: Time at which it begins, and that it lasts (s).
        disturbance_force, disturbance_moment, disturbance_time: Standard deviations of an
            Ornstein-Uhlenbeck force (N) and moment (N m), and their time constant (s).
        road: "straight", or "nominal-path", which bends as the nominal linear car would drive the
            steering profile at the wanted speed; its camera reports y_l without that bend.
        curvature: Curvature of the bend (1/m), left positive.
        curve_start, curve_ramp: Place where curvature, bank and grade begin (m; negative: from the
            beginning), and length over which they come in (m).
        bank, grade: Bank (rad), left side up, and grade (rad), uphill, of the road.
        half_width: Distance (m) from the driver's path, else from the road's centre line, that ends
            the episode.
        camera_delays, camera_jitter: Repeating pattern of delays and their jitter (s), which
            replace the id's.
        camera_loss: Probability that a frame is lost; 0: the id's.
        camera_heading, camera_offset: Heading against the road (rad) and offset from the lane's
            centre (m) beyond which no lane is in view (quality 0).
        camera_outage, gps_outage: (from, to) without packets (s).
        gps_period, gps_delays: Period, and repeating pattern of delays, that replace the id's (s).
        gps_latency: Further delay of all GPS packets of the episode, whose stamps are true (s);
            `slow_sensors` describes its range as a delay and a jitter.
        gyro_bias, accel_y_bias: Additions to the noise's biases of gyro (rad/s) and lateral
            accelerometer (m/s2).
        hdop, hdop_spread, hdop_time: Median of the GPS's HDOP, and standard deviation and
            correlation time (s) of its logarithm.
        hdop_law: How much of the GPS's noise follows HDOP, of `HDOP_LAWS`.
        small_angle, tyres: Whether the plant is of small angles; tyre law, of `TYRE_LAWS`.
        lags, roll: Whether motors and steering have lags, and whether the body rolls.
        tier: Tier in whose score the scenario may stand: "1", "2a", "2b", "2c", or "" for none.
        vehicle, nominal: Parameters that replace those of the env's vehicle and nominal vehicle.
        noise: Numbers that replace the default `Noise`.
    """

    name: str
    duration: float = quantity("s", 0, 3600, default=10.0)
    steering: str = "straight"
    trace: tuple[float, ...] = ()
    trace_step: float = quantity("s", 0, 10, default=0.01)
    onset: Range = 0.0
    amplitude: Range = quantity("rad", -1.6, 1.6, default=0.0)
    amplitude_2: Range = quantity("rad", -1.6, 1.6, default=0.0)
    frequency: Range = quantity("Hz", 1e-4, 50, default=0.5)
    frequency_2: Range = quantity("Hz", 0, 50, default=0.5)
    frequency_3: Range = quantity("Hz", 1e-4, 50, default=0.5)
    frequency_4: Range = quantity("Hz", 0, 50, default=0.5)
    hold: Range = 1.5
    mirror: bool = False
    path: str = "road"
    path_speed: Range | None = quantity("m/s", 0.01, 120, default=None)
    driver_preview: float = quantity("s", 0.01, 20, default=0.8)
    driver_gain: float = quantity("-", 1e-12, 100, default=1.0)
    driver_lag: float = quantity("s", 0, 5, default=0.1)
    driver_rate: float = quantity("rad/s", 0.001, 100, default=0.8)
    initial_beta: Range = quantity("rad", -1.6, 1.6, default=0.0)
    initial_gamma: Range = quantity("rad/s", -10, 10, default=0.0)
    speed: Range = quantity("m/s", 0, 120, default=25.0 * KMH)
    acceleration: float | None = quantity("m/s2", -50, 50, default=None)
    speed_change: float = quantity("m/s", -120, 120, default=0.0)
    change_start: float = 0.0
    change_length: float = quantity("s", 0, 3600, default=10.0)
    surge: float = quantity("m/s2", -50, 50, default=0.0)
    surge_frequency: float = quantity("Hz", 1e-4, 50, default=0.1)
    friction: Range = quantity("-", 0.02, 2.5, default=0.9)
    friction_right: Range | None = quantity("-", 0.02, 2.5, default=None)
    front_stiffness: Range = quantity("-", 0.01, 20, default=1.0)
    rear_stiffness: Range = quantity("-", 0.01, 20, default=1.0)
    tyre_change_time: Range | None = quantity("s", 1e-12, math.inf, default=None)
    front_change: Range = quantity("-", 0.01, 20, default=1.0)
    rear_change: Range = quantity("-", 0.01, 20, default=1.0)
    wind_force: Range = quantity("N", -1e5, 1e5, default=0.0)
    wind_arm: Range = quantity("m", -10, 10, default=0.0)
    wind_start: Range = 0.0
    wind_length: Range = 0.0
    wind_height: float = quantity("m", -10, 10, default=0.0)
    disturbance_force: float = quantity("N", -1e5, 1e5, default=50.0)
    disturbance_moment: float = quantity("N m", -1e5, 1e5, default=20.0)
    disturbance_time: float = quantity("s", 1e-12, math.inf, default=0.3)
    road: str = "straight"
    curvature: Range = quantity("1/m", -2, 2, default=0.0)
    curve_start: float = 20.0
    curve_ramp: float = quantity("m", 1e-12, math.inf, default=20.0)
    bank: Range = 0.0
    grade: float = 0.0
    half_width: float = quantity("m", 0.01, math.inf, default=50.0)
    camera_delays: tuple[float, ...] | None = quantity("s", 0, 5, default=None)
    camera_jitter: float = quantity("s", 0, 5, default=0.0)
    camera_loss: float = 0.0
    camera_heading: float = quantity("rad", 0.001, math.inf, default=math.inf)
    camera_offset: float = quantity("m", 0.001, math.inf, default=math.inf)
    camera_outage: tuple[float, float] | None = None
    gps_period: float | None = quantity("s", 0.05, 60, default=None)
    gps_delays: tuple[float, ...] | None = quantity("s", 0, 30, default=None)
    gps_outage: tuple[float, float] | None = None
    gps_latency: Range = quantity("s", 0, 30, default=0.0)
    gyro_bias: Range = quantity("rad/s", -0.5, 0.5, default=0.0)
    accel_y_bias: Range = quantity("m/s2", -10, 10, default=0.0)
    hdop: float = quantity("-", 0.1, math.inf, default=1.4)
    hdop_spread: float = 0.5
    hdop_time: float = quantity("s", 0.001, math.inf, default=20.0)
    hdop_law: str = "half"
    small_angle: bool = False
    tyres: str = "fiala"
    lags: bool = True
    roll: bool = True
    tier: str = ""
    vehicle: Mapping[str, float] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, list):
                object.__setattr__(self, entry.name, tuple(value))
        _check_fields(vars(self), dataclasses.fields(self))

    def range(self, name: str) -> tuple[float, float]:
        """Get the ends of a drawn quantity; zeros where it is None.

        Args:
            name: Name of the field.

        Returns:
            (low, high), equal for a number.
        """
        return get_range(getattr(self, name))

    def get_draw_ranges(self) -> tuple[Array, Array]:
        """Collect the ends of every quantity of `Draws`.

        Returns:
            (low, high), each of shape (len(Draws),).
        """
        low, high = np.empty(DRAWS_WIDTH), np.empty(DRAWS_WIDTH)
        for i, name in enumerate(Draws._fields):
            if name in _SIDES:
                low[i], high[i] = (0.0, 1.0) if self.mirror else (1.0, 1.0)
            else:
                low[i], high[i] = self.range(name)
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

        Returns:
            The copy.
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
            default = {} if entry.name in ("vehicle", "nominal", "noise") else entry.default
            if isinstance(value, Mapping | tuple) and value != default:
                values[entry.name] = dict(value) if isinstance(value, Mapping) else list(value)
            elif value != default:
                values[entry.name] = value
        return values
