"""How long a contestant takes to decide: its estimator's step and its controller's `predict`."""

import time
from typing import Any

import gymnasium as gym
import numpy as np

from .build import make_contest
from .cells import Cell

STEPS = 200


def decision_time(cell: Cell) -> float:
    """us (wall) a decision of one car: predict, and what the estimator adds to an env-step.

    Median of STEPS steps, the bare env stepped side by side.
    """
    env, agent = make_contest(cell, 1)
    bare: Any = gym.make_vec(cell.env_id, num_envs=1, scenario=cell.scenario, **cell.options)
    obs, _ = env.reset(seed=0)
    bare.reset(seed=0)
    state, start = None, np.ones(1, bool)
    spent = np.empty((STEPS, 3))
    for k in range(STEPS):
        t_0 = time.perf_counter()
        actions, state = agent.predict(obs, state, start, deterministic=True)
        t_1 = time.perf_counter()
        obs, *_ = env.step(actions)
        t_2 = time.perf_counter()
        bare.step(np.zeros_like(actions))
        spent[k] = t_1 - t_0, t_2 - t_1, time.perf_counter() - t_2
        start = np.zeros(1, bool)
    predict, with_estimator, without = np.median(spent, axis=0)
    return 1e6 * float(predict + max(with_estimator - without, 0.0))
