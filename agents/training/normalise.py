"""What a network reads instead of SI units: standardised observations, rewards per second.

The scales are measured once, before the training, and stay: they are part of the network, which
reads plain observations.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv

import torch  # isort: skip
from stable_baselines3.common.torch_layers import FlattenExtractor  # isort: skip
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper  # isort: skip

from ..vec_env.env import Observations  # first: it says which extra is missing

Array = npt.NDArray[np.float64]

CLIP = 10.0  # standard deviations
_WARM_UP = 20  # steps until every sensor has spoken
_STEPS = 400
_CONSTANT = 1e-9  # what varies less is not read


class Standardised(FlattenExtractor):
    """A network's first layer, which is not trained: clip((x - mean) scale, +-CLIP).

    mean, scale: one number an entry of the observation; an entry of scale 0 is not read.
    """

    def __init__(
        self, observation_space: gym.Space[Any], mean: list[float], scale: list[float]
    ) -> None:
        super().__init__(observation_space)
        self.mean: torch.Tensor
        self.scale: torch.Tensor
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32))
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float32))

    @property
    def numbers(self) -> tuple[Array, Array, float]:
        """(mean, scale, clip) as they are used."""
        mean, scale = (each.cpu().numpy().astype(np.float64) for each in (self.mean, self.scale))
        return mean, scale, CLIP

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """(N, k) of observations (N, k)."""
        return torch.clamp((observations - self.mean) * self.scale, -CLIP, CLIP)


def measured(env: VectorEnv[Any, Any, Any], spread: float, seed: int) -> tuple[Array, Array]:
    """(mean, scale) of each entry, under random actions of this standard deviation."""
    rng = np.random.default_rng(seed)
    shape = env.action_space.shape or ()
    env.reset(seed=seed)
    seen = []
    for step in range(_STEPS):
        actions = spread * rng.standard_normal(shape)
        obs, *_ = env.step(actions.astype(np.float32))
        if step >= _WARM_UP:
            seen.append(obs)
    samples = np.concatenate(seen).astype(np.float64)
    deviation = samples.std(axis=0)
    varies = deviation > _CONSTANT
    return samples.mean(axis=0), np.where(varies, 1.0 / np.where(varies, deviation, 1.0), 0.0)


class PerSecond(VecEnvWrapper):
    """Rewards as minus the cost rate: of the order of one, whatever the control period.

    seconds: of a control period. It stands outside of the monitor, which counts costs.
    """

    def __init__(self, venv: VecEnv, seconds: float) -> None:
        super().__init__(venv)
        self._rate = np.float32(1.0 / seconds)

    def reset(self) -> Observations:
        """The inner env's."""
        return np.asarray(self.venv.reset())

    def step_wait(self) -> Any:
        """The inner env's, with the rewards divided by the time they are for."""
        obs, rewards, dones, infos = self.venv.step_wait()
        return obs, rewards * self._rate, dones, infos
