"""A cell's cars: the vector env with its estimator, and the controller that drives them all."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...agents import make_agent
from ...agents.learned.files import is_policy, load_policy
from ...envs.task.observation import Entry
from ...estimators.filters import FILTERS
from ...estimators.vector.estimate import EstimateObservation
from ..harness.drives import quietly
from .cells import INFORMED, TRUTH, Cell

_DISTURBANCES = {"forces": ("F_d", "N_d"), "walk": ("d1", "d2"), "walk-all": ("d1", "d2")}


class TrueState(VectorWrapper[Any, Any, Any, Any, Any]):
    """The true beta and gamma as `beta_hat` and `gamma_hat`: an estimator without error."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        inner: tuple[Entry, ...] = env.layout  # type: ignore[attr-defined]
        self.layout = (
            *inner,
            Entry("beta_hat", "rad", -np.pi, np.pi),
            Entry("gamma_hat", "rad/s", -20.0, 20.0),
        )
        low, high = np.array([entry[2:] for entry in self.layout]).T.astype(np.float32)
        self.single_observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def _joined(self, obs: Any, infos: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        truth = np.stack([infos["beta"], infos["gamma"]], axis=1)
        return np.hstack([obs, np.clip(truth, [-np.pi, -20.0], [np.pi, 20.0])]).astype(np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset the rows and append their truth."""
        obs, infos = self.env.reset(seed=seed, options=options)
        return self._joined(obs, infos), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One step of all rows, with their truth."""
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        return self._joined(obs, infos), rewards, terminated, truncated, infos


def outputs_for(estimator: str) -> tuple[str, ...]:
    """The estimates that controllers read: beta, gamma, and disturbances if there are any."""
    row = FILTERS.get(estimator)  # a user's own has none
    return ("beta", "gamma", *_DISTURBANCES.get(row.disturbances if row else "", ()))


def estimate_options(cell: Cell) -> dict[str, Any]:
    """Options of `EstimateObservation` for a cell; a policy gets the estimate it was trained on."""
    if is_policy(cell.controller):
        card = load_policy(cell.controller).card
        if card.estimator == cell.estimator:
            return card.estimator_options
    return {"outputs": outputs_for(cell.estimator), "std": False}


def make_contest(cell: Cell, cars: int) -> tuple[VectorEnv[Any, Any, Any], Any]:
    """(vector env of `cars` rows with the cell's estimator, its agent)."""
    options = cell.env_options
    if cell.controller == INFORMED:
        from ...agents.rungs import make_rung

        return make_rung("oracle-parameters", cell.env_id, num_envs=cars, **options)
    env: Any = gym.make_vec(cell.env_id, num_envs=cars, **options)
    agent_options: dict[str, Any] = {}
    if cell.controller == "model-following":
        agent_options["rejection"] = cell.estimator == "dakf"
    if cell.estimator == TRUTH:
        env = TrueState(env)
    elif cell.estimator:
        env = quietly(EstimateObservation, env, cell.estimator, **estimate_options(cell))
    return env, make_agent(cell.controller, env, **agent_options)
