"""`sideslip tune`, of estimators and controllers, and `calibrate`, of the clairvoyant's costs."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.console import Console
from rich.table import Table
from typer import Argument, Option, Typer

from ...envs.validation import check_choice
from ..harness.parallel import PROCESSES, use_engine
from ..harness.results import check_writable
from ..report.terminal import print_suite
from .common import check_files, get_command_line, handle_interrupt, parse_options, print_written
from .names import Address, EngineName, File, Jobs, Text, Texts

tune_app = Typer(no_args_is_help=True)
Storage = Annotated[Text, Option(help="RDB URL or SQLite file; default: sideslip-tune.db here.")]
Seed = Annotated[int, Option(help="Seed of the sampler; another on each machine of a study.")]


@tune_app.callback()
def describe_tune() -> None:
    """Find the numbers of a method by search."""


def _parse_range(text: str) -> tuple[str, tuple[float, float] | None]:
    """Parse NAME or NAME=LOW:HIGH to the name and its range, None without one."""
    name, equals, limits = text.partition("=")
    if not equals:
        return name, None
    try:
        low, high = map(float, limits.split(":"))
    except ValueError:
        raise ValueError(f"what is searched is NAME or NAME=LOW:HIGH, got {text!r}") from None
    return name, (low, high)


@tune_app.command("estimator")
def tune_estimator(
    name: Annotated[str, Argument(help="An estimator's name.")],
    scenario: Annotated[
        list[str], Option(help="A scenario's name; repeatable: each counts alike.")
    ],
    env: Annotated[str, Option(help="An environment's id; default: one that fits.")] = "",
    target: Annotated[str, Option(help="The state whose error counts.")] = "beta",
    option: Annotated[Texts, Option(help="NAME=VALUE, held; repeatable.")] = None,
    search: Annotated[
        Texts, Option(help="NAME or NAME=LOW:HIGH; default: every q_STATE not held; repeatable.")
    ] = None,
    noise: Annotated[
        Texts, Option(help="psi_noise or psi_noise=LOW:HIGH, searched too; repeatable.")
    ] = None,
    trials: Annotated[int, Option(help="Trials of the study, finished ones included.")] = 200,
    seeds: Annotated[int, Option(help="Training drives.")] = 12,
    test_seeds: Annotated[int, Option(help="Test drives.")] = 20,
    sampler: Annotated[str, Option(help="cma (CMA-ES) or tpe.")] = "cma",
    seed: Seed = 0,
    storage: Storage = None,
    jobs: Jobs = None,
    out: Annotated[File, Option(help="Write the entry to a tunings file.")] = None,
    write: Annotated[bool, Option("--write", help="Make it the shipped tuning.")] = False,
    note: Annotated[str, Option(help="A note for the entry.")] = "",
) -> None:
    """Find an estimator's Q, and R if asked to, on training seeds; report on test seeds.

    A stopped search goes on where it was when the same command runs again.
    """
    from ...estimators.design import options
    from ..tuning.estimator import STORAGE, make_estimator_tuning, update
    from ..tuning.study import make_entry, run

    files = [*([out] if out else []), *([options.FILE] if write else [])]
    check_files(toml=out)
    check_writable(*files)
    held, ranges = parse_options(option), dict(map(_parse_range, search)) if search else None
    noises = dict(map(_parse_range, noise or []))
    task = make_estimator_tuning(name, scenario, env or None, target, held, ranges, noises, seeds)
    if write and not all(key.startswith("q_") for key in task.search):
        raise ValueError("shipped tunings hold process noise alone: --out writes the others")
    console = Console()
    suite, result = run(task, trials, test_seeds, storage or STORAGE, sampler, seed, jobs, console)
    print_suite(console, suite)
    flags: dict[str, Sequence[Any]] = {
        "--scenario": scenario,
        "--env": [env] if env else [],
        "--target": [target] if target != "beta" else [],
        "--option": option or [],
        "--search": search or [],
        "--noise": noise or [],
        "--sampler": [sampler] if sampler != "cma" else [],
        "--trials": [trials],
        "--seeds": [seeds],
        "--seed": [seed] if seed else [],
    }
    words = [str(word) for flag in flags for value in flags[flag] for word in (flag, value)]
    command = shlex.join(["sideslip", "tune", "estimator", name, *words])
    made = make_entry(task, result, command, note)
    for path in files:
        update(path, made)
        print_written(console, path)


@tune_app.command("controller")
def tune_controller(
    name: Annotated[str, Argument(help="A controller of the benchmark, or a baseline.")],
    kind: Annotated[
        Texts, Option("--class", help="Class of tasks, such as car-yaw; default: all. Repeatable.")
    ] = None,
    trials: Annotated[int, Option(help="Trials of a class, finished ones included.")] = 60,
    seeds: Annotated[int, Option(help="Tuning seeds of a task.")] = 16,
    seed: Seed = 0,
    storage: Storage = None,
    jobs: Jobs = None,
    out: Annotated[File, Option(help="Write the options to this TOML file.")] = None,
    log: Annotated[File, Option(help="A folder for every study's log.")] = None,
    write: Annotated[bool, Option("--write", help="Put options and log into the package.")] = False,
    engine_name: EngineName = PROCESSES,
    address: Address = "",
) -> None:
    """Find a controller's weights, bandwidths, thresholds and friction over a class of tasks.

    A stopped search goes on where it was when the same command runs again. A class whose tasks the
    controller cannot drive is named and left out.
    """
    from ...agents.baselines import FILE
    from ..control.tasks import make_tuning_seeds
    from ..tuning import controllers
    from ..tuning.controllers import KINDS
    from ..tuning.estimator import STORAGE, write_tuned

    check_files(toml=out)
    console, tables, logs = Console(), [out, FILE] if write else [out], [log]
    if write:
        logs.append(controllers.LOGS)
    for class_name in kind or KINDS:
        task = controllers.make_controller_tuning(name, class_name, make_tuning_seeds(seeds))
        try:
            with use_engine(engine_name, address):
                result = controllers.tune(task, trials, storage or STORAGE, seed, jobs, console)
        except ValueError as error:
            if kind:
                raise
            text = f"{name} in {class_name} was left out: {error}"
            console.print(text, markup=False, highlight=False)
            continue
        print_suite(console, controllers.make_suite(task, result))
        for path in filter(None, tables):
            write_tuned(path, class_name, name, result["options"])
        for folder in filter(None, logs):
            folder.mkdir(parents=True, exist_ok=True)
            controllers.write_log(folder / f"{class_name}.{name}.json", result)


def calibrate_command(
    out: Annotated[Path, Argument(help="The file to write.")] = Path("clairvoyant.json"),
    contest: Annotated[
        Texts, Option(help="Name of a task in the tables; default: all. Repeatable.")
    ] = None,
    seeds: Annotated[int, Option(help="Seeds of a task.")] = 64,
    write: Annotated[bool, Option("--write", help="Write the package's file instead.")] = False,
    jobs: Jobs = None,
    engine_name: EngineName = PROCESSES,
    address: Address = "",
) -> None:
    """Find the cost of the clairvoyant, the baseline that knows all, in the scored tasks.

    A stopped run goes on where it was when the same command runs again in the same folder. `bench
    control --clairvoyant FILE` reads the file.
    """
    from ..control.calibration import FILE, calibrate, make_cases, remove_cases, update
    from ..control.tasks import list_scored_tasks

    path = FILE if write else out
    check_files(json=path)
    known = {item.name: item for item in list_scored_tasks()}
    for name in contest or []:
        check_choice("contest", name, known)
    tasks = [known[name] for name in contest or known]
    console, folder = Console(), Path(f".{path.name}.cases").absolute()
    remaining = sum(not item.path.exists() for item in make_cases(tasks, folder, seeds))
    n_episodes = len(tasks) * seeds
    text = f"{remaining} of {n_episodes} episodes are left; the same command goes on if stopped."
    console.print(text, highlight=False)
    how = "run the same command in the same folder"
    with use_engine(engine_name, address), handle_interrupt(how):
        records = calibrate(tasks, folder, seeds, get_command_line(), jobs, console)
    update(path, records)
    remove_cases(make_cases(tasks, folder, seeds))
    table = Table("contest", "none", "clairvoyant", "a plan wins")
    for record in records:
        none = np.mean([episode.costs["none"] for episode in record.episodes])
        wins = sum(episode.winner.startswith("from") for episode in record.episodes)
        best = f"{record.costs.mean():.4g}"
        table.add_row(record.task.name, f"{none:.4g}", best, f"{wins} of {seeds}")
    console.print(table)
    print_written(console, path)
