"""Training of a policy in a folder: rollouts on the batch engine, evaluations, a checkpoint.

The folder holds `checkpoint.safetensors`, `policy.safetensors` (the best evaluation's network with
its card), `best_model.zip` (the same model in stable-baselines3's format), `curve.jsonl` (the
evaluations), and `begun_with.safetensors` where it started from a policy.
"""

import math
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ... import __version__
from ...envs.io import from_json
from ...envs.record import Array
from ..env_info import CarVectorEnv, get_layout
from ..learned.policy import Policy, check_names_no_code, is_policy, load_policy, save_policy
from ..rollout import COST_FLOOR
from ..vec_env import make_vec_env
from .callbacks import (
    CHECKPOINT,
    WARM_START_FILE,
    Checkpoint,
    EvalCallback,
    Evaluation,
    RunOptions,
    RunRecord,
    read_state,
)
from .config import TrainingTask
from .export import check_zip
from .normalise import CLIP, RewardScale, RewardScaleWrapper, StandardisedArguments
from .student import compute_whitening
from .warm_start import WarmStart

import torch  # isort: skip  # after ours, which say which extra is missing
from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.logger import KVWriter  # isort: skip
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm  # isort: skip
from stable_baselines3.common.vec_env import VecEnv  # isort: skip

if TYPE_CHECKING:
    from .. import Agent
    from .gradient import TrainingSource

_SCALING_ENVS = 64  # environments whose observations make the scaling
_WARM_UP, _DURATION = 0.2, 4.0  # s: until every sensor has spoken, and of the whole drive
_CORRELATION_TIME = 0.2  # s, in which random actions fade to 1/e
_MIN_VARIANCE = 1e-3  # least variance of a mixture of standardised entries
_CONSTANT = 1e-9  # standard deviation, in an entry's unit, up to which it is not read
_UNIFORM_LOG_STD = -0.55  # log(1 / sqrt(3)), of actions drawn uniformly from [-1, 1]


class TrainResult(NamedTuple):
    """The last model, and all evaluations."""

    model: BaseAlgorithm
    evaluations: tuple[Evaluation, ...]

    @property
    def best(self) -> Evaluation:
        """Evaluation whose model is saved."""
        return min(self.evaluations, key=lambda evaluation: evaluation.criterion)


class SavedTraining(NamedTuple):
    """A training as its folder has it."""

    folder: Path
    task: TrainingTask
    record: RunRecord
    state: Checkpoint  # of its checkpoint

    def load_initial_policy(self) -> Policy | None:
        """Load the policy that it started from, under its own name; None for another training."""
        name, file = self.record.begun_with, self.folder / WARM_START_FILE
        if not name:
            return None
        if not file.is_file():
            raise FileNotFoundError(f"{file}: the training began with policy {name}, and needs it")
        return replace(load_policy(file), name=name)


def read_training(folder: str | Path, **arguments: Any) -> SavedTraining:
    """Read a folder's training from its checkpoint.

    Args:
        folder: Folder of the training.
        **arguments: Fields of the task that must agree with it.

    Raises:
        FileNotFoundError: There is no checkpoint.
        ValueError: A field differs, or the checkpoint is of another version.
    """
    path = Path(folder) / CHECKPOINT
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no training to go on with: no {CHECKPOINT}")
    state = read_state(path)
    saved, version = state["task"], state["sideslip"]
    if version != __version__:
        text = f"{path} was made by sideslip {version}, this is {__version__}, whose cars and costs"
        raise ValueError(f"{text} may be others: train anew, in another folder")
    names = [item.name for item in fields(TrainingTask)]  # a default for none of them
    missing = [name for name in names if not isinstance(saved, dict) or name not in saved]
    if missing:
        raise ValueError(f"{path}: the checkpoint's task lacks {', '.join(missing)}")
    task = from_json(TrainingTask, saved, f"{path}: the task")
    try:
        check_names_no_code(task.env_id, task.estimator, task.estimator_options)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    for name, value in arguments.items():
        if value != getattr(task, name):
            text = f"{path} is of {name} {getattr(task, name)!r}, not {value!r}"
            raise ValueError(f"{text}: train that in another folder")
    record = from_json(RunRecord, state["aim"], f"{path}: the aim")
    return SavedTraining(Path(folder), task, record, state)


@dataclass
class Trainer:
    """A training in a folder.

    A resumed training has weights, optimisers, step size, steps and evaluations of the checkpoint,
    and new episodes. A replay buffer starts empty and fills by `learning_starts` steps of random
    actions before weights change.

    Raises:
        ValueError: The folder holds another training, or arguments contradict each other.
        ModuleNotFoundError: TensorBoard or Weights & Biases is not installed.
    """

    task: TrainingTask
    steps: int  # rounded up to whole rollouts
    folder: str | Path
    resume: bool = False  # whether to resume from the folder's checkpoint
    run_options: RunOptions = field(default_factory=RunOptions)
    # zip of stable-baselines3 with the first weights; or, for `ppo` and `gradient`, a `Policy` or
    # its name, whose costs weigh the drives
    trained_agent: str | Path | Policy | None = None
    trust: bool = False  # whether a pickle of VecNormalize beside the zip may be read

    def __post_init__(self) -> None:
        agent, self._folder = self.trained_agent, Path(self.folder)
        if self.steps < 1:
            raise ValueError(f"steps is at least 1, got {self.steps}")
        if agent is not None and self.resume:
            raise ValueError("a training that goes on from its checkpoint begins with nothing else")
        if agent is not None and self.task.reads:
            raise ValueError("a network reads what it was trained on: give reads or a network")
        if agent is not None and not isinstance(agent, Policy):
            if is_policy(str(agent)):
                self.trained_agent = load_policy(agent)
            else:
                check_zip(Path(agent))
        if self.run_options.tensorboard_log is not None and find_spec("tensorboard") is None:
            raise ModuleNotFoundError("a log for TensorBoard needs it: pip install tensorboard")
        try:
            self._wandb: Any = import_module("wandb") if self.run_options.track else None
        except ImportError:
            raise ModuleNotFoundError("tracking needs wandb: pip install wandb") from None
        torch.set_num_threads(1)  # on small matrices threads only wait for each other
        self._state: Checkpoint | None = None
        if self.resume:
            saved = read_training(self._folder, **asdict(self.task))
            self._state, self.trained_agent = saved.state, saved.load_initial_policy()
        elif (self._folder / CHECKPOINT).exists():
            text = f"{self._folder} holds a training already: go on with it (resume), or"
            raise ValueError(f"{text} take another folder")
        else:
            self._folder.mkdir(parents=True, exist_ok=True)

    def train(self) -> TrainResult:
        """Train up to the number of steps; the model and its evaluations."""
        callback, file = self.build(), self._folder / WARM_START_FILE
        policy, model, run = callback.policy, callback.model, None
        if self._state is None:
            file.unlink(missing_ok=True)  # of one without a checkpoint
            if policy is not None:
                save_policy(file, policy.network, policy.card)
        done = model.num_timesteps
        if done < self.steps:
            log = dict[str, Any](reset_num_timesteps=done == 0, tb_log_name=self.task.algo)
            if self._wandb is not None:
                project, config = self.run_options.track, asdict(self.task)
                run = self._wandb.init(project=project, name=self._folder.name, config=config)
                callback.writers.append(_RunWriter(run))
            try:
                model.learn(self.steps - done, callback=callback, **log)
                callback.evaluate()
            except ValueError:  # torch's, of a distribution that is none, or the env's, of actions
                callback.check()
                raise
            finally:
                if run is not None:
                    run.finish()
        return TrainResult(model, tuple(callback.evaluations))

    def build(self) -> EvalCallback:
        """Build the callback with its model, new or from a checkpoint, a zip or a policy."""
        task, agent, state = self.task, self.trained_agent, self._state
        start = None if agent is None else WarmStart(agent, task, self.trust)
        callback = EvalCallback(task, self._folder, self.run_options, self.steps, start, state)
        steps = int(state["steps"]) if state else 0
        if state and state["scaling"] is not None:
            callback.scaling = StandardisedArguments(*state["scaling"])
        else:
            callback.scaling = start.scaling if start and not state else _measure_scaling(task)
        options = dict[str, Any](wrapper_class=start.wrap_env if start else None, scaled=False)
        options |= {"estimator": task.estimator_kwargs, "env_kwargs": task.options(task.num_envs)}
        env = make_vec_env(task.env_id, task.num_envs, **options)
        first, period = task.first_seed + steps, callback.period
        if start and start.driver:
            n_steps = -(-(self.steps - steps) // env.num_envs)
            scales = _measure_reward_scale(start.driver, env, first, n_steps)
        else:
            scales = (np.resize(callback.weights, env.num_envs) / period)[:, None].tolist()
        scaled_env = RewardScaleWrapper(env, RewardScale(scales))
        run, seed = self.run_options, (task.seed + steps) % 2**32
        further = dict[str, Any](device=run.device, tensorboard_log=run.tensorboard_log, seed=seed)
        if task.algorithm.on_tensors:
            further["source"] = partial(_make_source, task, first, scaled_env.reward_scale)
        model = task.make_model(scaled_env, period, callback.scaling, **further)
        callback.init_callback(model)
        if state:
            callback.load_parameters()
            if isinstance(model, OffPolicyAlgorithm):
                model.learning_starts += steps  # its buffer begins empty
        elif start:
            start.load(model)
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


def _measure_scaling(task: TrainingTask) -> StandardisedArguments:
    """Measure each entry's scaling under random actions; for gradients it whitens them, too."""
    kwargs, env = task.settings.get("policy_kwargs", {}), task.vector_env(_SCALING_ENVS)
    spread = math.exp(kwargs.get("log_std_init", _UNIFORM_LOG_STD))
    names = [entry.name for entry in get_layout(env)]  # nominal cars may differ
    unknown = [name for name in task.reads if name not in names]
    if unknown:
        lacking, available = ", ".join(unknown), ", ".join(names)
        raise ValueError(f"the observation has no {lacking} to read; it has {available}")
    samples = _collect_observations(env, spread, task.scaling_seed)
    deviation = samples.std(axis=0)
    varies = deviation > _CONSTANT
    if task.reads:
        varies &= np.isin(names, task.reads)
    if not varies.any():
        raise ValueError(f"nothing of what the network reads varies within {_DURATION:g} s")
    scale = np.where(varies, 1.0 / np.where(varies, deviation, 1.0), 0.0)
    mean, mixing = samples.mean(axis=0), None
    if task.algorithm.on_tensors:
        correlated = _collect_observations(env, spread, task.scaling_seed, _CORRELATION_TIME)
        standard = np.clip((correlated - mean) * scale, -CLIP, CLIP)
        mixing = compute_whitening(standard, _MIN_VARIANCE).tolist()
    return StandardisedArguments(mean.tolist(), scale.tolist(), CLIP, mixing)


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


class _RunWriter(KVWriter):
    """Writes the log of stable-baselines3 to a run of Weights & Biases."""

    def __init__(self, run: Any) -> None:
        self._run = run

    def write(self, key_values: dict[str, object], key_excluded: object, step: int = 0) -> None:
        self._run.log(dict(key_values), step=step)  # the logger empties its own

    def close(self) -> None:
        """Do nothing: the last evaluation comes after the training's end."""
