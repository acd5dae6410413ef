"""What a policy remembers as an observation, so that whoever learns needs no memory."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ....envs.task.observation import ObservationEntry, make_space
from ....estimators.learned.memory import Array
from ....estimators.learned.network import Network
from .mixing import MIN_VARIANCE, SAMPLE_STRIDE, compute_whitening

PolicyFunction = Callable[[Any], Any]


class Mixing(NamedTuple):
    """What is remembered, x (k,), without correlation: (x - mean) mixing, which is symmetric."""

    mean: Array
    mixing: Array

    def adapt_to_mixed(self, network: Network) -> Network:
        """A network of mixed x that gives what one of plain x does."""
        first = network.weights[0] @ np.linalg.inv(self.mixing)
        return _replace_first_layer(
            network, first, network.biases[0] + network.weights[0] @ self.mean
        )

    def adapt_to_plain(self, network: Network) -> Network:
        """A network of plain x that gives what one of mixed x does."""
        first = network.weights[0] @ self.mixing
        return _replace_first_layer(network, first, network.biases[0] - first @ self.mean)


def _replace_first_layer(network: Network, weights: Array, biases: Array) -> Network:
    rest = network.weights[1:], network.biases[1:]
    return replace(network, weights=[weights, *rest[0]], biases=[biases, *rest[1]])


class MemoryObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """A vector env whose observations (N, k) are what a network's dense layers read.

    env: resets a row in the step that ends it; its observation is the network's. What the network
    remembers of a row begins anew with its episode. mixing: of the observations, None for none.
    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], network: Network, mixing: Mixing | None = None
    ) -> None:
        super().__init__(env)
        width = network.dense.inputs
        self.layout = tuple(
            ObservationEntry(f"memory_{i}", "-", -np.inf, np.inf) for i in range(width)
        )
        self.single_observation_space = make_space(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._network, self._state = network, np.zeros((env.num_envs, network.memory))
        self._mixing = mixing and Mixing(mixing.mean, mixing.mixing.astype(np.float32))
        self._last = np.zeros(self.observation_space.shape or (), np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """The inner env's; rows that a `reset_mask` leaves out go on, and are not read twice."""
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_)))
        obs, infos = self.env.reset(seed=seed, options=options)
        new_state, updated = np.zeros_like(self._state[mask]), self._last.copy()
        updated[mask] = self._read(obs[mask], new_state)
        self._state[mask], self._last = new_state, updated
        return updated.copy(), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """The inner env's; `final_obs` of its infos too."""
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        over = terminated | truncated
        if over.any():
            last = np.full(len(over), None)
            final_obs = np.stack(infos["final_obs"][over])
            for i, final in zip(
                np.flatnonzero(over), self._read(final_obs, self._state[over]), strict=True
            ):
                last[i] = final
            infos = infos | {"final_obs": last}
            self._state[over] = 0.0
        self._last = self._read(obs, self._state)
        return self._last.copy(), rewards, terminated, truncated, infos

    def _read(self, obs: Any, state: Any) -> Any:
        """(N, k) float32; state (N, memory) is updated."""
        x = self._network.compute_features(obs.astype(np.float64), state)
        if self._mixing is None:
            return x.astype(np.float32)
        return (x - self._mixing.mean).astype(np.float32) @ self._mixing.mixing


def measure_mixing(
    env: VectorEnv[Any, Any, Any], network: Network, drive: PolicyFunction, seed: int
) -> Mixing:
    """By what a network remembers in its own drives: one episode of each row, from a seed on.

    env: as of `MemoryObservation`. drive: gives actions of what its dense layers read.
    """
    wrapped, collected = MemoryObservation(env, network), []
    obs, _ = wrapped.reset(seed=seed)
    running, step = np.ones(env.num_envs, np.bool_), 0
    while running.any():
        if step % SAMPLE_STRIDE == 0:
            collected.append(obs[running])
        obs, _, terminated, truncated, _ = wrapped.step(drive(obs))
        running, step = running & ~(terminated | truncated), step + 1
    x = np.concatenate(collected).astype(np.float64)
    return Mixing(x.mean(0), compute_whitening(x, MIN_VARIANCE))
