"""What a policy remembers as an observation, so that whoever learns needs no memory."""

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ....envs.task.observation import Entry, space_of
from ....estimators.learned.network import Network


class Remembered(VectorWrapper[Any, Any, Any, Any, Any]):
    """A vector env whose observations (N, k) are what a network's dense layers read.

    env: resets a row in the step that ends it; its observation is the network's. What the network
    remembers of a row begins anew with its episode.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], network: Network) -> None:
        super().__init__(env)
        width = network.dense.inputs
        self.layout = tuple(Entry(f"memory_{i}", "-", -np.inf, np.inf) for i in range(width))
        self.single_observation_space = space_of(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._network, self._state = network, np.zeros((env.num_envs, network.memory))

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """The inner env's."""
        obs, infos = self.env.reset(**arguments)
        self._state[:] = 0.0
        return self._read(obs, self._state), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """The inner env's; `final_obs` of its infos too."""
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        over = terminated | truncated
        if over.any():
            last = np.full(len(over), None)
            seen = np.stack(infos["final_obs"][over])
            for i, each in zip(
                np.flatnonzero(over), self._read(seen, self._state[over]), strict=True
            ):
                last[i] = each
            infos = infos | {"final_obs": last}
            self._state[over] = 0.0
        return self._read(obs, self._state), rewards, terminated, truncated, infos

    def _read(self, obs: Any, state: Any) -> Any:
        """(N, k) float32; state (N, memory) is updated."""
        return self._network.remembered(obs.astype(np.float64), state).astype(np.float32)
