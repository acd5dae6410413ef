"""FilterPy's Kalman filter with a rewind by hand for late samples gives our filters' estimates."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("filterpy")

from sideslip.agents.rollout import rollout
from sideslip.estimators.make import make_estimator
from tests.estimators.core.filterpy_rival import OURS, Rival, four_states, six_states


@pytest.mark.parametrize("delay", [0.0, 0.030, 0.129])
@pytest.mark.parametrize(
    ("name", "states"), [("multirate-kf", four_states), ("exact-kf", six_states)]
)
def test_filterpy_and_ours_give_the_same_estimates(
    name: str, states: Callable[..., Any], delay: float
) -> None:
    scenario = {"base": "tie-vision-fig7", "camera_delays": [delay], "duration": 0.4}
    env: Any = gym.make("sideslip/YawVision-v0", scenario=scenario, control_period=1)
    log, base = rollout(env).log, env.unwrapped
    assert len(log.record.packets) >= 8
    car = base.nominal
    theirs = Rival(states(car, base.held_speed, base.dt), car, round(delay * 1e3)).run(log.record)
    facts = {"vehicle": car, "sensors": base.slow_sensors, "dt": base.dt, "speed": base.held_speed}
    ours = make_estimator(name, **facts, gains="covariance", **OURS[name]).run(log)
    scale = np.abs(ours.x).max(axis=0)
    np.testing.assert_allclose(theirs / scale, ours.x / scale, rtol=0.0, atol=1e-10)
