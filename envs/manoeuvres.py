"""The manoeuvres by name: the scored ones, drawn by the seed, here; the papers' own beside them."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from .paper_simulations import ROAD_TESTS, SIMULATIONS
from .scenario import KMH, Scenario

_DRAWN: dict[str, Any] = {
    "mirror": True,
    "speed": (18.0 * KMH, 36.0 * KMH),
    "front_stiffness": (0.6, 1.4),
    "rear_stiffness": (0.6, 1.4),
    "friction": (0.7, 1.0),
}

_MANOEUVRES = (
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
        steering="slalom",
        onset=(0.5, 1.5),
        amplitude=(0.04, 0.1),
        frequency=(0.2, 0.6),
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
    Scenario(
        name="step-steer",
        duration=8.0,
        steering="step",
        onset=(0.5, 1.5),
        amplitude=(0.03, 0.1),
        hold=(1.0, 2.0),
        **_DRAWN,
    ),
    Scenario(
        name="random-steering",
        steering="random",
        onset=(0.0, 1.0),
        amplitude=(0.01, 0.04),
        amplitude_2=(0.01, 0.04),
        frequency=(0.3, 0.4),
        frequency_2=(0.4, 0.8),
        frequency_3=(0.2, 0.3),
        frequency_4=(0.4, 0.6),
        **_DRAWN,
    ),
    Scenario(
        name="gust",
        wind_force=(150.0, 300.0),
        wind_arm=(-0.1, 0.3),
        wind_start=(1.0, 3.0),
        wind_length=(1.0, 4.0),
        **_DRAWN,
    ),
)

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario for scenario in (*_MANOEUVRES, *SIMULATIONS, *ROAD_TESTS)
}


def scenario_from(source: "str | Scenario | Mapping[str, Any]") -> Scenario:
    """A scenario from its name, a mapping of fields, or a scenario itself.

    A mapping may name a scenario to start from under `"base"`. Raises ValueError for an unknown
    name, TypeError for an unknown field.
    """
    if isinstance(source, Scenario):
        return source
    if isinstance(source, str):
        if source not in SCENARIOS:
            raise ValueError(f"unknown scenario {source!r}; known: {', '.join(SCENARIOS)}")
        return SCENARIOS[source]
    values = dict(source)
    base = values.pop("base", None)
    known = {entry.name for entry in dataclasses.fields(Scenario)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise TypeError(f"unknown scenario field {', '.join(map(repr, unknown))}")
    if base is not None:
        return scenario_from(base).replace(**values)
    return Scenario(**{"name": "custom", **values})
