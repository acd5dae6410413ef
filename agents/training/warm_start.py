"""Start of a training from a zip of stable-baselines3 or a policy, and the scale of its rewards.

The score compares logarithms of costs, and d log J = dJ / J. So the scenarios of a mixture are
weighted by 1 over the uncontrolled car's cost. Where a training starts from a policy, each drive is
weighted by 1 over that policy's cost in the same drive.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv

from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.task import ObservationEntry
from ...estimators.learned.forward import CELL_WEIGHTS, MovingAverages
from ...estimators.learned.network import Network
from ..env_info import get_layout
from ..learned.policy import Policy
from ..rollout import COST_FLOOR, evaluate_episodes
from ..vec_env import Observations, make_native_env
from .config import (
    WARM_START_ENTRY,
    WARM_START_TRACES_ENTRY,
    Settings,
    TrainingTask,
    get_algorithm,
    read_settings,
)
from .export import check_zip, find_normaliser, load_normaliser, read_normalisation
from .networks import MemoryObservation, measure_mixing
from .normalise import StandardisedArguments

with require_extra("train", "training needs {}"):
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

import torch  # isort: skip  # after ours, which say which extra is missing
from stable_baselines3.common.save_util import load_from_zip_file  # isort: skip

_WEIGHT_DRIVES = 32  # uncontrolled drives by which a scenario is weighed
_MIN_COST_SHARE = 0.05  # of the scenarios' mean cost: a cheaper one counts as this in its weight
_GRU = [f"cell.{part}_l0" for part in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]


class WarmStart(NamedTuple):
    """The tensors of a zip or policy for a new model."""

    name: str  # path of the zip or name of the policy
    parameters: dict[str, Any]  # weights and optimisers by their names in `get_parameters`
    variables: dict[str, Any]  # further tensors of a zip
    scaling: StandardisedArguments  # of the observations
    partial: bool = False  # whether the rest of the model stays unchanged


def read_warm_start(path: str | Path, width: int, trust: bool = False) -> WarmStart:
    """Read the tensors of a zip without running code from it.

    Args:
        path: Path of the zip.
        width: Entries of the observation.
        trust: Whether a pickle of VecNormalize beside the zip may be read.

    Returns:
        Tensors of the model, and its scaling.

    Raises:
        PermissionError: There is such a pickle and no trust.
        ValueError: The zip cannot be read, or as `check_zip`.
    """
    file = Path(path)
    check_zip(file)
    try:
        _, loaded, variables = load_from_zip_file(file, load_data=False, device="cpu")
        parameters: dict[str, Any] = loaded
        policy = parameters["policy"]
    except Exception as error:  # torch raises many for one that is cut short
        raise ValueError(f"{file} cannot be read: {' '.join(str(error).split())}") from error
    inner = [name for name in policy if "features_extractor." in name]
    buffers = {name.rpartition(".")[2]: policy[name] for name in inner}
    if buffers.keys() >= {"mean", "scale", "clip"}:  # every network of the policy has the same
        bound = float(buffers["clip"])
        mixing = buffers["mixing"].tolist() if "mixing" in buffers else None
        mean_scale = buffers["mean"].tolist(), buffers["scale"].tolist()
        inner_scaling = (*mean_scale, bound if bound < math.inf else None, mixing)
        return WarmStart(str(file), parameters, variables or {}, inner_scaling)
    normaliser_file = find_normaliser(file)
    if normaliser_file is not None and not trust:
        raise PermissionError(
            f"{normaliser_file} is a pickle, which may run code: say --trust to read it"
        )
    normaliser = load_normaliser(normaliser_file) if normaliser_file else None
    mean, scale, clip = read_normalisation(normaliser, width, 1)
    scaling = mean.tolist(), scale.tolist(), clip, None
    return WarmStart(str(file), parameters, variables or {}, scaling)


def make_finetune_task(policy: Policy, **fields: Any) -> TrainingTask:
    """Make the task of training a policy further, from its card and its network's form.

    Args:
        policy: Policy to train further.
        fields: Fields of `TrainingTask` that replace the card's. `env_options` add to the card's, a
            scenario there replaces its mixture, and another estimator drops the card's options.

    Returns:
        Task with the policy's observation and form.
    """
    card, algo = policy.card, fields.get("algo", "ppo")
    options = dict(card.env_options) | fields.pop("env_options", {})
    mixture = [] if options != card.env_options else card.algorithm_options.get("scenarios", [])
    scenarios = fields.pop("scenarios", mixture)
    if scenarios:
        options.pop("scenario", None)
    task_fields = dict[str, Any](env_id=card.env_id, env_options=options, scenarios=scenarios)
    if fields.get("estimator", card.estimator) == card.estimator:
        task_fields["estimator"] = card.estimator
        task_fields["estimator_options"] = dict(card.estimator_options)
    settings = fields.pop("settings", None) or resolve_settings(None, algo, card.env_id, policy)
    task_fields["settings"] = _add_policy_form(settings, policy, algo)
    return TrainingTask(**task_fields | fields)


def resolve_settings(file: str | Path | None, algo: str, env_id: str, start: Any) -> Settings:
    """Resolve the settings of an environment, or of training a policy further.

    Args:
        file: File of settings; None: the package's own.
        algo: Name of the algorithm.
        env_id: Id of the env.
        start: Policy to train further, or anything else for a new training.

    Returns:
        Values by name.
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
        raise ValueError(
            f"{algo} goes on from dense layers without tanh at their end, {needed} before them and "
            f"no older frames; (output, history, cells) of {policy.name} are {architecture}"
        )
    if on_tensors and network.activation != "silu":
        raise ValueError(f"{algo} goes on from layers of silu, not of {network.activation}")
    if on_tensors:
        return {"net_arch": list(network.hidden), "cells": network.cells[0].size}
    return {"net_arch": list(network.hidden), "activation_fn": network.activation}


def _make_warm_start(
    policy: Policy, task: TrainingTask, layout: Sequence[ObservationEntry]
) -> WarmStart:
    """Make the warm start of a task's actor from a policy; a critic stays unchanged."""
    network, policy_entries = policy.network, [name for name, _ in policy.card.observation]
    names = [entry.name for entry in layout]
    if policy_entries != names:
        known, available = ", ".join(policy_entries), ", ".join(names)
        raise ValueError(f"{policy.name} reads {known}; here there is {available}")
    form = _get_policy_form(policy, task.algo)
    policy_kwargs = task.settings.get("policy_kwargs", {})
    if policy_kwargs != policy_kwargs | form:
        contrast = f"{form}, and the settings say {policy_kwargs}"
        raise ValueError(f"{policy.name} is a network of {contrast}")
    on_tensors = get_algorithm(task.algo).on_tensors
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
    read = network if on_tensors else network.dense
    scaling = read.mean.tolist(), read.scale.tolist(), read.clip, None
    return WarmStart(policy.name, {"policy": tensors}, {}, scaling, partial=True)


def load_warm_start(start: WarmStart, model: Any) -> None:
    """Load a warm start into a model.

    Args:
        start: Tensors to load.
        model: Model of stable-baselines3.

    Raises:
        ValueError: The tensors are of another network.
    """
    policy = dict(model.get_parameters()["policy"])
    if not start.partial:  # a zip from elsewhere has its features extractor outside
        policy = {name: x for name, x in policy.items() if "features_extractor." in name}
    policy |= start.parameters["policy"]
    parameters = {**model.get_parameters(), **start.parameters, "policy": policy}
    try:
        model.set_parameters(parameters, device=model.device)
        for name, tensor in start.variables.items():
            getattr(model, name).data.copy_(tensor)
    except (AttributeError, KeyError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"{start.name} holds other networks than this training's {type(model).__name__} (its "
            f"settings say which): {' '.join(str(error).split())[:300]}"
        ) from error


class NetworkAgent:
    """A network as an agent on plain observations; rows may be of any cars.

    Args:
        network: Network that computes the action.
    """

    def __init__(self, network: Network) -> None:
        self.network = network

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Compute actions within [-1, 1], with the signature of stable-baselines3.

        Args:
            observation: Observations, shape (N, k).
            state: Memory, shape (N, memory); None at the start.
            episode_start: Rows whose memory is cleared, shape (N,).
            deterministic: Without effect.

        Returns:
            Actions (N, m) and the next state.
        """
        memory = (
            np.zeros((len(observation), self.network.memory)) if state is None else state.copy()
        )
        if episode_start is not None:
            memory[np.asarray(episode_start, np.bool_)] = 0.0
        actions = self.network(np.asarray(observation, np.float64), memory)
        return np.clip(actions, -1.0, 1.0).astype(np.float32), memory


class PolicyWarmStart:
    """The warm start of a training from a policy.

    PPO has no memory: moving averages stay unchanged as part of its environments, whitened by the
    policy's own drives.

    Args:
        policy: Policy to train further.
        task: Task of the training.
        env: Vector env of the task, without moving averages.
        seed: Seed of the drives.
    """

    def __init__(
        self, policy: Policy, task: TrainingTask, env: VectorEnv[Any, Any, Any], seed: int
    ) -> None:
        layout, self._network = get_layout(env), policy.network
        self.start = _make_warm_start(policy, task, layout)
        self.driver = NetworkAgent(policy.network)  # drives as the policy does
        self._mixing = None
        if policy.network.cells and not get_algorithm(task.algo).on_tensors:
            dense_agent = NetworkAgent(policy.network.dense)
            self._mixing = measure_mixing(
                env, policy.network, lambda obs: dense_agent.predict(obs)[0], seed
            )
            mixed = self._mixing.adapt_to_mixed(policy.network)
            self.start = _make_warm_start(replace(policy, network=mixed), task, layout)
            self.driver = NetworkAgent(mixed.dense)

    def wrap_env(self, env: VectorEnv[Any, Any, Any]) -> VectorEnv[Any, Any, Any]:
        """Wrap a vector env so that it has the model's observation.

        Args:
            env: Vector env of the task.

        Returns:
            Wrapped env; `env` itself for a policy without memory.
        """
        return MemoryObservation(env, self._network, self._mixing) if self._mixing else env

    def merge_network(self, network: Network) -> Network:
        """Merge a model's network with the policy's memory, for plain observations.

        Args:
            network: Network of the model.

        Returns:
            Network of plain observations.
        """
        if not self._mixing:
            return network
        return self._network.replace_dense(self._mixing.adapt_to_plain(network))


def compute_equal_weights(costs: Array) -> Array:
    """Compute weights that make scenarios' costs equal, so that costly ones do not outweigh others.

    Args:
        costs: Mean costs of the scenarios, shape (k,).

    Returns:
        Weights, shape (k,).
    """
    return np.asarray(costs.mean() / np.maximum(costs, _MIN_COST_SHARE * costs.mean()))


def compute_scenario_weights(task: TrainingTask, first: int) -> Array:
    """Compute each scenario's weight by the uncontrolled cost of a control period.

    Args:
        task: Task of the training.
        first: First seed of the uncontrolled drives.

    Returns:
        Weights of the scenarios, shape (k,); 1 for a task without a mixture.
    """
    k = len(task.scenarios)
    if not k:
        return np.ones(1)
    rows = _WEIGHT_DRIVES * k
    env = make_native_env(task.env_id, rows, None, task.options(rows))
    costs, steps = evaluate_episodes(env, None, range(first, first + rows))
    rates = [costs[i::k].sum() / steps[i::k].sum() for i in range(k)]
    return compute_equal_weights(np.array(rates))


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

    def _update_scale(self, rows: Sequence[int]) -> None:
        for i in rows:
            scales = self._drive_scales[i]
            self.now[i] = scales[min(self._drive[i], len(scales) - 1)]


def measure_reward_scale(agent: Any, env: VecEnv, seed: int, steps: int) -> list[list[float]]:
    """Measure the factors with which an agent's mean reward is -1 in each drive.

    Args:
        agent: Agent, as for `iterate_steps`.
        env: Env that resets itself, whose scenarios do not depend on the agent.
        seed: Seed of row 0.
        steps: Steps of each row.

    Returns:
        Factors of each row's drives, then their median for all further drives.
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
    for row_scales, open_scale in zip(scales, open_scales, strict=True):
        row_scales.append(float(np.median(row_scales or [open_scale])))
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

    def step_wait(self) -> Any:
        """Step the inner env and scale its rewards."""
        obs, rewards, dones, infos = self.venv.step_wait()
        scaled = rewards * self.reward_scale.now
        self.reward_scale.start_next_drives(dones)
        return obs, scaled, dones, infos
