"""`World`: what calibration leaves over in car and sensors, drawn by the seed, told to nobody.

The default of every range is the ideal world, in which nothing errs; `WORLDS["v1"]` is in
`v1.toml` with the source of each range. The table in the docs is made of both.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..io import read_document
from ..validation import check_choice, describe_unknown, is_finite, short_repr
from ..vehicle.tyres import TYRE_LAWS
from .draws import Range, get_range

WORLD_VERSION = 1
"""Version of plant, sensors and world "v1": what was measured in another is measured anew."""
GROUPS = (
    "camera", "steering", "wheels and motors", "inertial", "GPS and map", "load", "road", "tyres",
)  # fmt: skip
"""Groups of ranges, each of which can be doubled or set to zero."""


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
