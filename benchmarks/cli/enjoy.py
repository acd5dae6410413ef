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

from ..harness.parallel import use_shared_bar
from .export import Trust, describe_sizes, export_policy
from .output import check_files, print_written, show_episode, write_output

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
    from ..control.figures import make_env_and_agent, run_entry
    from ..policies import evaluate_policy, make_suite
    from ..report.film import FilmDriver, check_film, write_film

    console = Console()
    check_files(html=html, json=json, parquet=parquet, plot=plot)
    check_film(video)
    with export_policy(policy, env, trust) as path:
        if card:
            _show_card(console, load_policy(path))
            return
        with use_shared_bar(console, f"enjoy {policy}"):
            evaluation = evaluate_policy(path, episodes, env_id=env, scenario=scenario, seed=seed)
        write_output(console, [make_suite(evaluation)], html, json, parquet)
        first = evaluation.entries[evaluation.policy.name]
        show_episode(console, run_entry(first, evaluation.seeds[0]), evaluation.policy.name, plot)
        if video is not None:
            cars = (evaluation.policy.name, first), ("no control", evaluation.entries["none"])
            write_film(
                video,
                [FilmDriver(name, *make_env_and_agent(entry)) for name, entry in cars],
                evaluation.seeds[0],
                console,
            )
            print_written(console, video)


def _show_card(console: Console, policy: "Policy") -> None:
    """A line a field of the card, and the size of the network."""
    network = policy.network
    unread = [name for (name, _), read in zip(policy.card.observation, policy.reads, strict=True)
              if not read]  # fmt: skip
    fields = asdict(policy.card) | {
        "observation": ", ".join(f"{name} / {unit}" for name, unit in policy.card.observation),
        "not read": ", ".join(unread) or "none",
        "network": f"{describe_sizes(network)}, {network.activation}, {network.output} output",
        "observation clipped at": network.clip,
    }
    table = Table("field", "value", box=box.SIMPLE_HEAD, title=policy.name, title_justify="left")
    for name, value in fields.items():
        table.add_row(name, escape(value if isinstance(value, str) else dumps(value)))
    console.print(table)


def make_task_table(file: Path, kind: str, episodes: int) -> Table:
    """What a policy costs in each contest of its class; its card has it too."""
    from ..distillation import evaluate_card

    table = Table("contest", "in % of nominal", "adaptive-nmpc", "better", "fails")
    with use_shared_bar(Console(), f"judge {file}"):
        written = evaluate_card(file, kind, episodes)
    for task, record in written["cost in % of nominal"].items():
        policy_cost, rival_cost = record["policy"], record["adaptive-nmpc"]
        better, fails = record["better than adaptive-nmpc"][0], record["fails"]
        numbers = (
            f"{policy_cost[0]:.0f} [{policy_cost[1]:.0f}, {policy_cost[2]:.0f}]",
            f"{rival_cost[0]:.0f}",
        )
        table.add_row(task, *numbers, f"{100.0 * better:.0f} %", f"{100.0 * fails:.0f} %")
    return table
