"""The scenarios by name, and a recorded drive's steering trace as a scenario.

`SCENARIOS` holds the manoeuvres below, the scored tiers' and the papers'.
"""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..io import has_suffix, is_document, read_document
from ..recordings.log_file import find_step
from ..recordings.tables import read_quantities
from ..validation import check_choice, describe_unknown, short_repr
from . import tiers
from .draws import KMH
from .papers import ROAD_TESTS, SIMULATIONS
from .scenario import Fields, Scenario


def _read_trace(source: Path) -> Scenario:
    """Read a scenario that steers as a recorded drive, at its first speed, as long as it lasts."""
    values, _ = read_quantities(source, {}, ("time", "steer"), {"speed_x"})
    try:
        step = find_step(values["time"])
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    trace = tuple(values["steer"].tolist())
    length = round((len(trace) - 1) * step, 9)
    fields: Fields = {"trace": trace, "trace_step": step, "duration": length}
    speed = values.get("speed_x", np.zeros(0))
    known_speed = speed[np.isfinite(speed)]
    if len(known_speed):
        fields["speed"] = max(float(known_speed[0]), 0.0)  # noise at rest
    return Scenario(name=source.stem, steering="trace", **fields)


_DRAWN: Fields = {
    "mirror": True, "speed": (18.0 * KMH, 36.0 * KMH), "front_stiffness": (0.6, 1.4),
    "rear_stiffness": (0.6, 1.4), "friction": (0.7, 1.0),
}  # fmt: skip
# Above 28 km/h so many of the drawn cars are close to their critical speed that those which spin
# would decide the mean cost of a harsh manoeuvre.
_HARSH = _DRAWN | {"speed": (18.0 * KMH, 28.0 * KMH)}
_RANDOM = tiers.make_random_steering(0.005, 0.015)
_SLALOM = tiers.SLALOM | {"amplitude": (0.04, 0.1)}
_LANE: Fields = {"steering": "driver", "half_width": 1.75}
_BEND: Fields = {"curvature": (0.01, 0.03), "curve_start": 15.0, "curve_ramp": 10.0}

_MANOEUVRES = (
    Scenario(name="random-steering", **_RANDOM, **_HARSH),
    Scenario(name="sine-with-dwell", amplitude=(0.05, 0.12), **tiers.SINE_WITH_DWELL, **_HARSH),
    Scenario(name="double-lane-change", **tiers.DOUBLE_LANE_CHANGE, **_HARSH),
    Scenario(name="step-steer", amplitude=(0.03, 0.1), **tiers.STEP, **_HARSH),
    Scenario(name="gust", wind_force=(300.0, 500.0), wind_arm=(-0.1, 0.3),
             wind_start=(1.0, 3.0), wind_length=(1.0, 4.0), **_HARSH),
    Scenario(name="low-friction", duration=6.0, steering="lane-change", onset=(0.5, 1.5),
             amplitude=(0.02, 0.045), frequency=(0.3, 0.6),
             **(_HARSH | {"friction": (0.27, 0.35)})),
    Scenario(name="brake-in-turn", amplitude=(0.04, 0.1), **tiers.BRAKE_IN_TURN, **_HARSH),
    Scenario(name="stiffness-step", tyre_change_time=(3.0, 6.0), front_change=(0.7, 1.3),
             rear_change=(0.7, 1.3), **_RANDOM, **_HARSH),
    Scenario(name="sensor-outage", camera_outage=(3.0, 6.0), gps_outage=(3.0, 6.0),
             **_SLALOM, **_HARSH),
    Scenario(name="uneven-delay", camera_delays=(0.020, 0.015, 0.010, 0.025),
             **_RANDOM, **_HARSH),  # uneven-delay, Fig. 5
)  # fmt: skip

# Easier ones, to begin with.
_EASY = (
    Scenario(name="straight", **_DRAWN),
    Scenario(name="sine", steering="sine", onset=(0.5, 1.5), amplitude=(0.02, 0.06),
             frequency=(0.3, 0.8), **_DRAWN),
    Scenario(name="slalom", **_SLALOM, **_DRAWN),
    Scenario(name="lane-change", duration=6.0, steering="lane-change", onset=(0.5, 1.5),
             amplitude=(0.05, 0.14), frequency=(0.3, 0.6), **_DRAWN),
)  # fmt: skip

# The task of these is the car's place on the road, which the cost does not contain.
_ROADS = (
    # braking as hard as the motors can: the right wheel slips
    Scenario(name="split-friction", duration=6.0, speed_change=-18.0 * KMH, change_start=2.0,
             change_length=2.0, friction_right=(0.2, 0.3), **_LANE,
             **(_HARSH | {"speed": (22.0 * KMH, 30.0 * KMH)})),
    # only the controller steers
    Scenario(name="curved-road", half_width=1.75, **_BEND, **_HARSH),
    Scenario(name="curved-road-driver", **_LANE, **_BEND, **_HARSH),
    tiers.WET_EVASION,
)  # fmt: skip

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (*_MANOEUVRES, *_EASY, *_ROADS, *tiers.TIERS, *SIMULATIONS, *ROAD_TESTS)
}


ScenarioSource = str | os.PathLike[str] | Mapping[str, Any] | Scenario
"""Source of a scenario, which `make_scenario` reads."""


def make_scenario(source: ScenarioSource) -> Scenario:
    """Make a scenario from its name, a file, a mapping of fields, or a scenario itself.

    A TOML or JSON file holds such a mapping, as `Scenario.write` makes one. A mapping may start
    from another scenario, a name or a file, under `base`. Without a `name` a file's stem is the
    name. A CSV or Parquet file (needs the extra `report`) is a recorded drive: its columns for time
    and steering angle (time_s, steer_rad or steer_deg), and speed (speed_x_mps) if it has one, are
    driven again, with `Scenario`'s defaults for all else. A missing file raises FileNotFoundError,
    an unknown name and a value out of place ValueError.

    Args:
        source: Name in `SCENARIOS`, path, mapping of fields, or a `Scenario`, returned as it is.

    Returns:
        The scenario.

    Raises:
        TypeError: For an unknown field or another kind of source.
        type: The reader's error, with the file's name.
    """
    if isinstance(source, Scenario):
        return source
    if isinstance(source, Mapping):
        return _parse_scenario(dict(source))
    if has_suffix(source, (".csv", ".parquet")):
        return _read_trace(Path(source))
    if is_document(source):
        values = read_document(source, "scenario")
        try:
            return _parse_scenario({"name": Path(source).stem} | values)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{source}: {error}") from None
    if not isinstance(source, str):
        raise TypeError(
            "a scenario is a name, the path of a TOML, JSON, CSV or Parquet file or a mapping of "
            f"fields, got {short_repr(source)}"
        )
    check_choice("scenario", source, SCENARIOS)
    return SCENARIOS[source]


def _parse_scenario(values: Fields) -> Scenario:
    """Make a scenario from a mapping, which may have a `base`."""
    base = values.pop("base", None)
    known = [entry.name for entry in dataclasses.fields(Scenario)]
    if unknown := [key for key in values if key not in known]:
        raise TypeError(describe_unknown("scenario field", unknown, [*known, "base"]))
    if base is not None:
        return make_scenario(base).replace(**values)
    return Scenario(**{"name": "custom", **values})
