"""The reward of a policy: its cost rate, weighted so that drives count as they do in a score.

The score compares logarithms of costs, whose derivative is that of the cost over the cost. So the
scenarios of a mixture are weighted by the uncontrolled car's cost. Where a training starts from a
policy, each drive is weighted by that policy's cost in the same drive.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.backend.extras import require_extra
from ...envs.record import Array
from ..rollout import COST_FLOOR, evaluate_episodes
from ..vec_env.env import Observations, make_native_env
from .task import TrainingTask

with require_extra("train", "training needs {}"):
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper


_WEIGHT_DRIVES = 32  # uncontrolled drives by which a scenario is weighed
_MIN_COST_SHARE = 0.05  # of the mean: a scenario that costs less uncontrolled weighs no more


def compute_equal_weights(costs: Array) -> Array:
    """Compute weights that make scenarios' costs equal, so that costly ones do not outweigh others.

    Args:
        costs: Mean costs of the scenarios, shape (k,).

    Returns:
        Weights, shape (k,).
    """
    return np.asarray(costs.mean() / np.maximum(costs, _MIN_COST_SHARE * costs.mean()))


def compute_scenario_weights(task: TrainingTask, first: int) -> Array:
    """Compute each scenario's weight by the uncontrolled cost of a control period, shape (k,).

    It is 1 for a task without a mixture.

    Args:
        task: Task of the training.
        first: First seed of the uncontrolled drives.

    Returns:
        Weights in the order of the scenarios.
    """
    k = len(task.scenarios)
    if not k:
        return np.ones(1)
    rows = _WEIGHT_DRIVES * k
    env = make_native_env(task.env_id, rows, None, task.options(rows))
    costs, steps = evaluate_episodes(env, None, range(first, first + rows))
    return compute_equal_weights(
        np.array([costs[i::k].sum() / steps[i::k].sum() for i in range(k)])
    )


class RewardScale:
    """The factors of the cars' rewards, which change from drive to drive.

    Args:
        drive_scales: Factors of each car's first, second, ... drive; the last one serves for all
            further drives.

    Attributes:
        now: Present factors, float32, shape (N,).
    """

    def __init__(self, drive_scales: Sequence[Sequence[float]]) -> None:
        self._drive_scales, self._drive = drive_scales, np.zeros(len(drive_scales), np.intp)
        self.now = np.zeros(len(drive_scales), np.float32)
        self.begin()

    def begin(self) -> None:
        """Start every car's first drive."""
        self._drive[:] = 0
        self._update_scale(range(len(self._drive)))

    def start_next_drives(self, rows: npt.NDArray[np.bool_]) -> None:
        """Start the next drive of some cars.

        Args:
            rows: Whether a car starts its next drive, shape (N,).
        """
        if rows.any():
            chosen = np.flatnonzero(rows).tolist()
            self._drive[chosen] += 1
            self._update_scale(chosen)

    def _update_scale(self, rows: Sequence[int]) -> None:
        for i in rows:
            scales = self._drive_scales[i]
            self.now[i] = scales[min(self._drive[i], len(scales) - 1)]


def measure_reward_scale(agent: Any, env: VecEnv, seed: int, steps: int) -> list[list[float]]:
    """Measure the factors with which an agent's mean reward is -1 in each drive.

    Args:
        agent: Agent, as for `iterate_steps`.
        env: Env that resets itself, whose scenarios do not depend on the agent.
        seed: Seed of row 0.
        steps: Steps of each row; further drives have the median of the row's factors.

    Returns:
        Factors of each row's drives, the last for all further ones.
    """
    scales: list[list[float]] = [[] for _ in range(env.num_envs)]
    costs, lengths = np.zeros(env.num_envs), np.zeros(env.num_envs)
    env.seed(seed)
    obs, state, start = env.reset(), None, np.ones(env.num_envs, np.bool_)
    for _ in range(steps):
        actions, state = agent.predict(obs, state, start, deterministic=True)
        obs, rewards, start, _ = env.step(actions)
        costs -= rewards
        lengths += 1.0
        for i in np.flatnonzero(start).tolist():
            scales[i].append(float(lengths[i] / (costs[i] + COST_FLOOR)))
            costs[i] = lengths[i] = 0.0
    open_scales = lengths / (costs + COST_FLOOR)
    return [
        [*row_scales, float(np.median(row_scales or [open_scales[i]]))]
        for i, row_scales in enumerate(scales)
    ]


class RewardScaleWrapper(VecEnvWrapper):
    """Rewards times `RewardScale`: of the order of one for every control period.

    It stands outside of the monitor, which counts costs.

    Args:
        venv: Env of stable-baselines3.
        reward_scale: Factors of the rewards.
    """

    def __init__(self, venv: VecEnv, reward_scale: RewardScale) -> None:
        super().__init__(venv)
        self.reward_scale = reward_scale

    def reset(self) -> Observations:
        """Reset the inner env and the factors."""
        self.reward_scale.begin()
        return np.asarray(self.venv.reset())

    def step_wait(self) -> Any:
        """Step the inner env and scale its rewards."""
        obs, rewards, dones, infos = self.venv.step_wait()
        scaled = rewards * self.reward_scale.now
        self.reward_scale.start_next_drives(dones)
        return obs, scaled, dones, infos
