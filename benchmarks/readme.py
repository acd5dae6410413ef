"""The tables of results in README.md and docs/benchmark.md, made from the rows of runs.

`sideslip bench control --json rows.json`, then `python -m sideslip.benchmarks.readme rows.json`
writes the tiers' rows to docs/control.json and the table of docs/benchmark.md. With --first,
README's few entries drive the contests with steering; their rows go to docs/first.json and make
README's table. Rows of env version 0 have its tiers.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from .control.entries import LEARNED, REFERENCE_CONTROLLER, REFERENCE_FILTER, Entry
from .control.run import Results, measure
from .control.score import rank_entries
from .control.tasks import (
    NOMINAL,
    PARAMETERS,
    STATE,
    STEERING,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
)
from .harness.parallel import report_user_errors
from .harness.results import ResultRow, Suite, read_json, write_json, write_text

README, FIRST_ROWS = Path("README.md"), Path("docs/first.json")
PAGE, ROWS = Path("docs/benchmark.md"), Path("docs/control.json")
METRICS = ("cost_vs_nominal", "failure_rate")
HEADS = {"1": "COMS, 18-28 km/h", "2a": "car, dry", "2b": "any friction", "2c": "limit"} | {
    "small car": "18-28 km/h", "road": "60-90 km/h", "limit": "70-110 km/h"
}  # fmt: skip
_ON_JOINT = (
    *("distill-car-steering", "distill-car-yaw", "ppo-coms-yaw", "ppo-coms-steering"),
    *("distill-coms-yaw", "distill-coms-steering"),
)
_UNFILTERED = ("raw-car-steering", "raw-car-yaw", "raw-coms-yaw", "raw-coms-steering")
_SHOWN: Mapping[str, tuple[str, str]] = {
    "`oracle-state`: knows state and car": (STATE, ""),
    "`oracle-parameters`: knows car and biases": (PARAMETERS, ""),
    "`adaptive-nmpc` on `joint`": ("adaptive-nmpc", "joint"),
    "`adaptive-lqr` on `joint`": ("adaptive-lqr", "joint"),
    "`nmpc` on `exact-kf`": ("nmpc", REFERENCE_FILTER),
    "`nominal`: `lqr` on `exact-kf`": (NOMINAL, ""),
    "`mpc` on `exact-kf`": ("mpc", REFERENCE_FILTER),
    "`sliding-mode` on `exact-kf`": ("sliding-mode", REFERENCE_FILTER),
    **{f"policy `{name}` on `joint`": (name, "joint") for name in _ON_JOINT},
    **{f"policy `{name}`, no filter": (name, "") for name in _UNFILTERED},
    "`model-following` on `exact-kf`": ("model-following", REFERENCE_FILTER),
    "`two-dof` on `exact-kf`": ("two-dof", REFERENCE_FILTER),
    "`esc` on `exact-kf`": ("esc", REFERENCE_FILTER),
    "no control": ("none", ""),
    "`lqr` on `joint`": (REFERENCE_CONTROLLER, "joint"),
    "`lqr` on `exact-kf` without bias states": (REFERENCE_CONTROLLER, "exact-kf, no bias states"),
    "`lqr` on `exact-kf`, camera alone": (REFERENCE_CONTROLLER, "exact-kf, camera"),
    "`lqr` on `bicycle-kf` (no camera, no GPS)": (REFERENCE_CONTROLLER, "bicycle-kf"),
    "`lqr` on `uneven-delay-kf`": (REFERENCE_CONTROLLER, "uneven-delay-kf"),
    "`lqr` on `dakf`": (REFERENCE_CONTROLLER, "dakf"),
}
"""Controller and estimator of each line of the table by its label."""
FIRST: Mapping[str, Sequence[tuple[str, str]]] = {
    "a controller given the true state and car": [(STATE, "")],
    "policy on `joint`": [("distill-car-steering", "joint"), ("ppo-coms-steering", "joint")],
    "policy on the late sensors alone": [("raw-car-steering", ""), ("raw-coms-steering", "")],
    "`adaptive-nmpc` on `joint`": [("adaptive-nmpc", "joint")],
    "`adaptive-lqr` on `joint`": [("adaptive-lqr", "joint")],
    "tuned LQG: `lqr` on `exact-kf`": [(NOMINAL, "")],
    "`model-following` (dakf-stability)": [("model-following", REFERENCE_FILTER)],
    "`two-dof` (tie-vision), motors alone": [("two-dof", REFERENCE_FILTER)],
    "no control": [("none", "")],
}
"""The lines of README's table: of each tier the first entry that drove it."""
EPISODES = 32  # a contest, of README's table


def _measure_first(
    jobs: int | None = None, console: Console | None = None, salt: str = ""
) -> list[ResultRow]:
    """Drive README's entries in every scored contest with steering; return the tiers' rows."""
    tasks = [item for item in list_scored_tasks() if item.tier and item.env_id == STEERING]
    policies = {entry.agent: kind for kind, entries in LEARNED.items() for entry in entries}
    cases = [
        (task, Entry(*pair))
        for task in tasks
        for pairs in FIRST.values()
        for pair in pairs
        if policies.get(pair[0], task.kind) == task.kind
    ]
    salt = salt or make_salt()
    seeds = make_task_seeds(salt, EPISODES)
    results = measure(cases, seeds, jobs=jobs, console=console, title="README")
    _check_driven(results)
    return _make_tier_rows(results, salt)


def _check_driven(results: Results) -> None:
    """Raise ValueError for an entry that could not drive."""
    for (task, entry), result in results.items():
        if result.error:
            raise ValueError(f"{entry.label} in {task.name}: {result.error}")


def _make_tier_rows(results: Results, salt: str) -> list[ResultRow]:
    """Cost and failures in each tier."""
    suite = Suite("control", "", "")
    for tier in HEADS:
        for standing in rank_entries(results, tier):
            standing.add_rows(suite, salt)
    return _select_tier_rows(suite.rows)


def _read_tier_rows(path: str | Path) -> list[ResultRow]:
    """Read the tiers' rows of which the table is made; raises what `read_json` does."""
    return _select_tier_rows(read_json(path))


def _select_tier_rows(rows: Sequence[ResultRow]) -> list[ResultRow]:
    tiers = {f"tier {tier}" for tier in HEADS}
    return [row for row in rows if row.metric in METRICS and row.scenario in tiers]


def _list_tiers(rows: Sequence[ResultRow]) -> list[str]:
    """List the tiers that rows have."""
    known = {row.scenario for row in rows}
    return [tier for tier in HEADS if f"tier {tier}" in known]


def make_table(rows: Sequence[ResultRow]) -> str:
    """Make the table: cost in % of nominal's with its interval, and in brackets failures in %.

    Args:
        rows: Rows of the tiers.

    Returns:
        Markdown.
    """
    by_key = {(row.scenario, row.controller, row.estimator, row.metric): row for row in rows}
    lines, tiers = [], _list_tiers(rows)
    for name, key in _SHOWN.items():
        cells = []
        for tier in tiers:
            cost, failing = (by_key.get((f"tier {tier}", *key, metric)) for metric in METRICS)
            if cost is None or failing is None:
                cells.append("")
                continue
            interval = f" [{100.0 * cost.low:.0f}, {100.0 * cost.high:.0f}]"
            text = f"{100.0 * cost.value:.0f}{'' if key[0] == NOMINAL else interval}"
            cells.append(f"{text} ({100.0 * failing.value:.0f})")
        lines.append([name, *cells])
    return _format_table(lines, tiers)


def _format_table(lines: Sequence[Sequence[str]], tiers: Sequence[str]) -> str:
    """A table with a column for each tier, as Markdown."""
    heads = " | ".join(f"{tier}: {HEADS[tier]}" for tier in tiers)
    body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([f"| | {heads} |", "|---" * (1 + len(tiers)) + "|", *body])


def _make_first_table(rows: Sequence[ResultRow]) -> str:
    """Make README's table: cost in % of nominal's, the best of the first tier's columns first."""
    cost_rows = [row for row in rows if row.metric == METRICS[0]]
    by_key = {(row.scenario, row.controller, row.estimator): row.value for row in cost_rows}
    lines, tiers = [], _list_tiers(rows)
    for name, entries in FIRST.items():
        costs = [[by_key.get((f"tier {tier}", *pair)) for pair in entries] for tier in tiers]
        first = (next((x for x in tier_costs if x is not None), None) for tier_costs in costs)
        lines.append([name, *("" if x is None else f"{100.0 * x:.0f}" for x in first)])
    return _format_table(lines, tiers)


def _make_headlines(root: Path) -> list[str]:
    """Make README's sentences with numbers from the files in docs.

    `python -m sideslip.benchmarks.tuning.next_car --out docs/next_car.json` and `sideslip bench
    speed --json docs/speed.json` write the files.
    """
    table = json.loads((root / "docs/next_car.json").read_text(encoding="utf-8"))
    whole = table["rows"][0]
    key, speeds = ("YawFusion-v0 x 1024", "us_per_step"), read_json(root / "docs/speed.json")
    (step,) = (row.value for row in speeds if (row.scenario, row.metric) == key)
    first = [row for row in read_json(root / FIRST_ROWS) if row.metric == METRICS[0]]
    above = [(row.scenario, math.ceil(100.0 * (row.high / row.value - 1.0))) for row in first]
    limit = max(percent for tier, percent in above if tier == "tier 2c")
    usual = max(percent for tier, percent in above if tier != "tier 2c")
    return [
        f"Their 95 % intervals reach up to {usual} % above them, {limit} % at the limit",
        f"On {table['n']} of them it errs {whole['rms / deg']:.2f} deg (RMS), and its 95 % "
        f"interval holds {whole['in 95 % / %']:.0f} % of the time.",
        f"A 10 ms step takes {step:.1f} us of CPU time a car in a batch of 1,024.",
    ]


def _replace_table(text: str, new_table: str) -> str:
    """Replace the table of a page."""
    pattern = re.compile(r"^\| \| (1|small car): [^\n]*\n(\|[^\n]*\n)+", re.MULTILINE)
    if len(pattern.findall(text)) != 1:
        raise ValueError("the page has no table that begins with the tiers, or several")
    return pattern.sub(lambda _: new_table + "\n", text)


def _main(
    rows: Annotated[Path | None, typer.Argument(help="Of sideslip bench control --json.")] = None,
    first: Annotated[bool, typer.Option("--first", help="Drive README's entries.")] = False,
    salt: Annotated[str, typer.Option(help="Of the seeds of --first, hexadecimal.")] = "",
) -> None:
    """Write rows and the tables made of them, in the repository's root."""
    console = Console(stderr=True)
    if first:
        result_rows = _measure_first(console=console, salt=salt)
        _write(FIRST_ROWS, result_rows, README, _make_first_table(result_rows))
    if rows is not None:
        result_rows = _read_tier_rows(rows)
        _write(ROWS, result_rows, PAGE, make_table(result_rows))


def _write(path: Path, rows: Sequence[ResultRow], page: Path, new_table: str) -> None:
    text = _replace_table(page.read_text(encoding="utf-8"), new_table)
    write_json(path, rows)
    write_text(page, text)


if __name__ == "__main__":
    with report_user_errors():
        typer.run(_main)
