"""A policy's memory as an observation, for algorithms without memory."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ....envs.record import Array
from ....envs.task.observation import ObservationEntry, make_space
from ....estimators.learned.network import Network
from .mixing import MIN_VARIANCE, SAMPLE_STRIDE, compute_whitening

PolicyFunction = Callable[[Any], Any]


class Mixing(NamedTuple):
    """The whitening of memory features x: (x - mean) mixing.

    Attributes:
        mean: Means, shape (k,).
        mixing: Symmetric matrix, shape (k, k).
    """

    mean: Array
    mixing: Array

    def adapt_to_mixed(self, network: Network) -> Network:
        """Adapt a network of plain x to mixed x.

        Args:
            network: Network of plain x.

        Returns:
            Network of mixed x.
        """
        first = network.weights[0] @ np.linalg.inv(self.mixing)
        return _replace_first_layer(
            network, first, network.biases[0] + network.weights[0] @ self.mean
        )

    def adapt_to_plain(self, network: Network) -> Network:
        """Adapt a network of mixed x to plain x.

        Args:
            network: Network of mixed x.

        Returns:
            Network of plain x.
        """
        first = network.weights[0] @ self.mixing
        return _replace_first_layer(network, first, network.biases[0] - first @ self.mean)


def _replace_first_layer(network: Network, weights: Array, biases: Array) -> Network:
    rest = network.weights[1:], network.biases[1:]
    return replace(network, weights=[weights, *rest[0]], biases=[biases, *rest[1]])


class MemoryObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """A vector env whose observations (N, k) are the inputs of a network's dense layers.

    A row's memory starts anew with its episode.

    Args:
        env: Vector env that resets a row in the step that ends it, with the network's observation.
        network: Network with memory.
        mixing: Whitening of the observations, None for none.
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
        """Reset the rows; those that a `reset_mask` leaves out keep their memory and observation.

        Args:
            seed: Seeds of the inner env.
            options: Options of the inner env.

        Returns:
            Observations of all rows, and infos.
        """
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_)))
        obs, infos = self.env.reset(seed=seed, options=options)
        new_state, updated = np.zeros_like(self._state[mask]), self._last.copy()
        updated[mask] = self._read(obs[mask], new_state)
        self._state[mask], self._last = new_state, updated
        return updated.copy(), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the inner env and compute the observations, `final_obs` of the infos too.

        Args:
            actions: Actions, shape (N, width).

        Returns:
            Observations, rewards, terminated, truncated and infos.
        """
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
        """Compute observations (N, k), float32; the state (N, memory) is updated."""
        x = self._network.compute_features(obs.astype(np.float64), state)
        if self._mixing is None:
            return x.astype(np.float32)
        return (x - self._mixing.mean).astype(np.float32) @ self._mixing.mixing


def measure_mixing(
    env: VectorEnv[Any, Any, Any], network: Network, drive: PolicyFunction, seed: int
) -> Mixing:
    """Measure the whitening in a network's own drives, one episode of each row.

    Args:
        env: Vector env, as for `MemoryObservation`.
        network: Network with memory.
        drive: Function from the inputs of its dense layers to actions.
        seed: Seed of the first row.

    Returns:
        Mean and whitening of the dense layers' inputs.
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
