"""A manoeuvre is data: named, frozen, JSON-able."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .layout import Array
from .programme import DRAWS_WIDTH, STEERING_KINDS, Draws
from .sensors import Noise

Range = float | tuple[float, float]
"""A number, or the (low, high) that the seed draws from uniformly."""

KMH = 1.0 / 3.6


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What happens in an episode. Ranges are drawn by the seed; SI units.

    steering: a kind of `STEERING_KINDS`, built from onset, amplitude, frequency (random: two pairs
    of sines) and hold (step). mirror: the seed draws the side of steering and wind. front_stiffness
    and rear_stiffness are factors on the vehicle's; draws that make the car unstable at the drawn
    speed are drawn again and counted. friction is the road's and replaces the vehicle's.
    acceleration: None holds the speed. disturbance_*: an
    Ornstein-Uhlenbeck force and moment. vehicle and nominal: parameters that replace those of the
    env. noise: sensor noise that replaces the default. camera_delays: a repeating pattern that
    replaces the id's. small_angle, linear_tyres, lags: the plant.
    scored: whether it counts in a score (the papers' experiments never do).

    Raises ValueError for a value out of place and names the field.
    """

    name: str
    duration: float = 10.0
    steering: str = "straight"
    onset: Range = 0.0
    amplitude: Range = 0.0
    amplitude_2: Range = 0.0
    frequency: Range = 0.5
    frequency_2: Range = 0.5
    frequency_3: Range = 0.5
    frequency_4: Range = 0.5
    hold: Range = 1.5
    mirror: bool = False
    speed: Range = 25.0 * KMH
    acceleration: float | None = None
    friction: Range = 0.9
    front_stiffness: Range = 1.0
    rear_stiffness: Range = 1.0
    wind_force: Range = 0.0
    wind_arm: Range = 0.0
    wind_start: Range = 0.0
    wind_length: Range = 0.0
    disturbance_force: float = 50.0
    disturbance_moment: float = 20.0
    disturbance_time: float = 0.3
    curvature: float = 0.0
    curve_start: float = 20.0
    curve_ramp: float = 20.0
    half_width: float = 50.0
    camera_delays: tuple[float, ...] | None = None
    camera_outage: tuple[float, float] | None = None
    gps_outage: tuple[float, float] | None = None
    small_angle: bool = False
    linear_tyres: bool = False
    lags: bool = True
    scored: bool = True
    vehicle: Mapping[str, float] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, list):
                object.__setattr__(self, entry.name, tuple(value))
        if self.steering not in STEERING_KINDS:
            raise ValueError(
                f"scenario {self.name!r}: unknown steering {self.steering!r}; "
                f"known: {', '.join(STEERING_KINDS)}"
            )
        if not (self.duration > 0.0 and math.isfinite(self.duration)):
            raise ValueError(f"scenario {self.name!r}: duration {self.duration!r} s")
        unknown = sorted(set(self.noise) - set(Noise._fields))
        if unknown:
            raise ValueError(f"scenario {self.name!r}: unknown noise {', '.join(unknown)}")
        for name in Draws._fields:
            if name in _SIDES:
                continue
            low, high = self.range(name)
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                raise ValueError(f"scenario {self.name!r}: {name} {getattr(self, name)!r}")
        numbers = {name: getattr(self, name) for name in _NUMBERS} | dict(self.noise)
        for name, value in (numbers | {"acceleration": self.acceleration or 0.0}).items():
            if not math.isfinite(value):
                raise ValueError(f"scenario {self.name!r}: {name} {value!r} is not finite")
        for name in ("frequency", "frequency_3", "front_stiffness", "rear_stiffness", "friction"):
            if self.range(name)[0] <= 0.0:
                raise ValueError(f"scenario {self.name!r}: {name} must be positive")
        if self.range("speed")[0] < 0.0 or not all(
            value > 0.0 for value in (self.disturbance_time, self.curve_ramp, self.half_width)
        ):
            raise ValueError(
                f"scenario {self.name!r}: speed must not be negative, disturbance_time, "
                "curve_ramp and half_width must be positive"
            )

    def range(self, name: str) -> tuple[float, float]:
        """(low, high) of a drawn quantity."""
        value = getattr(self, name)
        if isinstance(value, tuple):
            low, high = value
            return float(low), float(high)
        return float(value), float(value)

    def draws(self) -> tuple[Array, Array]:
        """(low, high) of every quantity of `Draws`, each (len(Draws),)."""
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
        fixed = low == high and self.acceleration is None and self.small_angle
        return low if fixed else None

    def replace(self, **changes: Any) -> "Scenario":
        """A copy with some fields changed; TypeError on an unknown field."""
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """JSON types only, defaults left out; `scenario_from` reads it back."""
        kept = {}
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            default = {} if entry.name in ("vehicle", "nominal", "noise") else entry.default
            if value != default:
                mapping = isinstance(value, Mapping)
                kept[entry.name] = (
                    dict(value) if mapping else list(value) if isinstance(value, tuple) else value
                )
        return kept


_SIDES = ("side", "wind_side")
_NUMBERS = (
    "disturbance_force",
    "disturbance_moment",
    "disturbance_time",
    "curvature",
    "curve_start",
    "curve_ramp",
)
