"""Standardised observations as the input of a network, instead of SI units, and scaled rewards.

Scales and mixing are measured once, before the training, and are part of the network, which reads
plain observations. Some differences, such as course less heading, vary little while their parts
vary much, and matter to a policy. Mixing scales them up, as gradient methods need.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.numerics import require_extra
from ...envs.record import Array
from ..env_info import CarVectorEnv, get_layout
from ..rollout import COST_FLOOR
from ..vec_env import Observations
from .student import compute_whitening

with require_extra("train", "training needs {}"):
    import torch
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

if TYPE_CHECKING:
    from .. import Agent

StandardisedArguments = tuple[list[float], list[float], float | None, list[list[float]] | None]
"""Mean, scale, clip and mixing of `Standardised`, in JSON types."""

CLIP = 10.0  # limit of a standardised entry (standard deviations)
_WARM_UP, _DURATION = 0.2, 4.0  # s: until every sensor has spoken, and of the whole drive
_CORRELATION_TIME = 0.2  # s, in which random actions fade to 1/e
_MIN_VARIANCE = 1e-3  # least variance of a mixture of standardised entries
_PRIOR = 1e-4  # samples that a VecNormalize starts with, of mean 0 and variance 1
_CONSTANT = 1e-9  # standard deviation, in an entry's unit, up to which it is not read


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
        self,
        observation_space: gym.Space[Observations],
        mean: list[float],
        scale: list[float],
        clip: float | None = CLIP,
        mixing: list[list[float]] | None = None,
    ) -> None:
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
        """Standardise observations.

        Args:
            observations: Observations, shape (N, k).

        Returns:
            Standardised and mixed observations, shape (N, k).
        """
        z = torch.clamp((observations - self.mean) * self.scale, -self.clip, self.clip)
        return z @ self.mixing


def read_normalisation(
    normaliser: VecNormalize | None, n_inputs: int, history: int
) -> tuple[Array, Array, float | None]:
    """Read mean, scale and clip of a VecNormalize, around the stack of frames or inside of it.

    Args:
        normaliser: VecNormalize or None.
        n_inputs: Entries that the network reads, of all frames together.
        history: Number of frames.

    Returns:
        Mean, factor (0: not read) and clip (None: none), by entry of all frames or of one.

    Raises:
        ValueError: The normaliser is of observations of another size.
    """
    if normaliser is None or not normaliser.norm_obs:
        return np.zeros(n_inputs), np.ones(n_inputs), None
    stats: Any = normaliser.obs_rms
    if getattr(stats, "mean", np.zeros(0)).shape not in ((n_inputs,), (n_inputs // history,)):
        raise ValueError(f"the normaliser is of another observation than the network's {n_inputs}")
    prior = _PRIOR * (1.0 + stats.mean**2) / stats.count  # what it leaves of a constant's variance
    scale = 1.0 / np.sqrt(stats.var + normaliser.epsilon)
    return stats.mean, np.where(stats.var > 2.0 * prior, scale, 0.0), normaliser.clip_obs


def measure_scaling(
    env: CarVectorEnv,
    spread: float,
    seed: int,
    reads: Sequence[str] = (),
    mixed: bool = False,
) -> StandardisedArguments:
    """Measure the scaling of each entry under random actions.

    Args:
        env: Vector env that the random actions drive.
        spread: Standard deviation of the actions.
        seed: Seed of actions and drives.
        reads: Entries that the network reads; empty: all.
        mixed: Whether to whiten the entries under actions that are correlated in time.

    Returns:
        Mean, factor (0: not read), clip and mixing (None: none).

    Raises:
        ValueError: The observation lacks an entry of `reads`, or none of them varies.
    """
    names = [entry.name for entry in get_layout(env)]  # nominal cars may differ
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
        correlated_samples = _collect_observations(env, spread, seed, period, decay)
        standard = np.clip((correlated_samples - mean) * scale, -CLIP, CLIP)
        mixing = compute_whitening(standard, _MIN_VARIANCE).tolist()
    return mean.tolist(), scale.tolist(), CLIP, mixing


def _collect_observations(
    env: CarVectorEnv, spread: float, seed: int, period: float, decay: float
) -> Array:
    """Collect observations (n, k) under AR(1) noise, times `decay` in each step."""
    rng, observations = np.random.default_rng(seed), []
    noise = np.zeros(env.action_space.shape or ())
    env.reset(seed=seed)
    for step in range(round(_DURATION / period)):
        noise = decay * noise + (1.0 - decay**2) ** 0.5 * rng.standard_normal(noise.shape)
        obs, *_ = env.step((spread * noise).astype(np.float32))
        if step >= round(_WARM_UP / period):
            observations.append(obs)
    return np.concatenate(observations).astype(np.float64)


class RewardScale:
    """The factors of the cars' rewards, which change from drive to drive.

    Args:
        drive_scales: Factors of each car's drives in order; the last one serves for all later ones.
    """

    def __init__(self, drive_scales: Sequence[Sequence[float]]) -> None:
        self._drive_scales, self._drive = drive_scales, np.zeros(len(drive_scales), np.intp)
        self.now = np.zeros(len(drive_scales), np.float32)  # present factors
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
        chosen = np.flatnonzero(rows).tolist()
        self._drive[chosen] += 1
        self._update_scale(chosen)

    def _update_scale(self, cars: Sequence[int]) -> None:
        for i in cars:
            scales = self._drive_scales[i]
            self.now[i] = scales[min(self._drive[i], len(scales) - 1)]


def measure_reward_scale(agent: "Agent", env: VecEnv, seed: int, steps: int) -> list[list[float]]:
    """Measure the factors with which an agent's mean reward is -1 in each drive.

    Args:
        agent: Agent whose costs count, as for `iterate_steps`.
        env: Env that resets itself, whose scenarios do not depend on the agent.
        seed: Seed of car 0.
        steps: Steps of each car.

    Returns:
        Factors of each car's drives, then their median for all further drives.
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
    for car_scales, open_scale in zip(scales, open_scales, strict=True):
        car_scales.append(float(np.median(car_scales or [open_scale])))
    return scales


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
