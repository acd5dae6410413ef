"""`sideslip tune`, of estimators and controllers, and `calibrate`, of the clairvoyant's costs."""

import shlex
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from typer import Typer

from ...envs.validation import check_choice
from ..harness.parallel import use_engine
from ..harness.results import check_writable
from ..report.tables import print_suite
from .common import (
    File,
    Text,
    Texts,
    check_file,
    get_command_line,
    handle_interrupt,
    parse_options,
    print_written,
    register,
    take,
    take_argument,
)

tune_app = Typer(no_args_is_help=True)

_RECORDED = ("scenario", "env", "target", "option", "search", "noise", "sampler")
_ALWAYS_RECORDED = ("trials", "seeds")


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


@register("estimator", to=tune_app)
class _TuneEstimator:
    """Find an estimator's Q, and R if asked to, on training seeds; report on test seeds.

    A stopped search goes on where it was when the same command runs again.
    """

    name: str = take_argument("An estimator's name.", ...)
    scenario: list[str] = take("A scenario's name; repeatable: each counts alike.", ...)
    env: str = take("An environment's id; default: one that fits.", "")
    target: str = take("The state whose error counts.", "beta")
    option: Texts = take("NAME=VALUE, held; repeatable.")
    search: Texts = take("NAME or NAME=LOW:HIGH; default: every q_STATE not held; repeatable.")
    noise: Texts = take("psi_noise or psi_noise=LOW:HIGH, searched too; repeatable.")
    trials: int = take("Trials of the study, finished ones included.", 200)
    seeds: int = take("Training drives.", 12)
    test_seeds: int = take("Test drives.", 20)
    sampler: str = take("cma (CMA-ES) or tpe.", "cma")
    seed: int
    storage: Text
    jobs: int | None
    out: File = take("Write the entry to a tunings file.", ends=".toml")
    write: bool = take("Make it the shipped tuning.", False, "--write")
    note: str = take("A note for the entry.", "")

    def run(self) -> None:
        from ...estimators.design import options
        from ..tuning.estimator import make_entry, make_estimator_tuning, run, update
        from ..tuning.search import STORAGE, SearchOptions

        files = [*([self.out] if self.out else []), *([options.FILE] if self.write else [])]
        check_writable(*files)
        ranges, noises = (dict(map(_parse_range, x or [])) for x in (self.search, self.noise))
        chosen = self.name, self.scenario, self.env or None, self.target, parse_options(self.option)
        task = make_estimator_tuning(*chosen, ranges or None, noises, self.seeds)
        if self.write and not all(key.startswith("q_") for key in task.search):
            raise ValueError("shipped tunings hold process noise alone: --out writes the others")
        console, where = Console(), (self.storage or STORAGE, self.sampler, self.seed, self.jobs)
        suite, result = run(task, SearchOptions(self.trials, *where, console), self.test_seeds)
        print_suite(console, suite)
        words = ["sideslip", "tune", "estimator", self.name]
        for name in (*_RECORDED, *_ALWAYS_RECORDED, "seed"):
            value = getattr(self, name)
            if name in _ALWAYS_RECORDED or value != getattr(type(self), name, None):
                values = value if isinstance(value, list) else [value]
                words += [str(word) for item in values for word in (f"--{name}", item)]
        made = make_entry(task, result, shlex.join(words), self.note)
        for path in files:
            update(path, made)
            print_written(console, path)


@register("controller", to=tune_app)
class _TuneController:
    """Find a controller's weights, bandwidths, thresholds and friction over a class of tasks.

    A stopped search goes on where it was when the same command runs again. A class whose tasks the
    controller cannot drive is named and left out.
    """

    name: str = take_argument("A controller of the benchmark, or a baseline.", ...)
    kind: Texts = take(
        "Class of tasks, such as car-yaw; default: all. Repeatable.", None, "--class"
    )
    trials: int = take("Trials of a class, finished ones included.", 120)
    seeds: int = take("Tuning seeds of a task.", 8)
    seed: int
    storage: Text
    jobs: int | None
    out: File = take("Write the options to this TOML file.", ends=".toml")
    log: File = take("A folder for every study's log.")
    write: bool = take("Put options and log into the package.", False, "--write")
    engine_name: str
    address: str

    def run(self) -> None:
        from ...agents.baselines import FILE
        from ..control.tasks import make_tuning_seeds
        from ..tuning import controllers
        from ..tuning.search import STORAGE, SearchOptions

        console, shipped = Console(), (FILE, controllers.LOGS) if self.write else (None, None)
        check_writable(*filter(None, (self.out, shipped[0])))
        where = self.storage or STORAGE, "tpe", self.seed, self.jobs, console
        search, seeds = SearchOptions(self.trials, *where), make_tuning_seeds(self.seeds)
        for kind in self.kind or controllers.KINDS:
            task = controllers.make_controller_tuning(self.name, kind, seeds)
            try:
                with use_engine(self.engine_name, self.address):
                    result = controllers.tune(task, search)
            except ValueError as error:
                if self.kind:
                    raise
                text = f"{self.name} in {kind} was left out: {error}"
                console.print(text, markup=False, highlight=False)
                continue
            print_suite(console, controllers.make_suite(task, result))
            for path in filter(None, (self.out, shipped[0])):
                controllers.write_tuned(path, kind, self.name, result["options"])
            for folder in filter(None, (self.log, shipped[1])):
                folder.mkdir(parents=True, exist_ok=True)
                controllers.write_log(folder / f"{kind}.{self.name}.json", result)


@register("calibrate", "Find the cost of perfect foresight.")
class _Calibrate:
    """Find the cost of the clairvoyant, the baseline that knows all, in the scored tasks.

    A stopped run goes on with the task it was in when the same command runs again in the same
    folder. `bench control --clairvoyant FILE` reads the file.
    """

    out: Path = take_argument("The file to write.", Path("clairvoyant.json"))
    contest: Texts = take("Name of a task in the tables; default: all. Repeatable.")
    seeds: int = take("Seeds of a task.", 64)
    write: bool = take("Write the package's file instead.", False, "--write")
    jobs: int | None
    engine_name: str
    address: str

    def run(self) -> None:
        from ..control.calibration import FILE, calibrate
        from ..control.tasks import list_scored_tasks

        path, seeds = FILE if self.write else self.out, self.seeds
        check_file(path, ".json")
        known = {item.name: item for item in list_scored_tasks()}
        for name in self.contest or []:
            check_choice("task", name, known)
        tasks = [known[name] for name in self.contest or known]
        console = Console()
        how = "run the same command in the same folder"
        with use_engine(self.engine_name, self.address), handle_interrupt(how):
            chosen = tasks, seeds, get_command_line(), self.jobs, console
            records = calibrate(path.absolute(), *chosen)
        table = Table("task", "none", "clairvoyant", "a plan wins")
        for record in records:
            none = np.mean([episode.costs["none"] for episode in record.episodes])
            wins = sum(episode.winner.startswith("from") for episode in record.episodes)
            best = f"{record.costs.mean():.4g}"
            table.add_row(record.task.name, f"{none:.4g}", best, f"{wins} of {seeds}")
        console.print(table)
        print_written(console, path)
