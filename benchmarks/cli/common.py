"""Helpers of the commands: the files that they write, and who drives in `run` and `live`."""

import platform
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from typer import Exit

from ... import __version__
from ...envs.io import atomic_file
from ..harness.results import Suite, write_json, write_parquet, write_text
from ..report.tables import print_run, print_suite
from .names import check_env
from .options import parse_options

if TYPE_CHECKING:
    from ...agents import Agent
    from ...agents.env_info import CarEnv
    from ...agents.rollout import Rollout

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
