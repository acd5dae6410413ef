"""The deterministic actor of a stable-baselines3 model as a `Network`, which needs no torch."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ...envs.backend.extras import require_extra
from ...estimators.learned.memory import RecurrentCell
from ...estimators.learned.network import ACTIVATIONS, Network

_PRIOR = 1e-4  # samples that a VecNormalize starts with, of mean 0 and variance 1


def convert_sb3_policy(model: Any, normaliser: Any = None, history: int = 1) -> Network:
    """Convert the deterministic actor of a model to a network.

    Entries that never varied in training are not read: their scale is 0.

    Args:
        model: Model of stable-baselines3 or sb3-contrib, or its policy, of a class in `ACTORS`,
            with actions within [-1, 1] and at most `Standardised` before its layers.
        normaliser: VecNormalize of the training, or None.
        history: Frames that a VecFrameStack stacked, inside or outside of the normaliser.

    Returns:
        Network of the actor.

    Raises:
        ValueError: The model is none of these, or has an observation of another width.
        ModuleNotFoundError: torch is not installed.
    """
    with require_extra("train", "networks come from stable-baselines3"):
        from stable_baselines3.common.torch_layers import FlattenExtractor

        from .normalise import Standardised
    policy = getattr(model, "policy", model)
    actor = find_actor_reader(type(policy))(policy)
    space = policy.action_space
    bounds = getattr(space, "low", 0.0), getattr(space, "high", 0.0)
    if not (np.all(bounds[0] == -1.0) and np.all(bounds[1] == 1.0)):
        raise ValueError(f"an action lies within [-1, 1], got {space}")
    if type(actor.extractor) not in (FlattenExtractor, Standardised):
        name = type(actor.extractor).__name__
        raise ValueError(f"the observation goes through {name}, not as it is")
    weights, biases, activations, output = _convert_dense(actor.layers)
    if len(set(activations)) > 1:
        raise ValueError(f"one activation in all layers, got {', '.join(activations)}")
    cells = _convert_cells(actor.recurrent)
    n_inputs = (cells[0].weight_in if cells else weights[0]).shape[1]
    mean, scale, clip = read_normalisation(normaliser, n_inputs, history)
    if isinstance(actor.extractor, Standardised):
        if clip is not None:
            raise ValueError("the observation is normalised twice: outside and by the network")
        mean, scale, clip = actor.extractor.numbers
        mixing = _to_array(actor.extractor.mixing).T
        if cells:
            cells[0] = replace(cells[0], weight_in=cells[0].weight_in @ mixing)
        else:
            weights[0] = weights[0] @ mixing
    return Network(
        mean,
        scale,
        weights,
        biases,
        activations[0] if activations else "tanh",
        "tanh" if actor.squashed else output,
        clip,
        history,
        cells,
    )


class _Actor(NamedTuple):
    """The actor of a policy: layers, whether tanh follows, features extractor, recurrent layers."""

    layers: list[Any]
    squashed: bool
    extractor: Any
    recurrent: Any = None


def _find_on_policy_actor(policy: Any) -> _Actor:
    layers = [*policy.mlp_extractor.policy_net, policy.action_net]
    return _Actor(layers, bool(policy.squash_output), policy.pi_features_extractor)


def _find_recurrent_actor(policy: Any) -> _Actor:
    return _find_on_policy_actor(policy)._replace(recurrent=policy.lstm_actor)


def _find_gru_actor(policy: Any) -> _Actor:
    return _Actor(list(policy.layers), False, policy.features_extractor, policy.cell)


def _find_gaussian_actor(policy: Any) -> _Actor:
    actor = policy.actor
    if actor.use_sde and actor.clip_mean > 0.0:
        raise ValueError("state-dependent exploration (gSDE) clips the mean: not known here")
    return _Actor([*actor.latent_pi, actor.mu], True, actor.features_extractor)


def _find_deterministic_actor(policy: Any) -> _Actor:
    return _Actor(list(policy.actor.mu), False, policy.actor.features_extractor)  # tanh is a layer


ACTORS: dict[str, Callable[[Any], _Actor]] = {
    "stable_baselines3.common.policies.ActorCriticPolicy": _find_on_policy_actor,
    "stable_baselines3.sac.policies.SACPolicy": _find_gaussian_actor,
    "stable_baselines3.td3.policies.TD3Policy": _find_deterministic_actor,
    "sb3_contrib.tqc.policies.TQCPolicy": _find_gaussian_actor,
    "sb3_contrib.common.recurrent.policies.RecurrentActorCriticPolicy": _find_recurrent_actor,
    f"{__package__}.gradient.GruPolicy": _find_gru_actor,
}
"""Readers of the known actors: "MlpPolicy" and "MlpLstmPolicy" of PPO, A2C, SAC, TD3, DDPG, TQC and
RecurrentPPO, and `GruPolicy`. A subclass may compute anything and is none of them."""


def find_actor_reader(kind: type) -> Callable[[Any], _Actor]:
    """Find the function that reads the actor of a class of policies.

    Args:
        kind: Class of the policy.

    Returns:
        Function of a policy.

    Raises:
        ValueError: The class is not in `ACTORS`.
    """
    name = f"{kind.__module__}.{kind.__qualname__}"
    if name not in ACTORS:
        known = ", ".join(path.rpartition(".")[2] for path in ACTORS)
        raise ValueError(f"the actor of {name} is not known; known: {known}")
    return ACTORS[name]


def _convert_cells(module: Any) -> list[RecurrentCell]:
    """Convert the cells of torch's GRU or LSTM; none for a policy without them."""
    if module is None:
        return []
    if module.bidirectional or module.proj_size or module.batch_first or not module.bias:
        raise ValueError(f"recurrent layers with further arguments are not known: {module}")
    names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
    return [
        RecurrentCell(
            module.mode.lower(), *(_to_array(getattr(module, f"{name}_l{i}")) for name in names)
        )
        for i in range(module.num_layers)
    ]


def _to_array(parameter: Any) -> Any:
    return parameter.detach().cpu().numpy().copy()


def list_activations() -> dict[str, type]:
    """Collect torch's classes of activations, by their names in a `Network`."""
    from torch import nn

    kinds = nn.Tanh, nn.ReLU, nn.ELU, nn.LeakyReLU, nn.SiLU
    return dict(zip(ACTIVATIONS, kinds, strict=True))


def _convert_dense(layers: list[Any]) -> tuple[list[Any], list[Any], list[str], str]:
    """Convert linear layers to weights, biases, activations between them, and the output's."""
    from torch import nn

    names = {kind: name for name, kind in list_activations().items()}
    weights: list[Any] = []
    biases: list[Any] = []
    layer_activations: list[str] = []
    for layer in layers:
        if isinstance(layer, nn.Linear):
            if len(layer_activations) != len(weights):
                raise ValueError("two linear layers without an activation between")
            weights.append(_to_array(layer.weight))
            biases.append(_to_array(layer.bias))
        elif type(layer) in names and _has_default_arguments(layer):
            layer_activations.append(names[type(layer)])
        else:
            raise ValueError(
                f"layer {layer} is not known; known: linear, {', '.join(names.values())}"
            )
    if len(layer_activations) == len(weights):  # the last one is the output's
        return weights, biases, layer_activations[:-1], layer_activations[-1]
    return weights, biases, layer_activations, "linear"


def _has_default_arguments(activation: Any) -> bool:
    """Return whether an activation has torch's default arguments."""
    return getattr(activation, "alpha", 1.0) == 1.0 and (
        getattr(activation, "negative_slope", 0.01) == 0.01
    )


def read_normalisation(
    normaliser: Any, n_inputs: int, history: int
) -> tuple[Any, Any, float | None]:
    """Read mean, scale and clip of a VecNormalize, around the stack of frames or inside of it.

    Args:
        normaliser: VecNormalize or None.
        n_inputs: Entries that the network reads, of all frames together.
        history: Number of frames.

    Returns:
        Mean, factor (0: not read) and clip (None: none), by entry of all frames or of one.
    """
    if normaliser is None or not normaliser.norm_obs:
        return np.zeros(n_inputs), np.ones(n_inputs), None
    stats = normaliser.obs_rms
    if getattr(stats, "mean", np.zeros(0)).shape not in ((n_inputs,), (n_inputs // history,)):
        raise ValueError(f"the normaliser is of another observation than the network's {n_inputs}")
    prior = _PRIOR * (1.0 + stats.mean**2) / stats.count  # what it leaves of a constant's variance
    scale = 1.0 / np.sqrt(stats.var + normaliser.epsilon)
    return stats.mean, np.where(stats.var > 2.0 * prior, scale, 0.0), normaliser.clip_obs
