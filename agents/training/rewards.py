"""What a policy is paid: its cost rate, so weighed that what counts alike in a score does so here.

The score compares logarithms of costs, and their slope is that of the cost over the cost. So the
scenarios of a mixture weigh by what the uncontrolled car pays there, and where a training goes on
from a policy each drive weighs by what that policy pays in the very same drive.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.backend.extras import require_extra
from ..rollout import COST_FLOOR, evaluate_episodes
from ..vec_env.env import Observations, make_native_env
from .task import TrainingTask

with require_extra("train", "training needs {}"):
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

Array = npt.NDArray[np.float64]

_WEIGHT_DRIVES = 32  # uncontrolled drives by which a scenario is weighed
_MIN_COST_SHARE = 0.05  # of the mean: a scenario that costs less uncontrolled weighs no more


def compute_equal_weights(costs: Array) -> Array:
    """Weights with which scenarios' costs (k,) are the same: dear ones would outweigh others."""
    return np.asarray(costs.mean() / np.maximum(costs, _MIN_COST_SHARE * costs.mean()))


def compute_scenario_weights(task: TrainingTask, first: int) -> Array:
    """Of each scenario's costs, (k,), by what the uncontrolled car pays there in a control period;
    one of a task without a mixture. first: of the seeds of those drives."""
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
    """What each car's costs are multiplied by: `now` (N,) float32, another one from drive to drive.

    drive_scales: of each car's first, second, ... drive; the last one serves for all after it.
    """

    def __init__(self, drive_scales: Sequence[Sequence[float]]) -> None:
        self._drive_scales, self._drive = drive_scales, np.zeros(len(drive_scales), np.intp)
        self.now = np.zeros(len(drive_scales), np.float32)
        self.begin()

    def begin(self) -> None:
        """Every car is in its first drive."""
        self._drive[:] = 0
        self._update_scale(range(len(self._drive)))

    def start_next_drives(self, rows: npt.NDArray[np.bool_]) -> None:
        """These cars, (N,), begin their next drive."""
        if rows.any():
            chosen = np.flatnonzero(rows).tolist()
            self._drive[chosen] += 1
            self._update_scale(chosen)

    def _update_scale(self, rows: Sequence[int]) -> None:
        for i in rows:
            scales = self._drive_scales[i]
            self.now[i] = scales[min(self._drive[i], len(scales) - 1)]


def measure_reward_scale(agent: Any, env: VecEnv, seed: int, steps: int) -> list[list[float]]:
    """`RewardScale` with which an agent is paid -1 in the mean of each drive.

    env: resets itself; what its cars meet does not depend on who drives. seed: of row 0. steps: of
    each row; what a row drives later has the median of its drives.
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
    """Rewards times `RewardScale`: of the order of one, whatever the control period.

    It stands outside of the monitor, which counts costs.
    """

    def __init__(self, venv: VecEnv, reward_scale: RewardScale) -> None:
        super().__init__(venv)
        self.reward_scale = reward_scale

    def reset(self) -> Observations:
        """The inner env's."""
        self.reward_scale.begin()
        return np.asarray(self.venv.reset())

    def step_wait(self) -> Any:
        """The inner env's, with other rewards."""
        obs, rewards, dones, infos = self.venv.step_wait()
        scaled = rewards * self.reward_scale.now
        self.reward_scale.start_next_drives(dones)
        return obs, scaled, dones, infos
