"""`sideslip calibrate`: what the clairvoyant costs, into a file beside the user."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ...envs.arguments import check_choice
from ..harness.engines import PROCESSES, engine
from .options import Address, EngineName, command_line
from .output import check_files, explain_interrupt, wrote


def calibrate_command(
    out: Annotated[Path, typer.Argument(help="The file to write.")] = Path("clairvoyant.json"),
    contest: Annotated[
        list[str] | None, typer.Option(help="Its name in the tables; default: all. Repeatable.")
    ] = None,
    seeds: Annotated[int, typer.Option(help="Seeds a contest.")] = 64,
    write: Annotated[bool, typer.Option("--write", help="Into the package instead.")] = False,
    jobs: Annotated[int | None, typer.Option("--jobs", "-j", min=1, help="Processes.")] = None,
    engine_name: EngineName = PROCESSES,
    address: Address = "",
) -> None:
    """Find the cost of the clairvoyant, the ladder's highest rung, in the scored contests.

    A stopped run goes on where it was when the same command runs again in the same folder. `bench
    control --clairvoyant FILE` reads the file.
    """
    from ..control.calibration import FILE, calibrate, cases_of, forget, update
    from ..control.contests import contests

    path = FILE if write else out
    check_files(json=path)
    known = {each.name: each for each in contests()}
    for name in contest or []:
        check_choice("contest", name, known)
    asked = [known[name] for name in contest or known]
    console, folder = Console(), Path(f".{path.name}.cases").absolute()
    left = sum(not each.path.exists() for each in cases_of(asked, folder, seeds))
    text = f"{left} of {len(asked) * seeds} episodes are left; the same command goes on if stopped."
    console.print(text, highlight=False)
    with engine(engine_name, address), explain_interrupt("run the same command in the same folder"):
        made = calibrate(asked, folder, seeds, command_line(), jobs, console)
    update(path, made)
    forget(cases_of(asked, folder, seeds))
    table = Table("contest", "none", "clairvoyant", "a plan wins")
    for entry in made:
        none = np.mean([episode.costs["none"] for episode in entry.episodes])
        wins = sum(episode.winner.startswith("from") for episode in entry.episodes)
        best = f"{entry.costs.mean():.4g}"
        table.add_row(entry.contest.name, f"{none:.4g}", best, f"{wins} of {seeds}")
    console.print(table)
    wrote(console, path)
