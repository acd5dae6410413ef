"""`sideslip calibrate`: what the clairvoyant costs, into a file beside the user."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ...envs.arguments import check_choice
from ..harness.engines import PROCESSES, use_engine
from .options import Address, EngineName, get_command_line
from .output import check_files, handle_interrupt, print_written


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
    from ..control.calibration import FILE, calibrate, make_cases, remove_cases, update
    from ..control.contests import list_scored_tasks

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
    with (
        use_engine(engine_name, address),
        handle_interrupt("run the same command in the same folder"),
    ):
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
