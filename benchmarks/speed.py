"""Question: what does a step cost? Ours beside other environments' and filters', in one run."""

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from ..estimators import EstimateObservation
from . import speed_filters, timing
from .rows import Row, Suite, Table

ENV_ID = "sideslip/YawVision-v0"
FILTERS = ("multirate-kf", "exact-kf")


def _stepper(env: gym.Env[Any, Any], n: int) -> timing.Contestant:
    """A contestant that takes n steps, with resets."""
    env.reset(seed=0)
    action: Any = 1
    if isinstance(env.action_space, gym.spaces.Box):
        action = np.zeros(env.action_space.shape, env.action_space.dtype)

    def steps() -> None:
        for _ in range(n):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return lambda: timing.microseconds(steps, n)


def _contestants() -> dict[str, Callable[[], float]]:
    steppers = {ENV_ID: _stepper(gym.make(ENV_ID), 4000)}
    for name in FILTERS:
        env = EstimateObservation(gym.make(ENV_ID), name)
        steppers[f"{ENV_ID} with {name}"] = _stepper(env, 4000)
    steppers["CartPole-v1"] = _stepper(gym.make("CartPole-v1"), 4000)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lane: gym.Env[Any, Any] = gym.make("highway_env:lane-keeping-v0")
        steppers["lane-keeping-v0 (highway-env)"] = _stepper(lane, 200)
    except ModuleNotFoundError:  # shown where it is installed
        pass
    return steppers


def run(console: Console | None = None) -> Suite:
    """CPU microseconds per env-step and per filter-tick: the median of rounds, and their range."""
    suite = Suite(
        "speed",
        "What a step costs",
        "CPU time, one thread, median and range of interleaved rounds. An env.step is 10 ms of "
        "driving: ten ticks of plant and sensors. A filter's tick is one sample of the gyro, and "
        "every 33rd a sample of the camera.",
    )
    _env_steps(suite)
    speed_filters.add(suite)
    return suite


def _env_steps(suite: Suite) -> None:
    rounds = timing.interleaved(_contestants())
    ours = timing.spread(rounds[ENV_ID])[0]
    cells = []
    for name, values in rounds.items():
        middle, low, high = timing.spread(values)
        suite.rows.append(
            Row(suite.name, name, "us_per_step", middle, low=low, high=high, n=len(values))
        )
        cells.append([name, f"{middle:.2f}", f"{low:.2f} .. {high:.2f}", f"{middle / ours:.2f}"])
    suite.tables.append(
        Table(
            "Cost of an env-step",
            ("environment", "us per step", "range", "over ours"),
            cells,
            "The filters' own cost is the difference to the first line.",
        )
    )
