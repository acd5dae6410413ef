"""Training of a policy: rollouts on the batch engine, evaluations on other seeds, a checkpoint.

A training's folder holds `checkpoint.safetensors` (for `resume`), `policy.safetensors` (the
network of the best evaluation, with its card), `best_model.zip` (the same model in
stable-baselines3's format), `curve.jsonl` (the evaluations), and `begun_with.safetensors` where it
started from a policy.
"""

from dataclasses import asdict, fields, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from ... import __version__
from ...envs.io import from_json
from ..learned.policy import Policy, check_names_no_code, is_policy, load_policy, save_policy
from .callbacks import (
    BEST,
    CHECKPOINT,
    CURVE,
    POLICY,
    WARM_START_FILE,
    Checkpoint,
    EvalCallback,
    Evaluation,
    Progress,
    RunOptions,
    RunRecord,
    read_state,
)
from .config import TrainingTask
from .export import check_zip

import torch  # isort: skip  # after ours, which say which extra is missing
from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.callbacks import BaseCallback  # isort: skip
from stable_baselines3.common.logger import KVWriter  # isort: skip

__all__ = [
    "BEST", "CHECKPOINT", "CURVE", "POLICY", "EvalCallback", "Progress", "RunOptions", "RunRecord",
    "TrainResult", "TrainingTask", "read_task", "train",
]  # fmt: skip


class TrainResult(NamedTuple):
    """The last model, and all evaluations."""

    model: BaseAlgorithm
    evaluations: tuple[Evaluation, ...]

    @property
    def best(self) -> Evaluation:
        """Evaluation whose model is saved."""
        return min(self.evaluations, key=lambda evaluation: evaluation.criterion)


def train(
    task: TrainingTask,
    steps: int,
    folder: str | Path,
    resume: bool = False,
    run_options: RunOptions | None = None,
    trained_agent: str | Path | Policy | None = None,
    trust: bool = False,
) -> TrainResult:
    """Train up to a number of steps in a folder.

    A resumed training has weights, optimisers, step size, steps and evaluations of the checkpoint,
    and new episodes. A replay buffer starts empty and fills by `learning_starts` steps of random
    actions before weights change.

    Args:
        task: Task of the training.
        steps: Number of steps, rounded up to whole rollouts.
        folder: Folder of the training.
        resume: Whether to resume from the folder's checkpoint.
        run_options: Options of this run.
        trained_agent: Zip of stable-baselines3 with the first weights; or, for `ppo` and
            `gradient`, a `Policy` or its name, whose costs weigh the drives.
        trust: Whether a pickle of VecNormalize beside the zip may be read.

    Returns:
        Model and its evaluations.

    Raises:
        ValueError: The folder holds another training, or arguments contradict each other.
        ModuleNotFoundError: TensorBoard or Weights & Biases is not installed.
    """
    chosen_options = run_options or RunOptions()
    if steps < 1:
        raise ValueError(f"steps is at least 1, got {steps}")
    if trained_agent is not None:
        if resume:
            raise ValueError("a training that goes on from its checkpoint begins with nothing else")
        if task.reads:
            raise ValueError("a network reads what it was trained on: give reads or a network")
        if not isinstance(trained_agent, Policy) and is_policy(str(trained_agent)):
            trained_agent = load_policy(trained_agent)
        elif not isinstance(trained_agent, Policy):
            check_zip(Path(trained_agent))
    if chosen_options.tensorboard_log is not None and find_spec("tensorboard") is None:
        raise ModuleNotFoundError("a log for TensorBoard needs it: pip install tensorboard")
    tracker = None
    if chosen_options.track:
        project, name = chosen_options.track, Path(folder).name
        tracker = _WandbCallback(project=project, name=name, config=asdict(task))
    torch.set_num_threads(1)  # on small matrices threads only wait for each other
    folder_path = Path(folder)
    checkpoint = _prepare_folder(task, folder_path, resume)
    initial_policy = _resolve_initial_policy(folder_path, resume, trained_agent)
    zip_path = None if isinstance(trained_agent, Policy) else trained_agent
    callback = EvalCallback(task, folder_path, checkpoint, chosen_options, steps, initial_policy)
    callbacks: list[BaseCallback] = [callback] if tracker is None else [tracker, callback]
    model = callback.build(zip_path, trust)
    done = model.num_timesteps
    if done < steps:
        log = dict[str, Any](reset_num_timesteps=done == 0, tb_log_name=task.algo)
        try:
            model.learn(steps - done, callback=callbacks, **log)
            callback.evaluate()
        except ValueError:  # torch's, of a distribution that is none, or the env's, of actions
            callback.check()
            raise
        finally:
            if tracker is not None:
                tracker.finish()
    return TrainResult(model, tuple(callback.evaluations))


def load_initial_policy(folder: str | Path) -> Policy | None:
    """Load the policy that a folder's training started from, None for another training.

    Args:
        folder: Folder of the training.

    Returns:
        Policy under its own name.

    Raises:
        FileNotFoundError: The copy of the policy is missing.
    """
    name, file = read_run_record(folder).begun_with, Path(folder) / WARM_START_FILE
    if not name:
        return None
    if not file.is_file():
        raise FileNotFoundError(f"{file}: the training began with policy {name}, and needs it")
    return replace(load_policy(file), name=name)


def _resolve_initial_policy(folder: Path, resume: bool, agent: Any) -> Policy | None:
    """Resolve the policy that a training starts from, and save a copy in the folder."""
    if resume:
        return load_initial_policy(folder)
    if not isinstance(agent, Policy):
        (folder / WARM_START_FILE).unlink(missing_ok=True)  # of one that had no evaluation yet
        return None
    save_policy(folder / WARM_START_FILE, agent.network, agent.card)
    return agent


def read_run_record(folder: str | Path) -> RunRecord:
    """Read the run's record from a folder's checkpoint.

    Args:
        folder: Folder of the training.

    Returns:
        Record of the run.
    """
    read_task(folder)
    path = Path(folder) / CHECKPOINT
    return from_json(RunRecord, read_state(path)["aim"], f"{path}: the aim")


class _WandbCallback(BaseCallback, KVWriter):
    """Write the log of stable-baselines3 to a run of Weights & Biases."""

    def __init__(self, **run_arguments: object) -> None:
        super().__init__()
        try:
            self._wandb: Any = import_module("wandb")
        except ImportError:
            raise ModuleNotFoundError("tracking needs wandb: pip install wandb") from None
        self._run_arguments = run_arguments
        self._run: Any = None

    def _on_training_start(self) -> None:
        self._run = self._wandb.init(**self._run_arguments)
        self.logger.output_formats.append(self)

    def _on_step(self) -> bool:
        return True

    def write(self, key_values: dict[str, object], key_excluded: object, step: int = 0) -> None:
        self._run.log(dict(key_values), step=step)  # the logger empties its own

    def close(self) -> None:
        """Do nothing: the last evaluation comes after the training's end."""

    def finish(self) -> None:
        if self._run is not None:
            self._run.finish()


def read_task(folder: str | Path, **arguments: Any) -> TrainingTask:
    """Read the task of a folder's checkpoint.

    Args:
        folder: Folder of the training.
        arguments: Fields of the task that must agree with it.

    Returns:
        The task.

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
        raise ValueError(
            f"{path} was made by sideslip {version}, this is {__version__}, whose cars and costs "
            "may be others: train anew, in another folder"
        )
    names = [task_field.name for task_field in fields(TrainingTask)]  # a default for none of them
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
            raise ValueError(
                f"{path} is of {name} {getattr(task, name)!r}, not {value!r}: train that in "
                "another folder"
            )
    return task


def _prepare_folder(task: TrainingTask, folder: Path, resume: bool) -> Checkpoint | None:
    """Return the checkpoint's state, or prepare the folder of a new training and return None."""
    if resume:
        read_task(folder, **asdict(task))
        return read_state(folder / CHECKPOINT)
    if (folder / CHECKPOINT).exists():
        raise ValueError(
            f"{folder} holds a training already: go on with it (resume), or take another folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    return None
