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
    """What happens in an episode. Ranges are drawn by the seed; SI units, in plausible
    ranges, which environments check unless `strict=False`.

    An episode is `duration` s long. Steering is a kind of `STEERING_KINDS`, built from onset,
    amplitude, frequency (random: two pairs of sines, of amplitude and amplitude_2, of frequency,
    frequency_2, frequency_3 and frequency_4; sweep: to frequency_2) and hold (of a step, a dwell, a
    ramp or a sweep, or from one lane change to the next); "trace" follows the angles of `trace`
    (rad at the wheels, recorded every trace_step seconds, straight between them) and holds the
    last. "wander" is a zero-mean Ornstein-Uhlenbeck process of standard deviation amplitude and
    corner frequency `frequency`, held for `hold` s from one angle to the next. mirror: the seed
    draws the side of steering, track, bend, bank, friction_right and start, and that of the wind.
    initial_beta, initial_gamma: sideslip angle in rad and yaw rate in rad/s that the car starts
    with.

    The steering "driver" keeps to a path of `PATHS` (`driver.py`): the road's centre line, or a
    track that begins where the car is at the onset at the speed it starts with, for the vehicle's
    width; path_speed: m/s at which it has its standard's lengths, which grow with the speed drawn
    (None: at every speed).
    driver_preview (s), driver_gain, driver_lag (s) and driver_rate (rad/s at the wheels). An
    episode ends where the car is half_width off the path (without a driver, off the road's centre
    line).

    acceleration: None holds the speed. speed_change: m/s by which the held speed changes at an
    even rate, from change_start over change_length. surge, surge_frequency: a sine of the driver's
    acceleration, which the held speed follows.

    Car: front_stiffness and rear_stiffness are factors on the vehicle's; draws that make the car
    unstable at the drawn speed are drawn again and counted. From tyre_change_time (s, None: never,
    and then they are 1) on front_change and rear_change are further factors. vehicle and nominal:
    parameters that replace those of the env. tyres: a law of `TYRE_LAWS`. small_angle, lags, roll:
    the rest of the plant.

    Surroundings: friction is the road's and replaces the vehicle's; friction_right, if given, is
    that under the right wheels. curvature, bank (rad, left side up) and grade (rad, uphill) come
    in from curve_start over curve_ramp metres; a negative curve_start has them from the beginning.
    road: "straight", or "nominal-path", which bends as the nominal linear car would drive the
    programme's steering at the speed that the driver wants (`roads.py`); its camera reports y_l
    without that bend.
    wind_force (N) from wind_start for wind_length s: a side wind, wind_arm ahead of the centre of
    gravity and wind_height above the roll axis. disturbance_force (N), disturbance_moment (N m),
    disturbance_time (s): an Ornstein-Uhlenbeck force and moment.

    Sensors: noise replaces the default; gyro_bias (rad/s) and accel_y_bias (m/s2) add to its
    biases. camera_delays: a repeating pattern that replaces the id's, and camera_jitter with it;
    gps_period and gps_delays likewise. camera_outage, gps_outage: (from, to) s without packets.
    camera_loss: the probability that a frame is lost (0: the
    id's). camera_heading (rad, against the road) and camera_offset (m, of the car from the lane's
    centre): beyond either no lane is in view, and a packet's quality is 0. gps_latency: s by which
    all GPS packets of the episode arrive later, their stamps being true; `slow_sensors` describes
    its range as a delay and a jitter. hdop, hdop_spread, hdop_time: median of the GPS's HDOP,
    standard deviation of its logarithm, and the time in which that forgets. hdop_law of
    `HDOP_LAWS`: how much of the noise follows HDOP.

    tier: of `TIER_NAMES`, the one in whose score the scenario may stand, "" for none.

    Raises ValueError for a value out of place and names the field.

    >>> Scenario(name="mine", steering="step", amplitude=(0.02, 0.05)).range("amplitude")
    (0.02, 0.05)

    See also `make_scenario`, which takes a mapping over a named scenario.
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
        """(low, high) of a drawn quantity; zeros where it is None."""
        return get_range(getattr(self, name))

    def get_draw_ranges(self) -> tuple[Array, Array]:
        """(low, high) of every quantity of `Draws`, each (len(Draws),)."""
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
        """A copy with some fields changed; TypeError on an unknown field."""
        return dataclasses.replace(self, **changes)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a TOML or JSON file, by its ending, that `make_scenario` reads back."""
        write_document(path, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """JSON types only, defaults left out; `make_scenario` reads it back."""
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
