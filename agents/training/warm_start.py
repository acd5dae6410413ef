"""Start of a training from a zip of stable-baselines3 or a policy.

A policy's moving averages become part of the environments, for algorithms without memory.
"""

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorWrapper
from gymnasium.vector.utils import batch_space

from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.task import ObservationEntry, make_space
from ..env_info import CarVectorEnv, get_layout
from ..learned.forward import CELL_WEIGHTS, MovingAverages
from ..learned.network import Network
from ..learned.policy import Policy
from ..rollout import iterate_steps
from ..vec_env import Observations, get_scales, scale_layout
from .config import Settings, TrainingTask, get_algorithm, read_settings
from .export import check_zip, load_normaliser
from .normalise import StandardisedArguments, read_normalisation
from .student import SAMPLE_STRIDE, compute_whitening

with require_extra("train", "training needs {}"):
    import torch
    from stable_baselines3.common.save_util import load_from_zip_file

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

WARM_START_ENTRY = "begun"  # the entry of training a policy further
WARM_START_TRACES_ENTRY = "begun-traces"  # likewise, for a policy with moving averages
_GRU = [f"cell.{part}_l0" for part in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]
_MIN_VARIANCE = 1e-4  # least variance of a mixture of memory features, for `compute_whitening`


def make_finetune_task(policy: Policy, **fields: Any) -> TrainingTask:
    """Make the task of training a policy further, from its card and its network's form.

    Args:
        policy: Policy to train further.
        fields: Fields of `TrainingTask` that replace the card's. `env_options` add to the card's, a
            scenario there replaces its mixture, and another estimator drops the card's options.
    """
    card, algo = policy.card, fields.get("algo", "ppo")
    changes = fields.pop("env_options", {})
    mixture = [] if "scenario" in changes else card.algorithm_options.get("scenarios", [])
    options, scenarios = card.env_options | changes, fields.pop("scenarios", mixture)
    if scenarios:
        options.pop("scenario", None)
    task_fields = dict[str, Any](env_id=card.env_id, env_options=options, scenarios=scenarios)
    if fields.get("estimator", card.estimator) == card.estimator:
        task_fields["estimator"] = card.estimator
        task_fields["estimator_options"] = dict(card.estimator_options)
    settings = fields.pop("settings", None) or resolve_settings(None, algo, card.env_id, policy)
    task_fields["settings"] = _add_policy_form(settings, policy, algo)
    return TrainingTask(**task_fields | fields)


def resolve_settings(file: str | Path | None, algo: str, env_id: str, start: object) -> Settings:
    """Resolve the settings of an environment, or of training a policy further.

    Args:
        file: File of settings; None: the package's own.
        algo: Name of the algorithm.
        env_id: Id of the env.
        start: Policy to train further, or anything else for a new training.
    """
    if not isinstance(start, Policy):
        return read_settings(algo, env_id, file)
    has_averages = MovingAverages.kind in [cell.kind for cell in start.network.cells]
    entry = WARM_START_TRACES_ENTRY if has_averages else WARM_START_ENTRY
    return _add_policy_form(read_settings(algo, entry, file), start, algo)


def _add_policy_form(settings: Settings, policy: Policy, algo: str) -> Settings:
    """Replace the policy's arguments in settings by those of a policy to train further."""
    form = _get_policy_form(policy, algo)
    return settings | {"policy_kwargs": settings.get("policy_kwargs", {}) | form}


def _get_policy_form(policy: Policy, algo: str) -> dict[str, Any]:
    """Get the `policy_kwargs` of a model whose actor is a policy's network."""
    network, on_tensors = policy.network, get_algorithm(algo).on_tensors
    kinds = [cell.kind for cell in network.cells]
    if algo != "ppo" and not on_tensors:
        raise ValueError(f"{algo} begins with a zip, not with policy {policy.name}")
    architecture = network.output, network.history, kinds
    known = [["gru"]] if on_tensors else [[], [MovingAverages.kind]]
    if architecture not in [("linear", 1, option) for option in known]:
        needed = "a GRU" if on_tensors else "nothing or traces"
        text = f"dense layers without tanh at their end, {needed} before them and no older frames"
        form = f"(output, history, cells) of {policy.name} are {architecture}"
        raise ValueError(f"{algo} goes on from {text}; {form}")
    if on_tensors and network.activation != "silu":
        raise ValueError(f"{algo} goes on from layers of silu, not of {network.activation}")
    if on_tensors:
        return {"net_arch": list(network.hidden), "cells": network.cells[0].size}
    return {"net_arch": list(network.hidden), "activation_fn": network.activation}


def _is_scaled(file: Path, layout: Sequence[ObservationEntry]) -> bool:
    """Return whether a zip was trained on `ScaledVecEnv`, by its space as JSON has it."""
    with ZipFile(file) as archive:
        space = json.loads(archive.read("data")).get("observation_space", {})
    return bool(space.get("low") == str(make_space(scale_layout(layout)).low))


class WarmStart:
    """The start of a training from a zip of stable-baselines3 or from a policy.

    PPO has no memory: a policy's moving averages stay unchanged as part of its environments,
    whitened by the policy's own drives.

    Args:
        agent: Path of the zip, or policy.
        task: Task of the training.
        trust: Whether a pickle of VecNormalize beside the zip may be read.

    Raises:
        PermissionError: There is such a pickle and no trust.
        ValueError: The zip cannot be read, or the task trains no such policy.
    """

    scaling: StandardisedArguments  # of the model's observations

    def __init__(self, agent: str | Path | Policy, task: TrainingTask, trust: bool = False) -> None:
        self.policy = agent if isinstance(agent, Policy) else None
        self.driver: _NetworkAgent | None = None  # that drives as the policy does
        self.env = task.vector_env(task.n_eval_envs)  # with the model's observation
        self._whitening: tuple[Array, Array] | None = None
        self._variables: dict[str, Any] = {}  # a zip's tensors of no module
        if isinstance(agent, Policy):
            self._read_policy(agent, task)
        else:
            self._read_zip(Path(agent), trust)

    def _read_zip(self, file: Path, trust: bool) -> None:
        """Read the tensors of a zip without running code from it."""
        check_zip(file)
        try:
            _, loaded, variables = load_from_zip_file(file, load_data=False, device="cpu")
            self._name, self._parameters = str(file), dict[str, Any](loaded)
            self._variables, policy = variables or {}, self._parameters["policy"]
        except Exception as error:  # torch raises many for one that is cut short
            raise ValueError(f"{file} cannot be read: {' '.join(str(error).split())}") from error
        inner = [name for name in policy if "features_extractor." in name]
        buffers = {name.rpartition(".")[2]: policy[name].tolist() for name in inner}
        if buffers.keys() >= {"mean", "scale", "clip"}:  # every network of the policy has the same
            clip = buffers["clip"] if buffers["clip"] < math.inf else None
            numbers = buffers["mean"], buffers["scale"], clip, buffers.get("mixing")
            self.scaling = StandardisedArguments(*numbers)
            return
        width = (self.env.single_observation_space.shape or (0,))[0]
        mean, scale, clip = read_normalisation(load_normaliser(file, trust), width, 1)
        layout = get_layout(self.env)
        scales = get_scales(layout) if _is_scaled(file, layout) else np.ones(width)
        mean, scale = mean * scales, scale / scales
        self.scaling = StandardisedArguments(mean.tolist(), scale.tolist(), clip)

    def _read_policy(self, policy: Policy, task: TrainingTask) -> None:
        """Read the actor's tensors of a policy, which the task's observation and form must fit."""
        network, policy_entries = policy.network, [name for name, _ in policy.card.observation]
        names = [entry.name for entry in get_layout(self.env)]
        if policy_entries != names:
            known, here = ", ".join(policy_entries), ", ".join(names)
            raise ValueError(f"{policy.name} reads {known}; here there is {here}")
        form, on_tensors = _get_policy_form(policy, task.algo), task.algorithm.on_tensors
        policy_kwargs = task.settings.get("policy_kwargs", {})
        if policy_kwargs != policy_kwargs | form:
            text = f"{policy.name} is a network of {form}"
            raise ValueError(f"{text}, and the settings say {policy_kwargs}")
        if network.cells and not on_tensors:
            self._whitening = _measure_whitening(self.env, network, task.scaling_seed)
            self.env = self.wrap_env(self.env)
            mean, mixing = self._whitening
            first, bias = network.weights[0], network.biases[0]
            first, bias = first @ np.linalg.inv(mixing), bias + first @ mean
            network = _replace_first_layer(network, first, bias).dense
        if on_tensors:
            cell = network.cells[0]
            arrays = dict(zip(_GRU, (getattr(cell, part) for part in CELL_WEIGHTS), strict=True))
            layers = [f"layers.{2 * i}" for i in range(len(network.weights))]
        else:
            arrays, hidden = {}, range(len(network.hidden))
            layers = [*(f"mlp_extractor.policy_net.{2 * i}" for i in hidden), "action_net"]
        for layer, W, b in zip(layers, network.weights, network.biases, strict=True):
            arrays |= {f"{layer}.weight": W, f"{layer}.bias": b}
        tensors = {name: torch.tensor(x, dtype=torch.float32) for name, x in arrays.items()}
        self._name, self._parameters = policy.name, {"policy": tensors}
        self.driver = _NetworkAgent(network)
        numbers = network.mean.tolist(), network.scale.tolist(), network.clip
        self.scaling = StandardisedArguments(*numbers)

    def wrap_env(self, env: CarVectorEnv) -> CarVectorEnv:
        """Wrap a vector env so that it has the model's observation.

        Args:
            env: Vector env of the task.

        Returns:
            Wrapped env; `env` itself where a policy has no memory.
        """
        if self.policy is None or self._whitening is None:
            return env
        return _MemoryObservation(env, self.policy.network, self._whitening)

    def merge_network(self, network: Network) -> Network:
        """Merge a model's network with the policy's memory, for plain observations.

        Args:
            network: Network of the model.
        """
        if self.policy is None or self._whitening is None:
            return network
        mean, mixing = self._whitening
        first = network.weights[0] @ mixing
        plain = _replace_first_layer(network, first, network.biases[0] - first @ mean)
        names = ("weights", "biases", "activation", "output")
        return replace(self.policy.network, **{name: getattr(plain, name) for name in names})

    def load(self, model: "BaseAlgorithm") -> None:
        """Load the tensors, of a policy the actor's; ValueError where the model has other ones.

        Args:
            model: Model of stable-baselines3.
        """
        policy = dict(model.get_parameters()["policy"])
        if self.policy is None:  # a zip from elsewhere has its features extractor outside
            policy = {name: x for name, x in policy.items() if "features_extractor." in name}
        policy |= self._parameters["policy"]
        parameters = {**model.get_parameters(), **self._parameters, "policy": policy}
        try:
            model.set_parameters(parameters, device=model.device)
            for name, tensor in self._variables.items():
                getattr(model, name).data.copy_(tensor)
        except (AttributeError, KeyError, RuntimeError, ValueError) as error:
            text = f"{self._name} holds other networks than this training's {type(model).__name__}"
            reason = " ".join(str(error).split())[:300]
            raise ValueError(f"{text} (its settings say which): {reason}") from error


def _replace_first_layer(network: Network, weights: Array, biases: Array) -> Network:
    """Replace weights (m, k) and biases (m,) of a network's first dense layer."""
    all_weights, all_biases = [weights, *network.weights[1:]], [biases, *network.biases[1:]]
    return replace(network, weights=all_weights, biases=all_biases)


class _NetworkAgent:
    """A network as an agent on plain observations; rows may be of any cars."""

    def __init__(self, network: Network) -> None:
        self.network = network

    def predict(
        self, observation: Observations, state: Array | None = None, episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Observations, Array]:  # fmt: skip
        """Compute actions within [-1, 1] and the next memory, as stable-baselines3 does."""
        shape = len(observation), self.network.memory
        memory = np.zeros(shape) if state is None else state.copy()
        if episode_start is not None:
            memory[np.asarray(episode_start, np.bool_)] = 0.0
        actions = self.network(np.asarray(observation, np.float64), memory)
        return np.clip(actions, -1.0, 1.0).astype(np.float32), memory


class _MemoryObservation(
    VectorWrapper[Observations, Observations, Observations, Observations, npt.NDArray[Any]]
):
    """A vector env whose observations (N, k) are the inputs of a network's dense layers.

    Of `whitening` the first, shape (k,), is subtracted; the second multiplies, shape (k, k).
    """

    transparent = True  # its layout says how it changes the observation

    def __init__(
        self, env: CarVectorEnv, network: Network, whitening: tuple[Array, Array] | None = None
    ) -> None:
        super().__init__(env)
        names = [f"memory_{i}" for i in range(network.dense.inputs)]
        self.layout = tuple(ObservationEntry(name, "-", -np.inf, np.inf) for name in names)
        self.single_observation_space = make_space(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._network, self._state = network, np.zeros((env.num_envs, network.memory))
        self._whitening = whitening and (whitening[0], whitening[1].astype(np.float32))
        self._last = np.zeros(self.observation_space.shape or (), np.float32)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Reset the rows; those that a `reset_mask` leaves out keep memory and observation."""
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_)))
        obs, infos = self.env.reset(seed=seed, options=options)
        new_state, updated = np.zeros_like(self._state[mask]), self._last.copy()
        updated[mask] = self._read(obs[mask], new_state)
        self._state[mask], self._last = new_state, updated
        return updated.copy(), infos

    def step(self, actions: Observations) -> Any:
        """Step the inner env and compute the observations, `final_obs` of the infos too."""
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        over = terminated | truncated
        if over.any():
            last = np.full(len(over), None)
            final_obs = self._read(np.stack(infos["final_obs"][over]), self._state[over])
            for i, final in zip(np.flatnonzero(over), final_obs, strict=True):
                last[i] = final
            infos = infos | {"final_obs": last}
            self._state[over] = 0.0
        self._last = self._read(obs, self._state)
        return self._last.copy(), rewards, terminated, truncated, infos

    def _read(self, obs: Observations, state: Array) -> Observations:
        """Compute observations (N, k), float32; the state (N, memory) is updated."""
        x = self._network.compute_features(obs.astype(np.float64), state)
        if self._whitening is None:
            return x.astype(np.float32)
        mean, mixing = self._whitening
        return np.asarray((x - mean).astype(np.float32) @ mixing)


def _measure_whitening(env: CarVectorEnv, network: Network, seed: int) -> tuple[Array, Array]:
    """Measure mean and whitening of a network's memory in an episode a row, from a seed on."""
    collected, agent = [], _NetworkAgent(network.dense)
    drive = iterate_steps(_MemoryObservation(env, network), agent, seed)
    for step in itertools.islice(drive, 0, None, SAMPLE_STRIDE):
        over = np.logical_or(step.terminated, step.truncated)
        collected.append(step.obs[step.running & ~over])
    x = np.concatenate(collected).astype(np.float64)
    return x.mean(0), compute_whitening(x, _MIN_VARIANCE)
