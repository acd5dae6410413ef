"""What a policy is paid: its cost rate, so weighed that what counts alike in a score does so here.

The score compares logarithms of costs, and their slope is that of the cost over the cost. So the
scenarios of a mixture weigh by what the uncontrolled car pays there, and where a training goes on
from a policy each drive weighs by what that policy pays in the very same drive.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.backend.extras import extra
from ..rollout import FLOOR, drives_of
from ..vec_env.env import Observations, make_native_env
from .task import Task

with extra("train", "training needs {}"):
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

Array = npt.NDArray[np.float64]

_ALONE = 32  # uncontrolled drives by which a scenario is weighed
_LEAST = 0.05  # of the mean: a scenario that costs less uncontrolled weighs no more


def alike(costs: Array) -> Array:
    """Weights with which scenarios' costs (k,) are the same: dear ones would outweigh others."""
    return np.asarray(costs.mean() / np.maximum(costs, _LEAST * costs.mean()))


def weights_of(task: Task, first: int) -> Array:
    """Of each scenario's costs, (k,), by what the uncontrolled car pays there in a control period;
    one of a task without a mixture. first: of the seeds of those drives."""
    k = len(task.scenarios)
    if not k:
        return np.ones(1)
    rows = _ALONE * k
    env = make_native_env(task.env_id, rows, None, task.options(rows))
    costs, steps = drives_of(env, None, range(first, first + rows))
    return alike(np.array([costs[i::k].sum() / steps[i::k].sum() for i in range(k)]))


class Rates:
    """What each car's costs are multiplied by: `now` (N,) float32, another one from drive to drive.

    of_drives: of each car's first, second, ... drive; the last one serves for all after it.
    """

    def __init__(self, of_drives: Sequence[Sequence[float]]) -> None:
        self._of_drives, self._drive = of_drives, np.zeros(len(of_drives), np.intp)
        self.now = np.zeros(len(of_drives), np.float32)
        self.begin()

    def begin(self) -> None:
        """Every car is in its first drive."""
        self._drive[:] = 0
        self._show(range(len(self._drive)))

    def ended(self, rows: npt.NDArray[np.bool_]) -> None:
        """These cars, (N,), begin their next drive."""
        if rows.any():
            chosen = np.flatnonzero(rows).tolist()
            self._drive[chosen] += 1
            self._show(chosen)

    def _show(self, rows: Sequence[int]) -> None:
        for i in rows:
            known = self._of_drives[i]
            self.now[i] = known[min(self._drive[i], len(known) - 1)]


def paid_by(agent: Any, env: VecEnv, seed: int, steps: int) -> list[list[float]]:
    """`Rates` with which an agent is paid -1 in the mean of each drive.

    env: resets itself; what its cars meet does not depend on who drives. seed: of row 0. steps: of
    each row; what a row drives later has the median of its drives.
    """
    found: list[list[float]] = [[] for _ in range(env.num_envs)]
    costs, lengths = np.zeros(env.num_envs), np.zeros(env.num_envs)
    env.seed(seed)
    obs, state, start = env.reset(), None, np.ones(env.num_envs, np.bool_)
    for _ in range(steps):
        actions, state = agent.predict(obs, state, start, deterministic=True)
        obs, rewards, start, _ = env.step(actions)
        costs -= rewards
        lengths += 1.0
        for i in np.flatnonzero(start).tolist():
            found[i].append(float(lengths[i] / (costs[i] + FLOOR)))
            costs[i] = lengths[i] = 0.0
    unended = lengths / (costs + FLOOR)
    return [[*each, float(np.median(each or [unended[i]]))] for i, each in enumerate(found)]


class Rated(VecEnvWrapper):
    """Rewards times `Rates`: of the order of one, whatever the control period.

    It stands outside of the monitor, which counts costs.
    """

    def __init__(self, venv: VecEnv, rates: Rates) -> None:
        super().__init__(venv)
        self.rates = rates

    def reset(self) -> Observations:
        """The inner env's."""
        self.rates.begin()
        return np.asarray(self.venv.reset())

    def step_wait(self) -> Any:
        """The inner env's, with other rewards."""
        obs, rewards, dones, infos = self.venv.step_wait()
        paid = rewards * self.rates.now
        self.rates.ended(dones)
        return obs, paid, dones, infos
