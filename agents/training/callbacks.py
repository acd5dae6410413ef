"""The callback of a training: evaluations on other seeds, the best policy, a checkpoint.

The score compares logarithms of costs, and d log J = dJ / J. So the scenarios of a mixture are
weighted by 1 over the uncontrolled car's cost, but at least 5 % of its mean over the scenarios.
Where a training starts from a policy, each drive is weighted by 1 over that policy's cost in it.

Args:
    task: Task of the training; of a mixture the zoo's `enjoy` drives the first scenario.
    folder: Folder of the training.
    steps: Steps of the whole training.
    eval_freq: Steps between two evaluations.
    logs: Folder of all trainings.
"""

import glob
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ... import __version__
from ...envs.io import atomic_file, from_json, write_atomic
from ...envs.numerics import require_extra
from ...envs.record import Array
from ..learned.policy import Card, Policy, check_names_no_code, load_policy, save_policy
from ..rollout import compute_cost_ratios, evaluate_episodes
from ..vec_env import make_native_env
from .config import TrainingTask
from .export import convert_sb3_policy
from .normalise import Standardisation

with require_extra("train", "training needs {}"):
    import torch
    import yaml
    from safetensors import SafetensorError, safe_open
    from safetensors.torch import load_file, save
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.utils import get_device, get_latest_run_id

CHECKPOINT, CURVE = "checkpoint.safetensors", "curve.jsonl"
POLICY, BEST, INITIAL_FILE = "policy.safetensors", "best_model.zip", "begun_with.safetensors"
EVALUATIONS = "evaluations.npz"  # in a folder of rl-baselines3-zoo
_ZOO_WRAPPER = "sideslip.estimators.EstimateObservation"
_FORMAT = 3  # of a checkpoint
_VARIABLES = "variables"  # tensors of no module, such as the logarithm of an entropy's weight
_WEIGHT_DRIVES = 32  # uncontrolled drives by which a scenario is weighed
_MIN_COST_SHARE = 0.05  # of the scenarios' mean cost: a cheaper one counts as this in its weight
_WEIGHT_SEEDS, _EVALUATION_SEEDS = 2**63, 2**64  # `TrainingTask` has those of its drives


def _make_evaluation_seeds(episodes: int) -> list[int]:
    return [_EVALUATION_SEEDS + i for i in range(episodes)]


class Evaluation(NamedTuple):
    """An evaluation of the deterministic policy; in a mixture scenarios are weighed alike."""

    steps: int  # of the training so far
    cpu_seconds: float  # of the training so far, without evaluations
    cost: float  # mean cost J; of a mixture its scenarios' by `equal_weights`
    of_none: float  # `cost` over the uncontrolled car's on these seeds
    of_start: float | None = None  # geometric mean of costs over the initial policy's, if any

    @property
    def criterion(self) -> float:
        """Number whose minimum chooses the best evaluation."""
        return self.cost if self.of_start is None else self.of_start


@dataclass(frozen=True)
class RunOptions:
    """The options of a run, free to change later; ValueError: `eval_freq` < 1 or unknown device."""

    eval_freq: int = 250_000  # steps between two evaluations
    device: str = "cpu"  # torch's name of the device
    tensorboard_log: str | None = None  # folder for TensorBoard
    report: "Callable[[EvalCallback], None] | None" = None  # called after every rollout
    command: str = ""  # command line, for the policy's card

    def __post_init__(self) -> None:
        if self.eval_freq < 1:
            raise ValueError(f"eval_freq is at least 1, got {self.eval_freq}")
        try:
            device = get_device(self.device)  # the CPU where there is no CUDA
        except RuntimeError:
            known = "a device is cpu, cuda or another of torch's, or auto"
            raise ValueError(f"{known}, got {self.device!r}") from None
        if self.device.startswith("cuda") and device.type != "cuda":
            text = "torch finds no CUDA device, got"
            raise ValueError(f"{text} {self.device!r}; auto takes one if there is")


@dataclass(frozen=True)
class RunRecord:
    """The record of a run beside its task."""

    steps: int  # of the whole training
    eval_freq: int  # steps between two evaluations
    command: str = ""  # command line, for the policy's card
    begun_with: str = ""  # name of the initial policy, "" for none


@dataclass(frozen=True)
class Checkpoint:
    """The state of a training beside its tensors, which JSON can hold."""

    groups: dict[str, Any]  # `param_groups` of each optimiser
    sideslip: str  # version of the package
    task: TrainingTask
    steps: int  # so far
    aim: RunRecord
    scaling: list[Any]  # of the observations: `Standardisation`
    evaluations: list[Any]  # so far

    def load_initial(self, folder: str | Path) -> Policy | None:
        """Load the policy that it started from, under its own name; None for another training."""
        name, file = self.aim.begun_with, Path(folder) / INITIAL_FILE
        if not name:
            return None
        if not file.is_file():
            raise FileNotFoundError(f"{file}: the training began with policy {name}, and needs it")
        return replace(load_policy(file), name=name)


class EvalCallback(BaseCallback):
    """Evaluate the policy between rollouts, and save what a resumed training needs.

    Args:
        task: Task of the training.
        folder: Folder of the training.
        run_options: Options of this run.
        steps: Steps of the whole training.
        initial: Policy from which the training starts, whose costs weigh the drives.
        checkpoint: Checkpoint of a resumed training, None for a new one.
    """

    scaling: Standardisation  # of the model's observations, which `Trainer.build` sets

    def __init__(
        self, task: TrainingTask, folder: Path, run_options: RunOptions, steps: int,
        initial: Policy | None = None, checkpoint: Checkpoint | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self.task, self.folder, self.run_options, self.initial = task, folder, run_options, initial
        name, frequency = initial.name if initial else "", run_options.eval_freq
        self.run_record = RunRecord(steps, frequency, run_options.command, name)
        self.seeds = _make_evaluation_seeds(task.n_eval_envs)
        self.env = task.vector_env(task.n_eval_envs)
        base: Any = self.env.unwrapped
        self.period = float(base.control_period * base.dt)  # of control (s)
        rows = checkpoint.evaluations if checkpoint else []
        self.evaluations = [Evaluation(*row) for row in rows]
        uncontrolled = self._average_scenarios(evaluate_episodes(self.env, None, self.seeds)[0])
        if uncontrolled.mean() == 0.0:
            raise ValueError("the uncontrolled car costs nothing there: there is nothing to learn")
        self.equal_weights = _compute_equal_weights(uncontrolled)
        self.uncontrolled_cost = float(np.mean(uncontrolled * self.equal_weights))
        self.weights, self.initial_costs = np.ones(1), None
        if initial is None:
            self.weights = _compute_scenario_weights(task)
        else:
            self.initial_costs = evaluate_episodes(self.env, initial.network, self.seeds)[0]
        self.spent = self.evaluations[-1].cpu_seconds if self.evaluations else 0.0
        self.since = time.process_time()

    @property
    def best(self) -> Evaluation:
        """Evaluation whose model is saved."""
        return min(self.evaluations, key=lambda evaluation: evaluation.criterion)

    @property
    def cost(self) -> float | None:
        """Mean cost of the newest episodes with exploration; None before one ends."""
        rewards = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        return -float(np.mean(rewards)) if rewards else None

    def _average_scenarios(self, costs: Array) -> Array:
        """Average the costs of an evaluation by scenario, shape (k,)."""
        k = max(len(self.task.scenarios), 1)
        return np.array([costs[i::k].mean() for i in range(k)])

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.check()
        last = self.evaluations[-1].steps if self.evaluations else -self.run_options.eval_freq
        if self.model.num_timesteps - last >= self.run_options.eval_freq:
            self.evaluate()

    def _on_rollout_end(self) -> None:
        if self.run_options.report is not None:
            self.run_options.report(self)

    def check(self) -> None:
        """Check that the weights are finite; FloatingPointError otherwise."""
        if not all(bool(weights.isfinite().all()) for weights in self.model.policy.parameters()):
            text = f"{self.folder / CHECKPOINT} holds them as they were at the last evaluation"
            step = self.model.num_timesteps
            raise FloatingPointError(f"the weights are not finite after step {step}; {text}")

    def evaluate(self) -> None:
        """Evaluate the policy, and write the checkpoint and the best policy so far."""
        self.check()
        self.spent += time.process_time() - self.since
        costs, lengths = evaluate_episodes(self.env, self.model, self.seeds)
        cost, ratio = float(np.mean(self._average_scenarios(costs) * self.equal_weights)), None
        if self.initial_costs is not None:
            ratio = float(np.exp(np.log(compute_cost_ratios(costs, self.initial_costs)).mean()))
        spent, of_none = round(self.spent, 3), cost / self.uncontrolled_cost
        current = Evaluation(self.model.num_timesteps, spent, cost, of_none, ratio)
        if all(current.criterion < evaluation.criterion for evaluation in self.evaluations):
            self._save_best(current)
        self.evaluations.append(current)
        self.logger.record("eval/mean_reward", -cost)
        self.logger.dump(self.model.num_timesteps)
        self._save_checkpoint()
        lines = "".join(json.dumps(evaluation._asdict()) + "\n" for evaluation in self.evaluations)
        write_atomic(self.folder / CURVE, lines.encode())
        if (self.folder / _make_zoo_name(self.task.env_id)).is_dir():
            self._write_zoo_evaluation(costs, lengths)
        self.since = time.process_time()

    def _save_best(self, current: Evaluation) -> None:
        """Write the policy's file with its card, and the model's zip."""
        task, mixture = self.task, self.task.scenarios
        options = task.make_model_options(self.period)
        options |= {"num_envs": task.num_envs, "policy": task.settings["policy"]}
        options |= {"reads": task.reads} if task.reads else {}
        if self.initial is not None:
            before = self.initial.card.algorithm_options
            options |= {"begun_with": self.initial.name}
            options |= {"class": before["class"]} if "class" in before and mixture else {}
        options |= {"scenarios": mixture} if mixture else {}
        if mixture and self.initial is None:
            options |= {"weights": self.weights.round(3).tolist()}
        env_options = task.env_options | ({"scenario": mixture[0]} if mixture else {})
        card = Card.from_env_id(
            task.env_id, env_options, task.estimator, task.estimator_options,
            algorithm=task.algo, algorithm_options=options, command=self.run_options.command,
            seeds={"training": task.seed, "from": task.first_seed},
            steps=current.steps, cpu_seconds=current.cpu_seconds,
        )  # fmt: skip
        save_policy(self.folder / POLICY, convert_sb3_policy(self.model), card)
        with atomic_file(self.folder / BEST) as file:
            self.model.save(file)

    def _save_checkpoint(self) -> None:
        """Save the model's parameters and optimisers, and the rest of the training's state."""
        tensors, groups = dict[str, torch.Tensor](), dict[str, Any]()
        for part, state in self.model.get_parameters().items():
            if "param_groups" in state:  # an optimiser's
                groups[part] = state["param_groups"]
                for i, values in state["state"].items():
                    tensors |= {f"{part}/{i}/{key}": value for key, value in values.items()}
            else:
                tensors |= {f"{part}/{name}": value for name, value in state.items()}
        tensors |= {f"{_VARIABLES}/{k}": value for k, value in self._get_variables().items()}
        records = self.task, self.model.num_timesteps, self.run_record
        now = Checkpoint(groups, __version__, *records, list(self.scaling), self.evaluations)
        plain = {name: value.detach().cpu().clone() for name, value in tensors.items()}
        text = json.dumps({"format": _FORMAT} | asdict(now), allow_nan=False)
        write_atomic(self.folder / CHECKPOINT, save(plain, {"checkpoint": text}))

    def _write_zoo_evaluation(self, costs: Array, lengths: Array) -> None:
        """Write the last model, and the costs and lengths as stable-baselines3's `EvalCallback`."""
        # later evaluations in the file, of a training stopped before its checkpoint, are removed
        with atomic_file(self.folder / f"{_make_zoo_name(self.task.env_id)}.zip") as file:
            self.model.save(file)
        evaluation: dict[str, Any] = {"timesteps": np.array([self.model.num_timesteps])}
        evaluation |= {"results": -costs[None], "ep_lengths": lengths[None].astype(np.int64)}
        path = self.folder / EVALUATIONS
        if path.exists():
            with np.load(path, allow_pickle=False) as saved:
                before = saved["timesteps"] < self.model.num_timesteps
                for name, values in evaluation.items():
                    evaluation[name] = np.concatenate([saved[name][before], values])
        with atomic_file(path) as file:
            np.savez(file, **evaluation)

    def _get_variables(self) -> dict[str, torch.Tensor]:
        """Get the tensors that `get_parameters` leaves out, though a model's zip has them."""
        return {name: getattr(self.model, name) for name in self.model._get_torch_save_params()[1]}

    def load_parameters(self, groups: dict[str, Any]) -> None:
        """Load the parameters and optimisers of the folder's checkpoint into the model.

        Args:
            groups: `Checkpoint.groups`.
        """
        path, variables = self.folder / CHECKPOINT, self._get_variables()
        parts: dict[str, Any] = {part: {} for part in self.model.get_parameters()}
        parts |= {part: {"param_groups": group, "state": {}} for part, group in groups.items()}
        for name, tensor in load_file(path).items():
            part, key = name.split("/", 1)
            if part == _VARIABLES:
                variables[key].data.copy_(tensor)
            elif part in groups:
                i, key = key.split("/", 1)
                parts[part]["state"].setdefault(int(i), {})[key] = tensor
            else:
                parts[part][key] = tensor
        self.model.set_parameters(parts, device=self.model.device)


def read_training(folder: str | Path, **arguments: Any) -> Checkpoint:
    """Read the checkpoint of a folder's training; ValueError for another version.

    Args:
        folder: Folder of the training; FileNotFoundError without a checkpoint.
        **arguments: Fields of the task that must agree with it, else ValueError.
    """
    path = Path(folder) / CHECKPOINT
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no training to go on with: no {CHECKPOINT}")
    try:
        with safe_open(path, "pt") as file:
            state = json.loads((file.metadata() or {}).get("checkpoint", "null"))
    except SafetensorError as error:
        raise ValueError(f"{path} is no checkpoint, or is cut short: {error}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no checkpoint: its state is no JSON ({error})") from None
    if not isinstance(state, dict) or state.pop("format", 0) != _FORMAT:
        raise ValueError(f"{path} is no checkpoint of this format ({_FORMAT})")
    if (version := state.get("sideslip", __version__)) != __version__:
        text = f"{path} was made by sideslip {version}, this is {__version__}"
        raise ValueError(f"{text}, whose cars and costs may be others: train anew, elsewhere")
    checkpoint = from_json(Checkpoint, state, f"{path}: the checkpoint")
    task = checkpoint.task
    try:
        check_names_no_code(task.env_id, task.estimator, task.estimator_options)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    for name, value in arguments.items():
        if value != getattr(task, name):
            text = f"{path} is of {name} {getattr(task, name)!r}, not {value!r}"
            raise ValueError(f"{text}: train that in another folder")
    return checkpoint


def _compute_equal_weights(costs: Array) -> Array:
    """Compute weights (k,) by 1 over scenarios' mean costs (k,), or over 5 % of their mean."""
    return np.asarray(costs.mean() / np.maximum(costs, _MIN_COST_SHARE * costs.mean()))


def _compute_scenario_weights(task: TrainingTask, first: int = _WEIGHT_SEEDS) -> Array:
    """Compute scenarios' weights by uncontrolled costs of a period; without a mixture 1, (1,)."""
    k = len(task.scenarios)
    if not k:
        return np.ones(1)
    rows = _WEIGHT_DRIVES * k
    env = make_native_env(task.env_id, rows, None, task.options(rows))
    costs, steps = evaluate_episodes(env, None, range(first, first + rows))
    rates = [costs[i::k].sum() / steps[i::k].sum() for i in range(k)]
    return _compute_equal_weights(np.array(rates))


def _make_zoo_name(env_id: str) -> str:
    """Make the name of an env's files in rl-baselines3-zoo: a dash stands for the slash."""
    return env_id.replace("/", "-")


def find_zoo_folder(logs: Path, task: TrainingTask) -> Path:
    """Find the next folder LOGS/ALGO/ENV_N in which the `enjoy` of rl-baselines3-zoo looks.

    It will hold `best_model.zip`, `ENV.zip` (the last model), `evaluations.npz` and `ENV/`, which
    `describe_for_zoo` makes.
    """
    folder, name = logs / task.algorithm.zoo, _make_zoo_name(task.env_id)
    return folder / f"{name}_{get_latest_run_id(glob.escape(str(folder)), name) + 1}"


def describe_for_zoo(task: TrainingTask, folder: Path, steps: int, eval_freq: int) -> None:
    """Make a training's folder with the files that the zoo's `enjoy` reads before a model."""
    first = {"scenario": task.scenarios[0]} if task.scenarios else {}
    arguments = {
        "algo": task.algorithm.zoo, "env": task.env_id, "env_kwargs": task.env_options | first,
        "eval_freq": eval_freq, "n_eval_envs": task.n_eval_envs, "n_timesteps": steps,
        "seed": task.seed,
    }  # fmt: skip
    # the model has the scales: `enjoy` shall look for no VecNormalize
    config = task.settings | {"n_envs": task.num_envs, "normalize": False}
    if task.estimator_kwargs is not None:
        config["env_wrapper"] = [{_ZOO_WRAPPER: task.estimator_kwargs}]
    place = folder / _make_zoo_name(task.env_id)
    place.mkdir(parents=True)
    for file_name, content in (("config.yml", config), ("args.yml", arguments)):
        write_atomic(place / file_name, yaml.safe_dump(content).encode())
