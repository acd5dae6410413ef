"""The manoeuvres by name: the scored ones, drawn by the seed, here; the papers' own beside them."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from ..arguments import brief, check_choice, listed
from .draws import KMH
from .papers import ROAD_TESTS, SIMULATIONS
from .scenario import Scenario

_DRAWN: dict[str, Any] = {
    "mirror": True,
    "speed": (18.0 * KMH, 36.0 * KMH),
    "front_stiffness": (0.6, 1.4),
    "rear_stiffness": (0.6, 1.4),
    "friction": (0.7, 1.0),
}
# Above 28 km/h so many of the drawn cars are close to their critical speed that those which spin
# would decide the mean cost of a harsh manoeuvre.
_HARSH = _DRAWN | {"speed": (18.0 * KMH, 28.0 * KMH)}
_SCORED = _HARSH | {"scored": True}
_RANDOM: dict[str, Any] = {
    "steering": "random",
    "onset": (0.0, 1.0),
    "amplitude": (0.005, 0.015),
    "amplitude_2": (0.005, 0.015),
    "frequency": (0.3, 0.4),
    "frequency_2": (0.4, 0.8),
    "frequency_3": (0.2, 0.3),
    "frequency_4": (0.4, 0.6),
}
_SLALOM: dict[str, Any] = {
    "steering": "slalom",
    "onset": (0.5, 1.5),
    "amplitude": (0.04, 0.1),
    "frequency": (0.2, 0.6),
}
_LANE: dict[str, Any] = {"steering": "driver", "half_width": 1.75}
_BEND: dict[str, Any] = {"curvature": (0.01, 0.03), "curve_start": 15.0, "curve_ramp": 10.0}

_MANOEUVRES = (
    Scenario(
        name="random-steering",
        **_RANDOM,
        **_SCORED,
    ),
    Scenario(  # FMVSS 126: 0.7 Hz, and half a second at the second peak
        name="sine-with-dwell",
        duration=6.0,
        steering="sine-with-dwell",
        onset=(0.5, 1.0),
        amplitude=(0.05, 0.12),
        frequency=(0.6, 0.8),
        hold=0.5,
        **_SCORED,
    ),
    Scenario(  # the sections of the standard in the times they take at 25 to 32 km/h
        name="double-lane-change",
        duration=6.0,
        path="iso-3888-2",
        path_speed=(7.0, 9.0),
        onset=(0.5, 1.0),
        **(_LANE | {"half_width": 2.0}),
        **_SCORED,
    ),
    Scenario(
        name="step-steer",
        duration=8.0,
        steering="step",
        onset=(0.5, 1.5),
        amplitude=(0.03, 0.1),
        hold=(1.0, 2.0),
        **_SCORED,
    ),
    Scenario(
        name="gust",
        wind_force=(300.0, 500.0),
        wind_arm=(-0.1, 0.3),
        wind_start=(1.0, 3.0),
        wind_length=(1.0, 4.0),
        **_SCORED,
    ),
    Scenario(
        name="low-friction",
        duration=6.0,
        steering="lane-change",
        onset=(0.5, 1.5),
        amplitude=(0.02, 0.045),
        frequency=(0.3, 0.6),
        **(_SCORED | {"friction": (0.27, 0.35)}),
    ),
    Scenario(  # the motors brake; they share their torque with the yaw moment
        name="brake-in-turn",
        duration=6.0,
        steering="held-step",
        onset=(0.5, 1.0),
        amplitude=(0.04, 0.1),
        speed_change=-12.0 * KMH,
        change_start=2.0,
        change_length=2.0,
        **_SCORED,
    ),
    Scenario(
        name="stiffness-step",
        tyre_change_time=(3.0, 6.0),
        front_change=(0.7, 1.3),
        rear_change=(0.7, 1.3),
        **_RANDOM,
        **_SCORED,
    ),
    Scenario(
        name="sensor-outage",
        camera_outage=(3.0, 6.0),
        gps_outage=(3.0, 6.0),
        **_SLALOM,
        **_SCORED,
    ),
    Scenario(
        name="uneven-delay",
        camera_delays=(0.020, 0.015, 0.010, 0.025),  # uneven-delay, Fig. 5
        **_RANDOM,
        **_SCORED,
    ),
)

# Easier ones, not scored: to begin with, and for what shall not be learned on the scored ones.
_OTHERS = (
    Scenario(name="straight", **_DRAWN),
    Scenario(
        name="sine",
        steering="sine",
        onset=(0.5, 1.5),
        amplitude=(0.02, 0.06),
        frequency=(0.3, 0.8),
        **_DRAWN,
    ),
    Scenario(
        name="slalom",
        **_SLALOM,
        **_DRAWN,
    ),
    Scenario(
        name="lane-change",
        duration=6.0,
        steering="lane-change",
        onset=(0.5, 1.5),
        amplitude=(0.05, 0.14),
        frequency=(0.3, 0.6),
        **_DRAWN,
    ),
)

# Not scored: what they ask for is a place on the road, which the cost does not judge.
_ROADS = (
    Scenario(  # braking as hard as the motors can: the right wheel slips
        name="split-friction",
        duration=6.0,
        speed_change=-18.0 * KMH,
        change_start=2.0,
        change_length=2.0,
        friction_right=(0.2, 0.3),
        **_LANE,
        **(_HARSH | {"speed": (22.0 * KMH, 30.0 * KMH)}),
    ),
    Scenario(  # nobody steers but the controller
        name="curved-road", half_width=1.75, **_BEND, **_HARSH
    ),
    Scenario(name="curved-road-driver", **_LANE, **_BEND, **_HARSH),
)

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (*_MANOEUVRES, *_OTHERS, *_ROADS, *SIMULATIONS, *ROAD_TESTS)
}


def scenario_from(source: "str | Scenario | Mapping[str, Any]") -> Scenario:
    """A scenario from its name, a mapping of fields, or a scenario itself.

    A mapping may name a scenario to start from under `"base"`. Raises ValueError for an unknown
    name, TypeError for an unknown field and for another type.
    """
    if isinstance(source, Scenario):
        return source
    if isinstance(source, str):
        check_choice("scenario", source, SCENARIOS)
        return SCENARIOS[source]
    if not isinstance(source, Mapping):
        raise TypeError(f"a scenario is a name or a mapping of fields, got {brief(source)}")
    values = dict(source)
    base = values.pop("base", None)
    known = {entry.name for entry in dataclasses.fields(Scenario)}
    unknown = sorted(set(values) - known, key=str)
    if unknown:
        raise TypeError(f"unknown scenario field {listed(map(brief, unknown))}")
    if base is not None:
        return scenario_from(base).replace(**values)
    return Scenario(**{"name": "custom", **values})
