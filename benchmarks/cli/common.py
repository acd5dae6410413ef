"""What commands share: options as fields of records, files that they write, and who drives."""

import json
import platform
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import MISSING, dataclass, field, fields
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import typer
from rich.console import Console
from typer import Exit

from ... import __version__
from ...envs.io import atomic_file
from ..harness.parallel import PROCESSES
from ..harness.results import Suite, check_writable, write_json, write_parquet, write_text
from ..report.tables import print_run, print_suite
from .names import check_env, complete

if TYPE_CHECKING:
    from ...agents import Agent
    from ...agents.env_info import CarEnv
    from ...agents.rollout import Rollout

Text = str | None
Texts = list[str] | None
File = Path | None
Kind = TypeVar("Kind", bound=type)

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)


def take(
    help: str,
    default: Any = None,
    *names: str,
    declare: Callable[..., Any] = typer.Option,
    ends: str = "",
    kinds: str = "",
    **more: Any,
) -> Any:
    """Make the dataclass field of a command's option.

    Args:
        help: Help text of the option.
        default: Default value, `...` for a required one.
        names: Options that replace the field's name, such as "--jobs" and "-j".
        declare: Typer's function that declares the option.
        ends: Suffixes of a file that is written, which is checked before the work: ".html .htm".
        kinds: Kinds of the names that a shell completes: "agents policies".
        more: Other arguments of `declare`.

    Returns:
        Field whose metadata hold typer's declaration.
    """
    more |= {"autocompletion": complete(*kinds.split())} if kinds else {}
    declared = {"typer": declare(default, *names, help=help, **more), "ends": ends}
    return field(default=MISSING if default is ... else default, metadata=declared)


take_argument = partial(take, declare=typer.Argument)
_SHARED: dict[str, Any] = {
    "address": take("HOST:PORT of the cluster; default: this machine's.", ""),
    "control_period": take("Control period in ticks of 1 ms; default: 10."),
    "engine_name": take(
        "What runs the cases: processes, or ray, a cluster.", PROCESSES, "--engine"
    ),
    "html": take("Write a self-contained report.", ends=".html .htm"),
    "jobs": take("Number of parallel processes.", None, "--jobs", "-j", min=1),
    "json": take("Write the rows as JSON.", ends=".json"),
    "mapping": take(
        "NAME_UNIT=COLUMN of the log (yaw_rate_degps=r), dbc=FILE, or a TOML file; repeatable.",
        None,
        "--map",
    ),
    "parquet": take("Write the rows as Parquet.", ends=".parquet"),
    "seed": take("Seed of the sampler; another on each machine of a study.", 0),
    "steering_offset": take("Offset that is added to the steering (deg at the wheels)."),
    "steering_ratio": take("Logged steering angle over the wheels' angle (15.2)."),
    "steering_sign": take("Sign of the logged steering: 1 or -1."),
    "storage": take("RDB URL or SQLite file; default: sideslip-tune.db here."),
    "trust": take("Read policies' zips, which may run code of their makers.", False, "--trust"),
    "vehicle": take("The car: a name or a TOML or JSON file.", kinds="vehicles"),
}  # a command declares these fields without a value


def register(name: str, line: str | None = None, to: typer.Typer = app) -> Callable[[Kind], Kind]:
    """Make a command of a class with `run`: its help is the docstring, its options the fields.

    Args:
        name: Name of the command.
        line: Short help in the list of commands.
        to: Typer application of the command.

    Returns:
        Decorator of the class.
    """

    def register_class(kind: Kind) -> Kind:
        for shared in kind.__annotations__.keys() - vars(kind).keys():
            setattr(kind, shared, copy(_SHARED[shared]))  # into which the dataclass writes
        record: Any = dataclass(frozen=True)(kind)

        def call(**values: Any) -> None:
            for option in fields(record):
                if ends := option.metadata["ends"]:
                    check_file(values[option.name], ends)
            record(**values).run()

        call.__doc__ = kind.__doc__
        vars(call)["__signature__"] = Signature([
            Parameter(x.name, Parameter.KEYWORD_ONLY, default=x.metadata["typer"],
                      annotation=x.type)
            for x in fields(record)
        ])  # fmt: skip
        to.command(name, short_help=line)(call)
        return kind

    return register_class


def check_file(path: Path | None, ends: str) -> None:
    """Check before the work that a file has a known suffix and can be written.

    Args:
        path: File, None for none.
        ends: Suffixes, such as ".html .htm".
    """
    known = ends.split()
    if path and path.suffix.lower() not in known and not path.is_char_device():
        raise ValueError(f"{path}: expected a file that ends in {' or '.join(known)}")
    check_writable(path)


def parse_options(texts: Sequence[str] | None) -> dict[str, Any]:
    """Parse options; ValueError for a text of another form.

    Args:
        texts: Texts such as NAME=VALUE, None for none; a value is JSON or a word.
    """
    options: dict[str, Any] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise ValueError(f"an option is NAME=VALUE, got {text!r}")
        if name in options:
            raise ValueError(f"option {name} is there twice, as {options[name]!r} and {value!r}")
        options[name] = value
        with suppress(json.JSONDecodeError):
            options[name] = json.loads(value)
    return options


_PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "control", "plotly")  # named in reports
_DEFAULT_ENVS = ("sideslip/YawVision-v0", "sideslip/AfsYawFusion-v0")


def get_command_line() -> str:
    """Get the command line of this process."""
    return shlex.join(["sideslip", *sys.argv[1:]])


def announce_torch() -> None:
    """Say that PyTorch is loaded, which takes seconds; nothing where it is there already."""
    if sys.modules.get("torch") is None:
        print("sideslip: loading PyTorch, some seconds ...", file=sys.stderr, flush=True)


@contextmanager
def handle_interrupt(how: str) -> Iterator[None]:
    """End with exit status 130 where the user interrupts.

    Args:
        how: How to continue, which is printed.
    """
    try:
        yield
    except KeyboardInterrupt:
        Console(stderr=True, soft_wrap=True).print(f"stopped; to go on: {how}", highlight=False)
        raise Exit(130) from None


def print_written(console: Console, *paths: Path | None) -> None:
    """Print that files were written.

    Args:
        console: Console that prints.
        *paths: Files that were written, None for none.
    """
    for path in filter(None, paths):
        console.print(f"wrote {path}", highlight=False, soft_wrap=True, markup=False)


def show_episode(
    console: Console, drive: "Rollout", driver: str, files: Mapping[str, Path | None] | None = None
) -> None:
    """Print an episode's score, and write its picture, signals and track.

    Args:
        console: Console that prints.
        drive: Record of the episode.
        driver: Name of the track.
        files: Files of the picture (plot), all signals (parquet) and the track (kml), if wanted.
    """
    from ..report.film import make_track_kml

    slip = drive["beta"]
    text = (
        f"{drive.log.name}: {drive['t'][-1]:.2f} s, cost {drive.cost:.4g}, "
        f"RMS slip {1e3 * np.sqrt(np.mean(slip**2)):.2f} mrad, "
        f"peak {1e3 * np.max(np.abs(slip)):.2f} mrad" + (", FAILED" if drive.failed else "")
    )
    console.print(text, soft_wrap=True, markup=False, highlight=False)
    plot, parquet, kml = ((files or {}).get(name) for name in ("plot", "parquet", "kml"))
    if plot is not None:
        with atomic_file(plot) as file:
            drive.plot().savefig(file, format=plot.suffix[1:] or "png", dpi=120)
    if parquet is not None:
        drive.to_parquet(parquet)
    if kml is not None:
        write_text(kml, make_track_kml(drive.log.name, driver, drive["X"], drive["Y"]))
    print_written(console, plot, parquet, kml)


def write_output(
    console: Console, suites: Sequence[Suite], options: Mapping[str, Any], brief: bool = False
) -> None:
    """Print suites, and write their report and rows to files.

    Args:
        console: Console that prints.
        suites: Results to print and write.
        options: With files of the report (html) and, perhaps, the rows (json, parquet); None: none.
        brief: Whether verdicts and a table are printed instead of all tables.
    """
    html = options["html"]
    if brief:
        print_run(console, suites, html is not None)
    for suite in () if brief else suites:
        print_suite(console, suite)
    rows = [row for suite in suites for row in suite.rows]
    for kind, write in (("json", write_json), ("parquet", write_parquet)):
        if (path := options.get(kind)) is not None:
            write(path, rows)
            print_written(console, path)
    if html is not None:
        from ..report.html import write_report

        versions = {"sideslip": __version__, "Python": platform.python_version()}
        for name in _PACKAGES:
            with suppress(PackageNotFoundError):
                versions[name] = version(name)
        write_report(html, list(suites), get_command_line(), versions)
        print_written(console, html)


def refuse_unused_options(command: Any, used: str, what: str) -> None:
    """Raise ValueError for options that a command would ignore.

    Args:
        command: Command.
        used: Names of the options that it uses.
        what: What uses no others.
    """
    changed = {x.name for x in fields(command) if getattr(command, x.name) != x.default}
    if ignored := sorted(changed - {*used.split()}):
        raise ValueError(f"{', '.join(ignored)}: of no use to {what}")


def make_setup(options: Mapping[str, Any]) -> dict[str, Any]:
    """Make the record of who drives, in which env.

    Args:
        options: Options of the command by name.

    Returns:
        Names and options of agent, estimator and env, and the seed.
    """
    chosen = {name: options[name] for name in ("scenario", "vehicle", "control_period")}
    env_options = {name: value for name, value in chosen.items() if value is not None}
    more = parse_options(options["option"])
    if twice := sorted(env_options.keys() & more.keys()):
        raise ValueError(f"{twice[0]} is there twice, as a flag and as --option")
    return {
        **{name: options[name] for name in ("estimator", "agent", "env")},
        "options": env_options | more,
        "agent_options": parse_options(options["agent_option"]),
        "estimator_options": parse_options(options["estimator_option"]),
        "seed": options["seed"],
    }


def make_driver(setup: Mapping[str, Any], trust: bool) -> "tuple[CarEnv, Agent]":
    """Make an env with its estimator, and the agent; without an env the first that fits.

    Args:
        setup: Record of `make_setup`.
        trust: Whether a policy's zip may be read, which runs code of its maker's.

    Returns:
        Env and agent.
    """
    first, *others = _DEFAULT_ENVS if setup["env"] is None else (setup["env"],)
    check_env(first)
    try:
        return _make_driver(setup, first, trust)
    except ValueError:
        for other in others:
            with suppress(TypeError, ValueError):
                return _make_driver(setup, other, trust)
        raise


def _make_driver(setup: Mapping[str, Any], env_id: str, trust: bool) -> "tuple[CarEnv, Agent]":
    from ...agents import make_agent
    from ...agents.env_info import make_env
    from ...estimators.wrappers.estimate import EstimateObservation, choose_estimator
    from ..control.entries import Entry
    from ..harness.drives import call_quietly

    agent, estimator, options = setup["agent"], setup["estimator"], setup["estimator_options"]
    env = make_env(env_id, setup["options"])
    if estimator is not None:
        arguments = env, estimator, Entry(agent, estimator).outputs
        env = call_quietly(EstimateObservation, *arguments, options=options or None)
    elif options:
        raise ValueError("--estimator-option needs --estimator")
    try:
        return env, make_agent(agent, env, trust=trust, **setup["agent_options"])
    except ValueError as error:
        if estimator is None and "_hat" in str(error):
            example = f"--estimator {choose_estimator(env.get_wrapper_attr('slow_sensors'))}"
            text = f"{agent} works on an estimate: add --estimator, for example {example}"
            raise ValueError(text) from None
        raise
