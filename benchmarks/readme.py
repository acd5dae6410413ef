"""The tables of results in README.md and docs/results/benchmark.md.

`python -m sideslip.benchmarks.readme` drives the entries in every task with steering, and writes
their rows to docs/first.json and both tables. The columns of transfer are those of
docs/procedures.json, which `sideslip bench procedures --json docs/procedures.json` writes.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from ..envs.scenarios.world import GROUPS, make_world
from .control.entries import JOINT, LEARNED, REFERENCE_CONTROLLER, REFERENCE_FILTER, Entry
from .control.run import Results, measure
from .control.score import CONSTANTS, Standing, rank_entries
from .control.tasks import (
    NOMINAL,
    PARAMETERS,
    STATE,
    STEERING,
    TITLES,
    WORLD,
    ControlTask,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
)
from .harness.parallel import report_user_errors
from .harness.results import ResultRow, Suite, read_json, write_json, write_text

README, PAGE = Path("README.md"), Path("docs/results/benchmark.md")
ROWS, TRANSFER = Path("docs/first.json"), Path("docs/procedures.json")
METRICS = ("cost_vs_nominal", "failure_rate", "score")
SPEEDS = dict(zip(TITLES, ("18-28 km/h", "60-90 km/h", "70-110 km/h"), strict=True))
ENTRIES: dict[str, Sequence[tuple[str, str]]] = {
    "a controller given the true state and car": [(STATE, "")],
    "policy on `joint`": [("distill-car-steering", JOINT), ("distill-coms-steering", JOINT)],
    "`adaptive-nmpc` on `joint`": [("adaptive-nmpc", JOINT)],
    "`adaptive-lqr` on `joint`": [("adaptive-lqr", JOINT)],
    "tuned LQG: `lqr` on `exact-kf`": [(REFERENCE_CONTROLLER, REFERENCE_FILTER)],
    "LQG as designed": [(NOMINAL, "")],
    "`model-following` on `exact-kf` (dakf-stability)": [("model-following", REFERENCE_FILTER)],
    "`two-dof` on `exact-kf` (tie-vision), motors alone": [("two-dof", REFERENCE_FILTER)],
    "no control": [("none", "")],
}
"""The lines of README's table, and who stands for each: of a policy the one of the task's car."""
PAGE_ENTRIES = ENTRIES | {  # the lines of the page's tables
    "policy on late samples alone": [("raw-car-steering", ""), ("raw-coms-steering", "")],
    "a controller given the true car, not its state": [(PARAMETERS, "")],
}
_PROCEDURES = {"distill-car-steering": "policy on joint"}
_TRANSFER = {
    "FMVSS 126": ("fmvss-126 passenger-car", "amplitude", 1.0, ".1f"),
    "another plant": ("outside multi-body", "ratio", 100.0, ".0f"),
}
"""Columns of transfer: scenario, metric, factor and format."""
EPISODES, _DOUBLED_EPISODES = 64, 32  # a task
_DOUBLED = ", ranges doubled"


def _measure_entries(
    jobs: int | None = None, console: Console | None = None, salt: str = "",
    keep: Path | None = None,
) -> list[ResultRow]:  # fmt: skip
    """Drive the entries and nominal in every scored task with steering; return their rows."""
    policies = {entry.agent: kind for kind, entries in LEARNED.items() for entry in entries}
    pairs = [(NOMINAL, ""), *(pair for pairs in PAGE_ENTRIES.values() for pair in pairs)]
    salt, rows = salt or make_salt(), list[ResultRow]()
    for changes, episodes in (({}, EPISODES), ({"world": _double_ranges()}, _DOUBLED_EPISODES)):
        cases = [
            (replace(task, changes=changes), Entry(*pair))
            for task in _list_tasks()
            for pair in pairs
            if policies.get(pair[0], task.kind) == task.kind
        ]
        seeds = make_task_seeds(salt, episodes)
        results = measure(cases, seeds, jobs=jobs, console=console, keep=keep, title="README")
        check_driven(results)
        suite = Suite("control", "", "")
        for tier in TITLES:
            for standing in rank_entries(results, tier):
                standing.add_rows(suite, salt)
                if not changes:
                    suite.add_rows(_score_otherwise(standing), salt=salt)
        suffix = _DOUBLED if changes else ""
        rows += [
            replace(x, scenario=x.scenario + suffix) for x in suite.rows if x.metric in METRICS
        ]
    return rows


def _score_otherwise(standing: Standing) -> list[dict[str, Any]]:
    """Make rows of an entry's score by other constants."""
    names = {"controller": standing.entry.agent, "estimator": standing.entry.estimator}
    return [
        names
        | {"scenario": f"tier {standing.tier}, {label}", "n": standing.n}
        | {"score": standing.compute_score(*constants)}
        for label, constants in CONSTANTS.items()
    ]


def _list_tasks() -> list[ControlTask]:
    return [task for task in list_scored_tasks() if task.env_id == STEERING]


def _double_ranges() -> dict[str, Any]:
    """Make the world with all ranges doubled, which designs are told as they are told their own."""
    world = make_world(WORLD)
    for group in GROUPS:
        world = world.scale(group, 2.0)
    return world.to_dict()


def check_driven(results: Results) -> None:
    """Raise ValueError for an entry that could not drive.

    Args:
        results: Episodes.
    """
    for (task, entry), result in results.items():
        if result.error:
            raise ValueError(f"{entry.label} in {task.name}: {result.error}")


class _Cells:
    """Cells of a table: numbers of rows by scenario, controller, estimator and metric."""

    def __init__(self, rows: Sequence[ResultRow]) -> None:
        self._rows = {(x.scenario, x.controller, x.estimator, x.metric): x for x in rows}

    def find(self, scenario: str, pairs: Sequence[tuple[str, str]]) -> dict[str, ResultRow]:
        """The metrics of the first pair that drove the scenario, by name."""
        for pair in pairs:
            keys = {metric: (scenario, *pair, metric) for metric in METRICS}
            metrics = {x: self._rows[key] for x, key in keys.items() if key in self._rows}
            if metrics:
                return metrics
        return {}

    def format(self, scenario: str, pairs: Sequence[tuple[str, str]], interval: bool) -> str:
        """Cost in % of nominal's, with its interval if asked, and in brackets cars lost in %."""
        metrics = self.find(scenario, pairs)
        if not metrics:
            return ""
        cost, lost = metrics.get(METRICS[0]), metrics[METRICS[1]]
        low, high = (100.0 * x for x in (cost.low, cost.high)) if cost else (math.nan, math.nan)
        ends = f" [{low:.0f}, {high:.0f}]" if interval and math.isfinite(low) else ""
        number = f"{100.0 * cost.value:.0f}" if cost else "-"
        return f"{number}{ends} ({100.0 * lost.value:.0f})"


def _make_table(rows: Sequence[ResultRow], transfer: Sequence[ResultRow]) -> str:
    """Make README's table: a line an entry, a column a tier, and columns of transfer."""
    cells, lines = _Cells(rows), []
    far = {(row.scenario, row.controller, row.metric): row for row in transfer}
    for name, pairs in ENTRIES.items():
        agent = _PROCEDURES.get(pairs[0][0], pairs[0][0])
        line = [name, *(cells.format(f"tier {tier}", pairs, False) for tier in TITLES)]
        for scenario, metric, factor, form in _TRANSFER.values():
            row = far.get((scenario, agent, metric))
            is_rival = (agent, metric) == (REFERENCE_CONTROLLER, "ratio")  # beside itself: 1
            value = row.value if row else 1.0 if is_rival else None
            line.append("" if value is None else f"{factor * value:{form}}")
        lines.append(line)
    tiers = (f"{tier}, {SPEEDS[tier]}" for tier in TITLES)
    return format_table(lines, [*tiers, *_TRANSFER])


def _make_task_table(rows: Sequence[ResultRow]) -> str:
    """Make the table by task: a line a task, a column an entry, with 95 % intervals."""
    cells = _Cells(rows)
    lines = [
        [task.scenario, *(cells.format(task.name, pairs, True) for pairs in PAGE_ENTRIES.values())]
        for task in _list_tasks()
    ]
    return format_table(lines, list(PAGE_ENTRIES))


def _make_doubled_table(rows: Sequence[ResultRow]) -> str:
    """Make the table of the world whose ranges are doubled: a line an entry, a column a tier."""
    cells, heads = _Cells(rows), [f"tier {tier}{_DOUBLED}" for tier in TITLES]
    lines = [
        [name, *(cells.format(x, pairs, True) for x in heads)]
        for name, pairs in PAGE_ENTRIES.items()
    ]
    return format_table(lines, heads)


def format_table(lines: Sequence[Sequence[str]], heads: Sequence[str]) -> str:
    """Format a table whose first column has no head.

    Args:
        lines: Cells.
        heads: Heads of the other columns.
    """
    body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([f"| | {' | '.join(heads)} |", "|---" * (1 + len(heads)) + "|", *body])


def replace_table(text: str, new_table: str) -> str:
    """Replace a page's table with the same first column head.

    Args:
        text: Page.
        new_table: Markdown.

    Raises:
        ValueError: The page has no such table, or several.
    """
    first = re.escape(new_table.split(" | ")[1].split(",")[0])
    pattern = re.compile(rf"^\| \| {first}[^\n]*\n(\|[^\n]*\n)+", re.MULTILINE)
    if len(pattern.findall(text)) != 1:
        raise ValueError(f"the page has no table that begins with {first!r}, or several")
    return pattern.sub(lambda _: new_table + "\n", text)


def _write_tables(rows: Sequence[ResultRow]) -> None:
    """Write rows and the tables made of them, in the repository's root."""
    transfer = read_json(TRANSFER) if TRANSFER.is_file() else []
    readme = replace_table(README.read_text(encoding="utf-8"), _make_table(rows, transfer))
    page = replace_table(PAGE.read_text(encoding="utf-8"), _make_task_table(rows))
    page = replace_table(page, _make_doubled_table(rows))
    write_json(ROWS, rows)
    write_text(README, readme)
    write_text(PAGE, page)


def _main(
    salt: Annotated[str, typer.Option(help="Of the seeds, hexadecimal.")] = "",
    keep: Annotated[Path | None, typer.Option(help="Folder for finished cases.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes.")] = None,
    driven: Annotated[bool, typer.Option("--driven", help="Make the tables of old rows.")] = False,
) -> None:
    """Drive README's entries and write their rows and tables."""
    console = Console(stderr=True)
    _write_tables(read_json(ROWS) if driven else _measure_entries(jobs, console, salt, keep))


if __name__ == "__main__":
    with report_user_errors():
        typer.run(_main)
