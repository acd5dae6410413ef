"""Commands of learned policies and corrections: export, enjoy, train, distill, train-estimator."""

import shlex
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from json import dumps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from typer import Argument, Option

from ... import __version__
from ..harness.parallel import use_shared_bar
from ..harness.results import check_writable
from .common import (
    announce_torch,
    check_files,
    choose_folder,
    get_command_line,
    make_command,
    parse_options,
    print_written,
    show_episode,
    show_training,
    write_output,
)
from .names import File, Html, Json, Parquet, Text, Texts, check_env, complete

if TYPE_CHECKING:
    from ...agents.learned.policy import Policy
    from ...agents.training.trainer import TrainResult
    from ...estimators.learned.network import Network

ENV = "sideslip/YawVision-v0"
EPISODES, _TASK_EPISODES = 256, 32  # of the policy's test, and of each contest of its class
Trust = Annotated[
    bool, Option("--trust", help="Read policies' zips, which may run code of their makers.")
]


def export_command(
    zipped: Annotated[Path, Argument(metavar="ZIP", help="Of stable-baselines3.")],
    out: Annotated[File, Option("--out", "-o", help="Default: NAME.safetensors beside it.")] = None,
    env: Annotated[str, Option(help="The id that it was trained on.")] = ENV,
    estimator: Annotated[str, Option(help="The estimator around it.")] = "",
    option: Annotated[Texts, Option(help="NAME=VALUE of the environment; repeatable.")] = None,
    normalise: Annotated[
        File, Option(help="VecNormalize's pickle; default: NAME.pkl or vecnormalize.pkl beside.")
    ] = None,
    trust: Trust = False,
) -> None:
    """Make a policy's file of a zip: weights and a card, which no reader has to trust."""
    from ...agents.training.export import export_zip, find_normaliser

    target = out or zipped.with_suffix(".safetensors")
    check_writable(target)
    options = parse_options(option)
    policy = export_zip(
        zipped, target, env, options, estimator,
        trust=trust, normalise=normalise, command=get_command_line(),
    )  # fmt: skip
    console, scaled = Console(soft_wrap=True), find_normaliser(zipped, normalise)
    sizes = f"network: {_describe_sizes(policy.network)}"
    text = f"{sizes}; observations normalised by: {scaled or 'nothing'}"
    console.print(text, markup=False, highlight=False)
    print_written(console, target)


def _describe_sizes(network: "Network") -> str:
    """Describe the sizes of a network's layers, as "22 x 3 frames x 16 lstm x 64 x 1"."""
    frames = [f"{network.history} frames"] if network.history > 1 else []
    cells = [f"{cell.size} {cell.kind}" for cell in network.cells]
    layers = map(str, (*network.hidden, network.width))
    return " x ".join([str(network.inputs), *frames, *cells, *layers])


@contextmanager
def _export_policy(name: str, env: Text, trust: bool) -> Iterator[str]:
    """Yield a policy's name or path; for a zip the path of its export in a temporary folder."""
    if not name.endswith(".zip"):
        yield name
        return
    from ...agents.training.export import export_zip

    with TemporaryDirectory() as folder:
        target = Path(folder) / f"{Path(name).stem}.safetensors"
        export_zip(name, target, env or ENV, trust=trust)
        yield str(target)


def enjoy_command(
    policy: Annotated[str, Argument(help="A shipped policy's name, or a file's or zip's path.")],
    env: Annotated[Text, Option(help="Another id than the policy's own.")] = None,
    episodes: Annotated[int, Option(min=1, help="How many.")] = 256,
    scenario: Annotated[Text, Option(help="A scenario's name.")] = None,
    seed: Annotated[
        int | None, Option(help="Of the first episode; default: test seeds made from the weights.")
    ] = None,
    html: Html = None,
    json: Json = None,
    parquet: Parquet = None,
    plot: Annotated[File, Option(help="Write the first episode as a PNG.")] = None,
    video: Annotated[
        File, Option(help="Write it as a film, .mp4 or .gif, no control beside it.")
    ] = None,
    card: Annotated[bool, Option("--card", help="Show the policy's card, no more.")] = False,
    trust: Trust = False,
) -> None:
    """Drive a learned policy: its cost against no control and the best classical line.

    A zip drives the id that it was trained on (--env); `sideslip export` takes further options.
    """
    from ...agents.learned.policy import load_policy
    from ..control.report import make_env_and_agent, run_entry
    from ..report.film import FilmDriver, check_film, write_film
    from ..studies.policies import evaluate_policy, make_suite

    console = Console()
    check_files(html=html, json=json, parquet=parquet, plot=plot)
    check_film(video)
    with _export_policy(policy, env, trust) as path:
        if card:
            _show_card(console, load_policy(path))
            return
        with use_shared_bar(console, f"enjoy {policy}"):
            evaluation = evaluate_policy(path, episodes, env_id=env, scenario=scenario, seed=seed)
        write_output(console, [make_suite(evaluation)], html, json, parquet)
        first = evaluation.entries[evaluation.policy.name]
        show_episode(console, run_entry(first, evaluation.seeds[0]), evaluation.policy.name, plot)
        if video is not None:
            cars = (evaluation.policy.name, first), ("no control", evaluation.entries["none"])
            drivers = [FilmDriver(name, *make_env_and_agent(entry)) for name, entry in cars]
            write_film(video, drivers, evaluation.seeds[0], console)
            print_written(console, video)


def _show_card(console: Console, policy: "Policy") -> None:
    """Print a policy's card and the sizes of its network."""
    network = policy.network
    unread = [name for (name, _), read in zip(policy.card.observation, policy.reads, strict=True)
              if not read]  # fmt: skip
    fields = asdict(policy.card) | {
        "observation": ", ".join(f"{name} / {unit}" for name, unit in policy.card.observation),
        "not read": ", ".join(unread) or "none",
        "network": f"{_describe_sizes(network)}, {network.activation}, {network.output} output",
        "observation clipped at": network.clip,
    }
    table = Table("field", "value", box=box.SIMPLE_HEAD, title=policy.name, title_justify="left")
    for name, value in fields.items():
        table.add_row(name, escape(value if isinstance(value, str) else dumps(value)))
    console.print(table)


def make_task_table(file: Path, kind: str, episodes: int) -> Table:
    """Make a table of a policy's costs on the tasks of its class, written into its card too."""
    from ..studies.policies import evaluate_card

    table = Table("contest", "in % of nominal", "adaptive-nmpc", "better", "fails")
    with use_shared_bar(Console(), f"judge {file}"):
        written = evaluate_card(file, kind, episodes)
    for task, record in written["cost in % of nominal"].items():
        cost, low, high = record["policy"]
        better, fails = record["better than adaptive-nmpc"][0], record["fails"]
        numbers = f"{cost:.0f} [{low:.0f}, {high:.0f}]", f"{record['adaptive-nmpc'][0]:.0f}"
        table.add_row(task, *numbers, f"{100.0 * better:.0f} %", f"{100.0 * fails:.0f} %")
    return table


def train_command(
    algo: Annotated[Text, Option(help="ppo, sac, tqc, recurrent-ppo, gradient (ppo).")] = None,
    env: Annotated[Text, Option(help="An environment's id (sideslip/YawVision-v0).")] = None,
    estimator: Annotated[Text, Option(help="An estimator's name (none).")] = None,
    estimator_option: Annotated[
        Texts, Option(help='NAME=VALUE of EstimateObservation, as outputs=["beta","F_d"].')
    ] = None,
    option: Annotated[
        Texts, Option(help="NAME=VALUE of the environment, as scenario=gust; repeatable.")
    ] = None,
    scenarios: Annotated[Texts, Option(help="Of a mixture: a name or a file; repeatable.")] = None,
    reads: Annotated[
        Texts, Option(help="An entry of the observation that the network reads (all); repeatable.")
    ] = None,
    steps: Annotated[
        int | None, Option("--steps", "--n-timesteps", "-n", help="Control periods, all in all.")
    ] = None,
    seed: Annotated[int | None, Option(help="Of weights and episodes (0).")] = None,
    num_envs: Annotated[
        int | None, Option(min=1, help="Side by side; default: of the settings.")
    ] = None,
    conf_file: Annotated[
        File, Option("--conf-file", "-conf", help="YAML of settings; default: the package's own.")
    ] = None,
    eval_freq: Annotated[int | None, Option(help="Steps between two evaluations (250000).")] = None,
    n_eval_envs: Annotated[
        int | None, Option(min=1, help="Episodes of an evaluation (256).")
    ] = None,
    tensorboard_log: Annotated[
        Text, Option("--tensorboard-log", "-tb", help="A folder for TensorBoard.")
    ] = None,
    track: Annotated[bool, Option("--track", help="Log to Weights & Biases.")] = False,
    wandb_project_name: Annotated[str, Option(help="With --track.")] = "sideslip",
    device: Annotated[str, Option(help="Of the networks, as torch calls it.")] = "cpu",
    progress: Annotated[bool, Option("--progress/--no-progress", "-P", help="Show a bar.")] = True,
    trained_agent: Annotated[
        File, Option("--trained-agent", "-i", help="Begin with an sb3 zip or a policy.")
    ] = None,
    varied: Annotated[
        int, Option(min=0, help="With a policy: each contest so often, varied as in `distill`.")
    ] = 0,
    trust: Trust = False,
    out: Annotated[File, Option(help="Folder; default: train-ENV-ALGO...-SEED here.")] = None,
    log_folder: Annotated[
        File, Option("--log-folder", "-f", help="Instead of --out, as the zoo: FOLDER/ALGO/ENV_N.")
    ] = None,
    resume: Annotated[
        bool, Option("--resume", help="Go on with the training in the folder.")
    ] = False,
) -> None:
    """Train a policy; the best one of the evaluations is saved, the last one can be gone on with.

    With --resume the options left out are those of the training in the folder.
    """
    announce_torch()
    from ...agents.learned.policy import Policy, load_policy
    from ...agents.training.callbacks import CURVE, POLICY, RunOptions, RunRecord
    from ...agents.training.trainer import load_initial_policy, read_run_record, read_task, train
    from ...agents.training.warm_start import resolve_settings
    from ..studies.policies import prepare_start, record_evaluation, summarise_evaluation

    options: dict[str, Any] = {
        "env_id": env,
        "algo": algo,
        "estimator": estimator,
        "estimator_options": parse_options(estimator_option) or None,
        "env_options": parse_options(option) or None,
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
    agent, new = prepare_start(trained_agent, varied)
    if log_folder is not None and isinstance(agent, Policy) and agent.network.memory:
        raise ValueError(f"the zoo's `enjoy` drives nothing that remembers as {agent.name}: --out")
    task = read_task(out) if resume and out else new(**options)
    folder = choose_folder(task, trained_agent.stem if trained_agent else "", out, log_folder)
    if conf_file is not None:
        start = load_initial_policy(folder) if resume else agent
        options["settings"] = resolve_settings(conf_file, task.algo, task.env_id, start)
    task = read_task(folder, **options) if resume else new(**options)
    aim = (
        read_run_record(folder)
        if resume
        else RunRecord(int(task.settings["n_timesteps"]), RunOptions.eval_freq, "")
    )
    steps = aim.steps if steps is None else steps
    eval_freq = aim.eval_freq if eval_freq is None else eval_freq
    more = {"--eval-freq": eval_freq, "--conf-file": conf_file, "--trained-agent": trained_agent}
    more["--varied"] = varied
    arguments = [str(word) for pair in more.items() if pair[1] for word in pair]
    named = replace(task, scenarios=[]) if varied else task
    command = shlex.join([*make_command(named, steps), *arguments])
    command = f"{aim.command}; sideslip train --resume --steps {steps}" if resume else command
    console = Console()
    with use_shared_bar(console if progress else None, "train", "steps", steps) as bar:
        project, show = wandb_project_name if track else "", partial(show_training, bar)
        means = RunOptions(eval_freq, device, tensorboard_log, show, command, project)
        if log_folder is not None:
            task.describe_for_zoo(folder, steps, eval_freq)
        try:
            trained = train(task, steps, folder, resume, means, agent, trust)
        except Exception:
            if log_folder is not None and not (folder / POLICY).exists():
                shutil.rmtree(folder)  # it has nothing but the zoo's description
            raise
    console.print(_make_table(trained))
    kind = load_policy(folder / POLICY).card.algorithm_options.get("class")
    if kind is not None:
        console.print(make_task_table(folder / POLICY, kind, _TASK_EPISODES))
    else:
        costs = summarise_evaluation(record_evaluation(folder / POLICY, EPISODES))["cost"]
        shown = ", ".join(f"{name} {cost['mean']:.4g}" for name, cost in costs.items())
        where = f" of {task.scenarios[0]}, the mixture's first" if task.scenarios else ""
        console.print(f"mean cost on test seeds{where}: {shown}", highlight=False, soft_wrap=True)
    print_written(console, folder / POLICY)
    print_written(console, folder / CURVE)


def _make_table(trained: "TrainResult") -> Table:
    table = Table("steps", "CPU-s", "cost", "of none's", "of its start's")
    for evaluation in trained.evaluations:
        mark = " best" if evaluation is trained.best else ""
        numbers = f"{evaluation.steps:,}", f"{evaluation.cpu_seconds:.1f}", f"{evaluation.cost:.4g}"
        start = "" if evaluation.of_start is None else f"{evaluation.of_start:.3f}"
        table.add_row(*numbers, f"{evaluation.of_none:.3f}{mark}", start)
    return table


def distill_command(
    name: Annotated[str, Argument(help="Of the file NAME.safetensors.")],
    kind: Annotated[str, Option("--class", help="Of contests, as coms-model.")],
    teacher: Annotated[
        str, Option(help="A rung, a controller of the matrix, or a policy.")
    ] = "adaptive-nmpc",
    estimator: Annotated[
        str, Option(help="What the policy reads: joint, or nothing but the sensors.")
    ] = "joint",
    cars: Annotated[
        int, Option(help="Of each contest and round; its varied lessons share as many.", min=1)
    ] = 6,
    varied: Annotated[
        int,
        Option(
            min=0, help="Lessons of each contest with another car, late camera, wind and outages."
        ),
    ] = 0,
    rounds: Annotated[int, Option(help="Of driving and learning.")] = 7,
    epochs: Annotated[int, Option(help="Passes over all drives in a round.")] = 12,
    cells: Annotated[int, Option(help="Of its GRU; 0: no memory.")] = 0,
    hidden: Annotated[list[int] | None, Option(help="Size of a dense layer (64, 64).")] = None,
    batch: Annotated[int, Option(help="Episodes, with a GRU or traces.")] = 16,
    noise: Annotated[float, Option(help="That shakes the teacher, at most.")] = 0.02,
    traces: Annotated[
        int, Option(min=0, help="Bent units whose running means it reads, instead of a GRU.")
    ] = 0,
    told: Annotated[
        float, Option(help="Weight of what the teacher reads, as its GRU or traces tell it.")
    ] = 0.0,
    option: Annotated[
        Texts, Option(help="NAME=VALUE of what is observed: with_map, fast; repeatable.")
    ] = None,
    seed: Annotated[int, Option(help="Of weights and episodes.")] = 0,
    episodes: Annotated[int, Option(help="Of each contest's test.", min=2)] = 32,
    out: Annotated[File, Option(help="The file; default: NAME here.")] = None,
) -> None:
    """Distil a policy by DAgger; its card says what it costs in each contest, on unseen seeds."""
    announce_torch()
    from ...agents.training.distill import RoundResult, distill
    from ...agents.training.student import DistillConfig
    from ..studies.policies import make_card, make_lessons

    target, console = out or Path(f"{name}.safetensors"), Console()
    check_files(policy=target)
    sizes = tuple(hidden or (64, 64))
    course = DistillConfig(
        rounds, epochs, cells, sizes, noise=noise, seed=seed, batch=batch, told=told, traces=traces
    )
    about = {"class": kind, "teacher": teacher, "cars": cars, "varied": varied}
    about |= course.describe()
    options = {"algorithm": "distill", "algorithm_options": about, "seeds": {"training": seed}}
    observation_options = parse_options(option)
    card = make_card(
        kind, estimator, teacher, observation_options, command=get_command_line(), **options
    )

    def show(now: RoundResult) -> None:
        text = f"{now.steps:,} steps, mean cost {now.cost:.4g}, loss {now.loss:.3g}"
        console.print(text, highlight=False)
        bar.advance(bar.task_ids[0])

    with use_shared_bar(console, f"distill {name}", "rounds", rounds) as bar:
        lessons = make_lessons(kind, teacher, estimator, cars, varied, seed, observation_options)
        distill(card, lessons, course, target, show)
    console.print(make_task_table(target, kind, episodes))
    print_written(console, target)


def train_estimator_command(
    name: Annotated[str, Argument(help="Of the file NAME.safetensors.")],
    base: Annotated[
        str, Option(help="The filter.", autocompletion=complete("estimators"))
    ] = "exact-kf",
    scenarios: Annotated[Texts, Option(help="Repeatable; default: of all scored contests.")] = None,
    option: Annotated[Texts, Option(help="NAME=VALUE of the filter; repeatable.")] = None,
    episodes: Annotated[int, Option(help="Of each contest, driver and sensor set.")] = 32,
    epochs: Annotated[int, Option(help="Passes over all samples.")] = 20,
    seed: Annotated[int, Option(help="Of weights and episodes.", min=0)] = 0,
    out: Annotated[File, Option(help="The file; default: NAME here.")] = None,
) -> None:
    """Train a correction of a filter; `learned` with `file=FILE` estimates with it."""
    announce_torch()
    from ...agents.training.corrections import READ, train_correction
    from ...envs.sensors.slow import SENSOR_SETS
    from ...estimators.learned.correction_file import CorrectionCard, save_correction
    from ...estimators.make import make_estimator
    from ..control.tasks import YAW, list_scored_tasks

    target, console = out or Path(f"{name}.safetensors"), Console()
    check_files(correction=target)
    known = [item.scenario for item in list_scored_tasks()]
    wanted = dict.fromkeys(scenarios or known)
    drives = [(c.env_id, c.env_options) for c in list_scored_tasks() if c.scenario in wanted]
    drives += [(YAW, {"scenario": item}) for item in wanted if item not in known]
    both, options = SENSOR_SETS["fusion"], parse_options(option)
    states = make_estimator(base, sensors=both, slow=list(both), **options).names
    card = CorrectionCard(
        base=base,
        base_options=options,
        states=tuple(item for item in READ if item in states),
        scenarios=tuple(wanted),
        seed=seed,
        command=get_command_line(),
        sideslip=__version__,
    )
    with use_shared_bar(console, f"train-estimator {name}") as bar:
        task = bar.task_ids[0]
        correction = train_correction(
            card, drives, episodes, epochs, lambda text: bar.update(task, description=text)
        )
    save_correction(target, correction)
    for what, number in correction.card.evaluation.items():
        console.print(f"{what} on held-out seeds: {number:.4g}", highlight=False)
    print_written(console, target)
