"""Checks of a scenario and of reset options against what an outside plant can do."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from ..arguments import check_mapping, is_finite, short_repr
from ..scenarios.scenario import Scenario

MIN_SPEED = (
    1.0  # m/s: the multi-body model's least speed; below 0.1 it freezes while its wheels spin
)

# Fields of a scenario that change our own plant or its road: only their defaults will do.
_OWN_PLANT_FIELDS = (
    "road",
    "curvature",
    "bank",
    "grade",
    "small_angle",
    "tyres",
    "vehicle",
    "friction_right",
    "tyre_change_time",
)


def check_scenario(scenario: Scenario, model: str) -> None:
    """Check that a model can drive a scenario.

    Args:
        scenario: The scenario.
        model: Name of the model, of `OUTSIDE_PLANTS`.

    Raises:
        ValueError: For a field that only our plant has, or that this model has not.
    """
    name = f"scenario {scenario.name!r}"
    defaults = {entry.name: entry.default for entry in dataclasses.fields(Scenario)}
    for field in _OWN_PLANT_FIELDS:
        value = getattr(scenario, field)
        if value and value != defaults[field]:
            raise ValueError(
                f"{name}: {field} {value!r} is of our own plant and road; an outside plant is "
                "what it is, on a straight and level road"
            )
    if model != "multi-body":
        if scenario.wind_height:
            raise ValueError(
                f"{name}: wind_height {scenario.wind_height!r} rolls the body; the {model} model "
                "has no roll"
            )
        return
    if not scenario.roll:
        raise ValueError(f"{name}: roll False; the multi-body model always rolls")
    min_speed = find_min_speed(scenario)
    if min_speed < MIN_SPEED:
        raise ValueError(
            f"{name}: its speed comes down to {min_speed:.3g} m/s; the multi-body model needs "
            f"{MIN_SPEED} m/s or more"
        )


def find_min_speed(scenario: Scenario) -> float:
    """Find the lowest speed that a scenario's own changes of speed lead to.

    Args:
        scenario: The scenario.

    Returns:
        Speed (m/s).
    """
    change = scenario.speed_change + (scenario.acceleration or 0.0) * scenario.duration
    return scenario.range("speed")[0] + min(change, 0.0)


def check_options(options: Mapping[str, Any], model: str) -> None:
    """Check that a model can follow the options of reset.

    Args:
        options: Options of reset.
        model: Name of the model, of `OUTSIDE_PLANTS`.

    Raises:
        ValueError: For an option that it cannot follow.
    """
    if "vehicle" in options:
        raise ValueError("reset option vehicle: an outside plant is its own vehicle")
    if "friction" in options and model == "single-track":
        raise ValueError(
            "reset option friction: the single-track model's tyres are linear and know none"
        )
    state = check_mapping("reset option state", options.get("state", {}))
    for name in ("s", "y", "theta"):
        if name in state:
            raise ValueError(f"reset option state: {name} follows from X and Y here")
    if model != "multi-body":
        if state.get("phi") or state.get("phi_dot"):
            raise ValueError(f"reset option state: the {model} model has no roll")
    elif (v_x := state.get("v_x")) is not None and not (is_finite(v_x) and v_x >= MIN_SPEED):
        raise ValueError(
            f"reset option state: v_x is {short_repr(v_x)} m/s; "
            f"the multi-body model needs {MIN_SPEED} or more"
        )
