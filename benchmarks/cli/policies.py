"""Commands of learned policies: train, distill, enjoy, export."""

import json
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..harness.parallel import Bar, use_shared_bar
from ..harness.results import check_writable
from ..harness.stats import Estimate
from . import common
from .common import File, Text, Texts, register, take, take_argument
from .names import check_env

if TYPE_CHECKING:
    from ...agents.learned.network import Network
    from ...agents.learned.policy import Policy
    from ...agents.training.callbacks import EvalCallback
    from ...agents.training.config import TrainingTask

_ENV = "sideslip/YawVision-v1"  # of a zip, which does not say
EPISODES = 256  # of a policy's test


@register("export", "Make a policy's file of a zip.")
class _Export:
    """Make a policy's file of a zip: weights and a card, which no reader has to trust."""

    zipped: Path = take_argument("Zip of stable-baselines3.", ..., metavar="ZIP")
    out: File = take("Default: NAME.safetensors beside it.", None, "--out", "-o")
    env: str = take("The id that it was trained on.", _ENV)
    estimator: str = take("The estimator around it.", "")
    option: Texts = take("NAME=VALUE of the environment; repeatable.")
    normalise: File = take("VecNormalize's pickle; default: NAME.pkl or vecnormalize.pkl beside.")
    trust: bool

    def run(self) -> None:
        from ...agents.training.export import export_zip, find_normaliser

        target = self.out or self.zipped.with_suffix(".safetensors")
        check_writable(target)
        policy = export_zip(self.zipped, target, self.env, common.parse_options(self.option),
                            trust=self.trust, normalise=self.normalise, estimator=self.estimator,
                            command=common.get_command_line())  # fmt: skip
        default = "the scales of its training" if (policy.network.scale != 1.0).any() else "nothing"
        scaled = find_normaliser(self.zipped, self.normalise) or default
        text = f"network: {_describe_sizes(policy.network)}; observations normalised by: {scaled}"
        console = Console(soft_wrap=True)
        console.print(text, markup=False, highlight=False)
        common.print_written(console, target)


def _describe_sizes(network: "Network") -> str:
    """Describe the sizes of a network's layers, as "22 x 3 frames x 16 lstm x 64 x 1"."""
    frames = [f"{network.history} frames"] if network.history > 1 else []
    cells = [f"{cell.size} {cell.kind}" for cell in network.cells]
    layers = map(str, (*network.hidden, network.width))
    return " x ".join([str(network.inputs), *frames, *cells, *layers])


@register("enjoy", "Drive a policy beside other controllers.")
class _Enjoy:
    """Drive a learned policy: its cost against no control and the best classical line.

    A zip drives the id that it was trained on (--env); `sideslip export` takes further options.
    """

    policy: str = take_argument("A shipped policy's name, or a file's or zip's path.", ...)
    env: Text = take("Another id than the policy's own.")
    episodes: int = take("Number of episodes.", 256, min=1)
    scenario: Text = take("A scenario's name.")
    seed: int | None = take("Seed of the first episode; default: test seeds by the weights.")
    html: File
    json: File
    parquet: File
    plot: File = take("Write the first episode as a PNG.", ends=".png .pdf .svg")
    video: File = take("Write it as a film, .mp4 or .gif, no control beside it.")
    card: bool = take("Show the policy's card, no more.", False, "--card")
    trust: bool

    def run(self) -> None:
        from ..report.film import check_film

        check_film(self.video)
        if self.card:
            common.refuse_unused_options(self, "policy env trust card", "--card")
        if not self.policy.endswith(".zip"):
            self._drive(self.policy)
            return
        from ...agents.training.export import export_zip

        with TemporaryDirectory() as folder:
            path = Path(folder, f"{Path(self.policy).stem}.safetensors")
            export_zip(self.policy, path, self.env or _ENV, trust=self.trust)
            self._drive(str(path))

    def _drive(self, path: str) -> None:
        """Drive the policy of a name or a path."""
        from ...agents.learned.policy import load_policy
        from ...agents.rollout import rollout
        from ..report.film import FilmDriver, write_film
        from ..studies.policies import evaluate_policy

        console, options = Console(), {"env_id": self.env, "scenario": self.scenario}
        if self.card:
            _show_card(console, load_policy(path))
            return
        with use_shared_bar(console, f"enjoy {self.policy}"):
            evaluation = evaluate_policy(path, self.episodes, seed=self.seed, **options)
        common.write_output(console, [evaluation.make_suite()], vars(self))
        name, seed, task = evaluation.policy.name, evaluation.seeds[0], evaluation.task
        first = evaluation.entries[name]
        common.show_episode(console, rollout(*first.make(task), seed), name, {"plot": self.plot})
        if self.video is not None:
            cars = (name, first), ("no control", evaluation.entries["none"])
            drivers = [FilmDriver(driver, *entry.make(task)) for driver, entry in cars]
            write_film(self.video, drivers, seed, console)
            common.print_written(console, self.video)


def _show_card(console: Console, policy: "Policy") -> None:
    network = policy.network
    unread = [name for (name, _), read in zip(policy.card.observation, network.reads, strict=True)
              if not read]  # fmt: skip
    fields = asdict(policy.card) | {
        "observation": ", ".join(f"{name} / {unit}" for name, unit in policy.card.observation),
        "not read": ", ".join(unread) or "none",
        "network": f"{_describe_sizes(network)}, {network.activation}, {network.output} output",
        "observation clipped at": network.clip,
    }
    table = Table("field", "value", box=box.SIMPLE_HEAD, title=policy.name, title_justify="left")
    for name, value in fields.items():
        table.add_row(name, escape(value if isinstance(value, str) else json.dumps(value)))
    console.print(table)


def _evaluate_on_tasks(file: Path, kind: str, episodes: int) -> Table:
    """Evaluate a policy on the tasks of its class, into its card and a table."""
    from ..studies.policies import record_evaluation

    table = Table("task", "in % of nominal", "adaptive-nmpc", "better", "fails")
    with use_shared_bar(Console(), f"judge {file}"):
        written = record_evaluation(file, episodes, kind)
    for task, record in written["cost in % of nominal"].items():
        cost, rival = Estimate(*record["policy"]).inline(digits=".0f"), record["adaptive-nmpc"][0]
        shares = record["better than adaptive-nmpc"][0], record["fails"]
        table.add_row(task, cost, f"{rival:.0f}", *(f"{100.0 * x:.0f} %" for x in shares))
    return table


@register("distill", "Train a policy to imitate a controller.")
class _Distill:
    """Distil a policy by DAgger; its card says what it costs in each task, on unseen seeds."""

    name: str = take_argument("Name of the file, NAME.safetensors.", ...)
    kind: str = take("Class of tasks, as coms-model.", ..., "--class")
    teacher: str = take("An oracle, a controller of the benchmark, or a policy.", "adaptive-nmpc")
    estimator: str = take("What the policy reads: joint, or nothing but the sensors.", "joint")
    cars: int = take("Cars a task and round; its varied lessons share as many.", 6, min=1)
    varied: int = take(
        "Lessons of each task with another car, late camera, wind and outages.", 0, min=0
    )
    rounds: int = take("Rounds of driving and learning.", 7)
    epochs: int = take("Passes over all drives in a round.", 12)
    cells: int = take("Of its GRU; 0: no memory.", 0)
    hidden: list[int] | None = take("Size of a dense layer (64, 64).")
    batch: int = take("Episodes, with a GRU or traces.", 16)
    noise: float = take("Of the teacher's action, its largest standard deviation.", 0.02)
    traces: int = take("Units whose running means it reads, instead of a GRU.", 0, min=0)
    auxiliary_weight: float = take(
        "Weight of predicting what the teacher reads, from GRU or traces.", 0.0, "--told"
    )
    option: Texts = take("NAME=VALUE of what is observed: with_map, fast; repeatable.")
    seed: int = take("Of weights and episodes.", 0)
    episodes: int = take("Episodes of each task's test.", 32, min=5)
    out: File = take("The file; default: NAME here.")

    def run(self) -> None:
        common.announce_torch()
        from ...agents.training.config import DistillConfig
        from ...agents.training.distill import RoundResult, distill
        from ..studies.policies import Lessons

        target, console = self.out or Path(f"{self.name}.safetensors"), Console()
        common.check_file(target, ".safetensors")
        names = "rounds epochs cells noise seed batch traces auxiliary_weight"
        numbers = {name: getattr(self, name) for name in names.split()}
        config = DistillConfig(hidden=tuple(self.hidden or (64, 64)), **numbers)
        about: dict[str, object] = {"class": self.kind, "teacher": self.teacher}
        about |= {"cars": self.cars, "varied": self.varied} | config.describe()
        options = {"algorithm": "distill", "algorithm_options": about}
        options |= {"seeds": {"training": self.seed}, "command": common.get_command_line()}
        taught = self.estimator, self.teacher, self.cars, self.varied, self.seed
        lessons = Lessons(self.kind, *taught, common.parse_options(self.option))
        card = lessons.make_card(**options)

        def show(now: RoundResult) -> None:
            text = f"{now.steps:,} steps, mean cost {now.cost:.4g}, loss {now.loss:.3g}"
            console.print(text, highlight=False)
            bar.advance(bar.task_ids[0])

        with use_shared_bar(console, f"distill {self.name}", "rounds", self.rounds) as bar:
            distill(card, lessons.make_tasks(), config, target, show)
        console.print(_evaluate_on_tasks(target, self.kind, self.episodes))
        common.print_written(console, target)


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
    device: str = take("Of the networks, as torch calls it.", "cpu")
    progress: bool = take("Show a bar.", True, "--progress/--no-progress", "-P")
    trained_agent: File = take("Begin with an sb3 zip or a policy.", None, "--trained-agent", "-i")
    varied: int = take("With a policy: each task so often, varied as in `distill`.", 0, min=0)
    trust: bool
    out: File = take("Folder; default: train-ENV-ALGO...-SEED here.")
    log_folder: File = take("Not --out, but FOLDER/ALGO/ENV_N.", None, "--log-folder", "-f")
    resume: bool = take("Go on with the training in the folder.", False, "--resume")

    def run(self) -> None:
        common.announce_torch()
        from ...agents.learned.policy import load_policy
        from ...agents.training import callbacks, trainer
        from ...agents.training.config import TrainingTask, resolve_settings
        from ..studies.policies import prepare_start, record_evaluation

        chosen = {item.name: getattr(self, item.name, None) for item in fields(TrainingTask)}
        for name in ("estimator_options", "env_options"):
            chosen[name] = common.parse_options(chosen[name])
        options = {name: value for name, value in chosen.items() if value not in (None, [], {})}
        out, logs, resume, varied = self.out, self.log_folder, self.resume, self.varied
        if self.env_id is not None:
            check_env(self.env_id)
        if logs is not None and resume:
            raise ValueError(f"--log-folder {logs} is for a new training: name the old --out")
        if varied and resume:
            raise ValueError(f"--varied {varied} is for a new training: an old one keeps its tasks")
        agent, new = prepare_start(self.trained_agent, varied)
        task = callbacks.read_training(out).task if resume and out else new(**options)
        start = self.trained_agent.stem if self.trained_agent else ""
        folder = _choose_folder(task, start, out, logs)
        file = folder / callbacks.POLICY
        if self.conf_file is not None:
            initial = callbacks.read_training(folder).load_initial(folder) if resume else agent
            options["settings"] = resolve_settings(self.conf_file, task.algo, task.env_id, initial)
        if resume:
            saved = callbacks.read_training(folder, **options)
            task, record = saved.task, saved.aim
        else:
            task = new(**options)
            usual = int(task.settings["n_timesteps"]), callbacks.RunOptions.eval_freq
            record = callbacks.RunRecord(*usual)
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
            logged = self.tensorboard_log, partial(_show, bar), command
            run_options = callbacks.RunOptions(eval_freq, self.device, *logged)
            if logs is not None:
                callbacks.describe_for_zoo(task, folder, steps, eval_freq)
            training = task, steps, folder, resume, run_options, agent, self.trust
            try:
                trained = trainer.Trainer(*training).train()
            except Exception:
                if logs is not None and not file.exists():
                    shutil.rmtree(folder)  # it has nothing but the zoo's description
                raise
        console.print(_make_table(trained))
        kind = load_policy(file).card.algorithm_options.get("class")
        if kind is not None:
            console.print(_evaluate_on_tasks(file, kind, _TASK_EPISODES))
        else:
            costs = record_evaluation(file, EPISODES)["cost"]
            shown = ", ".join(f"{name} {cost['mean']:.4g}" for name, cost in costs.items())
            where = f" of {task.scenarios[0]}, the mixture's first" if task.scenarios else ""
            text = f"mean cost on test seeds{where}: {shown}"
            console.print(text, highlight=False, soft_wrap=True)
        common.print_written(console, file, folder / callbacks.CURVE)


def _make_table(trained: "EvalCallback") -> Table:
    table = Table("steps", "CPU-s", "cost", "of none's", "of its start's")
    for evaluation in trained.evaluations:
        mark = " best" if evaluation is trained.best else ""
        numbers = f"{evaluation.steps:,}", f"{evaluation.cpu_seconds:.1f}", f"{evaluation.cost:.4g}"
        start = "" if evaluation.of_start is None else f"{evaluation.of_start:.3f}"
        table.add_row(*numbers, f"{evaluation.of_none:.3f}{mark}", start)
    return table


def _show(bar: Bar, now: "EvalCallback") -> None:
    """Show a training's newest episodes, and its newest and best evaluation."""
    text = "" if now.cost is None else f"cost {now.cost:.3g} exploring, "
    last, best = now.evaluations[-1], now.best
    if last.of_start is None:
        text += f"of none's {last.of_none:.3f}, best {best.of_none:.3f}"
    else:
        text += f"of its start's {last.of_start:.3f}, best {best.of_start:.3f}"
    bar.update(bar.task_ids[0], completed=now.model.num_timesteps, description=text)


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
        from ...agents.training.callbacks import find_zoo_folder

        if task.algorithm.on_tensors:
            raise ValueError(f"rl-baselines3-zoo has no {task.algo}: its folder is no use")
        return find_zoo_folder(logs, task)
    if out is not None:
        return out
    options = [x if isinstance(x, str) else name for name, x in task.env_options.items()]
    options += ["mixture"] if task.scenarios else []
    words = [task.env_id.rpartition("/")[2], task.algo, task.estimator, *options, start]
    return Path("-".join(["train", *filter(None, words), str(task.seed)]))
