"""Whatever stands in a field, it is a number that drives or an error that names the field."""

import dataclasses
import math
from collections.abc import Callable
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


FIELDS = [entry.name for entry in dataclasses.fields(Scenario)]


@pytest.mark.parametrize("field", FIELDS)
def test_a_scenarios_field(field: str) -> None:
    names = {  # what the fault is a fault of
        "vehicle": "",
        "nominal": "",
        "camera_delays": "camera",
        "gps_delays": "gps",
    }
    count = refused(lambda value: drive(scenario={field: value}), names.get(field, field))
    assert count > 15


@pytest.mark.parametrize("base", ["iso-3888-1", "gps-course"])
def test_a_scenarios_field_on_a_track_and_a_linear_plant(base: str) -> None:
    for field in ("gps_period", "roll", "small_angle", "path_speed", "speed", "half_width"):
        drive_it = lambda value, f=field: drive(scenario={"base": base, f: value})  # noqa: E731
        assert refused(drive_it, "") > 15


@pytest.mark.parametrize("field", [entry.name for entry in dataclasses.fields(Vehicle)])
def test_a_vehicles_field(field: str) -> None:
    names = {"sprung_mass": "Vehicle.", "roll_arm": "Vehicle."}  # its suspension is too soft

    key = f"{field}_per_tyre" if field in ("front_stiffness", "rear_stiffness") else field

    def try_it(value: Any) -> None:
        drive(vehicle={"base": "coms", key: value})

    assert refused(try_it, names.get(field, field)) > 15


@pytest.mark.parametrize("field", [entry.name for entry in dataclasses.fields(SlowSensor)])
def test_a_slow_sensors_field(field: str) -> None:
    """The clock and the link go by all of them: a message may name another one."""
    assert refused(lambda value: drive(camera={field: value}), "") > 15


@pytest.mark.parametrize("option", ["scenario", "vehicle", "friction", "state", "duration"])
def test_an_option_of_reset(option: str) -> None:
    env = StabilityEnv()
    name = "" if option in ("scenario", "vehicle", "state") else option
    count = refused(lambda value: env.reset(seed=1, options={option: value}), name)
    assert count > 15


@pytest.mark.parametrize(
    "argument",
    ["scenario", "vehicle", "nominal", "reference", "control_period", "fast", "on_bad_action"],
)
def test_an_argument(argument: str) -> None:
    name = "" if argument in ("scenario", "vehicle", "nominal") else argument
    assert refused(lambda value: drive(**{argument: value}), name) > 15


def test_what_a_message_says_is_short() -> None:
    for value in ODD:
        assert len(short_repr(value)) < 200
    assert short_repr(10**5000) == "<int>"
    assert len(join_names(str(i) for i in range(1000))) <= 250
    assert join_names(["a", "b"]) == "a, b"
    with pytest.raises(ValueError, match="unknown vehicle 'tank'; known: coms, "):
        make_vehicle("tank")
