"""What cannot be is refused where it is made, and the error names it."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import pytest

from sideslip.envs import SlowSensor, StabilityEnv, StabilityVectorEnv

pytestmark = [pytest.mark.plain, pytest.mark.smoke]

Arguments = dict[str, Any]
Makers = tuple[Callable[..., Any], ...]
Refusal = tuple[Makers, Arguments, type[Exception], str]
ENV = (StabilityEnv,)
VISION, GPS = ((partial(gymnasium.make, f"sideslip/Yaw{name}-v0"),) for name in ("Vision", "Gps"))
ROWS = (
    partial(StabilityVectorEnv, num_envs=2),
    partial(gymnasium.make_vec, "sideslip/YawFusion-v0", num_envs=2),
)
THREE, SENSOR = (partial(StabilityVectorEnv, num_envs=3),), (partial(SlowSensor, period=0.1),)
VALUE, TYPE = ValueError, TypeError
REFUSED: list[Refusal] = [
    (ENV, {"sensors": "radar"}, VALUE, "unknown sensors 'radar'; known: vision, "),
    (ENV, {"scenario": "slalon"}, VALUE, "unknown scenario 'slalon'; did you mean 'slalom'"),
    (ENV, {"scenario": {"speeed": 1.0}}, TYPE, "unknown scenario field 'speeed'"),
    (ENV, {"scenario": {"duration": -1.0}}, VALUE, "'custom': duration -1.0"),
    (ENV, {"scenario": {"gps_outage": (3.0, 1.0)}}, VALUE, "gps_outage is .from, to., from before"),
    (ENV, {"scenario": {"wind_length": -2.0}}, VALUE, "wind_length is zero or more, got -2.0"),
    (ENV, {"scenario": {"vehicle": {"friction": 0.3}}}, VALUE, "vehicle has no friction here"),
    (ENV, {"scenario": {"nominal": {"masss": 1.0}}}, TYPE,
     "'custom': unknown parameter of nominal 'masss'; did you mean"),
    (ENV, {"scenario": {"noise": {"gyroscope": 1.0}}}, TYPE, "parameter of noise 'gyroscope'; did"),
    (ENV, {"world": {"moment_rate": -1.0}}, VALUE, "moment_rate is zero or more, got -1.0"),
    (ENV, {"vehicle": "comms"}, VALUE, "unknown vehicle 'comms'; did you mean 'coms'"),
    (ENV, {"vehicle": {"base": "coms", "mass": 0.0}}, VALUE, "Vehicle.mass: 0.0 kg is not"),
    (ENV, {"vehicle": {"base": "coms", "mass": math.nan}}, VALUE, "Vehicle.mass: nan kg"),
    (ENV, {"vehicle": {"base": "coms", "masss": 1.0}}, TYPE, "unknown vehicle parameter 'masss'"),
    (ENV, {"nominal": "comms"}, VALUE, "unknown vehicle 'comms'"),
    (ENV, {"control_period": 0}, VALUE, "control_period is 1 to 1000 ticks, got 0"),
    (ENV, {"control_period": 1001}, VALUE, "control_period is 1 to 1000 ticks, got 1001"),
    (ENV, {"control_period": 10.0}, TYPE, "control_period is a number of ticks, got 10.0"),
    (ENV, {"control_period": True}, TYPE, "control_period is a number of ticks, got True"),
    (ENV, {"steering": "yes"}, TYPE, "steering is True or False, got 'yes'"),
    (ENV, {"with_map": 1}, TYPE, "with_map is True or False, got 1"),
    (ENV, {"reference": "slip"}, VALUE, "unknown reference 'slip'; did you mean 'zero-slip'"),
    (ENV, {"fast": "some"}, VALUE, "unknown fast 'some'; known: summary, all"),
    (ENV, {"on_bad_action": "shrug"}, VALUE, "unknown on_bad_action 'shrug'; known: "),
    (ENV, {"render_mode": "ansi"}, VALUE, "unknown render_mode 'ansi'; known: human, rgb_array"),
    (ENV, {"gps": {"period": 0.1}}, VALUE, "this id has no gps; it has: camera"),
    (ENV, {"camera": {"perriod": 0.1}}, TYPE, "perriod"),
    (ENV, {"camera": {"period": -0.1}}, VALUE, "period must be at least one tick, got -0.1"),
    (ENV, {"camera": {"delays": [0.3]}}, VALUE, "10 packets under way at once; .* room for 8"),
    (ENV, {"estimator": "dakf"}, TYPE, "estimator"),
    (VISION, {"camera": {"perod": 0.05}}, TYPE,
     "unknown number of the camera 'perod'; did you mean 'per"),
    (GPS, {"camera": {"period": 0.05}}, VALUE, "this id has no camera; it has: gps"),
    (ROWS, {"num_envs": 0}, VALUE, "num_envs is at least 1, got 0"),
    (ROWS, {"num_envs": -3}, VALUE, "num_envs is at least 1, got -3"),
    (ROWS, {"num_envs": 2.0}, TYPE, "num_envs is a number of environments, got 2.0"),
    (ROWS, {"num_envs": True}, TYPE, "num_envs is a number of environments, got True"),
    (ROWS, {"autoreset_mode": "Later"}, VALUE,
     "'Later'; known: 'NextStep', 'SameStep', 'Disabled'"),
    (ROWS, {"info": "some"}, VALUE, "info is 'all' or 'ends', got 'some'"),
    (ROWS, {"scenario": "slalon"}, VALUE, "unknown scenario 'slalon'"),
    (ROWS, {"render_mode": "ansi"}, VALUE, "unknown render_mode 'ansi'; known: human, rgb_array"),
    (ROWS, {"on_bad_action": "shrug"}, VALUE, "unknown on_bad_action 'shrug'"),
    (ROWS, {"estimator": "dakf"}, TYPE, "unknown argument 'estimator'"),
    (THREE, {"scenario": ["gust", "slalom"]}, VALUE, "scenario: one or a list of 3, one a row"),
    (THREE, {"vehicle": ["coms"] * 4}, VALUE, "vehicle: one or a list of 3, one a row, got 4"),
    (THREE, {"scenario": ["gust", "gust", "gusty"]}, VALUE, "did you mean 'gust'"),
    (THREE, {"scenario": ["gust", None, "gust"]}, TYPE, "a scenario is a name"),
    (THREE, {"max_episode_steps": 0}, VALUE, "max_episode_steps is at least 1, got 0"),
    (THREE, {"max_episode_steps": 1.5}, TYPE, "max_episode_steps is a number of steps"),
    (SENSOR, {"period": 0.0005}, VALUE, "at least one tick, got 0.0005"),
    (SENSOR, {"period": math.nan}, VALUE, "at least one tick, got nan"),
    (SENSOR, {"period": math.inf}, VALUE, "at least one tick, got inf"),
    (SENSOR, {"delays": ()}, VALUE, "one to four delays"),
    (SENSOR, {"delays": (0.1,) * 5}, VALUE, "one to four delays"),
    (SENSOR, {"delays": (-0.1,)}, VALUE, "finite and not negative"),
    (SENSOR, {"delays": (math.nan,)}, VALUE, "finite and not negative"),
    (SENSOR, {"jitter": math.inf}, VALUE, "finite and not negative"),
    (SENSOR, {"phase": -0.1}, VALUE, "finite and not negative"),
    (SENSOR, {"loss": 1.1}, VALUE, "loss is a probability, got 1.1"),
    (SENSOR, {"duplicate": math.nan}, VALUE, "duplicate is a probability, got nan"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("makers", "arguments", "error", "message"), REFUSED, ids=[f"{row[1]}" for row in REFUSED]
)
def test_it_is_refused(
    makers: Makers, arguments: Arguments, error: type[Exception], message: str
) -> None:
    for make in makers:
        with pytest.raises(error, match=message):
            make(**arguments)
