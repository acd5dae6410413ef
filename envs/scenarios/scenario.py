"""A manoeuvre is data: named, frozen, JSON-able."""

import dataclasses
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..documents import write_document
from ..quantities import quantity
from ..record import Array
from .checks import SIDES, check_fields
from .draws import DRAWS_WIDTH, KMH, Draws, Range, get_range


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A manoeuvre: what happens in an episode. A (low, high) range is drawn from by the seed.

    Numbers must be plausible, which environments check unless `strict=False`. A value out of place
    raises ValueError and names the field. `make_scenario` takes a mapping over a named scenario.

    >>> Scenario(name="mine", steering="step", amplitude=(0.02, 0.05)).range("amplitude")
    (0.02, 0.05)

    Attributes:
        name: Name of the scenario.
        duration: Length of the episode (s).
        steering: Kind of the steering programme, of `STEERING_KINDS`. "random" is two pairs of
            sines, of amplitude and amplitude_2. "driver" keeps to `path` by preview. "wander" is a
            zero-mean Ornstein-Uhlenbeck process of standard deviation amplitude and corner
            frequency `frequency`, held for `hold` from one angle to the next.
        trace: Recorded angles at the wheels (rad) for "trace": straight between them, the last
            stays.
        trace_step: Time between the trace's samples (s).
        onset: Time at which steering begins (s).
        amplitude: Amplitude at the wheels (rad).
        amplitude_2: Amplitude of the second pair of a random steering (rad).
        frequency: Frequency (Hz).
        frequency_2: Second frequency of a random steering, or the end of a sweep (Hz).
        frequency_3: Third frequency of a random steering (Hz).
        frequency_4: Fourth frequency of a random steering (Hz).
        hold: Time of a step, dwell, ramp or sweep, or from one lane change to the next (s).
        mirror: Whether the seed draws the side of steering, track, bend, bank, friction_right and
            start, and that of the wind.
        path: Path of the driver, of `PATHS`: the road's centre line, or a track for the vehicle's
            width that begins where the car is at the onset at the speed it starts with.
        path_speed: Speed (m/s) at which a track has its standard's lengths, which grow with the
            speed drawn; None: these lengths at every speed.
        driver_preview: Preview time of the driver (s).
        driver_gain: Gain of the driver.
        driver_lag: Time constant of the driver's arms (s).
        driver_rate: Largest rate of the driver's angle at the wheels (rad/s).
        initial_beta: Sideslip angle at the start (rad).
        initial_gamma: Yaw rate at the start (rad/s).
        speed: Speed at the start (m/s).
        acceleration: Acceleration (m/s2); None holds the speed.
        speed_change: Change of the held speed at an even rate (m/s).
        change_start: Time at which that change begins (s).
        change_length: Time that it takes (s).
        surge: Amplitude of a sine of the driver's acceleration, which the held speed follows
            (m/s2).
        surge_frequency: Frequency of that sine (Hz).
        friction: Friction of the road, which replaces the vehicle's.
        friction_right: Friction under the right wheels; None: as on the left.
        front_stiffness: Factor on the front stiffness; draws of an unstable car are drawn again.
        rear_stiffness: Factor on the rear stiffness.
        tyre_change_time: Time at which the tyres change (s); None: never.
        front_change: Further factor on the front stiffness from then on.
        rear_change: Further factor on the rear stiffness from then on.
        wind_force: Force of a side wind (N).
        wind_arm: Its arm ahead of the centre of gravity (m).
        wind_start: Time at which it begins (s).
        wind_length: Time that it lasts (s).
        wind_height: Its height above the roll axis (m).
        disturbance_force: Standard deviation of an Ornstein-Uhlenbeck force (N).
        disturbance_moment: Standard deviation of an Ornstein-Uhlenbeck moment (N m).
        disturbance_time: Time constant of both (s).
        road: "straight", or "nominal-path", which bends as the nominal linear car would drive the
            programme's steering at the wanted speed; its camera reports y_l without that bend.
        curvature: Curvature of the bend (1/m), left positive.
        curve_start: Place where curvature, bank and grade begin (m); negative: from the beginning.
        curve_ramp: Length over which they come in (m).
        bank: Bank of the road (rad), left side up.
        grade: Grade of the road (rad), uphill.
        half_width: Distance from the driver's path, else from the road's centre line, that ends the
            episode (m).
        camera_delays: Repeating pattern of delays that replaces the id's, and its jitter (s).
        camera_jitter: Jitter of these delays (s).
        camera_loss: Probability that a frame is lost; 0: the id's.
        camera_heading: Heading against the road (rad) beyond which no lane is in view (quality 0).
        camera_offset: Offset from the lane's centre (m) beyond which no lane is in view.
        camera_outage: (from, to) without packets (s).
        gps_period: Period that replaces the id's (s).
        gps_delays: Repeating pattern of delays that replaces the id's (s).
        gps_outage: (from, to) without packets (s).
        gps_latency: Further delay of all GPS packets of the episode, whose stamps are true (s);
            `slow_sensors` describes its range as a delay and a jitter.
        gyro_bias: Addition to the noise's bias of the gyro (rad/s).
        accel_y_bias: Addition to the noise's bias of the lateral accelerometer (m/s2).
        hdop: Median of the GPS's HDOP.
        hdop_spread: Standard deviation of its logarithm.
        hdop_time: Correlation time of its logarithm (s).
        hdop_law: How much of the GPS's noise follows HDOP, of `HDOP_LAWS`.
        small_angle: Whether the plant is that of the papers' small angles.
        tyres: Tyre law, of `TYRE_LAWS`.
        lags: Whether motors and steering have lags.
        roll: Whether the body rolls.
        tier: Tier in whose score the scenario may stand, of `TIER_NAMES`; "" for none.
        vehicle: Parameters that replace those of the env's vehicle.
        nominal: Parameters that replace those of the env's nominal vehicle.
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
        check_fields(vars(self), dataclasses.fields(self))

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
            if name in SIDES:
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

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON types without defaults, which `make_scenario` reads back."""
        values = {}
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            default = {} if entry.name in ("vehicle", "nominal", "noise") else entry.default
            if value != default:
                mapping = isinstance(value, Mapping)
                values[entry.name] = (
                    dict(value) if mapping else list(value) if isinstance(value, tuple) else value
                )
        return values
