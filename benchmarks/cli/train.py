"""`sideslip train`: a policy learns, with a progress bar; a stopped training goes on.
`sideslip distill`: one learns from a teacher that sees more, over a class of contests.
`sideslip train-estimator`: a network learns to correct a filter's sideslip angle."""

import shlex
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ... import __version__
from ..harness.parallel import one_bar
from .enjoy import judged
from .export import Trust
from .names import check_env, complete
from .options import command_line, options_of
from .output import check_files, folder_of, show_training, words_of, wrote

if TYPE_CHECKING:
    from ...agents.training.train import Trained

EPISODES, CONTESTS = 256, 32  # of the policy's test, and of each contest of its class
_Text = str | None


def train_command(
    algo: Annotated[
        _Text, typer.Option(help="ppo, sac, tqc, recurrent-ppo, gradient (ppo).")
    ] = None,
    env: Annotated[_Text, typer.Option(help="An environment's id (sideslip/YawVision-v0).")] = None,
    estimator: Annotated[_Text, typer.Option(help="An estimator's name (none).")] = None,
    estimator_option: Annotated[
        list[str] | None,
        typer.Option(help='NAME=VALUE of EstimateObservation, as outputs=["beta","F_d"].'),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(help="NAME=VALUE of the environment, as scenario=gust; repeatable."),
    ] = None,
    scenarios: Annotated[
        list[str] | None, typer.Option(help="Of a mixture: a name or a file; repeatable.")
    ] = None,
    reads: Annotated[
        list[str] | None,
        typer.Option(help="An entry of the observation that the network reads (all); repeatable."),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option("--steps", "--n-timesteps", "-n", help="Control periods, all in all."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of weights and episodes (0).")] = None,
    num_envs: Annotated[
        int | None, typer.Option(min=1, help="Side by side; default: of the settings.")
    ] = None,
    conf_file: Annotated[
        Path | None,
        typer.Option("--conf-file", "-conf", help="YAML of settings; default: the package's own."),
    ] = None,
    eval_freq: Annotated[
        int | None, typer.Option(help="Steps between two evaluations (250000).")
    ] = None,
    n_eval_envs: Annotated[
        int | None, typer.Option(min=1, help="Episodes of an evaluation (256).")
    ] = None,
    tensorboard_log: Annotated[
        _Text, typer.Option("--tensorboard-log", "-tb", help="A folder for TensorBoard.")
    ] = None,
    track: Annotated[bool, typer.Option("--track", help="Log to Weights & Biases.")] = False,
    wandb_project_name: Annotated[str, typer.Option(help="With --track.")] = "sideslip",
    device: Annotated[str, typer.Option(help="Of the networks, as torch calls it.")] = "cpu",
    progress: Annotated[
        bool, typer.Option("--progress/--no-progress", "-P", help="Show a bar.")
    ] = True,
    trained_agent: Annotated[
        Path | None,
        typer.Option("--trained-agent", "-i", help="Begin with an sb3 zip or a policy."),
    ] = None,
    varied: Annotated[
        int,
        typer.Option(min=0, help="With a policy: each contest so often, varied as in `distill`."),
    ] = 0,
    trust: Trust = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder; default: train-ENV-ALGO...-SEED here.")
    ] = None,
    log_folder: Annotated[
        Path | None,
        typer.Option("--log-folder", "-f", help="Instead of --out, as the zoo: FOLDER/ALGO/ENV_N."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the training in the folder.")
    ] = False,
) -> None:
    """Train a policy; the best one of the evaluations is saved, the last one can be gone on with.

    With --resume the options left out are those of the training in the folder.
    """
    from ...agents.learned.files import Policy, load_policy
    from ...agents.training.starts import settings_in
    from ...agents.training.train import CURVE, POLICY, Aim, Means, aim_in, start_in, task_in, train
    from ..distillation import start_and_task
    from ..policies import evaluate, evaluation

    options: dict[str, Any] = {
        "env_id": env,
        "algo": algo,
        "estimator": estimator,
        "estimator_options": options_of(estimator_option) or None,
        "env_options": options_of(option) or None,
        "scenarios": scenarios or None,
        "seed": seed,
        "num_envs": num_envs,
        "n_eval_envs": n_eval_envs,
        "reads": reads or None,
    }
    options = {name: value for name, value in options.items() if value is not None}
    if env is not None:
        check_env(env)
    if log_folder is not None and resume:
        raise ValueError(f"--log-folder {log_folder} is for a new training: name the old --out")
    if varied and resume:
        raise ValueError(f"--varied {varied} is for a new training: an old one keeps its contests")
    agent, new = start_and_task(trained_agent, varied)
    if log_folder is not None and isinstance(agent, Policy) and agent.network.memory:
        raise ValueError(f"the zoo's `enjoy` drives nothing that remembers as {agent.name}: --out")
    task = task_in(out) if resume and out else new(**options)
    folder = folder_of(task, trained_agent.stem if trained_agent else "", out, log_folder)
    if conf_file is not None:
        start = start_in(folder) if resume else agent
        options["settings"] = settings_in(conf_file, task.algo, task.env_id, start)
    task = task_in(folder, **options) if resume else new(**options)
    aim = aim_in(folder) if resume else Aim(int(task.settings["n_timesteps"]), Means.eval_freq, "")
    steps = aim.steps if steps is None else steps
    eval_freq = aim.eval_freq if eval_freq is None else eval_freq
    more = {"--eval-freq": eval_freq, "--conf-file": conf_file, "--trained-agent": trained_agent}
    more["--varied"] = varied
    given = [str(word) for pair in more.items() if pair[1] for word in pair]
    named = replace(task, scenarios=[]) if varied else task
    command = shlex.join([*words_of(named, steps), *given])
    command = f"{aim.command}; sideslip train --resume --steps {steps}" if resume else command
    console = Console()
    with one_bar(console if progress else None, "train", "steps", steps) as bar:
        project, show = wandb_project_name if track else "", partial(show_training, bar)
        means = Means(eval_freq, device, tensorboard_log, show, command, project)
        if log_folder is not None:
            task.describe_for_zoo(folder, steps, eval_freq)
        try:
            trained = train(task, steps, folder, resume, means, agent, trust)
        except Exception:
            if log_folder is not None and not (folder / POLICY).exists():
                shutil.rmtree(folder)  # it has nothing but the zoo's description
            raise
    console.print(_table(trained))
    kind = load_policy(folder / POLICY).card.algorithm_options.get("class")
    if kind is not None:
        console.print(judged(folder / POLICY, kind, CONTESTS))
    else:
        costs = evaluation(evaluate(folder / POLICY, EPISODES))["cost"]
        shown = ", ".join(f"{name} {each['mean']:.4g}" for name, each in costs.items())
        where = f" of {task.scenarios[0]}, the mixture's first" if task.scenarios else ""
        console.print(f"mean cost on test seeds{where}: {shown}", highlight=False, soft_wrap=True)
    wrote(console, folder / POLICY)
    wrote(console, folder / CURVE)


def _table(trained: "Trained") -> Table:
    table = Table("steps", "CPU-s", "cost", "of none's", "of its start's")
    for each in trained.evaluations:
        mark = " best" if each is trained.best else ""
        numbers = f"{each.steps:,}", f"{each.cpu_seconds:.1f}", f"{each.cost:.4g}"
        start = "" if each.of_start is None else f"{each.of_start:.3f}"
        table.add_row(*numbers, f"{each.of_none:.3f}{mark}", start)
    return table


def distill_command(
    name: Annotated[str, typer.Argument(help="Of the file NAME.safetensors.")],
    kind: Annotated[str, typer.Option("--class", help="Of contests, as coms-model.")],
    teacher: Annotated[
        str, typer.Option(help="A rung, a controller of the matrix, or a policy.")
    ] = "adaptive-nmpc",
    estimator: Annotated[
        str, typer.Option(help="What the policy reads: joint, or nothing but the sensors.")
    ] = "joint",
    cars: Annotated[
        int,
        typer.Option(help="Of each contest and round; its varied lessons share as many.", min=1),
    ] = 6,
    varied: Annotated[
        int,
        typer.Option(
            min=0, help="Lessons of each contest with another car, late camera, wind and outages."
        ),
    ] = 0,
    rounds: Annotated[int, typer.Option(help="Of driving and learning.")] = 7,
    epochs: Annotated[int, typer.Option(help="Passes over all drives in a round.")] = 12,
    cells: Annotated[int, typer.Option(help="Of its GRU; 0: no memory.")] = 0,
    hidden: Annotated[
        list[int] | None, typer.Option(help="Size of a dense layer (64, 64).")
    ] = None,
    batch: Annotated[int, typer.Option(help="Episodes, with a GRU or traces.")] = 16,
    noise: Annotated[float, typer.Option(help="That shakes the teacher, at most.")] = 0.02,
    traces: Annotated[
        int, typer.Option(min=0, help="Bent units whose running means it reads, instead of a GRU.")
    ] = 0,
    told: Annotated[
        float, typer.Option(help="Weight of what the teacher reads, as its GRU or traces tell it.")
    ] = 0.0,
    option: Annotated[
        list[str] | None,
        typer.Option(help="NAME=VALUE of what is observed: with_map, fast; repeatable."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of weights and episodes.")] = 0,
    episodes: Annotated[int, typer.Option(help="Of each contest's test.", min=2)] = 32,
    out: Annotated[Path | None, typer.Option(help="The file; default: NAME here.")] = None,
) -> None:
    """Distil a policy by DAgger; its card says what it costs in each contest, on unseen seeds."""
    from ...agents.training.distill import Round, distill
    from ...agents.training.student import Course
    from ..distillation import card_of, lessons_of

    target, console = out or Path(f"{name}.safetensors"), Console()
    check_files(policy=target)
    sizes = tuple(hidden or (64, 64))
    course = Course(
        rounds, epochs, cells, sizes, noise=noise, seed=seed, batch=batch, told=told, traces=traces
    )
    about = {"class": kind, "teacher": teacher, "cars": cars, "varied": varied}
    about |= course.described()
    options = {"algorithm": "distill", "algorithm_options": about, "seeds": {"training": seed}}
    seen = options_of(option)
    card = card_of(kind, estimator, teacher, seen, command=command_line(), **options)

    def show(now: Round) -> None:
        text = f"{now.steps:,} steps, mean cost {now.cost:.4g}, loss {now.loss:.3g}"
        console.print(text, highlight=False)
        bar.advance(bar.task_ids[0])

    with one_bar(console, f"distill {name}", "rounds", rounds) as bar:
        lessons = lessons_of(kind, teacher, estimator, cars, varied, seed, seen)
        distill(card, lessons, course, target, show)
    console.print(judged(target, kind, episodes))
    wrote(console, target)


def train_estimator_command(
    name: Annotated[str, typer.Argument(help="Of the file NAME.safetensors.")],
    base: Annotated[
        str, typer.Option(help="The filter.", autocompletion=complete("estimators"))
    ] = "exact-kf",
    scenarios: Annotated[
        list[str] | None, typer.Option(help="Repeatable; default: of all scored contests.")
    ] = None,
    option: Annotated[
        list[str] | None, typer.Option(help="NAME=VALUE of the filter; repeatable.")
    ] = None,
    episodes: Annotated[int, typer.Option(help="Of each contest, driver and sensor set.")] = 32,
    epochs: Annotated[int, typer.Option(help="Passes over all samples.")] = 20,
    seed: Annotated[int, typer.Option(help="Of weights and episodes.", min=0)] = 0,
    out: Annotated[Path | None, typer.Option(help="The file; default: NAME here.")] = None,
) -> None:
    """Train a correction of a filter; `learned` with `file=FILE` estimates with it."""
    from ...agents.training.corrections import READ, train_correction
    from ...estimators.learned.files import CorrectionCard, save_correction
    from ...estimators.make import make_estimator
    from ..control.contests import YAW, contests

    target, console = out or Path(f"{name}.safetensors"), Console()
    check_files(correction=target)
    known = [each.scenario for each in contests()]
    wanted = dict.fromkeys(scenarios or known)
    drives = [(c.env_id, c.env_options) for c in contests() if c.scenario in wanted]
    drives += [(YAW, {"scenario": each}) for each in wanted if each not in known]
    from ...envs.sensors.slow import SENSOR_SETS

    both, options = SENSOR_SETS["fusion"], options_of(option)
    there = make_estimator(base, sensors=both, slow=list(both), **options).names
    card = CorrectionCard(
        base=base,
        base_options=options,
        states=tuple(each for each in READ if each in there),
        scenarios=tuple(wanted),
        seed=seed,
        command=command_line(),
        sideslip=__version__,
    )
    with one_bar(console, f"train-estimator {name}") as bar:
        task = bar.task_ids[0]
        found = train_correction(
            card, drives, episodes, epochs, lambda text: bar.update(task, description=text)
        )
    save_correction(target, found)
    for what, number in found.card.evaluation.items():
        console.print(f"{what} on held-out seeds: {number:.4g}", highlight=False)
    wrote(console, target)
