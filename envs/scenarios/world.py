"""What the seed draws of an episode: a scenario's ranges, and the errors of a `World`.

A `World` is what calibration leaves over in car and sensors. The default of every range is the
ideal world, in which nothing errs; `WORLDS["v1"]` is in `v1.toml` with the source of each range.
The table in the docs is made of both.
"""

import dataclasses
from collections import namedtuple
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..io import read_document
from ..numerics.functions import CHANNELS, draw_uniforms
from ..numerics.jit import jit
from ..numerics.packed import read
from ..numerics.primitives import Scalar, Vector, select
from ..validation import check_choice, describe_unknown, is_finite, short_repr
from ..vehicle.dynamics import CarParams
from ..vehicle.tyres import TYRE_LAWS

_ATTEMPTS = 64

Range = float | tuple[float, float]
"""A number, or the (low, high) that the seed draws from uniformly."""

KMH = 1.0 / 3.6


def get_range(value: Range | None) -> tuple[float, float]:
    """Get the ends (low, high) of a drawn quantity, equal for a number; zeros for None.

    Args:
        value: A number, a range or None.
    """
    low, high = value if isinstance(value, tuple) else (value or 0.0, value or 0.0)
    return float(low), float(high)


# Quantities that are drawn, by the names and in the units of their fields; 0 stands for None.
# Uniform in (0, 1) are side and wind_side, below a half mirrored, and phase, where the waves of a
# world begin. A new one goes to the end, as its place chooses its random number.
Draws = namedtuple(
    "Draws",
    # of a scenario
    "speed friction front_stiffness rear_stiffness onset amplitude amplitude_2 frequency "
    "frequency_2 frequency_3 frequency_4 hold wind_force wind_arm wind_start wind_length side "
    "wind_side curvature path_speed friction_right tyre_change_time front_change rear_change "
    "gyro_bias accel_y_bias gps_latency bank initial_beta initial_gamma "
    # of a `World`
    "camera_yaw camera_pitch camera_height steer_offset steer_scale wheel_scale wheel_left "
    "torque_scale torque_left torque_rate gyro_scale gyro_drift accel_scale accel_roll accel_ahead "
    "vibration course_error course_period gps_stamp map_error map_length map_lag load inertia "
    "gravity_shift bank_wave bank_length gust friction_wave friction_length friction_across "
    "relaxation phase friction_change critical_speed",
)
DRAWS_WIDTH = len(Draws._fields)
DRAWS = Draws(*range(DRAWS_WIDTH))


@jit
def _draw_numbers(
    low: Vector, high: Vector, key_low: int, key_high: int, attempt: int, out: Vector
) -> None:
    """Draw uniform numbers in [low, high] into out (len(Draws),); equal ends keep their bits."""
    u = draw_uniforms(key_low, key_high, attempt, CHANNELS.scenario, 0)
    for i in range(len(out)):
        if i % 4 == 0:
            u = draw_uniforms(key_low, key_high, attempt, CHANNELS.scenario, i // 4)
        out[i] = low[i] + (high[i] - low[i]) * u[i % 4]


@jit
def draw_car(d: Draws, car: CarParams) -> CarParams:
    """Load a car, whose load rolls with the body, and draw its tyres' stiffness."""
    laden, shift = 1.0 + d.load, d.gravity_shift * (car.l_f + car.l_r)
    drawn = (
        car.m * laden, car.I * laden * d.inertia, car.l_f + shift, car.l_r - shift,
        car.C_f * d.front_stiffness, car.C_r * d.rear_stiffness,
    )  # fmt: skip
    body = (car.S * laden, car.I_x * laden)  # fields 12 and 13
    return CarParams(*(drawn + car[6:12] + body + car[14:]))


@jit
def _is_stable(d: Draws, car: CarParams) -> Scalar:
    """Check whether the drawn car is stable, before its tyres change and after."""
    drawn = draw_car(d, car)
    has_change = d.tyre_change_time > 0.0
    later_f = drawn.C_f * select(has_change, d.front_change, 1.0)
    later_r = drawn.C_r * select(has_change, d.rear_change, 1.0)
    speed = d.critical_speed * d.speed
    is_stable_later = _is_below_critical(later_f, later_r, speed, drawn)
    return _is_below_critical(drawn.C_f, drawn.C_r, speed, drawn) & is_stable_later


@jit
def _is_below_critical(C_f: Scalar, C_r: Scalar, speed: Scalar, car: CarParams) -> Scalar:
    """Check whether a speed (m/s) is below the critical speed of linear tyres."""
    excess = C_f * car.l_f - C_r * car.l_r
    l, v = car.l_f + car.l_r, speed  # noqa: E741
    return car.m * v * v * excess < 2.0 * C_f * C_r * l * l


@jit
def draw_stable(
    low: Vector, high: Vector, key_low: int, key_high: int, car: CarParams, out: Vector
) -> tuple[Draws, int]:
    """Draw until the vehicle is stable, at most 64 times; returns the count of rejected draws, too.

    Args:
        low: Lower ends, shape (len(Draws),).
        high: Upper ends, shape (len(Draws),).
        key_low: Lower 32 bits of the episode's key.
        key_high: Upper 32 bits of the episode's key.
        car: `CarParams`.
        out: Array for the draws, shape (len(Draws),).
    """
    attempt = 0
    _draw_numbers(low, high, key_low, key_high, attempt, out)
    while attempt + 1 < _ATTEMPTS and not _is_stable(read(out, DRAWS), car):
        attempt += 1
        _draw_numbers(low, high, key_low, key_high, attempt, out)
    return read(out, DRAWS), attempt


WORLD_VERSION = 1
"""Version of plant, sensors and world "v1": what was measured in another is measured anew."""


def _draw(group: str, unit: str, limits: Range, ideal: float, text: str) -> Any:
    """Make a range's field; limits are plausible ends."""
    metadata = {"unit": unit, "text": text, "plausible": limits, "per": (), "group": group}
    return dataclasses.field(default=ideal, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class World:
    """Ranges of a car's and its sensors' errors; each is a number or (low, high).

    `World.__dataclass_fields__[name].metadata` has unit, text, plausible ends and group. A value
    out of place raises ValueError and names the field.
    """

    camera_yaw: Range = _draw("camera", "rad", (-0.2, 0.2), 0.0, "to the left")
    camera_pitch: Range = _draw("camera", "rad", (-0.2, 0.2), 0.0, "downwards")
    camera_height: Range = _draw("camera", "-", (-0.5, 0.5), 0.0, "told over true, minus 1")
    steer_offset: Range = _draw("steering", "rad", (-0.1, 0.1), 0.0, "at the wheels")
    steer_scale: Range = _draw("steering", "-", (0.5, 2), 1.0, "measured over true")
    wheel_scale: Range = _draw("wheels and motors", "-", (0.5, 2), 1.0, "measured speed over true")
    wheel_left: Range = _draw("wheels and motors", "-", (0.5, 2), 1.0, "left over right")
    torque_scale: Range = _draw("wheels and motors", "-", (0.1, 2), 1.0, "torque over commanded")
    torque_left: Range = _draw("wheels and motors", "-", (0.1, 2), 1.0, "left over right")
    torque_rate: Range = _draw(
        "wheels and motors", "1/s", (0, 10000), 0.0, "of full torque; 0: no limit"
    )
    gyro_scale: Range = _draw("inertial", "-", (0.5, 2), 1.0, "measured over true")
    gyro_drift: Range = _draw("inertial", "rad/s2", (-0.01, 0.01), 0.0, "of its bias")
    accel_scale: Range = _draw("inertial", "-", (0.5, 2), 1.0, "measured over true")
    accel_roll: Range = _draw("inertial", "rad", (-0.2, 0.2), 0.0, "of its mount")
    accel_ahead: Range = _draw("inertial", "m", (-3, 3), 0.0, "ahead of the centre of gravity")
    vibration: Range = _draw("inertial", "m/s2", (0, 5), 0.0, "of a_y, standard deviation")
    course_error: Range = _draw("GPS and map", "rad m/s", (0, 5), 0.0, "amplitude, over the speed")
    course_period: Range = _draw("GPS and map", "s", (1, 10000), 10.0, "of that error")
    gps_stamp: Range = _draw("GPS and map", "s", (-0.1, 0.1), 0.0, "stamp minus capture")
    map_error: Range = _draw("GPS and map", "1/m", (0, 0.1), 0.0, "amplitude")
    map_length: Range = _draw("GPS and map", "m", (1, 100000), 50.0, "period of that error")
    map_lag: Range = _draw("GPS and map", "s", (0, 5), 0.0, "time constant")
    load: Range = _draw("load", "-", (0, 2), 0.0, "payload over the mass")
    inertia: Range = _draw("load", "-", (0.2, 5), 1.0, "factor on yaw inertia")
    gravity_shift: Range = _draw("load", "-", (-0.3, 0.3), 0.0, "back, of the wheelbase")
    bank_wave: Range = _draw("road", "rad", (-0.3, 0.3), 0.0, "amplitude")
    bank_length: Range = _draw("road", "m", (1, 100000), 200.0, "period of that bank")
    gust: Range = _draw("road", "m/s2", (0, 10), 0.0, "force over mass, standard deviation")
    friction_wave: Range = _draw("road", "-", (-0.9, 0.9), 0.0, "amplitude")
    friction_length: Range = _draw("road", "m", (1, 100000), 50.0, "its period")
    friction_across: Range = _draw("road", "-", (0.1, 5), 1.0, "right over left")
    relaxation: Range = _draw("tyres", "-", (0, 5), 1.0, "factor on relaxation lengths")
    tyres: str = ""  # tyre law; "": the scenario's
    critical_speed: float = 1.05  # of a drawn car over its speed, at least; others are drawn anew
    moment_rate: float = 0.0  # s2, weight of the yaw moment's rate in the cost

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, list):
                value = tuple(value)
                object.__setattr__(self, entry.name, value)
            if entry.name == "tyres":
                if value:
                    check_choice("world: tyres", value, TYRE_LAWS)
                continue
            ends = value if isinstance(value, tuple) else (value, value)
            if not (len(ends) == 2 and all(map(is_finite, ends)) and ends[0] <= ends[1]):
                unit = entry.metadata.get("unit", "s2")
                text = f"world: {entry.name} is a number or (low, high) in {unit}"
                raise ValueError(f"{text}, got {short_repr(value)}")
            if "plausible" in entry.metadata and entry.metadata["plausible"][0] > 0 >= ends[0]:
                raise ValueError(f"world: {entry.name} must be positive, got {value!r}")
        if self.moment_rate < 0.0:
            raise ValueError(f"world: moment_rate is zero or more, got {self.moment_rate!r}")

    @property
    def is_ideal(self) -> bool:
        """Whether nothing errs and the cost has no rate."""
        return self == IDEAL

    def scale(self, group: str, factor: float) -> "World":
        """Scale a group's amplitudes about the ideal: 0 takes its errors away, 2 doubles them.

        Args:
            group: Name in `GROUPS`.
            factor: Factor, not negative.
        """
        check_choice("group of a world", group, GROUPS)
        changes: dict[str, object] = {}
        for name, entry in self.__dataclass_fields__.items():
            if entry.metadata.get("group") == group and not (name in _SHAPES and factor > 0.0):
                ideal, low_high = getattr(IDEAL, name), get_range(getattr(self, name))
                ends = [ideal + factor * (end - ideal) for end in low_high]
                changes[name] = tuple(ends) if ends[0] < ends[1] else ends[0]
        return make_world(self.to_dict() | changes)

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON types without defaults, which `make_world` reads back."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in vars(self).items()
            if value != getattr(IDEAL, name)
        }


_METADATA = [entry.metadata for entry in dataclasses.fields(World)]
GROUPS = tuple(dict.fromkeys(entry["group"] for entry in _METADATA if "group" in entry))
"""Groups of ranges, each of which can be doubled or set to zero."""
_SHAPES = ("course_period", "map_length", "bank_length", "friction_length", "torque_rate")
IDEAL = World()
_FILE = read_document(Path(__file__).with_name("v1.toml"), "world")
SOURCES: dict[str, str] = {name: t["source"] for name, t in _FILE.items() if isinstance(t, dict)}
"""Where each range of the world "v1" is from."""
WORLDS = {
    "ideal": IDEAL,
    "v1": World(**{name: t["range"] if name in SOURCES else t for name, t in _FILE.items()}),
}
"""The worlds by name."""
WorldSource = str | Mapping[str, Any] | World
"""Source of a world, which `make_world` reads."""


def make_world(source: WorldSource) -> World:
    """Make a world from its name, a mapping of fields or a world itself.

    Raises TypeError for an unknown field, and ValueError for an unknown name or a bad value.

    Args:
        source: Name in `WORLDS`; mapping of fields, over another world under `base`; or a `World`.
    """
    if isinstance(source, World):
        return source
    if isinstance(source, str):
        check_choice("world", source, WORLDS)
        return WORLDS[source]
    if not isinstance(source, Mapping):
        raise TypeError(f"a world is a name or a mapping of ranges, got {short_repr(source)}")
    values = dict(source)
    base = make_world(values.pop("base", "ideal"))
    known = [entry.name for entry in dataclasses.fields(World)]
    if unknown := [key for key in values if key not in known]:
        raise TypeError(describe_unknown("range of a world", unknown, [*known, "base"]))
    return dataclasses.replace(base, **values)
