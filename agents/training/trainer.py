"""Training of a policy in a folder: rollouts on the batch engine, evaluations, a checkpoint.

The folder holds `checkpoint.safetensors`, `policy.safetensors` (the best evaluation's network with
its card), `best_model.zip` (the same model in stable-baselines3's format), `curve.jsonl` (the
evaluations), and `begun_with.safetensors` where it started from a policy.
"""

import json
import math
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from zipfile import ZipFile

import numpy as np

from ...envs.record import Array
from ...envs.task import make_space
from ..env_info import CarVectorEnv, get_layout
from ..learned.policy import Policy, is_policy, load_policy, save_policy
from ..rollout import COST_FLOOR
from ..vec_env import get_scales, make_vec_env, scale_layout
from .callbacks import CHECKPOINT, INITIAL_FILE, Checkpoint, EvalCallback, RunOptions, read_training
from .config import TrainingTask, get_policy_form
from .export import check_zip, load_network, load_normaliser
from .normalise import (
    CLIP,
    RewardScale,
    RewardScaleWrapper,
    Standardisation,
    compute_scale,
    compute_whitening,
    read_normalisation,
)

import torch  # isort: skip  # after ours, which say which extra is missing
from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm  # isort: skip
from stable_baselines3.common.save_util import load_from_zip_file  # isort: skip
from stable_baselines3.common.vec_env import VecEnv  # isort: skip

if TYPE_CHECKING:
    from .. import Agent
    from .gradient import TrainingSource

_SCALING_ENVS = 64  # environments whose observations make the scaling
_WARM_UP, _DURATION = 0.2, 4.0  # s: until every sensor has spoken, and of the whole drive
_CORRELATION_TIME = 0.2  # s, in which random actions fade to 1/e
_UNIFORM_LOG_STD = -0.55  # log(1 / sqrt(3)), of actions drawn uniformly from [-1, 1]


class _ZipTensors(NamedTuple):
    """The tensors of a zip of stable-baselines3 with which a model begins."""

    file: Path
    parameters: dict[str, Any]  # as of `get_parameters`
    variables: dict[str, Any]  # tensors of no module
    scaling: Standardisation  # of the model's observations

    def load(self, model: BaseAlgorithm) -> None:
        """Load the tensors into a model; ValueError where it has other ones."""
        before = model.get_parameters()
        # a zip from elsewhere has its extractor outside
        inner = {name: x for name, x in before["policy"].items() if "features_extractor." in name}
        policy = {"policy": inner | self.parameters["policy"]}
        try:
            model.set_parameters(before | self.parameters | policy, device=model.device)
            for name, tensor in self.variables.items():
                getattr(model, name).data.copy_(tensor)
        except (AttributeError, KeyError, RuntimeError, ValueError) as error:
            text = f"{self.file} holds other networks than this training's {type(model).__name__}"
            reason = " ".join(str(error).split())[:300]
            raise ValueError(f"{text} (its settings say which): {reason}") from error


def _read_zip(file: Path, task: TrainingTask, trust: bool) -> _ZipTensors:
    """Read a zip without running code from it; ValueError where it cannot be read."""
    try:
        _, loaded, variables = load_from_zip_file(file, load_data=False, device="cpu")
        parameters = dict[str, Any](loaded)
        policy = parameters["policy"]
    except Exception as error:  # torch raises many for one that is cut short
        raise ValueError(f"{file} cannot be read: {' '.join(str(error).split())}") from error
    inner = [name for name in policy if "features_extractor." in name]
    buffers = {name.rpartition(".")[2]: policy[name].tolist() for name in inner}
    if buffers.keys() >= {"mean", "scale", "clip"}:  # every network of the policy has the same
        clip = buffers["clip"] if buffers["clip"] < math.inf else None
        scaling = Standardisation(buffers["mean"], buffers["scale"], clip, buffers.get("mixing"))
    else:
        layout = get_layout(task.vector_env(1))
        mean, scale, clip = read_normalisation(load_normaliser(file, trust), len(layout), 1)
        with ZipFile(file) as archive:
            space = json.loads(archive.read("data")).get("observation_space", {})
        # as JSON has the space of a `ScaledVecEnv`
        is_scaled = space.get("low") == str(make_space(scale_layout(layout)).low)
        scales = get_scales(layout) if is_scaled else np.ones(len(layout))
        scaling = Standardisation((mean * scales).tolist(), (scale / scales).tolist(), clip)
    return _ZipTensors(file, parameters, variables or {}, scaling)


def _check_policy(policy: Policy, task: TrainingTask) -> None:
    """Check that a task's entries, action and form are an initial policy's; else ValueError."""
    entries, env = [name for name, _ in policy.card.observation], task.vector_env(1)
    names = [entry.name for entry in get_layout(env)]
    if entries != names:
        known, here = ", ".join(entries), ", ".join(names)
        raise ValueError(f"{policy.name} reads {known}; here there is {here}")
    if env.single_action_space.shape != (policy.network.width,):
        text = f"{policy.name} gives {policy.network.width} numbers"
        raise ValueError(f"{text}, the env's action is of {env.single_action_space}")
    form, kwargs = get_policy_form(policy, task.algo), task.settings.get("policy_kwargs", {})
    if kwargs != kwargs | form:
        text = f"{policy.name} is a network of {form}"
        raise ValueError(f"{text}, and the settings say {kwargs}")


@dataclass
class Trainer:
    """A training in a folder.

    A resumed training has weights, optimisers, step size, steps and evaluations of the checkpoint,
    and new episodes. A replay buffer starts empty and fills by `learning_starts` steps of random
    actions before weights change. Raises ValueError for another training's folder or arguments that
    contradict each other, ModuleNotFoundError for a log without TensorBoard.
    """

    task: TrainingTask
    steps: int  # rounded up to whole rollouts
    folder: str | Path
    resume: bool = False  # whether to resume from the folder's checkpoint
    run_options: RunOptions = field(default_factory=RunOptions)
    # zip of stable-baselines3 with the first weights; or, for `ppo` and `gradient`, a `Policy`
    # or its name, whose costs weigh the drives
    initial: str | Path | Policy | None = None
    trust: bool = False  # whether a pickle of VecNormalize beside the zip may be read

    def __post_init__(self) -> None:
        agent, self._folder = self.initial, Path(self.folder)
        if self.steps < 1:
            raise ValueError(f"steps is at least 1, got {self.steps}")
        if agent is not None and self.resume:
            raise ValueError("a training that goes on from its checkpoint begins with nothing else")
        if agent is not None and self.task.reads:
            raise ValueError("a network reads what it was trained on: give reads or a network")
        if isinstance(agent, str | Path):
            if is_policy(str(agent)):
                self.initial = load_policy(agent)
            else:
                check_zip(Path(agent))
        if self.run_options.tensorboard_log and find_spec("tensorboard") is None:
            raise ModuleNotFoundError("a log for tensorboard needs it: pip install tensorboard")
        torch.set_num_threads(1)  # on small matrices threads only wait for each other
        self._checkpoint: Checkpoint | None = None
        if self.resume:
            self._checkpoint = read_training(self._folder, **asdict(self.task))
            self.initial = self._checkpoint.load_initial(self._folder)
        elif (self._folder / CHECKPOINT).exists():
            text = f"{self._folder} holds a training already: go on with it (resume), or"
            raise ValueError(f"{text} take another folder")
        else:
            self._folder.mkdir(parents=True, exist_ok=True)

    def train(self) -> EvalCallback:
        """Train up to the number of steps; the callback has the model and its evaluations."""
        callback, file = self.build(), self._folder / INITIAL_FILE
        policy, model = callback.initial, callback.model
        if self._checkpoint is None:
            file.unlink(missing_ok=True)  # of one without a checkpoint
            if policy is not None:
                save_policy(file, policy.network, policy.card)
        done = model.num_timesteps
        if done < self.steps:
            log = dict[str, Any](reset_num_timesteps=done == 0, tb_log_name=self.task.algo)
            try:
                model.learn(self.steps - done, callback=callback, **log)
                callback.evaluate()
            except ValueError:  # torch's, of a distribution that is none, or the env's, of actions
                callback.check()
                raise
        return callback

    def build(self) -> EvalCallback:
        """Build the callback with its model, new or from a checkpoint, a zip or a policy."""
        task, run, initial, checkpoint = self.task, self.run_options, self.initial, self._checkpoint
        policy, tensors = None, None
        if isinstance(initial, Policy):
            policy = initial
            _check_policy(policy, task)
        elif initial is not None:
            tensors = _read_zip(Path(initial), task, self.trust)
        callback = EvalCallback(task, self._folder, run, self.steps, policy, checkpoint)
        steps = checkpoint.steps if checkpoint else 0
        if checkpoint:
            callback.scaling = Standardisation(*checkpoint.scaling)
        elif policy:
            mean, scale = policy.network.mean.tolist(), policy.network.scale.tolist()
            callback.scaling = Standardisation(mean, scale, policy.network.clip)
        else:
            callback.scaling = tensors.scaling if tensors else _measure_scaling(task)
        options = dict[str, Any](env_kwargs=task.options(task.num_envs), scaled=False)
        env = make_vec_env(task.env_id, task.num_envs, None, task.estimator_kwargs, **options)
        first, period = task.first_seed + steps, callback.period
        if policy:
            n_steps = -(-(self.steps - steps) // env.num_envs)
            scales = _measure_reward_scale(policy.network, env, first, n_steps)
        else:
            scales = (np.resize(callback.weights, env.num_envs) / period)[:, None].tolist()
        scaled_env = RewardScaleWrapper(env, RewardScale(scales))
        seed = (task.seed + steps) % 2**32
        further = dict[str, Any](device=run.device, tensorboard_log=run.tensorboard_log, seed=seed)
        if task.algorithm.on_tensors:
            further["source"] = partial(_make_source, task, first, scaled_env.reward_scale)
        model = task.make_model(scaled_env, period, callback.scaling, **further)
        callback.init_callback(model)
        if checkpoint:
            callback.load_parameters(checkpoint.groups)
            if isinstance(model, OffPolicyAlgorithm):
                model.learning_starts += steps  # its buffer begins empty
        elif policy:
            load_network(model.policy, policy.network)
        elif tensors:
            tensors.load(model)
        model.num_timesteps = steps
        env.seed(first)
        return callback


def _make_source(
    task: TrainingTask, first: int, reward_scale: RewardScale, device: Any, compile: bool
) -> "TrainingSource":
    """Make a task's environments on tensors, whose rows have seeds from the first one on."""
    from ...envs.device import make_device_env
    from .gradient import TrainingSource

    options = dict[str, Any](device=device, dtype="float32", grad=True, compile=compile)
    options |= {"autoreset_mode": "SameStep", **task.options(task.num_envs)}
    cars = make_device_env(task.env_id, task.num_envs, **options)
    return TrainingSource(cars, [first + i for i in range(task.num_envs)], reward_scale)


def _measure_scaling(task: TrainingTask) -> Standardisation:
    """Measure each entry's scaling under random actions; for gradients it whitens them, too."""
    kwargs, env = task.settings.get("policy_kwargs", {}), task.vector_env(_SCALING_ENVS)
    spread = math.exp(kwargs.get("log_std_init", _UNIFORM_LOG_STD))
    names = [entry.name for entry in get_layout(env)]  # nominal cars may differ
    unknown = [name for name in task.reads if name not in names]
    if unknown:
        lacking, available = ", ".join(unknown), ", ".join(names)
        raise ValueError(f"the observation has no {lacking} to read; it has {available}")
    samples = _collect_observations(env, spread, task.scaling_seed)
    scale = compute_scale(samples.std(axis=0))
    if task.reads:
        scale[~np.isin(names, task.reads)] = 0.0
    if not scale.any():
        raise ValueError(f"nothing of what the network reads varies within {_DURATION:g} s")
    mean, mixing = samples.mean(axis=0), None
    if task.algorithm.on_tensors:
        correlated = _collect_observations(env, spread, task.scaling_seed, _CORRELATION_TIME)
        standard = np.clip((correlated - mean) * scale, -CLIP, CLIP)
        mixing = compute_whitening(standard).tolist()
    return Standardisation(mean.tolist(), scale.tolist(), CLIP, mixing)


def _collect_observations(
    env: CarVectorEnv, spread: float, seed: int, correlation_time: float = 0.0
) -> Array:
    """Collect observations (n, k) under noise that fades to 1/e in a time (s)."""
    base: Any = env.unwrapped
    period = base.control_period * base.dt
    decay = math.exp(-period / correlation_time) if correlation_time else 0.0
    rng, observations, noise = np.random.default_rng(seed), [], np.zeros(base.action_space.shape)
    env.reset(seed=seed)
    for step in range(round(_DURATION / period)):
        noise = decay * noise + (1.0 - decay**2) ** 0.5 * rng.standard_normal(noise.shape)
        obs, *_ = env.step((spread * noise).astype(np.float32))
        if step >= round(_WARM_UP / period):
            observations.append(obs)
    return np.concatenate(observations).astype(np.float64)


def _measure_reward_scale(agent: "Agent", env: VecEnv, seed: int, steps: int) -> list[list[float]]:
    """Measure the factors with which an agent's mean reward is -1, for each drive of each car."""
    # seed: of car 0; steps: of each car. Their median stands behind a car's factors, for the rest.
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
    for car_scales, open_scale in zip(scales, lengths / (costs + COST_FLOOR), strict=True):
        car_scales.append(float(np.median(car_scales or [open_scale])))
    return scales
