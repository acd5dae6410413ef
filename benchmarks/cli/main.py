"""The command line `sideslip`: all commands, with `list`, `run` and `bench` themselves."""

from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from typer import Argument, Option

from ... import __version__
from ...envs.validation import check_choice
from ..harness.parallel import PROCESSES, report_user_errors, use_engine
from ..report.html import check_page, write_page
from ..suites import SUITES, Request, check_salt, run_suites
from .common import (
    check_files,
    handle_interrupt,
    parse_options,
    print_written,
    show_episode,
    write_output,
)
from .data import MappingOption, identify_command, lane_command, replay_command
from .live import live_command
from .names import (
    KINDS,
    Address,
    EngineName,
    File,
    Html,
    Jobs,
    Json,
    Parquet,
    Text,
    Texts,
    complete,
)
from .policies import (
    Trust,
    distill_command,
    enjoy_command,
    export_command,
    train_command,
    train_estimator_command,
)
from .search import calibrate_command, tune_app

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
app.add_typer(tune_app, name="tune")
for _name, _command, _line in (
    ("train", train_command, "Train a policy."),
    ("distill", distill_command, "Train a policy to imitate a controller."),
    ("enjoy", enjoy_command, "Drive a policy beside other controllers."),
    ("export", export_command, "Make a policy's file of a zip."),
    ("train-estimator", train_estimator_command, "Train a network that corrects a filter."),
    ("replay", replay_command, "Run estimators over a recorded drive."),
    ("identify", identify_command, "Find the car of a recorded drive."),
    ("lane", lane_command, "Find the lane in a picture or film."),
    ("live", live_command, "Run an estimator on a car's wires."),
    ("calibrate", calibrate_command, "Find the cost of perfect foresight."),
):
    app.command(_name, short_help=_line)(_command)
console = Console()

VehicleOption = Annotated[
    Text,
    Option(help="The car: a name or a TOML or JSON file.", autocompletion=complete("vehicles")),
]


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
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print it.")
    ] = False,
) -> None:
    """Lateral stability of electric vehicles: environments, estimators, controllers."""


@app.command("list", short_help="List everything that has a name.")
def list_names(
    kinds: Annotated[
        Texts, Argument(help=f"{', '.join(KINDS)}; default: all.", autocompletion=lambda: [*KINDS])
    ] = None,
) -> None:
    """Everything that has a name, with a line on each."""
    for kind in kinds or []:
        check_choice("kind of name", kind, KINDS)
    for kind in kinds or KINDS:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")  # a long word goes on in the next line
        for name, line in KINDS[kind]().items():
            table.add_row(name, escape(line))
        console.print(f"[bold]{kind}[/]")
        console.print(table)


@app.command(short_help="Drive one episode and draw it.")
def run(
    env_id: Annotated[
        Text,
        Argument(
            help="An environment's id; default: the first of YawVision and AfsYawFusion that fits.",
            autocompletion=complete("environments"),
        ),
    ] = None,
    agent: Annotated[
        str,
        Option(
            help="A name, a policy's path, FILE.py:Class or module:Name.",
            autocompletion=complete("agents", "policies"),
        ),
    ] = "none",
    estimator: Annotated[
        Text,
        Option(help="A name, FILE.py:Class or module:Name.", autocompletion=complete("estimators")),
    ] = None,
    vehicle: VehicleOption = None,
    scenario: Annotated[
        Text,
        Option(
            help="A name, a TOML or JSON file, or a recorded drive (CSV, Parquet) to steer as.",
            autocompletion=complete("scenarios"),
        ),
    ] = None,
    option: Annotated[
        Texts, Option(help="NAME=VALUE of the environment (reference=model); repeatable.")
    ] = None,
    agent_option: Annotated[
        Texts, Option(help="NAME=VALUE of the agent (grip=0.6); repeatable.")
    ] = None,
    estimator_option: Annotated[
        Texts, Option(help="NAME=VALUE of the estimator (q_beta=1e-4); repeatable.")
    ] = None,
    seed: Annotated[int, Option(help="Seed of the episode.")] = 0,
    control_period: Annotated[int, Option(help="Ticks of 1 ms.")] = 10,
    plot: Annotated[File, Option(help="Write a PNG, PDF or SVG.")] = None,
    parquet: Annotated[File, Option(help="Write every signal.")] = None,
    kml: Annotated[File, Option(help="Write the track for a map.")] = None,
    video: Annotated[File, Option(help="Write a film, .mp4 or .gif.")] = None,
    beside: Annotated[Text, Option(help="Another agent, a ghost in the film.")] = None,
    trust: Trust = False,
) -> None:
    """Drive one episode, print its score, draw it."""
    from ...agents.rollout import rollout
    from ..report.film import FilmDriver, check_film, write_drive_film
    from .common import AgentSpec

    check_files(plot=plot, parquet=parquet, kml=kml)
    check_film(video)
    chosen = {"scenario": scenario, "vehicle": vehicle, "control_period": control_period}
    env_options = {name: value for name, value in chosen.items() if value is not None}
    spec = AgentSpec(
        agent, parse_options(agent_option), estimator, parse_options(estimator_option), trust
    )
    driver = FilmDriver(agent, *spec.build(env_id, env_options | parse_options(option)))
    if env_id is None and driver.env.spec is not None:
        console.print(f"on {driver.env.spec.id}", highlight=False)
    drive = rollout(driver.env, driver.agent, seed)
    show_episode(console, drive, agent, plot, parquet, kml)
    write_drive_film(video, driver, beside, seed, console)


@app.command(short_help="Compare estimators and controllers.")
def bench(
    suites: Annotated[
        Texts, Argument(help="Suites; default: all.", autocompletion=complete("suites"))
    ] = None,
    quick: Annotated[bool, Option("--quick", help="Few seeds: a first look in minutes.")] = False,
    log: Annotated[File, Option(help="Replay this recorded drive too.")] = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    html: Html = None,
    json: Json = None,
    parquet: Parquet = None,
    picture: Annotated[File, Option(help="The summary: PNG, PDF or SVG.")] = None,
    page: Annotated[File, Option(help="Put the tables between this Markdown page's marks.")] = None,
    jobs: Jobs = None,
    episodes: Annotated[
        int | None, Option(min=4, help="A cell of control (256), or seeds of other suites.")
    ] = None,
    keep: Annotated[
        File, Option(help="A folder for finished cases: a stopped run goes on.")
    ] = None,
    clairvoyant: Annotated[
        File, Option(help="A file of `sideslip calibrate`; default: the package's.")
    ] = None,
    agent: Annotated[
        Texts,
        Option(
            help="Your own: FILE.py:Class, a policy's path, a name; repeatable.",
            autocompletion=complete("agents", "policies"),
        ),
    ] = None,
    estimator: Annotated[Texts, Option(help="FILE.py:Class, a name, none; repeatable.")] = None,
    scenario: Annotated[Texts, Option(help="A name or a file; repeatable.")] = None,
    env_id: Annotated[str, Option("--env", help="The contests of this id alone.")] = "",
    fresh: Annotated[
        bool, Option("--fresh", help="Seeds drawn after your files are hashed: publishable.")
    ] = False,
    salt: Annotated[
        str, Option(help="Salt of the test seeds, hexadecimal; default: made from the sources.")
    ] = "",
    limit: Annotated[float, Option(help="s of wall time for a contestant in a contest.")] = 600.0,
    trust: Trust = False,
    engine_name: EngineName = PROCESSES,
    address: Address = "",
) -> None:
    """Compare estimators and controllers, and a recorded drive with --log; with --agent and
    --estimator your own beside some of the package's."""
    comparison = None
    if agent or estimator:
        from ..control.entries import QUICK_EPISODES
        from ..entrants.challenge import EPISODES, ComparisonRequest, make_user_entries

        if list(suites or []) not in ([], ["control"]):
            raise ValueError("--agent and --estimator go with the suite control alone")
        estimators = ["" if name == "none" else name for name in estimator or []]
        entries = tuple(make_user_entries(agent or [], estimators, trust))
        if not entries:
            raise ValueError("--estimator none goes with --agent")
        car, scenarios = None if log else vehicle, tuple(scenario or [])
        n_episodes = episodes or (QUICK_EPISODES if quick else EPISODES)
        comparison = ComparisonRequest(
            entries, vehicle=car, scenarios=scenarios, env_id=env_id, episodes=n_episodes,
            fresh=fresh, salt=salt, limit=limit,
        )  # fmt: skip
    elif scenario or env_id or fresh:
        raise ValueError("--scenario, --env and --fresh go with --agent or --estimator")
    names = suites or (["control"] if comparison else list(SUITES))
    for name in names:
        check_choice("suite", name, SUITES)
    check_salt(salt, names)
    check_files(html=html, json=json, parquet=parquet, picture=picture, page=page)
    check_page(page, names)
    done = []
    if log is not None:  # first: a log that cannot be read should not cost minutes
        from ..recorded.replay import replay_file

        done.append(replay_file(log, vehicle, mapping=mapping))
    request = Request(quick, jobs, console, episodes, keep, clairvoyant, comparison, salt)
    how = "the same command" if keep else "add --keep FOLDER, which keeps finished cases"
    with use_engine(engine_name, address), handle_interrupt(how):
        done += run_suites(names, request)
    order = [*names, "replay"]
    done.sort(key=lambda suite: order.index(suite.name))
    write_output(console, done, html, json, parquet, brief=True)
    if picture is not None:
        from ..picture import write_picture

        write_picture(picture, done)
        print_written(console, picture)
    if page is not None:
        write_page(page, done)
        print_written(console, page)
