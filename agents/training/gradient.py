"""Policies by the gradient of the cost itself, through cars, actuators and late sensors.

Many cars on tensors are driven for a window of control periods, and the mean cost rate is
propagated back through all of it to the weights: truncated back-propagation through time. It is
the short-horizon actor-critic (Xu et al., ICLR 2022) without its critic.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from .normalise import RewardScale, Standardised

import torch  # isort: skip  # after ours, which say which extra is missing
from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.policies import BasePolicy  # isort: skip
from stable_baselines3.common.torch_layers import create_mlp  # isort: skip
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule  # isort: skip
from torch import Tensor, nn  # isort: skip

_MAX_GRADIENT_NORM = 1.0  # norm of a step's gradient


class TrainingSource(NamedTuple):
    """The cars of a training."""

    cars: Any  # `DeviceVectorEnv` with gradients, which resets itself in the same step
    seeds: list[int]  # seeds of the cars
    reward_scale: RewardScale  # factor of each car's reward


class GruPolicy(BasePolicy):
    """A GRU on standardised observations, and dense layers behind it.

    Args:
        observation_space: Space of the observation.
        action_space: Space of the action.
        lr_schedule: Learning rate by the remaining fraction of the training.
        cells: Hidden units of the GRU.
        net_arch: Sizes of the dense layers.
        **options: Arguments of `BasePolicy`, such as the class before the GRU.
    """

    def __init__(
        self, observation_space: gym.spaces.Box, action_space: gym.spaces.Box,
        lr_schedule: Schedule, cells: int = 64, net_arch: Sequence[int] = (64, 64), **options: Any,
    ) -> None:  # fmt: skip
        options = {"features_extractor_class": Standardised} | options
        super().__init__(observation_space, action_space, **options)
        self.features_extractor = self.make_features_extractor()
        self.cell = nn.GRU(self.features_extractor.features_dim, cells)
        layers = create_mlp(cells, action_space.shape[0], [*net_arch], nn.SiLU)
        self.layers = nn.Sequential(*layers)
        with torch.no_grad():
            list(self.layers.parameters())[-2].mul_(0.1)  # small first actions: others teach little
        # betas as in Xu et al.: a shorter memory than Adam's defaults
        self.optimizer = torch.optim.Adam(self.parameters(), lr_schedule(1.0), betas=(0.7, 0.95))

    def forward(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Compute actions (N, m) and the next state (N, cells).

        Args:
            observations: Observations, shape (N, k).
            state: State, shape (N, cells).
        """
        _, after = self.cell(self.features_extractor(observations)[None], state[None])
        return self.layers(after[0]), after[0]

    def _begin(self, count: int) -> Tensor:
        """Make the state of an episode's start, zeros of shape (count, cells)."""
        return torch.zeros(count, self.cell.hidden_size, device=self.device)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:  # fmt: skip
        """Compute deterministic actions (m,) or (N, m) within [-1, 1], and the next state.

        Args:
            observation: Observation, shape (k,) or (N, k).
            state: State from the last call; None at the start.
            episode_start: Rows whose state is cleared, shape (N,).
            deterministic: Without effect.
        """
        obs_tensor, is_single = self.obs_to_tensor(observation)[0], np.ndim(observation) == 1
        before = self._begin(len(obs_tensor)) if state is None else torch.as_tensor(state[0])
        if state is not None and episode_start is not None:
            is_start = torch.as_tensor(np.asarray(episode_start, np.bool_), device=self.device)
            before = torch.where(is_start[:, None], 0.0, before)
        with torch.no_grad():
            actions, after = self(obs_tensor, before)
        clipped: Any = actions.clamp(-1.0, 1.0).cpu().numpy()
        return clipped[0] if is_single else clipped, (after,)

    def _predict(self, observation: Any, deterministic: bool = False) -> Any:
        return self(observation, self._begin(len(observation)))[0]


class AnalyticPolicyGradient(BaseAlgorithm):
    """The algorithm that follows the cost's gradient, in stable-baselines3's form.

    Args:
        policy: "GruPolicy", or a class.
        env: Env whose spaces count.
        learning_rate: Learning rate of Adam.
        n_steps: Control periods of a window.
        compile: Whether to compile the step, as for `DeviceVectorEnv`.
        source: Function of `device` and `compile` that makes the cars; None to load a zip.
        policy_kwargs: Arguments of the policy.
        _init_setup_model: As in stable-baselines3.
        **options: Arguments of `BaseAlgorithm`, such as the seed of the weights.
    """

    policy_aliases = {"GruPolicy": GruPolicy}  # noqa: RUF012  as in stable-baselines3

    def __init__(
        self, policy: str | type[GruPolicy], env: Any, learning_rate: float | Schedule = 5e-3,
        n_steps: int = 16, compile: bool = True,
        source: Callable[..., TrainingSource] | None = None,
        policy_kwargs: dict[str, Any] | None = None, _init_setup_model: bool = True, **options: Any,
    ) -> None:  # fmt: skip
        if n_steps < 1:
            raise ValueError(f"n_steps is at least 1, got {n_steps}")
        options["support_multi_env"] = True
        super().__init__(policy, env, learning_rate, policy_kwargs, **options)
        self.n_steps, self.compile, self.source = n_steps, compile, source
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        spaces = self.observation_space, self.action_space
        built = self.policy_class(*spaces, self.lr_schedule, **self.policy_kwargs)
        self.policy = built.to(self.device)

    def learn(
        self, total_timesteps: int, callback: MaybeCallback = None, log_interval: int = 1,
        tb_log_name: str = "gradient", reset_num_timesteps: bool = True, progress_bar: bool = False,
    ) -> "AnalyticPolicyGradient":  # fmt: skip
        """Train until a number of steps, window by window; ValueError without a source.

        Raises FloatingPointError, with the step, where the gradient is not finite.

        Args:
            total_timesteps: Steps of all cars.
            callback: Callback of stable-baselines3.
            log_interval: Windows between two logs.
            tb_log_name: Name of the run in TensorBoard.
            reset_num_timesteps: Whether the steps count from 0.
            progress_bar: Whether to show a bar.
        """
        if self.source is None:
            raise ValueError("AnalyticPolicyGradient drives cars on tensors: it needs their source")
        log = reset_num_timesteps, tb_log_name, progress_bar
        total, callback = self._setup_learn(total_timesteps, callback, *log)
        policy: Any = self.policy
        cars, seeds, reward_scale = self.source(device=self.device, compile=self.compile)
        reward_scale.begin()
        obs, _ = cars.reset(seed=seeds)
        state = policy._begin(cars.num_envs)
        callback.on_training_start(locals(), globals())
        is_running, windows = True, 0
        while is_running and self.num_timesteps < total:
            callback.on_rollout_start()
            window = policy, cars, obs, state, reward_scale, self.n_steps
            mean_cost, obs, state = _unroll_window(*window)
            self.num_timesteps += self.n_steps * cars.num_envs
            self._update_current_progress_remaining(self.num_timesteps, total)
            self._update_weights(mean_cost)
            cars.detach()
            obs, state, windows = obs.detach(), state.detach(), windows + 1
            is_running = callback.on_step()
            self.logger.record("train/cost_rate", mean_cost.item())
            if log_interval and windows % log_interval == 0:
                self.logger.dump(self.num_timesteps)
            callback.on_rollout_end()
        callback.on_training_end()
        return self

    def _update_weights(self, mean_cost: Tensor) -> None:
        """Update the weights by one step down the gradient of a window's cost."""
        optimizer = self.policy.optimizer
        self._update_learning_rate(optimizer)
        optimizer.zero_grad()
        torch.autograd.backward(mean_cost)
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), _MAX_GRADIENT_NORM)
        if not norm.isfinite():
            step = self.num_timesteps
            raise FloatingPointError(f"the cost's slope is not finite after step {step}")
        optimizer.step()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "source"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []


def _unroll_window(
    policy: GruPolicy, cars: Any, obs: Tensor, state: Tensor,
    reward_scale: RewardScale, steps: int,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Drive cars for a window: mean weighted cost with its graph, last observations and state."""
    mean_cost = torch.zeros((), dtype=cars.dtype, device=cars.device)
    for _ in range(steps):
        actions, state = policy(obs, state)
        obs, rewards, terminated, truncated, _ = cars.step(actions)
        weights = torch.tensor(reward_scale.now, dtype=cars.dtype, device=cars.device)
        mean_cost = mean_cost - (rewards * weights).mean() / steps
        over = terminated | truncated
        reward_scale.start_next_drives(over.cpu().numpy())
        state = torch.where(over[:, None], 0.0, state)
    return mean_cost, obs, state
