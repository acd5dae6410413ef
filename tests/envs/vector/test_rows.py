"""Arguments by row, and a limit of steps: each row is the environment made with its own."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from sideslip.estimators import EstimateObservation, vector

from ..batches import MODES, SHORT, batch, drive, same, same_cars, sync

FUSION = "sideslip/YawFusion-v0"
SCENARIOS: list[Any] = [SHORT, {"base": "gust", "duration": 0.2}, SHORT, "car-iso-3888-1"]
CARS: list[Any] = ["coms", {"base": "coms", "mass": 420.0}, "passenger-car", "coms"]


@pytest.mark.parametrize("mode", MODES)
def test_every_row_is_the_environment_with_its_own_arguments(mode: str) -> None:
    """Over many episodes: what a row was made with outlives its resets, reset's options do not."""
    told: dict[str, Any] = {"on_bad_action": "fail", "control_period": 20}
    rows = zip(SCENARIOS, CARS, strict=True)
    makers = [lambda s=s, v=v: gym.make(FUSION, scenario=s, vehicle=v, **told) for s, v in rows]
    alone = SyncVectorEnv(makers, autoreset_mode=mode)
    together = batch(FUSION, 4, scenario=SCENARIOS, vehicle=CARS, autoreset_mode=mode, **told)
    options = {"friction": 0.4}
    same(alone.reset(seed=3, options=options), together.reset(seed=3, options=options))
    same_cars(alone, together)
    assert drive(alone, together, 300) > 60


@pytest.mark.parametrize("mode", MODES)
def test_a_limit_of_steps_is_that_of_time_limit(mode: str) -> None:
    told: dict[str, Any] = {"scenario": SHORT, "on_bad_action": "fail", "max_episode_steps": 9}
    alone, together = sync(FUSION, 4, mode, **told), batch(FUSION, 4, autoreset_mode=mode, **told)
    same(alone.reset(seed=1), together.reset(seed=1))
    assert drive(alone, together, 200) > 60


def test_estimators_work_with_a_limit_of_steps() -> None:
    told: dict[str, Any] = {"scenario": SHORT, "max_episode_steps": 5}
    env = EstimateObservation(gym.make(FUSION, **told), "exact-kf")
    cars = vector.EstimateObservation(batch(FUSION, 1, **told), "exact-kf")
    seen, together = [env.reset(seed=0)[0]], [cars.reset(seed=0)[0][0]]
    for _ in range(5):
        step, steps = env.step(np.zeros(1)), cars.step(np.zeros((1, 1), np.float32))
        seen.append(step[0])
        together.append(steps[0][0])
    assert step[3] and steps[3].all() and not step[2]
    np.testing.assert_array_equal(seen, together)
