"""What an agent costs: one episode a seed, all at once."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv


def costs_of(
    env: VectorEnv[Any, Any, Any], agent: Any, seeds: Sequence[int]
) -> npt.NDArray[np.float64]:
    """The cost J of each seed's first episode, (N,); agent: with stable-baselines3's `predict`."""
    told: Any = list(seeds)
    obs, _ = env.reset(seed=told)
    costs, alive = np.zeros(env.num_envs), np.ones(env.num_envs, np.bool_)
    state, start = None, np.ones(env.num_envs, np.bool_)
    while alive.any():
        actions, state = agent.predict(obs, state, start, deterministic=True)
        obs, rewards, terminated, truncated, _ = env.step(actions)
        costs -= np.where(alive, rewards, 0.0)
        start = np.logical_or(terminated, truncated)
        alive &= ~start
    return costs
