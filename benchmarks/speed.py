"""Question: what does a step cost? Ours beside other environments', in one run."""

import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from ..estimators import EstimateObservation
from .rows import Row, Suite, Table

ROUNDS = 7
ENV_ID = "sideslip/YawVision-v0"
FILTERS = ("multirate-kf", "exact-kf")


def _stepper(env: gym.Env[Any, Any]) -> Callable[[int], float]:
    """A function that takes n steps (with resets) and returns CPU seconds per step."""
    env.reset(seed=0)
    action: Any = 1
    if isinstance(env.action_space, gym.spaces.Box):
        action = np.zeros(env.action_space.shape, env.action_space.dtype)

    def run(n: int) -> float:
        start = time.process_time()
        for _ in range(n):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return (time.process_time() - start) / n

    return run


def _contestants() -> dict[str, tuple[Callable[[int], float], int]]:
    ours: gym.Env[Any, Any] = gym.make(ENV_ID)
    steppers = {ENV_ID: (_stepper(ours), 4000)}
    for name in FILTERS:
        env = EstimateObservation(gym.make(ENV_ID), name)
        steppers[f"{ENV_ID} with {name}"] = (_stepper(env), 4000)
    steppers["CartPole-v1"] = (_stepper(gym.make("CartPole-v1")), 4000)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lane: gym.Env[Any, Any] = gym.make("highway_env:lane-keeping-v0")
        steppers["lane-keeping-v0 (highway-env)"] = (_stepper(lane), 200)
    except ModuleNotFoundError:  # shown where it is installed
        pass
    return steppers


def run(console: Console | None = None) -> Suite:
    """CPU microseconds per env-step: the median of interleaved rounds, and their range."""
    steppers = _contestants()
    rounds: dict[str, list[float]] = {name: [] for name in steppers}
    for stepper, n in steppers.values():
        stepper(n // 4)
    for _ in range(ROUNDS):
        for name, (stepper, n) in steppers.items():
            rounds[name].append(1e6 * stepper(n))
    ours = statistics.median(rounds[ENV_ID])
    suite = Suite(
        "speed",
        "What a step costs",
        "CPU time of one env.step (10 ms of driving: ten ticks of plant and sensors), one thread, "
        f"median and range of {ROUNDS} interleaved rounds.",
    )
    cells = []
    for name, values in rounds.items():
        middle = statistics.median(values)
        suite.rows.append(
            Row(
                suite.name,
                name,
                "us_per_step",
                middle,
                low=min(values),
                high=max(values),
                n=ROUNDS,
            )
        )
        cells.append(
            [
                name,
                f"{middle:.2f}",
                f"{min(values):.2f} .. {max(values):.2f}",
                f"{middle / ours:.2f}",
            ]
        )
    suite.tables.append(
        Table(
            "Cost of an env-step",
            ("environment", "us per step", "range", "over ours"),
            cells,
            "The filters' own cost is the difference to the first line.",
        )
    )
    return suite
