"""A driver who wanders: an Ornstein-Uhlenbeck process of the seed alone, in steps."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.clairvoyant.preview import make_forecast
from sideslip.envs import StabilityEnv
from sideslip.envs.device import make_device_env

from ..helpers import bits, drive_alike
from .commands import commands

WANDER: dict[str, Any] = {"steering": "wander", "amplitude": 0.01, "frequency": 2.0}
WANDER |= {"hold": 0.02, "duration": 0.5}


def wander(n: int = 10, seed: int = 0, **changes: Any) -> Any:
    return commands(StabilityEnv(scenario=WANDER | changes, control_period=n), seed)


def test_the_angle_is_of_the_seed_alone_and_is_held() -> None:
    angles = wander()
    assert bits(wander(7)) == bits(angles)
    assert bits(wander(1, vehicle={"mass": 500.0})) == bits(angles)
    assert bits(wander(seed=1)) != bits(angles)
    moved = 1 + np.flatnonzero(np.diff(angles))
    np.testing.assert_array_equal(moved, np.arange(20, 500, 20))


def test_it_is_stationary_and_forgets_at_its_rate() -> None:
    """From the reset on: standard deviation, correlation of neighbours, white innovations."""
    angles = np.array([wander(100, seed, duration=4.0)[::20] for seed in range(24)])
    keep = np.exp(-2.0 * np.pi * 2.0 * 0.02)
    fresh = (angles[:, 1:] - keep * angles[:, :-1]) / (0.01 * np.sqrt(1.0 - keep**2))
    count = fresh.size
    for numbers in (fresh, angles[:, ::20] / 0.01, angles[:, 0] / 0.01):
        assert abs(np.mean(numbers)) < 3.0 / np.sqrt(numbers.size)
        assert abs(np.mean(numbers**2) - 1.0) < 3.0 * np.sqrt(2.0 / numbers.size)
    for lag in (1, 2, 5):  # white, across env-steps too
        assert abs(np.mean(fresh[:, lag:] * fresh[:, :-lag])) < 3.0 / np.sqrt(count - 24 * lag)


def test_rows_of_a_batch_are_the_environment_alone() -> None:
    """In lanes beside a programme's rows, over several episodes."""
    rows: list[Any] = [WANDER, {"base": "slalom", "duration": 0.3}, WANDER | {"hold": 0.05}] * 8
    together = gym.make_vec("sideslip/YawVision-v0", len(rows), scenario=rows, control_period=7)
    alone = [StabilityEnv(scenario=each, control_period=7) for each in rows]
    drive_alike(together, alone, 90)


def test_a_forecast_knows_the_angles_and_a_device_refuses_them() -> None:
    env = StabilityEnv(scenario=WANDER)
    env.reset(seed=0)
    assert bits(make_forecast(env).driver.ravel()) == bits(wander())
    pytest.importorskip("torch")
    with pytest.raises(ValueError, match="'custom': no wander is driven on a device"):
        make_device_env("sideslip/YawVision-v0", scenario=WANDER)
