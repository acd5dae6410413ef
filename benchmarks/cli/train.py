"""`sideslip train`: the command, the folder that it fills, and the command in a policy's card."""

import json
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ..harness.parallel import Bar, use_shared_bar
from .common import announce_torch, print_written
from .names import check_env
from .options import File, Text, Texts, parse_options, register, take
from .policies import EPISODES, evaluate_on_tasks

if TYPE_CHECKING:
    from ...agents.training.callbacks import Progress as TrainingProgress
    from ...agents.training.config import TrainingTask
    from ...agents.training.trainer import TrainResult

_TASK_EPISODES = 32  # of each task of a policy's class


@register("train", "Train a policy.")
class _Train:
    """Train a policy; the best one of the evaluations is saved, the last one can be gone on with.

    With --resume the options left out are those of the training in the folder.
    """

    algo: Text = take("ppo, sac, tqc, recurrent-ppo, gradient (ppo).")
    env_id: Text = take("An environment's id (sideslip/YawVision-v1).", None, "--env")
    estimator: Text = take("An estimator's name (none).")
    estimator_options: Texts = take(
        'NAME=VALUE of EstimateObservation, as outputs=["beta","F_d"].', None, "--estimator-option"
    )
    env_options: Texts = take(
        "NAME=VALUE of the environment, as scenario=gust; repeatable.", None, "--option"
    )
    scenarios: Texts = take("Of a mixture: a name or a file; repeatable.")
    reads: Texts = take("An entry of the observation that the network reads (all); repeatable.")
    steps: int | None = take("Control periods, all in all.", None, "--steps", "--n-timesteps", "-n")
    seed: int | None = take("Of weights and episodes (0).")
    num_envs: int | None = take("Side by side; default: of the settings.", min=1)
    conf_file: File = take(
        "YAML of settings; default: the package's own.", None, "--conf-file", "-conf"
    )
    eval_freq: int | None = take("Steps between two evaluations (250000).")
    n_eval_envs: int | None = take("Episodes of an evaluation (256).", min=1)
    tensorboard_log: Text = take("A folder for TensorBoard.", None, "--tensorboard-log", "-tb")
    track: bool = take("Log to Weights & Biases.", False, "--track")
    wandb_project_name: str = take("With --track.", "sideslip")
    device: str = take("Of the networks, as torch calls it.", "cpu")
    progress: bool = take("Show a bar.", True, "--progress/--no-progress", "-P")
    trained_agent: File = take("Begin with an sb3 zip or a policy.", None, "--trained-agent", "-i")
    varied: int = take("With a policy: each task so often, varied as in `distill`.", 0, min=0)
    trust: bool
    out: File = take("Folder; default: train-ENV-ALGO...-SEED here.")
    log_folder: File = take("Not --out, but FOLDER/ALGO/ENV_N.", None, "--log-folder", "-f")
    resume: bool = take("Go on with the training in the folder.", False, "--resume")

    def run(self) -> None:
        announce_torch()
        from ...agents.learned.policy import Policy, load_policy
        from ...agents.training import trainer
        from ...agents.training.callbacks import CURVE, POLICY, RunOptions, RunRecord
        from ...agents.training.config import TrainingTask
        from ...agents.training.warm_start import resolve_settings
        from ..studies.policies import prepare_start, record_evaluation

        chosen = {item.name: getattr(self, item.name, None) for item in fields(TrainingTask)}
        for name in ("estimator_options", "env_options"):
            chosen[name] = parse_options(chosen[name])
        options = {name: value for name, value in chosen.items() if value not in (None, [], {})}
        out, logs, resume, varied = self.out, self.log_folder, self.resume, self.varied
        if self.env_id is not None:
            check_env(self.env_id)
        if logs is not None and resume:
            raise ValueError(f"--log-folder {logs} is for a new training: name the old --out")
        if varied and resume:
            raise ValueError(f"--varied {varied} is for a new training: an old one keeps its tasks")
        agent, new = prepare_start(self.trained_agent, varied)
        if logs is not None and isinstance(agent, Policy) and agent.network.memory:
            raise ValueError(f"the zoo's `enjoy` drives nothing with memory as {agent.name}: --out")
        task = trainer.read_training(out).task if resume and out else new(**options)
        start = self.trained_agent.stem if self.trained_agent else ""
        folder = _choose_folder(task, start, out, logs)
        if self.conf_file is not None:
            initial = trainer.read_training(folder).load_initial_policy() if resume else agent
            options["settings"] = resolve_settings(self.conf_file, task.algo, task.env_id, initial)
        if resume:
            saved = trainer.read_training(folder, **options)
            task, record = saved.task, saved.record
        else:
            task = new(**options)
            record = RunRecord(int(task.settings["n_timesteps"]), RunOptions.eval_freq)
        steps = record.steps if self.steps is None else self.steps
        eval_freq = record.eval_freq if self.eval_freq is None else self.eval_freq
        if resume:
            words = ["sideslip", "train", "--resume", "--out", folder.name, "--steps", str(steps)]
            command = f"{record.command}; {shlex.join(words)}"
        else:
            names = ("conf_file", "trained_agent", "varied")
            more = {"eval_freq": eval_freq} | {name: getattr(self, name) for name in names}
            more |= {"out": out.name if out else None}
            named = replace(task, scenarios=[]) if varied else task
            command = shlex.join(_make_command(named, steps, more))
        console = Console()
        with use_shared_bar(console if self.progress else None, "train", "steps", steps) as bar:
            project, show = self.wandb_project_name if self.track else "", partial(_show, bar)
            logged = self.tensorboard_log, show, command, project
            run_options = RunOptions(eval_freq, self.device, *logged)
            if logs is not None:
                _describe_for_zoo(task, folder, steps, eval_freq)
            try:
                training = task, steps, folder, resume, run_options, agent, self.trust
                trained = trainer.Trainer(*training).train()
            except Exception:
                if logs is not None and not (folder / POLICY).exists():
                    shutil.rmtree(folder)  # it has nothing but the zoo's description
                raise
        console.print(_make_table(trained))
        kind = load_policy(folder / POLICY).card.algorithm_options.get("class")
        if kind is not None:
            console.print(evaluate_on_tasks(folder / POLICY, kind, _TASK_EPISODES))
        else:
            costs = record_evaluation(folder / POLICY, EPISODES)["cost"]
            shown = ", ".join(f"{name} {cost['mean']:.4g}" for name, cost in costs.items())
            where = f" of {task.scenarios[0]}, the mixture's first" if task.scenarios else ""
            text = f"mean cost on test seeds{where}: {shown}"
            console.print(text, highlight=False, soft_wrap=True)
        print_written(console, folder / POLICY, folder / CURVE)


def _make_table(trained: "TrainResult") -> Table:
    table = Table("steps", "CPU-s", "cost", "of none's", "of its start's")
    for evaluation in trained.evaluations:
        mark = " best" if evaluation is trained.best else ""
        numbers = f"{evaluation.steps:,}", f"{evaluation.cpu_seconds:.1f}", f"{evaluation.cost:.4g}"
        start = "" if evaluation.of_start is None else f"{evaluation.of_start:.3f}"
        table.add_row(*numbers, f"{evaluation.of_none:.3f}{mark}", start)
    return table


def _show(bar: Bar, now: "TrainingProgress") -> None:
    """Show a training's newest episodes, and its newest and best evaluation."""
    text = "" if now.cost is None else f"cost {now.cost:.3g} exploring, "
    last = now.evaluations[-1]
    best = min(now.evaluations, key=lambda evaluation: evaluation.criterion)
    if last.of_start is None:
        text += f"of none's {last.of_none:.3f}, best {best.of_none:.3f}"
    else:
        text += f"of its start's {last.of_start:.3f}, best {best.of_start:.3f}"
    bar.update(bar.task_ids[0], completed=now.steps, description=text)


def _make_command(
    task: "TrainingTask", steps: int, more: Mapping[str, object] | None = None
) -> list[str]:
    """Make the words of the command that trains a task from the start."""
    words = ["sideslip", "train", "--algo", task.algo, "--env", task.env_id]
    words += ["--estimator", task.estimator] if task.estimator else []
    option_groups = {"--estimator-option": task.estimator_options, "--option": task.env_options}
    for option, values in option_groups.items():
        for name, value in values.items():
            words += [option, f"{name}={value if isinstance(value, str) else json.dumps(value)}"]
    words += [word for item in task.scenarios for word in ("--scenarios", str(item))]
    words += [word for item in task.reads for word in ("--reads", item)]
    numbers = {name: getattr(task, name) for name in ("seed", "num_envs", "n_eval_envs")}
    rest = {"steps": steps} | numbers | {name: x for name, x in (more or {}).items() if x}
    options = {f"--{name.replace('_', '-')}": str(value) for name, value in rest.items()}
    return words + [word for pair in options.items() for word in pair]


def _choose_folder(task: "TrainingTask", start: str, out: Path | None, logs: Path | None) -> Path:
    if logs is not None:
        if out is not None:
            raise ValueError(f"--log-folder {logs} numbers its folders itself: without --out {out}")
        from ...agents import zoo

        if task.algorithm.on_tensors:
            raise ValueError(f"rl-baselines3-zoo has no {task.algo}: its folder is no use")
        return zoo.find_next_folder(logs, task.algorithm.zoo, task.env_id)
    if out is not None:
        return out
    options = [x if isinstance(x, str) else name for name, x in task.env_options.items()]
    options += ["mixture"] if task.scenarios else []
    words = [task.env_id.rpartition("/")[2], task.algo, task.estimator, *options, start]
    return Path("-".join(["train", *filter(None, words), str(task.seed)]))


def _describe_for_zoo(task: "TrainingTask", folder: Path, steps: int, eval_freq: int) -> None:
    """Make a folder of `_choose_folder` with the files of the zoo's `enjoy`."""
    from ...agents import zoo

    first = {"scenario": task.scenarios[0]} if task.scenarios else {}
    arguments = dict[str, Any](algo=task.algorithm.zoo, env=task.env_id)
    arguments |= {"env_kwargs": task.env_options | first, "eval_freq": eval_freq}
    arguments |= {"n_eval_envs": task.n_eval_envs, "n_timesteps": steps, "seed": task.seed}
    settings = task.settings | {"n_envs": task.num_envs}
    zoo.describe(folder, settings, task.estimator_kwargs, arguments)
