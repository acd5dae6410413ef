"""The time of a contestant's decision: its estimator's step and its controller's `predict`."""

import time
from collections.abc import Callable
from itertools import islice
from typing import Any

import gymnasium as gym
import numpy as np

from ...agents.rollout import steps_of
from .build import make_contest
from .cells import Cell

STEPS = 200


class _Timed:
    """A function that notes how long each of its calls takes, in s of wall time."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.seconds = function, list[float]()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        begun = time.perf_counter()
        result = self.function(*args, **kwargs)
        self.seconds.append(time.perf_counter() - begun)
        return result


def decision_time(cell: Cell) -> float:
    """us (wall) a decision of one car: predict, and what the estimator adds to an env-step.

    Medians over STEPS steps of an episode, the bare env stepped side by side.
    """
    contest: tuple[Any, Any] = make_contest(cell, 1)
    env, agent = contest
    bare: Any = gym.make_vec(cell.env_id, num_envs=1, **cell.env_options)
    bare.reset(seed=0)
    agent.predict, env.step, without = _Timed(agent.predict), _Timed(env.step), _Timed(bare.step)
    for step in islice(steps_of(env, agent, 0), 1, STEPS + 1):
        without(np.zeros_like(step.action))
    predict, whole, plain = (np.median(f.seconds) for f in (agent.predict, env.step, without))
    return 1e6 * float(predict + max(whole - plain, 0.0))
