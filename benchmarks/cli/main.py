"""The command line `sideslip`: all commands; `list`, `run`, `bench`, `tune` and `calibrate`."""

import copy
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ... import __version__
from ...envs.validation import check_choice
from ..harness.parallel import report_user_errors, use_engine
from ..harness.results import check_writable
from ..report.html import check_page, write_page
from ..report.tables import print_suite
from ..suites import SALTED, SUITES, Request, run_suites
from . import common, data, live, policies  # noqa: F401  # they register their commands
from .common import File, Text, Texts, app, register, take, take_argument
from .names import KINDS

if TYPE_CHECKING:
    from ..entrants.challenge import ComparisonRequest

__all__ = ["app", "main"]
console = Console()
_ORDER = (
    *("train", "distill", "enjoy", "export", "replay", "identify", "inspect"),
    *("lane", "live", "calibrate", "list", "run", "bench"),
)


def main() -> None:
    """Run the command line; a user's error is one line and exit status 2."""
    with report_user_errors():
        app()


def _print_version(shown: bool) -> None:
    if shown:
        console.print(f"sideslip {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def describe_app(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print it.")
    ] = False,
) -> None:
    """Lateral stability of electric vehicles: environments, estimators, controllers."""


@register("list", "List everything that has a name.")
class _List:
    """Everything that has a name, with a line on each."""

    kinds: Texts = take_argument(
        f"{', '.join(KINDS)}; default: all.", None, autocompletion=lambda: [*KINDS]
    )

    def run(self) -> None:
        for kind in self.kinds or []:
            check_choice("kind of name", kind, KINDS)
        for kind in self.kinds or KINDS:
            table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
            table.add_column(no_wrap=True)
            table.add_column(overflow="fold")  # a long word goes on in the next line
            for name, line in KINDS[kind]().items():
                table.add_row(name, escape(line))
            console.print(f"[bold]{kind}[/]")
            console.print(table)


@register("run", "Drive one episode and draw it.")
class _Run:
    """Drive one episode, print its score, draw it."""

    env: Text = take_argument(
        "An environment's id; default: the first of YawVision and AfsYawFusion that fits.",
        None,
        metavar="env_id",
        kinds="environments",
    )
    agent: str = take(
        "A name, a policy's path, FILE.py:Class or module:Name.", "none", kinds="agents policies"
    )
    estimator: Text = take("A name, FILE.py:Class or module:Name.", kinds="estimators")
    vehicle: Text
    scenario: Text = take(
        "A name, a TOML or JSON file, or a recorded drive (CSV, Parquet) to steer as.",
        kinds="scenarios",
    )
    option: Texts = take("NAME=VALUE of the environment (reference=model); repeatable.")
    agent_option: Texts = take("NAME=VALUE of the agent (grip=0.6); repeatable.")
    estimator_option: Texts = take("NAME=VALUE of the estimator (q_beta=1e-4); repeatable.")
    seed: int = take("Seed of the episode.", 0)
    control_period: int | None
    plot: File = take("Write a PNG, PDF or SVG.", ends=".png .pdf .svg")
    parquet: File = take("Write every signal.", ends=".parquet")
    kml: File = take("Write the track for a map.", ends=".kml")
    video: File = take("Write a film, .mp4 or .gif.")
    beside: Text = take("Another agent, a ghost in the film.")
    trust: bool

    def run(self) -> None:
        from ...agents import make_agent
        from ...agents.rollout import rollout
        from ..report.film import FilmDriver, check_film, write_film

        check_film(self.video)
        if self.beside is not None and self.video is None:
            raise ValueError(f"{self.beside!r} can only drive beside in a film: --video FILE")
        setup = common.make_setup(vars(self))
        driver = FilmDriver(self.agent, *common.make_driver(setup, self.trust))
        if self.env is None and driver.env.spec is not None:
            console.print(f"on {driver.env.spec.id}", highlight=False)
        drive = rollout(driver.env, driver.agent, self.seed)
        common.show_episode(console, drive, self.agent, vars(self))
        if self.video is not None:
            cars = [driver]
            if self.beside is not None:
                env = copy.deepcopy(driver.env)
                name = "no control" if self.beside == "none" else self.beside
                cars.append(FilmDriver(name, env, make_agent(self.beside, env, trust=self.trust)))
            write_film(self.video, cars, self.seed, console)
            common.print_written(console, self.video)


_FIXED = {"highway", "procedures", "speed"}  # suites whose number of drives is fixed


@register("bench", "Compare estimators and controllers.")
class _Bench:
    """Compare estimators and controllers; with --agent and --estimator your own beside some of
    the package's."""

    suites: Texts = take_argument("Suites; default: all.", None, kinds="suites")
    quick: bool = take("Few seeds: a first look in minutes.", False, "--quick")
    data: File = take("The folder of downloaded drives, for the suite logs.")
    vehicle: Text
    html: File
    json: File
    parquet: File
    page: File = take("Put the tables between this Markdown page's marks.", ends=".md")
    jobs: int | None
    episodes: int | None = take("A cell of control (256), or seeds of other suites.", min=4)
    keep: File = take("A folder for finished cases: a stopped run goes on.")
    clairvoyant: File = take("A file of `sideslip calibrate`; default: the package's.")
    agent: Texts = take(
        "Your own: FILE.py:Class, a policy's path, a name; repeatable.", kinds="agents policies"
    )
    estimator: Texts = take("FILE.py:Class, a name, none; repeatable.")
    scenario: Texts = take("A name or a file; repeatable.")
    env_id: str = take("The tasks of this id alone.", "", "--env")
    fresh: bool = take("Seeds drawn after your files are hashed: publishable.", False, "--fresh")
    salt: str = take("Salt of the test seeds, hexadecimal; default: made from the sources.", "")
    limit: float | None = take("s of wall time for an entry in a task; default: 600.")
    trust: bool
    engine_name: str
    address: str

    def run(self) -> None:
        has_entries = bool(self.agent or self.estimator)
        of_entries = {
            "--scenario": self.scenario, "--env": self.env_id, "--fresh": self.fresh,
            "--vehicle": self.vehicle, "--trust": self.trust, "--limit": self.limit is not None,
        }  # fmt: skip
        if stray := [name for name, value in of_entries.items() if value and not has_entries]:
            raise ValueError(f"{', '.join(stray)} go with --agent or --estimator")
        everything = [name for name in SUITES if name != "logs" or self.data]
        names = self.suites or (["control"] if has_entries else everything)
        for name in names:
            check_choice("suite", name, SUITES)
        if self.salt:
            from ..control.tasks import make_salted_seeds

            if not {*SALTED} & {*names}:
                raise ValueError(f"--salt goes with {', '.join(SALTED)}, got {', '.join(names)}")
            make_salted_seeds(self.salt, 1)  # or ValueError
        check_page(self.page, names)
        for option, suite in (("keep", "control"), ("clairvoyant", "control"), ("data", "logs")):
            fits = suite in names and not (has_entries and option != "keep")
            if getattr(self, option) is not None and not fits:
                got = "--agent or --estimator" if suite in names else ", ".join(names)
                raise ValueError(f"--{option} goes with the suite {suite}, got {got}")
        if self.episodes is not None and not {*names} - _FIXED:
            raise ValueError(f"--episodes: {', '.join(names)} has a number of its own")
        shared = ("quick", "jobs", "episodes", "keep", "clairvoyant", "data", "salt")
        options = {name: getattr(self, name) for name in shared} | {"console": console}
        request, run = Request(**options), None
        if has_entries:
            from ..entrants.score import STUDY

            request, run = self._make_comparison(request), STUDY.run
        how = "the same command" if self.keep else "the same command, from the start"
        if "control" in names and not self.keep:
            how = "add --keep FOLDER, which keeps finished cases of control"
        with use_engine(self.engine_name, self.address), common.handle_interrupt(how):
            done = run_suites(names, request, run)
        common.write_output(console, done, vars(self), brief=True)
        if self.page is not None:
            write_page(self.page, done)
        common.print_written(console, self.page)

    def _make_comparison(self, request: Request) -> "ComparisonRequest":
        """Make the request of a user's own entries, on the options of a run."""
        from ..entrants.challenge import ComparisonRequest, make_user_entries
        from ..entrants.worker import LIMIT

        if list(self.suites or []) not in ([], ["control"]):
            raise ValueError("--agent and --estimator go with the suite control alone")
        estimators = ["" if name == "none" else name for name in self.estimator or []]
        entries = tuple(make_user_entries(self.agent or [], estimators, self.trust))
        if not entries:
            raise ValueError("--estimator none goes with --agent")
        where = self.vehicle, tuple(self.scenario or []), self.env_id, None
        limit = LIMIT if self.limit is None else self.limit
        return ComparisonRequest(entries, *where, self.fresh, limit, **vars(request))


_tune_app = typer.Typer(no_args_is_help=True)
app.add_typer(_tune_app, name="tune")

_RECORDED = ("scenario", "env", "target", "option", "search", "noise", "sampler")
_ALWAYS_RECORDED = ("trials", "seeds")


@_tune_app.callback()
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


@register("estimator", to=_tune_app)
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
        chosen = self.name, self.scenario, self.env or None, self.target
        held = common.parse_options(self.option)
        task = make_estimator_tuning(*chosen, held, ranges or None, noises, self.seeds)
        if self.write and not all(key.startswith("q_") for key in task.search):
            raise ValueError("shipped tunings hold process noise alone: --out writes the others")
        where = (self.storage or STORAGE, self.sampler, self.seed, self.jobs)
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
            common.print_written(console, path)


@register("controller", to=_tune_app)
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

        shipped = (FILE, controllers.LOGS) if self.write else (None, None)
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
        common.check_file(path, ".json")
        known = {item.name: item for item in list_scored_tasks()}
        for name in self.contest or []:
            check_choice("task", name, known)
        tasks = [known[name] for name in self.contest or known]
        how = "run the same command in the same folder"
        with use_engine(self.engine_name, self.address), common.handle_interrupt(how):
            chosen = tasks, seeds, common.get_command_line(), self.jobs, console
            records = calibrate(path.absolute(), *chosen)
        table = Table("task", "none", "clairvoyant", "a plan wins")
        for record in records:
            none = np.mean([episode.costs["none"] for episode in record.episodes])
            wins = sum(episode.winner.startswith("from") for episode in record.episodes)
            best = f"{record.costs.mean():.4g}"
            table.add_row(record.task.name, f"{none:.4g}", best, f"{wins} of {seeds}")
        console.print(table)
        common.print_written(console, path)


app.registered_commands.sort(key=lambda item: _ORDER.index(str(item.name)))
