"""Standardised observations as the input of a network, instead of SI units.

Scales and mixing are measured once, before the training, and are part of the network, which reads
plain observations. Differences that vary little while their parts vary much, such as course less
heading, matter to a policy; mixing scales them up, as algorithms need that follow the gradient.
"""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from ...envs.numerics import require_extra
from ...envs.record import Array
from ..env_info import get_layout
from .networks import compute_whitening

with require_extra("train", "training needs {}"):
    import torch
    from stable_baselines3.common.torch_layers import FlattenExtractor

StandardisedArguments = tuple[list[float], list[float], float | None, list[list[float]] | None]
"""Mean, scale, clip and mixing of `Standardised`, in JSON types."""

CLIP = 10.0  # limit of a standardised entry (standard deviations)
_WARM_UP, _DURATION = 0.2, 4.0  # s: until every sensor has spoken, and of the whole drive
_CORRELATION_TIME = 0.2  # s, in which random actions fade to 1/e
_MIN_VARIANCE = 1e-3  # least variance of a mixture of standardised entries
_CONSTANT = 1e-9  # standard deviation, in an entry's unit, up to which it is not read


class Standardised(FlattenExtractor):
    """A network's first layer, which is not trained: clip((x - mean) scale, +-clip) mixing.

    Args:
        observation_space: Space of the observation, of k entries.
        mean: Mean of each entry.
        scale: Factor of each entry; one of scale 0 is not read.
        clip: Limit in standard deviations, None for none.
        mixing: Mixing, shape (k, k), None for none.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        mean: list[float],
        scale: list[float],
        clip: float | None = CLIP,
        mixing: list[list[float]] | None = None,
    ) -> None:
        super().__init__(observation_space)
        self.mean: torch.Tensor
        self.scale: torch.Tensor
        self.clip: torch.Tensor
        self.mixing: torch.Tensor
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
        """Standardise observations.

        Args:
            observations: Observations, shape (N, k).

        Returns:
            Standardised and mixed observations, shape (N, k).
        """
        z = torch.clamp((observations - self.mean) * self.scale, -self.clip, self.clip)
        return z @ self.mixing


def measure_scaling(
    env: VectorEnv[Any, Any, Any],
    spread: float,
    seed: int,
    reads: Sequence[str] = (),
    mixed: bool = False,
) -> StandardisedArguments:
    """Measure the scaling of each entry under random actions.

    Args:
        env: Vector env.
        spread: Standard deviation of the actions.
        seed: Seed of actions and episodes.
        reads: Entries that the network reads; empty: all.
        mixed: Whether to whiten the entries under actions that are held for a while.

    Returns:
        Mean, factor (0: not read), clip and mixing (None: none).

    Raises:
        ValueError: The observation lacks an entry of `reads`, or none of them varies.
    """
    names = [entry.name for entry in get_layout(env)]  # rows may believe in other nominal cars
    base: Any = env.unwrapped
    period = base.control_period * base.dt
    unknown = [name for name in reads if name not in names]
    if unknown:
        lacking, available = ", ".join(unknown), ", ".join(names)
        raise ValueError(f"the observation has no {lacking} to read; it has {available}")
    samples = _collect_observations(env, spread, seed, period, 0.0)
    deviation = samples.std(axis=0)
    varies = deviation > _CONSTANT
    if reads:
        varies &= np.isin(names, reads)
    if not varies.any():
        raise ValueError(f"nothing of what the network reads varies within {_DURATION:g} s")
    scale = np.where(varies, 1.0 / np.where(varies, deviation, 1.0), 0.0)
    mean, mixing = samples.mean(axis=0), None
    if mixed:
        decay = math.exp(-period / _CORRELATION_TIME)
        held_samples = _collect_observations(env, spread, seed, period, decay)
        standard = np.clip((held_samples - mean) * scale, -CLIP, CLIP)
        mixing = compute_whitening(standard, _MIN_VARIANCE).tolist()
    return mean.tolist(), scale.tolist(), CLIP, mixing


def _collect_observations(
    env: VectorEnv[Any, Any, Any], spread: float, seed: int, period: float, decay: float
) -> Array:
    """Collect observations (n, k) under noise that decays by `decay` in each step."""
    rng, observations = np.random.default_rng(seed), []
    noise = np.zeros(env.action_space.shape or ())
    env.reset(seed=seed)
    for step in range(round(_DURATION / period)):
        noise = decay * noise + (1.0 - decay**2) ** 0.5 * rng.standard_normal(noise.shape)
        obs, *_ = env.step((spread * noise).astype(np.float32))
        if step >= round(_WARM_UP / period):
            observations.append(obs)
    return np.concatenate(observations).astype(np.float64)
