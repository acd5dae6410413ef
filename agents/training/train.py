"""Training of a policy: rollouts on the batch engine, evaluations on other seeds, a checkpoint.

A training's folder holds `checkpoint.safetensors` (all that `resume` needs), `policy.safetensors`
(the network of the best evaluation, with its card), `best.zip` (the same model in
stable-baselines3's format) and `curve.jsonl` (the evaluations).
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ... import __version__
from ...envs.backend.files import whole, write_whole
from ..controllers.base import NoControl
from ..learned.card import Card
from ..learned.files import save_policy
from ..rollout import costs_of
from ..vec_env.env import make_vec_env
from .algorithms import algorithm_of
from .checkpoint import load_parameters, read_state, save_checkpoint
from .export import network_from_sb3
from .normalise import PerSecond, measured
from .task import Task as Task

import torch  # isort: skip  # after ours, which say which extra is missing
from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.callbacks import BaseCallback  # isort: skip

CHECKPOINT, CURVE = "checkpoint.safetensors", "curve.jsonl"
POLICY, BEST = "policy.safetensors", "best.zip"

EPISODES = 256  # of an evaluation
EVERY = 250_000  # steps from one evaluation to the next
_MEASURED = 64  # environments whose observations make the scaling

# No other seeds are as large: those of tests and of the calibration are below 2^63.
_EVALUATION, _SCALING, _TRAINING = 2**64, 2**65, 2**66
_ROOM = 2**40  # seeds of a training: it takes those from its steps on when it starts or goes on


class Evaluation(NamedTuple):
    """Of the deterministic policy: mean cost, its share of the uncontrolled car's on these seeds.

    cpu_seconds: of the training up to here, evaluations apart.
    """

    steps: int
    cpu_seconds: float
    cost: float
    of_none: float


class Progress(NamedTuple):
    """Where a training stands: its newest episodes' mean cost with exploration (None: no episode
    ended yet), and its evaluations."""

    steps: int
    cost: float | None
    evaluations: tuple[Evaluation, ...]


class Trained(NamedTuple):
    """The last model, and all evaluations."""

    model: BaseAlgorithm
    evaluations: tuple[Evaluation, ...]

    @property
    def best(self) -> Evaluation:
        """The evaluation whose model is kept."""
        return min(self.evaluations, key=lambda each: each.cost)


def train(
    task: Task,
    steps: int,
    folder: str | Path,
    resume: bool = False,
    report: Callable[[Progress], None] | None = None,
    command: str = "",
) -> Trained:
    """Train up to a number of steps (rounded up to whole rollouts), in a folder.

    resume: go on from the folder's checkpoint: weights, optimiser, step size, steps and evaluations
    are those of the checkpoint, episodes are new. report: called after every rollout. command: for
    the policy's card.

    Raises ValueError where the folder holds another training, FileNotFoundError where there is
    none to go on with, FloatingPointError, with the step, where weights are not finite any more
    (the folder holds the last evaluation's), and what `make_vec_env` raises.
    """
    if steps < 1:
        raise ValueError(f"steps is at least 1, got {steps}")
    torch.set_num_threads(1)  # on small matrices threads only wait for each other
    place = Path(folder)
    checkpoint = _start(task, place, resume)
    keeper = _Keeper(task, place, checkpoint, report, command)
    model = keeper.build(checkpoint)
    done = model.num_timesteps
    if done < steps:
        try:
            model.learn(steps - done, callback=keeper, reset_num_timesteps=done == 0)
        except ValueError:  # torch's, of a distribution that is none
            keeper.check()
            raise
        keeper.evaluate()
    return Trained(model, tuple(keeper.evaluations))


def task_in(folder: str | Path, **arguments: Any) -> Task:
    """The task of a folder's checkpoint; ValueError where an argument differs from it.

    Raises FileNotFoundError where there is no checkpoint, ValueError for one of another version.
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
    missing = [each.name for each in fields(Task) if each.name not in saved]
    if missing:
        raise ValueError(f"{path}: the checkpoint's task lacks {', '.join(missing)}")
    task = Task(**{each.name: saved[each.name] for each in fields(Task)})
    for name, value in arguments.items():
        if value != getattr(task, name):
            raise ValueError(
                f"{path} is of {name} {getattr(task, name)!r}, not {value!r}: train that in "
                "another folder"
            )
    return task


def _start(task: Task, folder: Path, resume: bool) -> dict[str, Any] | None:
    """The checkpoint's state, None for a new training in a folder that is ready for it."""
    if resume:
        task_in(folder, **asdict(task))
        return read_state(folder / CHECKPOINT)
    if (folder / CHECKPOINT).exists():
        raise ValueError(
            f"{folder} holds a training already: go on with it (resume), or take another folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    return None


class _Keeper(BaseCallback):
    """Builds the model; evaluates it between rollouts and keeps what is needed to go on."""

    def __init__(
        self,
        task: Task,
        folder: Path,
        checkpoint: Mapping[str, Any] | None,
        report: Callable[[Progress], None] | None,
        command: str,
    ) -> None:
        super().__init__()
        self.task, self.folder, self.report, self.command = task, folder, report, command
        self.seeds = [_EVALUATION + i for i in range(EPISODES)]
        self.tested = task.vector_env(EPISODES)
        base: Any = self.tested.unwrapped
        self.period: float = base.control_period * base.dt  # s
        saved = {} if checkpoint is None else checkpoint
        self.evaluations = [Evaluation(*each) for each in saved.get("evaluations", [])]
        self.none: float = saved.get("none") or self._cost(NoControl(self.tested))
        self.scaling: Any = saved.get("scaling")
        self.spent = self.evaluations[-1].cpu_seconds if self.evaluations else 0.0
        self.since = time.process_time()

    def build(self, checkpoint: Mapping[str, Any] | None) -> BaseAlgorithm:
        """The model, new or of the checkpoint, with the environments it is trained on."""
        task, algorithm = self.task, algorithm_of(self.task.algo)
        if self.scaling is None:
            spread, seed = float(np.exp(algorithm.log_std)), _SCALING + task.seed
            found = measured(task.vector_env(_MEASURED), spread, seed)
            self.scaling = [each.tolist() for each in found]
        env = make_vec_env(
            task.env_id,
            task.num_envs,
            estimator=task.estimator or None,
            env_kwargs=task.options(task.num_envs),
        )
        period = self.period
        steps = 0 if checkpoint is None else int(checkpoint["steps"])
        seed = (task.seed + steps) % 2**32
        model = algorithm.make(PerSecond(env, period), period, self.scaling, seed)
        if checkpoint is not None:
            load_parameters(self.folder / CHECKPOINT, model)
        model.num_timesteps = steps
        env.seed(_TRAINING + task.seed * _ROOM + steps)
        self.init_callback(model)
        return model

    def _cost(self, agent: Any) -> float:
        """Mean over the evaluation's drives."""
        return float(costs_of(self.tested, agent, self.seeds).mean())

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.check()
        last = self.evaluations[-1].steps if self.evaluations else -EVERY
        if self.model.num_timesteps - last >= EVERY:
            self.evaluate()

    def _on_rollout_end(self) -> None:
        if self.report is not None:
            ended = self.model.ep_info_buffer
            cost = -float(np.mean([each["r"] for each in ended])) if ended else None
            progress = Progress(self.model.num_timesteps, cost, tuple(self.evaluations))
            self.report(progress)

    def check(self) -> None:
        """FloatingPointError where the weights are not finite."""
        if not all(bool(each.isfinite().all()) for each in self.model.policy.parameters()):
            raise FloatingPointError(
                f"the weights are not finite after step {self.model.num_timesteps}; "
                f"{self.folder / CHECKPOINT} holds them as they were at the last evaluation"
            )

    def evaluate(self) -> None:
        """Cost of the policy as it is; the best one so far and the checkpoint are written."""
        self.check()
        self.spent += time.process_time() - self.since
        cost = self._cost(self.model)
        now = Evaluation(self.model.num_timesteps, round(self.spent, 3), cost, cost / self.none)
        if all(cost < each.cost for each in self.evaluations):
            self._keep_best(now)
        self.evaluations.append(now)
        checkpoint = {
            "sideslip": __version__,
            "task": asdict(self.task),
            "steps": self.model.num_timesteps,
            "none": self.none,
            "scaling": self.scaling,
            "evaluations": self.evaluations,
        }
        save_checkpoint(self.folder / CHECKPOINT, self.model, checkpoint)
        lines = "".join(json.dumps(each._asdict()) + "\n" for each in self.evaluations)
        write_whole(self.folder / CURVE, lines.encode())
        self.since = time.process_time()

    def _keep_best(self, now: Evaluation) -> None:
        task = self.task
        described = algorithm_of(task.algo).described(self.period, task.num_envs)
        mixture: dict[str, Any] = {"scenarios": task.scenarios} if task.scenarios else {}
        first = {"scenario": task.scenarios[0]} if task.scenarios else {}
        card = Card.of(
            task.env_id,
            task.env_options | first,
            task.estimator,
            algorithm=task.algo,
            algorithm_options=described | mixture,
            command=self.command,
            seeds={"training": task.seed, "from": _TRAINING + task.seed * _ROOM},
            steps=now.steps,
            cpu_seconds=now.cpu_seconds,
        )
        save_policy(self.folder / POLICY, network_from_sb3(self.model), card)
        with whole(self.folder / BEST) as file:
            self.model.save(file)
