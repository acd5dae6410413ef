"""Whatever stands in a field, it is a number that drives or an error that names the field."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from sideslip.envs.scenarios.scenario import Scenario
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.stability import StabilityEnv
from sideslip.envs.validation import join_names, short_repr
from sideslip.envs.vehicle.parameters import Vehicle, make_vehicle

HUGE = 10**400
ODD: tuple[Any, ...] = (
    *(math.nan, math.inf, -math.inf, 1e308, -1e308, 1e300, 1e-308, HUGE, -HUGE, 10**5000, -1),
    *("x", "True", "0.9", "3" * 1000, True, False, None, b"b", 1 + 2j, object(), math),
    *([], [1], [1, 2, 3], [2, 1], [math.nan, 1], [1, HUGE], [0, 1e308], ["a", "b"], [[1], [2]]),
    *({}, {"x": 1}, {1: 2}, {"mass": math.nan}, {"gyro": HUGE}, range(3), [0.0] * 10_000),
    *(np.float64(math.nan), np.array([1.0, 2.0]), np.array(1.0)),
)


def refused(try_it: Callable[[Any], Any], field: str) -> int:
    """How many odd values are refused, each by an error that names the field and is short."""
    count = 0
    for value in ODD:
        try:
            try_it(value)
        except (ValueError, TypeError) as error:
            assert type(error) in (ValueError, TypeError), repr(error)
            message = str(error)
            assert field in message and len(message) < 500, (short_repr(value), message[:600])
            count += 1
    return count


def drive(**arguments: Any) -> None:
    env = StabilityEnv(**arguments)
    obs, _ = env.reset(seed=1)
    assert np.isfinite(obs).all()
    obs, reward, *_ = env.step(np.zeros(1, np.float32))
    assert np.isfinite(obs).all() and math.isfinite(reward)


Maker = Callable[[str, Any], Any]  # of a field and its value


def reset(option: str, value: Any) -> None:
    StabilityEnv().reset(seed=1, options={option: value})


def list_fields(kind: Any) -> list[str]:
    return [entry.name for entry in dataclasses.fields(kind)]


def drive_part(part: str, others: dict[str, Any], field: str, value: Any) -> None:
    drive(**{part: others | {field: value}})


def drive_argument(name: str, value: Any) -> None:
    drive(**{name: value})


SCENARIO, CAMERA = partial(drive_part, "scenario", {}), partial(drive_part, "camera", {})
TRACK, COURSE = (
    partial(drive_part, "scenario", {"base": base}) for base in ("iso-3888-1", "gps-course")
)
VEHICLE = partial(drive_part, "vehicle", {"base": "coms"})
OTHERS = ("gps_period", "roll", "small_angle", "path_speed", "speed", "half_width")
CHOICES = ("reference", "control_period", "fast", "on_bad_action")
PARTS = ("scenario", "vehicle", "nominal", "state")  # the fault is a fault of something in them
CASES: list[tuple[str, Maker, str, str]] = [  # what, how it is made, the field, what errors name
    *(("scenario", SCENARIO, name, name) for name in list_fields(Scenario)),
    *(("track", TRACK, name, "") for name in OTHERS),
    *(("linear plant", COURSE, name, "") for name in OTHERS),
    *(("vehicle", VEHICLE, name, name) for name in list_fields(Vehicle)),
    *(("camera", CAMERA, name, "") for name in list_fields(SlowSensor)),  # or another one
    *(("reset", reset, name, name) for name in (*PARTS[:2], "friction", "state", "duration")),
    *(("argument", drive_argument, name, name) for name in (*PARTS[:3], *CHOICES)),
]
NAMES = {"camera_delays": "camera", "gps_delays": "gps"} | dict.fromkeys(PARTS, "")
NAMES |= dict.fromkeys(("sprung_mass", "roll_arm"), "Vehicle.")  # its suspension is too soft
KEYS = {name: f"{name}_per_tyre" for name in ("front_stiffness", "rear_stiffness")}


@pytest.mark.parametrize(
    ("what", "make", "field", "named"), CASES, ids=[f"{row[0]} {row[2]}" for row in CASES]
)
def test_a_field(what: str, make: Maker, field: str, named: str) -> None:
    key = KEYS.get(field, field) if what == "vehicle" else field
    count = refused(lambda value: make(key, value), NAMES.get(named, named))
    assert count > 15


def test_what_a_message_says_is_short() -> None:
    for value in ODD:
        assert len(short_repr(value)) < 200
    assert short_repr(10**5000) == "<int>"
    assert len(join_names(str(i) for i in range(1000))) <= 250
    assert join_names(["a", "b"]) == "a, b"
    with pytest.raises(ValueError, match="unknown vehicle 'tank'; known: coms, "):
        make_vehicle("tank")
