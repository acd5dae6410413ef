"""The tables of results in README.md and docs/benchmark.md, made from the rows of runs.

`sideslip bench control --json rows.json`, then `python -m sideslip.benchmarks.readme rows.json`
writes the tiers' rows to docs/control.json and the table of docs/benchmark.md. With --add NAME, a
policy that came after the run drives its seeds. With --first, README's few entries drive the
contests with steering; their rows go to docs/first.json and make README's table.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from .. import __version__
from .control.entries import LEARNED, REFERENCE_CONTROLLER, REFERENCE_FILTER, Entry
from .control.run import Results, measure
from .control.score import make_score_scales, rank_entries
from .control.tasks import (
    NOMINAL,
    PARAMETERS,
    STATE,
    STEERING,
    ControlTask,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
)
from .harness.parallel import report_user_errors
from .harness.results import ResultRow, Suite, read_json, write_json, write_text

README, FIRST_ROWS = Path("README.md"), Path("docs/first.json")
PAGE, ROWS = Path("docs/benchmark.md"), Path("docs/control.json")
METRICS = ("cost_vs_nominal", "failure_rate")
HEADS = {"1": "COMS, 18-28 km/h", "2a": "car, dry", "2b": "any friction", "2c": "limit"}
_ON_JOINT = (
    *("distill-car-steering", "distill-car-yaw", "ppo-coms-yaw", "ppo-coms-steering"),
    *("distill-coms-yaw", "distill-coms-steering"),
)
_UNFILTERED = ("raw-car-steering", "raw-car-yaw", "raw-coms-yaw", "raw-coms-steering")
_SHOWN: Mapping[str, tuple[str, str]] = {
    "`oracle-state`: knows state and car": (STATE, ""),
    "`oracle-parameters`: knows car and biases": (PARAMETERS, ""),
    "`adaptive-nmpc` on `joint` with friction": ("adaptive-nmpc", "joint, friction"),
    "the same on `learned-joint`": ("adaptive-nmpc", "learned-joint"),
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
    "`adaptive-nmpc` on `joint`": [("adaptive-nmpc", "joint, friction")],
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
    return _make_tier_rows(results, tasks, salt)


def _check_driven(results: Results) -> None:
    """Raise ValueError for an entry that could not drive."""
    for (task, entry), result in results.items():
        if result.error:
            raise ValueError(f"{entry.label} in {task.name}: {result.error}")


def _make_tier_rows(
    results: Results, tasks: Sequence[ControlTask], salt: str, controller: str = ""
) -> list[ResultRow]:
    """Cost and failures in each tier of a controller's entries, "" for all."""
    rows: list[ResultRow] = []
    for tier in HEADS:
        scales = make_score_scales(results, [task for task in tasks if task.tier == tier])
        for standing in rank_entries(results, tier, scales):
            if controller in ("", standing.entry.agent):
                suite = Suite("control", "", "")
                standing.add_rows(suite, salt)
                metric_rows = (row for row in suite.rows if row.metric in METRICS)
                rows += [row for row in metric_rows if row.scenario == f"tier {tier}"]
    return rows


def _read_tier_rows(path: str | Path) -> list[ResultRow]:
    """Read the tiers' rows of which the table is made; raises what `read_json` does."""
    tiers = {f"tier {tier}" for tier in HEADS}
    return [row for row in read_json(path) if row.metric in METRICS and row.scenario in tiers]


def make_table(rows: Sequence[ResultRow]) -> str:
    """Make the table: cost in % of nominal's with its interval, and in brackets failures in %.

    Args:
        rows: Rows of the tiers.

    Returns:
        Markdown.
    """
    by_key = {(row.scenario, row.controller, row.estimator, row.metric): row for row in rows}
    lines = []
    for name, key in _SHOWN.items():
        cells = []
        for tier in HEADS:
            cost, failing = (by_key.get((f"tier {tier}", *key, metric)) for metric in METRICS)
            if cost is None or failing is None:
                cells.append("")
                continue
            interval = f" [{100.0 * cost.low:.0f}, {100.0 * cost.high:.0f}]"
            text = f"{100.0 * cost.value:.0f}{'' if key[0] == NOMINAL else interval}"
            cells.append(f"{text} ({100.0 * failing.value:.0f})")
        lines.append([name, *cells])
    return _format_table(lines)


def _format_table(lines: Sequence[Sequence[str]]) -> str:
    """A table with a column for each tier, as Markdown."""
    heads = " | ".join(f"{tier}: {text}" for tier, text in HEADS.items())
    body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([f"| | {heads} |", "|---" * (1 + len(HEADS)) + "|", *body])


def _make_first_table(rows: Sequence[ResultRow]) -> str:
    """Make README's table: cost in % of nominal's, the best of the first tier's columns first."""
    cost_rows = [row for row in rows if row.metric == METRICS[0]]
    by_key = {(row.scenario, row.controller, row.estimator): row.value for row in cost_rows}
    lines = []
    for name, entries in FIRST.items():
        costs = [[by_key.get((f"tier {tier}", *pair)) for pair in entries] for tier in HEADS]
        first = (next((x for x in tier_costs if x is not None), None) for tier_costs in costs)
        lines.append([name, *("" if x is None else f"{100.0 * x:.0f}" for x in first)])
    return _format_table(lines)


def _make_headlines(root: Path) -> list[str]:
    """Make README's sentences with numbers from the files in docs.

    `sideslip bench estimation --json docs/estimation.json` and `sideslip bench speed --json
    docs/speed.json` write the files.
    """
    rows = read_json(root / "docs/estimation.json")
    key = ("tie-vision-fig7", "rmse_over_bound")
    ratios = {row.estimator: row for row in rows if (row.scenario, row.metric) == key}
    joint, multirate = ratios["joint"], ratios["multirate-residual-kf"]
    key, speeds = ("YawFusion-v0 x 1024", "us_per_step"), read_json(root / "docs/speed.json")
    (step,) = (row.value for row in speeds if (row.scenario, row.metric) == key)
    first = [row for row in read_json(root / FIRST_ROWS) if row.metric == METRICS[0]]
    above = [(row.scenario, math.ceil(100.0 * (row.high / row.value - 1.0))) for row in first]
    limit = max(percent for tier, percent in above if tier == "tier 2c")
    usual = max(percent for tier, percent in above if tier != "tier 2c")
    return [
        f"Their 95 % intervals reach up to {usual} % above them, {limit} % at the limit",
        f"`joint` errs {joint.value:.2f} times as much as the best possible filter, the "
        f"paper's own filter {multirate.value:.1f} times ({joint.n} seeds).",
        f"A 10 ms step takes {step:.1f} us of CPU time a car in a batch of 1,024.",
    ]


def _replace_table(text: str, new_table: str) -> str:
    """Replace the table of a page."""
    pattern = re.compile(r"^\| \| 1: [^\n]*\n(\|[^\n]*\n)+", re.MULTILINE)
    if len(pattern.findall(text)) != 1:
        raise ValueError("the page has no table that begins with the tiers, or several")
    return pattern.sub(lambda _: new_table + "\n", text)


def _add_policy(
    rows: Sequence[ResultRow], name: str, jobs: int | None = None, console: Console | None = None
) -> list[ResultRow]:
    """Add the rows of a learned policy in its class's contests, on the rows' own seeds.

    Its contests' reference points are driven anew.
    """
    known_entries = [(kind, entry) for kind, entries in LEARNED.items() for entry in entries]
    policies = {kind: entry for kind, entry in known_entries if entry.agent == name}
    if not policies:
        known = ", ".join(entry.agent for _, entry in known_entries)
        raise ValueError(f"the matrix's policies are {known}, got {name!r}")
    tier_1 = [row for row in rows if (row.controller, row.scenario) == (STATE, "tier 1")]
    versions = {row.env_version for row in tier_1}
    if versions != {__version__}:
        got = ", ".join(versions) or "none"
        raise ValueError(f"expected rows of {STATE} in tier 1, of version {__version__}, got {got}")
    count = sum(task.tier == "1" for task in list_scored_tasks())
    episodes = -(-tier_1[0].n // count)  # n: of those that the rungs survived
    tasks = [task for task in list_scored_tasks() if task.tier and task.kind in policies]
    cases = [(task, Entry(oracle)) for task in tasks for oracle in (NOMINAL, STATE)]
    cases += [(task, policies[task.kind]) for task in tasks]
    seeds = make_task_seeds(tier_1[0].salt, episodes)
    results = measure(cases, seeds, jobs=jobs, console=console, title=name)
    _check_driven(results)
    merged = [row for row in rows if row.controller != name]
    return merged + _make_tier_rows(results, tasks, tier_1[0].salt, name)


def _main(
    rows: Annotated[Path | None, typer.Argument(help="Of sideslip bench control --json.")] = None,
    add: Annotated[list[str] | None, typer.Option(help="A policy that came later.")] = None,
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
        for name in add or []:
            result_rows = _add_policy(result_rows, name, console=console)
        _write(ROWS, result_rows, PAGE, make_table(result_rows))


def _write(path: Path, rows: Sequence[ResultRow], page: Path, new_table: str) -> None:
    text = _replace_table(page.read_text(encoding="utf-8"), new_table)
    write_json(path, rows)
    write_text(page, text)


if __name__ == "__main__":
    with report_user_errors():
        typer.run(_main)
