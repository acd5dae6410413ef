"""`sideslip enjoy`: a learned policy at work, and what it costs against others."""

from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..harness.parallel import one_bar
from .export import Trust, as_policy, sizes_of
from .output import check_files, show_episode, write_output, wrote

if TYPE_CHECKING:
    from ...agents.learned.files import Policy


def enjoy_command(
    policy: Annotated[
        str, typer.Argument(help="A shipped policy's name, or a file's or zip's path.")
    ],
    env: Annotated[str | None, typer.Option(help="Another id than the policy's own.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="How many.")] = 256,
    scenario: Annotated[str | None, typer.Option(help="A scenario's name.")] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Of the first episode; default: test seeds made from the weights."),
    ] = None,
    html: Annotated[Path | None, typer.Option("--html", help="Write a report.")] = None,
    json: Annotated[Path | None, typer.Option("--json", help="Write the rows.")] = None,
    parquet: Annotated[Path | None, typer.Option("--parquet", help="Write the rows.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Write the first episode as a PNG.")] = None,
    video: Annotated[
        Path | None, typer.Option(help="Write it as a film, .mp4 or .gif, no control beside it.")
    ] = None,
    card: Annotated[bool, typer.Option("--card", help="Show the policy's card, no more.")] = False,
    trust: Trust = False,
) -> None:
    """Drive a learned policy: its cost against no control and the best classical line.

    A zip drives the id that it was trained on (--env); `sideslip export` takes further options.
    """
    from ...agents.learned.files import load_policy
    from ..control.figures import contestant_of, run_of
    from ..policies import enjoy, suite_of
    from ..report.film import Driver, check_film, film

    console = Console()
    check_files(html=html, json=json, parquet=parquet, plot=plot)
    check_film(video)
    with as_policy(policy, env, trust) as path:
        if card:
            _show_card(console, load_policy(path))
            return
        with one_bar(console, f"enjoy {policy}"):
            found = enjoy(path, episodes, env_id=env, scenario=scenario, seed=seed)
        write_output(console, [suite_of(found)], html, json, parquet)
        first = found.cells[found.policy.name]
        show_episode(console, run_of(first, found.seeds[0]), found.policy.name, plot)
        if video is not None:
            cars = (found.policy.name, first), ("no control", found.cells["none"])
            film(
                video,
                [Driver(name, *contestant_of(cell)) for name, cell in cars],
                found.seeds[0],
                console,
            )
            wrote(console, video)


def _show_card(console: Console, policy: "Policy") -> None:
    """A line a field of the card, and the size of the network."""
    network = policy.network
    unread = [name for (name, _), read in zip(policy.card.observation, policy.reads, strict=True)
              if not read]  # fmt: skip
    fields = asdict(policy.card) | {
        "observation": ", ".join(f"{name} / {unit}" for name, unit in policy.card.observation),
        "not read": ", ".join(unread) or "none",
        "network": f"{sizes_of(network)}, {network.activation}, {network.output} output",
        "observation clipped at": network.clip,
    }
    table = Table("field", "value", box=box.SIMPLE_HEAD, title=policy.name, title_justify="left")
    for name, value in fields.items():
        table.add_row(name, escape(value if isinstance(value, str) else dumps(value)))
    console.print(table)


def judged(file: Path, kind: str, episodes: int) -> Table:
    """What a policy costs in each contest of its class; its card has it too."""
    from ..distillation import judge

    table = Table("contest", "in % of nominal", "adaptive-nmpc", "better", "fails")
    with one_bar(Console(), f"judge {file}"):
        written = judge(file, kind, episodes)
    for contest, found in written["cost in % of nominal"].items():
        own, rival = found["policy"], found["adaptive-nmpc"]
        better, fails = found["better than adaptive-nmpc"][0], found["fails"]
        numbers = f"{own[0]:.0f} [{own[1]:.0f}, {own[2]:.0f}]", f"{rival[0]:.0f}"
        table.add_row(contest, *numbers, f"{100.0 * better:.0f} %", f"{100.0 * fails:.0f} %")
    return table
