"""The command line `sideslip`: all commands, with `list`, `run` and `bench` themselves."""

import copy
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ... import __version__
from ...envs.validation import check_choice
from ..harness.parallel import report_user_errors, use_engine
from ..report.html import check_page, write_page
from ..suites import SALTED, SUITES, Request, run_suites
from . import common, data, live, policies  # noqa: F401  # they register their commands
from .common import File, Text, Texts, app, register, take, take_argument
from .names import KINDS
from .search import tune_app

if TYPE_CHECKING:
    from ..entrants.challenge import ComparisonRequest

__all__ = ["app", "main"]
app.add_typer(tune_app, name="tune")
console = Console()
_ORDER = (
    *("train", "distill", "enjoy", "export", "train-estimator", "replay", "identify", "inspect"),
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
        comparison = self._make_comparison() if self.agent or self.estimator else None
        of_entries = {
            "--scenario": self.scenario, "--env": self.env_id, "--fresh": self.fresh,
            "--vehicle": self.vehicle, "--trust": self.trust, "--limit": self.limit is not None,
        }  # fmt: skip
        if stray := [name for name, value in of_entries.items() if value and comparison is None]:
            raise ValueError(f"{', '.join(stray)} go with --agent or --estimator")
        everything = [name for name in SUITES if name != "logs" or self.data]
        names = self.suites or (["control"] if comparison else everything)
        for name in names:
            check_choice("suite", name, SUITES)
        if self.salt:
            from ..control.tasks import make_salted_seeds

            if not {*SALTED} & {*names}:
                raise ValueError(f"--salt goes with {', '.join(SALTED)}, got {', '.join(names)}")
            make_salted_seeds(self.salt, 1)  # or ValueError
        check_page(self.page, names)
        for option, suite in (("keep", "control"), ("clairvoyant", "control"), ("data", "logs")):
            fits = suite in names and not (comparison and option != "keep")
            if getattr(self, option) is not None and not fits:
                got = "--agent or --estimator" if suite in names else ", ".join(names)
                raise ValueError(f"--{option} goes with the suite {suite}, got {got}")
        if self.episodes is not None and not {*names} - _FIXED:
            raise ValueError(f"--episodes: {', '.join(names)} has a number of its own")
        chosen = self.episodes, self.keep, self.clairvoyant, self.data, self.salt
        request = Request(self.quick, self.jobs, console, *chosen)
        how = "the same command" if self.keep else "the same command, from the start"
        if "control" in names and not self.keep:
            how = "add --keep FOLDER, which keeps finished cases of control"
        with use_engine(self.engine_name, self.address), common.handle_interrupt(how):
            done = run_suites(names, request, comparison)
        common.write_output(console, done, vars(self), brief=True)
        if self.page is not None:
            write_page(self.page, done)
        common.print_written(console, self.page)

    def _make_comparison(self) -> "ComparisonRequest":
        """Make the request of a user's own entries."""
        from ..control.entries import QUICK_EPISODES
        from ..entrants.challenge import EPISODES, ComparisonRequest, make_user_entries
        from ..entrants.worker import LIMIT

        if list(self.suites or []) not in ([], ["control"]):
            raise ValueError("--agent and --estimator go with the suite control alone")
        estimators = ["" if name == "none" else name for name in self.estimator or []]
        entries = tuple(make_user_entries(self.agent or [], estimators, self.trust))
        if not entries:
            raise ValueError("--estimator none goes with --agent")
        episodes = self.episodes or (QUICK_EPISODES if self.quick else EPISODES)
        limit = LIMIT if self.limit is None else self.limit
        where = self.vehicle, tuple(self.scenario or []), self.env_id, episodes
        return ComparisonRequest(entries, *where, fresh=self.fresh, salt=self.salt, limit=limit)


app.registered_commands.sort(key=lambda item: _ORDER.index(str(item.name)))
