"""Standardised observations as the input of a network, instead of SI units, and scaled rewards.

Scales and mixing are measured once, before the training, and are part of the network. Mixing scales
up small differences of entries that vary much, such as course less heading, for gradient methods.

Args:
    observations: Observations, shape (..., k).
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.numerics import require_extra
from ...envs.record import Array
from ..vec_env import Observations

with require_extra("train", "training needs {}"):
    import torch
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

Row = list[float] | Array  # JSON has lists

CLIP = 10.0  # limit of a standardised entry (standard deviations)
_MIN_SPREAD = 1e-9  # standard deviation below which an input counts as constant
_MIN_VARIANCE = 1e-3  # least variance of a mixture of normalised inputs
_PRIOR = 1e-4  # samples that a VecNormalize starts with, of mean 0 and variance 1


class Standardisation(NamedTuple):
    """The standardisation of observations: clip((x - mean) scale, +-clip) mixing."""

    mean: Row  # shape (k,)
    scale: Row  # factors, shape (k,), 0 for an entry that is not read
    clip: float | None  # limit (standard deviations), None for none
    mixing: list[list[float]] | Array | None = None  # shape (k, k), None for none

    def transform(self, observations: Observations) -> Observations:
        """Standardise and mix observations, as `Standardised` does."""
        mean, scale = np.array(self.mean, np.float32), np.array(self.scale, np.float32)
        limit = math.inf if self.clip is None else self.clip
        z: Observations = np.clip((observations - mean) * scale, -limit, limit)
        return z if self.mixing is None else z @ np.array(self.mixing, np.float32)


class Standardised(FlattenExtractor):
    """A network's first layer, which is not trained: clip((x - mean) * scale, +-clip) @ mixing.

    Args:
        observation_space: Space of the observation, of k entries.
        mean: Mean of each entry.
        scale: Factor of each entry; 0: the network does not read the entry.
        clip: Limit in standard deviations, None for none.
        mixing: Mixing, shape (k, k), None for none.
    """

    mean: torch.Tensor
    scale: torch.Tensor
    clip: torch.Tensor
    mixing: torch.Tensor

    def __init__(
        self, observation_space: gym.Space[Observations], mean: Row, scale: Row,
        clip: float | None = CLIP, mixing: list[list[float]] | Array | None = None,
    ) -> None:  # fmt: skip
        super().__init__(observation_space)
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32))
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float32))
        self.register_buffer("clip", torch.tensor(math.inf if clip is None else clip))
        mixed = torch.eye(len(mean)) if mixing is None else torch.tensor(mixing)
        self.register_buffer("mixing", mixed.to(torch.float32))

    @property
    def numbers(self) -> tuple[Array, Array, float | None]:
        """Mean, scale and clip in use."""
        mean, scale = (x.cpu().numpy().astype(np.float64) for x in (self.mean, self.scale))
        return mean, scale, float(self.clip) if self.clip.isfinite() else None

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Standardise and mix observations."""
        z = torch.clamp((observations - self.mean) * self.scale, -self.clip, self.clip)
        return z @ self.mixing


def compute_scale(spread: Array) -> Array:
    """Compute the inverse of each standard deviation, shape (k,), zero where nothing varies.

    Args:
        spread: Standard deviations, shape (k,).
    """
    return np.where(spread > _MIN_SPREAD, 1.0 / np.maximum(spread, _MIN_SPREAD), 0.0)


def compute_whitening(z: npt.NDArray[np.floating], minimum: float = _MIN_VARIANCE) -> Array:
    """Compute the symmetric whitening (k, k) of samples, ZCA (Bell and Sejnowski 1997).

    Args:
        z: Samples, shape (n, k).
        minimum: Value that the covariance's lower eigenvalues count as.
    """
    sizes, axes = np.linalg.eigh(np.cov(z, rowvar=False))
    return np.asarray(axes / np.sqrt(np.maximum(sizes, minimum)) @ axes.T)


def read_normalisation(
    normaliser: VecNormalize | None, n_inputs: int, history: int
) -> tuple[Array, Array, float | None]:
    """Read mean, factor (0: not read) and clip (None: none), by entry of all frames or of one.

    Args:
        normaliser: VecNormalize around the frames or inside, or None; ValueError for another size.
        n_inputs: Entries that the network reads, of all frames together.
        history: Number of frames.
    """
    if normaliser is None or not normaliser.norm_obs:
        return np.zeros(n_inputs), np.ones(n_inputs), None
    stats: Any = normaliser.obs_rms
    if getattr(stats, "mean", np.zeros(0)).shape not in ((n_inputs,), (n_inputs // history,)):
        raise ValueError(f"the normaliser is of another observation than the network's {n_inputs}")
    prior = _PRIOR * (1.0 + stats.mean**2) / stats.count  # what it leaves of a constant's variance
    scale = 1.0 / np.sqrt(stats.var + normaliser.epsilon)
    return stats.mean, np.where(stats.var > 1.01 * prior, scale, 0.0), normaliser.clip_obs


class RewardScale:
    """The factors of the cars' rewards, which change from drive to drive.

    Args:
        drive_scales: Factors of each car's drives in order; the last one serves for all later ones.
    """

    def __init__(self, drive_scales: Sequence[Sequence[float]]) -> None:
        self._drive_scales = drive_scales
        self.begin()

    def begin(self) -> None:
        """Start every car's first drive."""
        self._drive = [0] * len(self._drive_scales)
        self.now = np.array([scales[0] for scales in self._drive_scales], np.float32)  # factors

    def start_next_drives(self, rows: npt.NDArray[np.bool_]) -> None:
        """Start the next drive of some cars.

        Args:
            rows: Whether a car starts its next drive, shape (N,).
        """
        for i in np.flatnonzero(rows).tolist():
            self._drive[i] += 1
            scales = self._drive_scales[i]
            self.now[i] = scales[min(self._drive[i], len(scales) - 1)]


class RewardScaleWrapper(VecEnvWrapper):
    """Rewards times `RewardScale`, outside of the monitor, which counts costs.

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

    def step_wait(self) -> VecEnvStepReturn:
        """Step the inner env and scale its rewards."""
        obs, rewards, dones, infos = self.venv.step_wait()
        scaled = rewards * self.reward_scale.now
        self.reward_scale.start_next_drives(dones)
        return obs, scaled, dones, infos
