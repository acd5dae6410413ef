"""What is done between rollouts: evaluations on other seeds, the best policy, a checkpoint."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ... import __version__
from ...envs.backend.files import whole, write_whole
from ...envs.record import Array
from ..learned.card import Card
from ..learned.files import Policy, save_policy
from ..rollout import cost_ratios, costs_of, drives_of
from ..vec_env import zoo
from ..vec_env.env import make_vec_env
from .algorithms import algorithm_of, check_device, make_model, options_of, spread_of
from .checkpoint import load_parameters, save_checkpoint
from .export import network_from_sb3
from .normalise import measured
from .rewards import Rated, Rates, alike, paid_by, weights_of
from .starts import Begun, give, start_of
from .task import Task

from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip  # after ours, which
from stable_baselines3.common.callbacks import BaseCallback  # isort: skip  # name a missing extra
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm  # isort: skip
from stable_baselines3.common.vec_env import VecEnv  # isort: skip

CHECKPOINT, CURVE = "checkpoint.safetensors", "curve.jsonl"
POLICY, BEST, BEGUN_WITH = "policy.safetensors", "best_model.zip", "begun_with.safetensors"
_MEASURED = 64  # environments whose observations make the scaling

# Seeds of tests and of the calibration are below 2^63, those of `corrections` and `distill` beyond.
_WEIGHING, _EVALUATION, _SCALING, _TRAINING = 2**63, 2**64, 2**65, 2**66
_ROOM = 2**40  # seeds of a training: it takes those from its steps on when it starts or goes on


def evaluation_seeds(episodes: int) -> list[int]:
    """Of the episodes of an evaluation."""
    return [_EVALUATION + i for i in range(episodes)]


class Evaluation(NamedTuple):
    """Of the deterministic policy: mean cost, its share of the uncontrolled car's on these seeds.

    Of a mixture the share is the mean of its scenarios' shares, and the cost the same share of
    their mean uncontrolled one. cpu_seconds: of the training up to here, evaluations apart.
    of_start: geometric mean of the costs over those of the policy that the training began with.
    """

    steps: int
    cpu_seconds: float
    cost: float
    of_none: float
    of_start: float | None = None

    @property
    def judged(self) -> float:
        """By which the best one is chosen."""
        return self.cost if self.of_start is None else self.of_start


class Progress(NamedTuple):
    """Where a training stands: its newest episodes' mean cost with exploration (None: no episode
    ended yet), and its evaluations."""

    steps: int
    cost: float | None
    evaluations: tuple[Evaluation, ...]


@dataclass(frozen=True)
class Means:
    """What may be another when a training goes on.

    eval_freq: steps from one evaluation to the next. device: torch's name. tensorboard_log: a
    folder for TensorBoard. report: called after every rollout. command: for the policy's card.
    track: a project of Weights & Biases, "" for none.

    Raises ValueError for evaluations that are less than a step apart, or no device of torch's.
    """

    eval_freq: int = 250_000
    device: str = "cpu"
    tensorboard_log: str | None = None
    report: Callable[[Progress], None] | None = None
    command: str = ""
    track: str = ""

    def __post_init__(self) -> None:
        if self.eval_freq < 1:
            raise ValueError(f"eval_freq is at least 1, got {self.eval_freq}")
        check_device(self.device)


@dataclass(frozen=True)
class Aim:
    """What a training was told besides its task: steps, those between two evaluations, the command
    for the policy's card, the name of the policy that it began with."""

    steps: int
    eval_freq: int
    command: str = ""
    begun_with: str = ""


class Keeper(BaseCallback):
    """Builds the model; evaluates it between rollouts and keeps what is needed to go on.

    checkpoint: the state of one, None for a new training. steps: as many as it is to have.
    begun_with: the policy that the training began with: each drive weighs by what it pays there.
    """

    def __init__(
        self,
        task: Task,
        folder: Path,
        checkpoint: Mapping[str, Any] | None,
        means: Means,
        steps: int = 0,
        begun_with: Policy | None = None,
    ) -> None:
        super().__init__()
        self.task, self.folder, self.means = task, folder, means
        name = "" if begun_with is None else begun_with.name
        self.aim = Aim(steps, means.eval_freq, means.command, name)
        self.seeds = evaluation_seeds(task.n_eval_envs)
        self.tested = task.vector_env(task.n_eval_envs)
        self.begun_with, self.begun = begun_with, None
        if begun_with is not None:
            self.begun = Begun(begun_with, task, self.tested, _SCALING + task.seed)
            self.tested = self.begun.around(self.tested)
        base: Any = self.tested.unwrapped
        self.period: float = base.control_period * base.dt  # s
        saved = {} if checkpoint is None else checkpoint
        self.evaluations = [Evaluation(*each) for each in saved.get("evaluations", [])]
        none = self._means(costs_of(self.tested, None, self.seeds))
        if none.mean() == 0.0:
            raise ValueError("the uncontrolled car costs nothing there: there is nothing to learn")
        self.alike = alike(none)
        self.none = float(np.mean(none * self.alike))
        self.weights = np.ones(1) if begun_with else weights_of(task, _WEIGHING)
        driver = self.begun.driver if self.begun else None
        self.to_beat = costs_of(self.tested, driver, self.seeds) if driver else None
        self.scaling: Any = saved.get("scaling")
        self.spent = self.evaluations[-1].cpu_seconds if self.evaluations else 0.0
        self.since = time.process_time()

    def build(
        self,
        checkpoint: Mapping[str, Any] | None,
        trained_agent: str | Path | None = None,
        trust: bool = False,
    ) -> BaseAlgorithm:
        """The model, new, of the checkpoint, a zip or a policy, with the environments it is
        trained on."""
        task, means = self.task, self.means
        start = None
        if trained_agent is not None:
            width = (self.tested.single_observation_space.shape or (0,))[0]
            start = start_of(trained_agent, width, trust)
        elif checkpoint is None:
            start = self.begun.start if self.begun else None
        if start is not None:
            self.scaling = start.scaling
        if self.scaling is None:
            spread, seed = spread_of(task.settings), _SCALING + task.seed
            mixed = algorithm_of(task.algo).on_tensors
            self.scaling = measured(task.vector_env(_MEASURED), spread, seed, task.reads, mixed)
        env = make_vec_env(
            task.env_id,
            task.num_envs,
            estimator=task.around,
            env_kwargs=task.options(task.num_envs),
            wrapper_class=self.begun.around if self.begun else None,
        )
        steps = 0 if checkpoint is None else int(checkpoint["steps"])
        seed = (task.seed + steps) % 2**32
        first = _TRAINING + task.seed * _ROOM + steps
        rated = Rated(env, self._rates(env, first, steps))
        further: dict[str, Any] = {"device": means.device, "tensorboard_log": means.tensorboard_log}
        if algorithm_of(task.algo).on_tensors:
            from .gradient import source_of

            further["source"] = partial(source_of, task, first, rated.rates)
        model = make_model(
            task.algo, task.settings, rated, self.period, self.scaling, seed, **further
        )
        if checkpoint is not None:
            load_parameters(self.folder / CHECKPOINT, model)
            if isinstance(model, OffPolicyAlgorithm):
                model.learning_starts += steps  # its buffer begins empty
        if start is not None:
            give(start, model)
        model.num_timesteps = steps
        env.seed(first)
        self.init_callback(model)
        return model

    def _rates(self, env: VecEnv, first: int, steps: int) -> Rates:
        """What is paid for the cars' costs, from this seed and step on."""
        if self.begun is not None:
            each = -(-(self.aim.steps - steps) // env.num_envs)
            return Rates(paid_by(self.begun.driver, env, first, each))
        rate = np.resize(self.weights, env.num_envs) / self.period
        return Rates(rate[:, None].tolist())

    def _means(self, costs: Array) -> Array:
        """Of the evaluation's drives of each scenario, (k,)."""
        k = max(len(self.task.scenarios), 1)
        return np.array([costs[i::k].mean() for i in range(k)])

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.check()
        last = self.evaluations[-1].steps if self.evaluations else -self.means.eval_freq
        if self.model.num_timesteps - last >= self.means.eval_freq:
            self.evaluate()

    def _on_rollout_end(self) -> None:
        if self.means.report is not None:
            ended = self.model.ep_info_buffer
            cost = -float(np.mean([each["r"] for each in ended])) if ended else None
            progress = Progress(self.model.num_timesteps, cost, tuple(self.evaluations))
            self.means.report(progress)

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
        costs, lengths = drives_of(self.tested, self.model, self.seeds)
        cost, ratio = float(np.mean(self._means(costs) * self.alike)), None
        if self.to_beat is not None:
            ratio = float(np.exp(np.log(cost_ratios(costs, self.to_beat)).mean()))
        spent = round(self.spent, 3)
        now = Evaluation(self.model.num_timesteps, spent, cost, cost / self.none, ratio)
        if all(now.judged < each.judged for each in self.evaluations):
            self._keep_best(now)
        self.evaluations.append(now)
        self.logger.record("eval/mean_reward", -cost)
        self.logger.dump(self.model.num_timesteps)
        checkpoint = {
            "sideslip": __version__,
            "task": asdict(self.task),
            "steps": self.model.num_timesteps,
            "aim": asdict(self.aim),
            "scaling": self.scaling,
            "evaluations": self.evaluations,
        }
        save_checkpoint(self.folder / CHECKPOINT, self.model, checkpoint)
        lines = "".join(json.dumps(each._asdict()) + "\n" for each in self.evaluations)
        write_whole(self.folder / CURVE, lines.encode())
        zoo.leave(self.folder, self.task.env_id, self.model, costs, lengths)
        self.since = time.process_time()

    def _keep_best(self, now: Evaluation) -> None:
        task = self.task
        described = options_of(task.algo, task.settings, self.period, task.num_envs)
        described |= {"num_envs": task.num_envs, "policy": task.settings["policy"]}
        described |= {"reads": task.reads} if task.reads else {}
        if self.begun_with is not None:
            before = self.begun_with.card.algorithm_options
            described |= {"begun_with": self.begun_with.name}
            described |= {"class": before["class"]} if "class" in before and task.scenarios else {}
        mixture: dict[str, Any] = {"scenarios": task.scenarios} if task.scenarios else {}
        if task.scenarios and self.begun_with is None:
            mixture["weights"] = self.weights.round(3).tolist()
        first = {"scenario": task.scenarios[0]} if task.scenarios else {}
        card = Card.of(
            task.env_id,
            task.env_options | first,
            task.estimator,
            task.estimator_options,
            algorithm=task.algo,
            algorithm_options=described | mixture,
            command=self.means.command,
            seeds={"training": task.seed, "from": _TRAINING + task.seed * _ROOM},
            steps=now.steps,
            cpu_seconds=now.cpu_seconds,
        )
        network = network_from_sb3(self.model)
        network = self.begun.whole(network) if self.begun else network
        save_policy(self.folder / POLICY, network, card)
        with whole(self.folder / BEST) as file:
            self.model.save(file)
