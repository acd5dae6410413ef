"""PPO whose update NumPy takes: stable-baselines3's minibatches, losses and Adam in less than half
of its time, which was most of a training's."""

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ....envs.backend.extras import extra
from ..normalise import Standardised
from .adam import Adam
from .dense import ACTIVATIONS, Dense, Layer, Single

with extra("train", "training needs {}"):
    import stable_baselines3
    import torch
    from stable_baselines3.common.distributions import DiagGaussianDistribution
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from stable_baselines3.common.utils import explained_variance
    from threadpoolctl import ThreadpoolController

_LOG_SQRT_2PI = 0.5 * np.log(2.0 * np.pi)
_LOSSES = ("policy_gradient_loss", "value_loss", "entropy_loss", "clip_fraction", "approx_kl")


class PPO(stable_baselines3.PPO):
    """stable-baselines3's, with its arguments, files and numbers but for rounding.

    NumPy takes the update of a policy of dense layers (tanh, ReLU, SiLU) whose deviation depends on
    nothing, on a CPU, by plain Adam, without `target_kl` and `clip_range_vf`. Torch takes others.
    """

    def train(self) -> None:
        """The update from the rollout that was gathered."""
        parts = parts_of(self.policy)
        if parts is None or self.target_kl is not None or self.clip_range_vf is not None:
            super().train()
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = float(self.clip_range(self._current_progress_remaining))  # type: ignore[operator]
        one_thread = _threads().limit(limits=1, user_api="blas")  # more wait for each other
        with one_thread, np.errstate(all="ignore"):  # a training looks itself whether all is finite
            losses = self._stepped(parts, clip_range)
        self._n_updates += self.n_epochs
        buffer = self.rollout_buffer
        found = dict(zip(_LOSSES, losses.mean((0, 1)), strict=True))
        found["approx_kl"] = losses[-1, :, -1].mean()  # of the last pass
        found["loss"] = losses[-1, -1, :3] @ (1.0, self.vf_coef, self.ent_coef)
        found["explained_variance"] = explained_variance(
            buffer.values.ravel(), buffer.returns.ravel()
        )
        found["std"] = self.policy.log_std.exp().mean().item()
        for name, value in found.items():
            self.logger.record(f"train/{name}", float(value))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)

    def _stepped(self, parts: "Parts", clip_range: float) -> Any:
        """`_LOSSES` of each minibatch of each pass, whose step is taken."""
        optimizer: Any = self.policy.optimizer
        adam = Adam(optimizer, parts.tensors)
        surrogate = Surrogate(adam, parts, self.batch_size, clip_range, self.vf_coef, self.ent_coef)
        data, losses = self._data(), list[list[tuple[float, ...]]]()
        for _ in range(self.n_epochs):
            losses.append([])
            for x, actions, before, advantages, returns in self._minibatches(data):
                if self.normalize_advantage and len(advantages) > 1:
                    spread = advantages.std(ddof=1) + np.float32(1e-8)
                    advantages = (advantages - advantages.mean()) / spread
                losses[-1].append(surrogate(x, actions, before, advantages, returns))
                adam.step(self.max_grad_norm)
        adam.write_back()
        return np.array(losses)

    def _data(self) -> list[Single]:
        """What the layers read, actions, their log probability, advantages and returns."""
        buffer = self.rollout_buffer
        flat = buffer.swap_and_flatten
        observations = torch.as_tensor(flat(buffer.observations))
        with torch.no_grad():
            features: Any = self.policy.extract_features(observations)
        rest = buffer.log_probs, buffer.advantages, buffer.returns
        return [features.numpy(), flat(buffer.actions), *(flat(each)[:, 0] for each in rest)]

    def _minibatches(self, data: list[Single]) -> Iterator[list[Single]]:
        """In the order in which stable-baselines3 draws them."""
        order = np.random.permutation(len(data[0]))
        for first in range(0, len(order), self.batch_size):
            chosen = order[first : first + self.batch_size]
            yield [each[chosen] for each in data]


class Parts(NamedTuple):
    """What a policy consists of: layers of the actor and of the critic, the logarithm of the
    actions' standard deviation, and the activation's name."""

    actor: list[torch.nn.Linear]
    critic: list[torch.nn.Linear]
    log_std: torch.Tensor
    activation: str

    @property
    def tensors(self) -> list[torch.Tensor]:
        """All that is learned."""
        both = [*self.actor, *self.critic]
        return [each for layer in both for each in (layer.weight, layer.bias)] + [self.log_std]


def parts_of(policy: Any) -> Parts | None:
    """A policy's parts; None where it has others, or learns in another way."""
    plain = (
        (ActorCriticPolicy, policy),
        (torch.optim.Adam, policy.optimizer),
        (DiagGaussianDistribution, policy.action_dist),
    )
    if not all(type(part) is kind for kind, part in plain) or not policy.share_features_extractor:
        return None
    if type(policy.features_extractor) not in (FlattenExtractor, Standardised):
        return None
    hidden = policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net
    kinds = {type(each).__name__ for net in hidden for each in net} - {"Linear"}
    layers = [[each for each in net if isinstance(each, torch.nn.Linear)] for net in hidden]
    if (
        len(kinds) != 1
        or not kinds <= ACTIVATIONS.keys()
        or any(2 * len(found) != len(net) for found, net in zip(layers, hidden, strict=True))
    ):
        return None
    actor, critic = [*layers[0], policy.action_net], [*layers[1], policy.value_net]
    parts = Parts(actor, critic, policy.log_std, kinds.pop())
    learned = [each for group in policy.optimizer.param_groups for each in group["params"]]
    group = policy.optimizer.param_groups[0]
    special = any(group.get(name) for name in ("weight_decay", "amsgrad", "maximize"))
    biased = all(layer.bias is not None for layer in (*actor, *critic))
    ours = {id(each) for each in parts.tensors} if biased else set()
    alike = all(each.dtype == torch.float32 and each.device.type == "cpu" for each in learned)
    return parts if ours == {id(each) for each in learned} and alike and not special else None


class Surrogate:
    """PPO's clipped objective of a minibatch, and its slopes to all that is learned.

    rows: the most of a minibatch. value, entropy: the weights of these losses.
    """

    def __init__(
        self, adam: Adam, parts: Parts, rows: int, clip_range: float, value: float, entropy: float
    ) -> None:
        self._clip_range, self._value, self._entropy = clip_range, value, entropy
        activation, pairs = (
            ACTIVATIONS[parts.activation],
            list(zip(adam.parameters, adam.slopes, strict=True)),
        )
        layers = [
            Layer(W, b, W_slope, b_slope)
            for (W, W_slope), (b, b_slope) in zip(pairs[:-1:2], pairs[1:-1:2], strict=True)
        ]
        split = len(parts.actor)
        self._actor = Dense(layers[:split], activation, rows)
        self._critic = Dense(layers[split:], activation, rows)
        self._log_std, self._log_std_slope = pairs[-1]

    def __call__(
        self, x: Single, actions: Single, before: Single, advantages: Single, returns: Single
    ) -> tuple[float, ...]:
        """`_LOSSES` of rows (n, k); before: the actions' log probability when they were taken."""
        n, log_std, std = len(x), self._log_std, np.exp(self._log_std)
        z = (actions - self._actor(x)) / std
        log_ratio = (np.float32(-0.5) * z * z - log_std - np.float32(_LOG_SQRT_2PI)).sum(1) - before
        ratio = np.exp(log_ratio)
        gain, low, high = advantages * ratio, 1.0 - self._clip_range, 1.0 + self._clip_range
        clipped = advantages * np.clip(ratio, np.float32(low), np.float32(high))
        slope = np.where(gain <= clipped, gain, np.float32(0.0)) * np.float32(-1.0 / n)
        off = self._critic(x)[:, 0] - returns
        to_mean: Any = slope[:, None] * z / std
        to_value: Any = np.float32(2.0 * self._value / n) * off
        self._actor.back(to_mean)
        self._critic.back(to_value[:, None])
        self._log_std_slope[:] = slope @ (z * z - np.float32(1.0)) - np.float32(self._entropy)
        return (
            float(-np.minimum(gain, clipped).mean()),
            float(np.mean(off * off)),
            float(-(log_std + np.float32(0.5 + _LOG_SQRT_2PI)).sum()),
            float(np.mean(np.abs(ratio - np.float32(1.0)) > self._clip_range)),
            float(np.mean(ratio - np.float32(1.0) - log_ratio)),
        )


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()
