"""`sideslip calibrate`: the clairvoyant's mean costs, into the file that scores are made with."""

import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from ..harness.results import check_writable


def calibrate_command(
    env: Annotated[str, typer.Option(help="An environment's id.")] = "sideslip/YawFusion-v0",
    scenario: Annotated[
        list[str] | None, typer.Option(help="Repeatable; default: all that are scored.")
    ] = None,
    seeds: Annotated[int, typer.Option(help="Calibration seeds a scenario.")] = 64,
    start: Annotated[
        str, typer.Option(help="The agent whose run is the second start; none: zero alone.")
    ] = "two-dof",
    estimator: Annotated[str, typer.Option(help="Of that agent; empty: none.")] = "exact-kf",
    out: Annotated[Path | None, typer.Option(help="Default: the shipped calibration.")] = None,
    jobs: Annotated[int | None, typer.Option("--jobs", "-j", min=1, help="Processes.")] = None,
) -> None:
    """Find the cost of the clairvoyant, which a score of 1 stands for.

    A stopped run goes on where it was when the same command runs again in the same folder.
    """
    from ..control.calibration import FILE, calibrate, cases_of, forget, update
    from ..control.cells import MANOEUVRES

    path = FILE if out is None else out
    check_writable(path)
    names = scenario or list(MANOEUVRES)
    words = ["sideslip", "calibrate", "--env", env]
    words += [word for name in scenario or [] for word in ("--scenario", name)]
    words += ["--seeds", str(seeds), "--start", start, "--estimator", estimator]
    console = Console()
    folder = Path(f".{path.name}.cases")
    made = calibrate(names, folder, env, seeds, start, estimator, shlex.join(words), jobs, console)
    update(path, made)
    forget(cases_of(names, folder, env, seeds, start, estimator))
    table = Table("scenario", "none", "clairvoyant", "standard error", "plan from the agent wins")
    for entry in made:
        wins = sum(episode.winner == f"from {start}" for episode in entry.episodes)
        table.add_row(
            entry.scenario,
            f"{entry.none:.4g}",
            f"{entry.clairvoyant:.4g}",
            f"{entry.clairvoyant_error:.2g}",
            f"{wins} of {seeds}",
        )
    console.print(table)
    console.print(f"calibration: {path}", highlight=False, soft_wrap=True)
