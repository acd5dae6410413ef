"""The deterministic actor of a stable-baselines3 model as a `Network`, which needs no torch."""

from typing import Any

import numpy as np

from ..learned.network import Network

_PRIOR = 1e-4  # samples that a VecNormalize starts with, of mean 0 and variance 1


def network_from_sb3(model: Any, normaliser: Any = None) -> Network:
    """What `model.predict(..., deterministic=True)` computes of a `normaliser`'s observations.

    model: PPO, A2C, SAC or TD3 with dense layers and an action within [-1, 1], with `Standardised`
    before them or nothing. normaliser: the VecNormalize of the training, or None. An entry that
    never varied in training taught the network nothing and is not read: scale 0.

    Raises ValueError for a model that is none of these, or an observation of another width,
    ModuleNotFoundError without torch.
    """
    try:
        from stable_baselines3.common.torch_layers import FlattenExtractor

        from .normalise import Standardised
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "networks come from stable-baselines3: pip install 'sideslip[train]'", name=error.name
        ) from error
    space = model.action_space
    bounds = getattr(space, "low", 0.0), getattr(space, "high", 0.0)
    if not (np.all(bounds[0] == -1.0) and np.all(bounds[1] == 1.0)):
        raise ValueError(f"an action lies within [-1, 1], got {space}")
    layers, squashed, extractor = _actor(model.policy)
    if type(extractor) not in (FlattenExtractor, Standardised):
        raise ValueError(f"the observation goes through {type(extractor).__name__}, not as it is")
    weights, biases, activations, output = _dense(layers)
    if len(set(activations)) > 1:
        raise ValueError(f"one activation in all layers, got {', '.join(activations)}")
    wide = weights[0].shape[1]
    mean, scale, clip = _normalisation(normaliser, wide)
    if isinstance(extractor, Standardised):
        if clip is not None:
            raise ValueError("the observation is normalised twice: outside and by the network")
        mean, scale, clip = extractor.numbers
    return Network(
        mean,
        scale,
        weights,
        biases,
        activations[0] if activations else "tanh",
        "tanh" if squashed else output,
        clip,
    )


def _actor(policy: Any) -> tuple[list[Any], bool, Any]:
    """(layers, whether the last one is squashed by tanh, features extractor)."""
    if hasattr(policy, "mlp_extractor") and hasattr(policy, "action_net"):  # PPO, A2C
        if policy.squash_output:
            raise ValueError("a squashed policy of PPO or A2C is not known here")
        extractor = getattr(policy, "pi_features_extractor", policy.features_extractor)
        return [*policy.mlp_extractor.policy_net, policy.action_net], False, extractor
    actor = getattr(policy, "actor", None)
    if actor is not None and hasattr(actor, "latent_pi"):  # SAC
        if actor.use_sde and actor.clip_mean > 0.0:
            raise ValueError("SAC with state-dependent exploration clips its mean: not known here")
        return [*actor.latent_pi, actor.mu], True, actor.features_extractor
    if actor is not None and hasattr(actor, "mu"):  # TD3, whose layers end in tanh
        return list(actor.mu), False, actor.features_extractor
    raise ValueError(f"{type(policy).__name__} has no actor of dense layers")


def _dense(layers: list[Any]) -> tuple[list[Any], list[Any], list[str], str]:
    """(weights, biases, activations between, output) of a stack of linear layers."""
    from torch import nn

    names: dict[Any, str] = {nn.Tanh: "tanh", nn.ReLU: "relu"}
    weights: list[Any] = []
    biases: list[Any] = []
    bends: list[str] = []
    for layer in layers:
        if isinstance(layer, nn.Linear):
            if len(bends) != len(weights):
                raise ValueError("two linear layers without an activation between")
            weights.append(layer.weight.detach().cpu().numpy().copy())
            biases.append(layer.bias.detach().cpu().numpy().copy())
        elif type(layer) in names:
            bends.append(names[type(layer)])
        else:
            raise ValueError(
                f"layer {type(layer).__name__} is not known; known: linear, tanh, relu"
            )
    if len(bends) == len(weights):  # the last one is the output's
        return weights, biases, bends[:-1], bends[-1]
    return weights, biases, bends, "linear"


def _normalisation(normaliser: Any, wide: int) -> tuple[Any, Any, float | None]:
    """(mean, scale, clip) of a VecNormalize."""
    if normaliser is None or not normaliser.norm_obs:
        return np.zeros(wide), np.ones(wide), None
    stats = normaliser.obs_rms
    if getattr(stats, "mean", np.zeros(0)).shape != (wide,):
        raise ValueError(f"the normaliser is of another observation than the network's {wide}")
    prior = _PRIOR * (1.0 + stats.mean**2) / stats.count  # what it leaves of a constant's variance
    scale = 1.0 / np.sqrt(stats.var + normaliser.epsilon)
    return stats.mean, np.where(stats.var > 2.0 * prior, scale, 0.0), normaliser.clip_obs
