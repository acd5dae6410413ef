"""Torch's layers, and actors of stable-baselines3's models and zips, as networks without torch.

A zip holds pickles, and unpickling runs the code in them. So nothing is read without `trust`, and
`export_zip` writes a file that is read without it.

Args:
    path: Path of the zip.
    file: Path of the zip.
    trust: Whether code in the zip, or in the pickle, may run; PermissionError if not.
    normalise: Pickle of VecNormalize; None: NAME.pkl or vecnormalize.pkl beside the zip, if any.
"""

import json
import pickle
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile, ZipFile

import gymnasium as gym
import numpy as np

from ...envs.record import Array
from ...envs.task import ObservationEntry, make_space
from ...estimators.wrappers.estimate import EstimateObservation
from ..env_info import AnyEnv, CarEnv, get_env_facts
from ..learned.layers import ACTIVATIONS, Gru, Lstm, MemoryLayer, RecurrentLayer
from ..learned.network import SUFFIX, Network
from ..learned.policy import Card, Policy, save_policy
from ..vec_env import get_scales, scale_layout
from .normalise import Standardised, read_normalisation

from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy  # isort: skip
from stable_baselines3.common.save_util import load_from_zip_file  # isort: skip
from stable_baselines3.common.torch_layers import FlattenExtractor  # isort: skip
from stable_baselines3.common.vec_env import VecNormalize  # isort: skip
import torch  # isort: skip
from torch import nn  # isort: skip

# torch's activations by their names in a `Network`, and its cells by layers without it
_KINDS = (nn.Tanh, nn.ReLU, nn.ELU, nn.LeakyReLU, nn.SiLU)
TORCH_ACTIVATIONS: dict[str, type[nn.Module]] = dict(zip(ACTIVATIONS, _KINDS, strict=True))
TORCH_CELLS: dict[type[nn.RNNBase], type[RecurrentLayer]] = {nn.GRU: Gru, nn.LSTM: Lstm}
_NEEDED = ("policy_class", "policy_kwargs", "observation_space", "action_space")
_MEMBERS = {"data", "policy.pth"}
_NORMALISER = "vecnormalize.pkl"


def convert_sb3_policy(
    model: BaseAlgorithm | BasePolicy, normaliser: VecNormalize | None = None, history: int = 1
) -> Network:
    """Convert the deterministic actor of a model to a network; ValueError for an unknown one.

    Args:
        model: Model or policy of a class of `_POLICIES`, `Standardised` its extractor at most.
        normaliser: VecNormalize of the training, or None.
        history: Frames that a VecFrameStack stacked, inside or outside of the normaliser.
    """
    policy = getattr(model, "policy", model)
    actor, space = _find_actor(policy), policy.action_space
    low, high = getattr(space, "low", 0.0), getattr(space, "high", 0.0)
    if not (np.all(low == -1.0) and np.all(high == 1.0)):
        raise ValueError(f"an action lies within [-1, 1], got {space}")
    extractor_class = type(actor.extractor)
    if extractor_class not in (FlattenExtractor, Standardised):
        raise ValueError(f"the observation goes through {extractor_class.__name__}, not as it is")
    weights, biases, activations = _convert_dense(actor.layers)
    output = activations.pop() if len(activations) == len(weights) else "linear"
    if len(set(activations)) > 1:
        raise ValueError(f"one activation in all layers, got {', '.join(activations)}")
    cells = convert_cells(actor.recurrent)
    n_inputs = (cells[0].weight_in if cells else weights[0]).shape[1]
    mean, scale, clip = read_normalisation(normaliser, n_inputs, history)
    if isinstance(actor.extractor, Standardised):
        if clip is not None:
            raise ValueError("the observation is normalised twice: outside and by the network")
        mean, scale, clip = actor.extractor.numbers
        mix_inputs(cells, weights, _to_array(actor.extractor.mixing).T)
    kinds = activations[0] if activations else "tanh", "tanh" if actor.squashed else output
    return Network(mean, scale, weights, biases, *kinds, clip, history, cells)


class _Actor(NamedTuple):
    """The actor of a policy; `squashed`: whether tanh follows its layers."""

    layers: list[nn.Module]
    squashed: bool
    extractor: nn.Module
    recurrent: nn.RNNBase | None = None


_POLICIES = (  # classes; a subclass may compute anything and is none of them
    "stable_baselines3.common.policies.ActorCriticPolicy",
    "stable_baselines3.sac.policies.SACPolicy",
    "stable_baselines3.td3.policies.TD3Policy",
    "sb3_contrib.tqc.policies.TQCPolicy",
    "sb3_contrib.common.recurrent.policies.RecurrentActorCriticPolicy",
    f"{__package__}.gradient.GruPolicy",
)


def _check_known(kind: type) -> None:
    """Check that a class of policies is one of `_POLICIES`; else ValueError."""
    name = f"{kind.__module__}.{kind.__qualname__}"
    if name not in _POLICIES:
        known = ", ".join(path.rpartition(".")[2] for path in _POLICIES)
        raise ValueError(f"the actor of {name} is not known; known: {known}")


def _find_actor(policy: Any) -> _Actor:
    """Find the actor of a policy."""
    _check_known(type(policy))
    if hasattr(policy, "mlp_extractor"):  # on-policy
        layers, recurrent = policy.mlp_extractor.policy_net, getattr(policy, "lstm_actor", None)
        if recurrent and recurrent.batch_first:
            raise ValueError(f"recurrent layers with further arguments are not known: {recurrent}")
        squashed, extractor = bool(policy.squash_output), policy.pi_features_extractor
        return _Actor([*layers, policy.action_net], squashed, extractor, recurrent)
    if not hasattr(policy, "actor"):  # a `GruPolicy`
        return _Actor(list(policy.layers), False, policy.features_extractor, policy.cell)
    actor = policy.actor
    if not hasattr(actor, "latent_pi"):  # a `TD3Policy`, whose tanh is a layer
        return _Actor(list(actor.mu), False, actor.features_extractor)
    if actor.use_sde and actor.clip_mean > 0.0:
        raise ValueError("state-dependent exploration (gSDE) clips the mean: not known here")
    return _Actor([*actor.latent_pi, actor.mu], True, actor.features_extractor)


def convert_cells(module: nn.RNNBase | None) -> list[MemoryLayer]:
    """Convert the cells of a module of `TORCH_CELLS`; ValueError for any other, none for None.

    Args:
        module: Module, one direction of plain cells.
    """
    if module is None:
        return []
    is_plain = module.bias and not (module.bidirectional or module.proj_size)
    if type(module) not in TORCH_CELLS or not is_plain:
        raise ValueError(f"recurrent layers with further arguments are not known: {module}")
    cell = TORCH_CELLS[type(module)]
    return [cell(*map(_to_array, weights)) for weights in module.all_weights]


def mix_inputs(cells: list[MemoryLayer], weights: list[Array], mixing: Array) -> None:
    """Mix the inputs of a network's first layer.

    Args:
        cells: Memory layers, of which the first one is replaced, if any.
        weights: Weights of the dense layers, of which the first ones are replaced otherwise.
        mixing: Mixing, shape (inputs, inputs).
    """
    if cells:
        cells[0] = replace(cells[0], weight_in=cells[0].weight_in @ mixing)
    else:
        weights[0] = weights[0] @ mixing


def load_network(policy: BasePolicy, network: Network) -> None:
    """Load a network's weights into an actor of the same form, whose extractor stays.

    Args:
        policy: Policy of a class of `_POLICIES`.
        network: Network to load.
    """
    actor, parameters = _find_actor(policy), list[nn.Parameter]()
    arrays = [getattr(cell, name) for cell in network.cells for name in cell.arrays]
    arrays += [x for pair in zip(network.weights, network.biases, strict=True) for x in pair]
    for module in (actor.recurrent, *actor.layers):
        parameters += [] if module is None else module.parameters()
    with torch.no_grad():
        for parameter, array in zip(parameters, arrays, strict=True):
            parameter.copy_(torch.from_numpy(array))


def _to_array(parameter: torch.Tensor) -> Array:
    return parameter.detach().cpu().numpy()


def _convert_dense(layers: list[nn.Module]) -> tuple[list[Array], list[Array], list[str]]:
    """Convert linear layers to weights, biases and the activations behind them."""
    names = {kind: name for name, kind in TORCH_ACTIVATIONS.items()}
    weights, biases, layer_activations = list[Array](), list[Array](), list[str]()
    for layer in layers:
        if isinstance(layer, nn.Linear):
            if len(layer_activations) != len(weights):
                raise ValueError("two linear layers without an activation between")
            weights.append(_to_array(layer.weight))
            biases.append(_to_array(layer.bias))
        else:
            slopes = getattr(layer, "alpha", 1.0), getattr(layer, "negative_slope", 0.01)
            if type(layer) not in names or slopes != (1.0, 0.01):
                known = ", ".join(names.values())
                raise ValueError(f"layer {layer} is not known; known: linear, {known}")
            layer_activations.append(names[type(layer)])
    return weights, biases, layer_activations


def policy_from_zip(
    path: str | Path, env: AnyEnv, *, trust: bool = False, normalise: str | Path | None = None,
    **about: Any,
) -> Policy:  # fmt: skip
    """Read the deterministic actor of a stable-baselines3 zip, for the env of its training.

    A policy trained on a VecFrameStack around the env has that many frames of history.

    Args:
        path: Path of the zip; FileNotFoundError without one, ValueError for another file.
        env: Single or vector env whose observation names the numbered entries; ValueError if unfit.
        trust: Whether code in the zip may run; PermissionError if not.
        normalise: Pickle of VecNormalize; None: NAME.pkl or vecnormalize.pkl beside the zip.
        about: Fields of the policy's `Card`.
    """
    file = Path(path)
    check_trusted(file, trust)
    content, weights = _read(file)
    policy = _build_policy(file, content, weights)
    frames, scales = _match_frames(file, policy.observation_space, get_env_facts(env).layout)
    network = convert_sb3_policy(policy, load_normaliser(file, trust, normalise), frames)
    scales = np.resize(scales, network.mean.shape)  # of all frames, or of one
    network = replace(network, mean=network.mean * scales, scale=network.scale / scales)
    described = {"env_id": "", "steps": int(content.get("num_timesteps", 0))}
    described["algorithm"] = f"stable-baselines3's {type(policy).__name__}"
    return Policy(file.stem, network, Card.from_env(env, **described | about))


def export_zip(
    path: str | Path, target: str | Path, env_id: str, env_options: Mapping[str, Any] | None = None,
    *, trust: bool = False, normalise: str | Path | None = None, **about: Any,
) -> Policy:  # fmt: skip
    """Export a zip's actor to a policy's file, which runs no code where it is read.

    Args:
        path: Path of the zip.
        target: Path of the policy's file.
        env_id: Id of the training's env.
        env_options: Arguments of `gym.make` for that env.
        trust: Whether code in the zip may run.
        normalise: Pickle of VecNormalize, as for `policy_from_zip`.
        **about: Other fields of the policy's `Card`, such as the estimator of the training.
    """
    check_trusted(Path(path), trust)
    if Path(target).suffix != SUFFIX:  # before anything is read
        raise ValueError(f"a policy's file is NAME{SUFFIX}, got {target}")
    about |= {"env_id": env_id, "env_options": dict(env_options or {})}
    env: CarEnv = gym.make(env_id, **about["env_options"])
    if about.get("estimator"):
        env = EstimateObservation(env, about["estimator"], **about.get("estimator_options", {}))
    policy = policy_from_zip(path, env, trust=trust, normalise=normalise, **about)
    env.close()
    save_policy(target, policy.network, policy.card)
    return replace(policy, name=Path(target).stem)


def find_normaliser(path: Path, normalise: str | Path | None = None) -> Path | None:
    """Find the pickle of a zip's VecNormalize; None without one."""
    if normalise is not None:
        return Path(normalise)
    in_zoo = path.with_suffix("") / _NORMALISER  # where rl-baselines3-zoo puts it
    candidates = path.with_suffix(".pkl"), path.with_name(_NORMALISER), in_zoo
    return next((file for file in candidates if file.is_file()), None)


def check_trusted(file: Path, trust: bool) -> None:
    """Check that a file is a zip of stable-baselines3; PermissionError where it is not trusted."""
    check_zip(file)
    if not trust:
        raise PermissionError(
            f"{file} holds pickles: reading them runs whatever code its maker put there. If you "
            f"trust it, say --trust (trust=True); `sideslip export {file} --trust` makes a file "
            "of it that cannot run code"
        )


def check_zip(file: Path) -> None:
    """Check a zip of stable-baselines3 by its members; FileNotFoundError or ValueError else."""
    if not file.is_file():
        raise FileNotFoundError(f"{file}: {'a folder' if file.is_dir() else 'no such file'}")
    try:
        with ZipFile(file) as archive:
            missing = _MEMBERS - set(archive.namelist())
    except BadZipFile as error:
        raise ValueError(f"{file} is no zip, or is cut short: {error}") from None
    if missing:
        text = f"{file} is no zip of stable-baselines3, or is cut short: it holds no"
        raise ValueError(f"{text} {' and '.join(sorted(missing))}")


def _read(file: Path) -> tuple[dict[str, Any], Any]:
    """Read the model's data and the policy's weights; nothing else is unpickled."""
    try:
        with ZipFile(file) as archive:
            names = json.loads(archive.read("data"))
        skipped = {name: None for name, value in names.items()
                   if name not in _NEEDED and isinstance(value, dict)}  # fmt: skip
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="Could not deserialize")
            content, weights, _ = load_from_zip_file(file, device="cpu", custom_objects=skipped)
    except Exception as error:  # a pickle raises what its maker wrote
        text = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{file} cannot be read: {text}") from error
    if lacking := [name for name in _NEEDED if name not in (content or {})]:
        raise ValueError(f"{file} is no zip of stable-baselines3: no {', '.join(lacking)} in it")
    return content or {}, (weights or {})["policy"]


def _build_policy(file: Path, content: Mapping[str, Any], weights: Any) -> BasePolicy:
    """Build the policy with its weights, without the algorithm and its environments."""
    kind, options = content["policy_class"], {**content["policy_kwargs"]}
    options.pop("device", None)
    if not isinstance(kind, type):
        raise ValueError(f"{file}: its policy is of no class, but {kind!r}")
    _check_known(kind)
    if issubclass(kind, ActorCriticPolicy):
        options.setdefault("use_sde", bool(content.get("use_sde", False)))
    spaces = content["observation_space"], content["action_space"]
    try:
        policy: BasePolicy = kind(*spaces, lambda _: 0.0, **options)
        policy.load_state_dict(weights)
    except Exception as error:
        text = f"{file}: its weights are not those of its {kind.__name__}"
        raise ValueError(f"{text}: {error}") from error
    return policy


def load_normaliser(
    path: Path, trust: bool, normalise: str | Path | None = None
) -> VecNormalize | None:
    """Load a zip's VecNormalize from its pickle, which can run code; ValueError if unfit."""
    file = find_normaliser(path, normalise)
    if file is None:
        return None
    if not trust:
        raise PermissionError(f"{file} is a pickle, which may run code: say --trust to read it")
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file")
    try:
        normaliser = pickle.loads(file.read_bytes())
    except Exception as error:  # a pickle raises what its maker wrote
        raise ValueError(f"{file} cannot be read as a VecNormalize: {error}") from error
    if not isinstance(normaliser, VecNormalize):
        raise ValueError(f"{file} holds a {type(normaliser).__name__}, not a VecNormalize")
    return normaliser


def _match_frames(
    file: Path, space: gym.Space[Any], layout: Sequence[ObservationEntry]
) -> tuple[int, Array]:
    """Count the layout's frames in the policy's observation, and get the scales of its entries."""
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"{file} was trained on {space}, not on an observation of one dimension")
    frames, rest = divmod(space.shape[0], len(layout))
    if frames > 0 and rest == 0:
        if space == make_space(layout, frames):
            return frames, np.ones(1)
        if space == make_space(scale_layout(layout), frames):
            return frames, get_scales(layout).astype(np.float64)
    raise ValueError(
        f"{file} was trained on other entries or bounds, {space.shape[0]} numbers; the observation "
        f"here has {len(layout)}: {', '.join(entry.name for entry in layout)}. Say the id, and the "
        "estimator, of its training; an export (`sideslip export`) drives a wider observation too"
    )
