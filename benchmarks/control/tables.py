"""What a run of the matrix measured, as tables: standings, baselines, and what went wrong."""

import math
from collections.abc import Collection, Sequence

import numpy as np

from ...envs.task import FAILURES
from ..harness.metrics import EPISODE
from ..harness.results import Column, Line, ResultTable
from ..harness.stats import average
from .entries import Entry
from .run import Results
from .score import Matrix, PairedDrives, Standing
from .tasks import NOMINAL, PARAMETERS, STATE, TITLES, ControlTask, find_oracle

_PERIOD = 0.01  # s, between two decisions in every task
_CAR_OUTCOMES = ("none", "spin", "off-road")  # how an episode ends by the car's own motion

_LABEL = Column("label", "controller and estimator")
_MAIN = (
    _LABEL,
    Column("score", form=".2f"),
    Column("failure_rate", "fails / %", 100.0, ".1f"),
    Column("cost_vs_nominal", "cost / nominal's, %", 100.0, ".1f"),
    Column("share_won", "won / %", 100.0, ".0f", interval=False),
    Column("worst_cost", "worst 5 %", form=".3g", interval=False),
    Column("tasks", form="{:.0f} of {:.0f}"),
    Column("n", "episodes"),
    Column("us", "us a decision", form=".0f"),
)
_SHOWN = [metric for metric in EPISODE if metric.heading]
_MOTION = (
    _LABEL,
    *(Column(x.name, x.heading, x.scale, f".{x.digits}f") for x in _SHOWN),
    Column("part", "of the period / %", form=".2f"),
)
_BASELINES = (
    "task",
    Column("peak", "none: peak slip / deg", form=".1f"),
    Column("lost", "lost: none, nominal, oracle / %", form="{:.0f}, {:.0f}, {:.0f}"),
    "oracle-state is",
    Column("slip", "slip gap / deg", form=".2f"),
    Column("yaw", "yaw rate gap / (deg/s)", form=".2f"),
    Column("parameters", "r of oracle-parameters", form=".2f"),
    Column("state", "of oracle-state", form=".2f"),
    Column("foresight", "clairvoyant beyond", form=".2f"),
)
_MAIN_NOTE = (
    "score: mean r, 0 as nominal, an LQG that knows the nominal car. cost, won: of the drives that "
    "nominal finishes too. worst 5 %: their mean cost. tasks: driven, with nominal."
)
_TIME_NOTE = " A decision is the estimator's step and the controller's, of one car."
_LINE = "surely lose more cars than nominal:"
_MOTION_NOTE = (
    "Yaw error and path where the reference turns. motors: mechanical work of both. effort: "
    "mean square share of the full yaw moment. Steps: the largest of what is asked between "
    "two decisions. saturated: of the decisions. The last column: a decision's time. What the "
    "tyres dissipate is not measured: no signal of the car has their forces."
)


def make_tables(matrix: Matrix) -> list[ResultTable]:
    """Make all tables of the suite, those for the report alone behind the others."""
    main, detail = [], []
    for tier, ranked in matrix.by_tier.items():
        title = f"Tier {tier}: {TITLES[tier]}"
        main.append(make_main_table(title, ranked))
        tasks = [task for task in matrix.tasks if task.tier == tier]
        detail.append(make_task_table(f"{title}, task by task", ranked, tasks))
        detail.append(_make_motion_table(f"{title}: the motion", ranked))
    return [*main, _make_oracle_table(matrix), *detail, *make_failure_tables(matrix.results)]


def make_main_table(
    title: str, ranked: Sequence[Standing], marked: Collection[Entry] | None = None
) -> ResultTable:
    """Make the table of the entries.

    Args:
        title: Title of the table.
        ranked: Standings, the best first.
        marked: A user's entries, beside which no decision is timed; None: the matrix.
    """
    lines: list[Line] = [
        {"label": "> " * (x.entry in (marked or ())) + x.entry.label, "n": x.n, "us": x.us}
        | x.overall
        | {"tasks": (len(x.pairs), len(x.results))}
        for x in ranked
    ]
    if below := sum(standing.loses_more for standing in ranked):
        lines.insert(len(lines) - below, {"label": _LINE})
    if marked is not None:
        return ResultTable(title, _MAIN[:-1], lines, f"> yours. {_MAIN_NOTE}")
    return ResultTable(title, _MAIN, lines, _MAIN_NOTE + _TIME_NOTE)


def make_task_table(
    title: str, ranked: Sequence[Standing], tasks: Sequence[ControlTask]
) -> ResultTable:
    """Make the table of the scores, every entry in every task."""
    columns = (_LABEL, *(Column(task.name, form="{:.2f} ({:.0f})") for task in tasks))
    lines: list[Line] = [
        {"label": item.entry.label} | {task.name: _make_cell(item, task) for task in tasks}
        for item in ranked
    ]
    note = "Score, the mean r; in brackets failures in percent."
    return ResultTable(title, columns, lines, note, detail=True)


def _make_cell(standing: Standing, task: ControlTask) -> tuple[float, float] | str:
    """Score and failures, or why there is no score."""
    if task not in standing.results:
        return ""
    if standing.results[task].error:
        return "not driven"
    metrics = standing.by_task[task]
    failed = 100.0 * metrics["failure_rate"].value
    if task not in standing.pairs:
        return f"no nominal ({failed:.0f})"
    return metrics["score"].value, failed


def _make_motion_table(title: str, ranked: Sequence[Standing]) -> ResultTable:
    lines = [
        {"label": x.entry.label, "part": 1e-4 * x.us / _PERIOD}
        | {metric.name: x.mean(metric.name) for metric in _SHOWN}
        for x in ranked
    ]
    return ResultTable(title, _MOTION, lines, _MOTION_NOTE, detail=True)


def _make_oracle_table(matrix: Matrix) -> ResultTable:
    """Make the table of every task's demand and baselines."""
    note = (
        "Gaps: medians by which oracle-state's root mean square errors are below nominal's. r is "
        "0.69 for half of nominal's cost."
    )
    if not matrix.foresight:
        note += " The clairvoyant is not calibrated: its column is empty (`sideslip calibrate`)."
    upsets = _list_upsets(matrix) or ["no entry above oracle-state, nor it above the clairvoyant"]
    note += f" Surely above what knows more: {'; '.join(upsets)}."
    lines = [_make_oracle_line(matrix, task) for task in matrix.tasks]
    return ResultTable("The oracles", _BASELINES, lines, note, keyed=False)


def _list_upsets(matrix: Matrix) -> list[str]:
    """List who is surely above a reference: a finding, for then that reference does not hold."""
    from scipy.stats import ttest_1samp

    leads = {f"oracle-state in {task.name}": -gain for task, gain in matrix.foresight.items()}
    for tier, ranked in matrix.by_tier.items():
        best = next((x.scores for x in ranked if x.entry == Entry(STATE)), {})
        for item in (x for x in ranked if x.entry != Entry(STATE)):
            both = [(r, best[task]) for task, r in item.scores.items() if task in best]
            if both:
                lead = np.concatenate([a[: len(b)] - b[: len(a)] for a, b in both])
                leads[f"{item.entry.label} in tier {tier}"] = lead
    tested = {text: lead for text, lead in leads.items() if len(lead) > 1 and np.ptp(lead) > 0.0}
    level = 0.05 / max(len(tested), 1)  # Bonferroni's
    return [
        text
        for text, lead in tested.items()
        if ttest_1samp(lead, 0.0, alternative="greater").pvalue < level
    ]


def _make_oracle_line(matrix: Matrix, task: ControlTask) -> Line:
    names = ("none", NOMINAL, PARAMETERS, STATE)
    none, nominal, parameters, state = (matrix.results[task, Entry(name)] for name in names)
    errors = [drive.error for drive in (none, nominal, state) if drive.error]
    if errors:
        return {"task": task.name, "oracle-state is": "; ".join(errors)}
    pair = PairedDrives(nominal, state, task.cost_floor)
    foresight, knowing = matrix.foresight.get(task), None
    if not parameters.error:
        knowing = PairedDrives(nominal, parameters, task.cost_floor).compute_scores().mean()
    slip, yaw = compute_gaps(pair, task)
    return {
        "task": task.name,
        "peak": float(np.degrees(np.median(none["peak_slip"]))),
        "lost": tuple(100.0 * float(np.mean(~x.survived)) for x in (none, nominal, state)),
        "oracle-state is": find_oracle(task),
        "slip": slip,
        "yaw": yaw,
        "parameters": knowing,
        "state": average(pair.compute_scores()),
        "foresight": None if foresight is None else foresight.mean(),
    }


def compute_gaps(pair: PairedDrives, task: ControlTask) -> tuple[float, float]:
    """Compute by how much an entry's errors are below nominal's, medians of the drives of both.

    Args:
        pair: Drives of the entry and of nominal.
        task: Their task.

    Returns:
        Gap of slip (deg) and yaw rate (deg/s), NaN where not judged, or both finish no drive.
    """

    def compute_gap(name: str) -> float:
        errors, nominal = (x[name][: pair.n][pair.both] for x in (pair.result, pair.nominal))
        return float(np.degrees(np.median(nominal - errors))) if len(errors) else math.nan

    slip = compute_gap("rms_slip_error")
    return slip, math.nan if task.reference == "zero-slip" else compute_gap("rms_yaw_error")


def make_failure_tables(results: Results) -> list[ResultTable]:
    """Make the table of the failures that are not the car's, such as a NaN; none without any."""
    lines = []
    for (task, entry), result in results.items():
        codes = result["failure"]
        ended = [
            f"{name} {100.0 * (codes == code).mean():.1f} %"
            for code, name in enumerate(FAILURES)
            if name not in _CAR_OUTCOMES and (codes == code).any()
        ]
        if result.error:
            ended = [f"not driven: {result.error}"]
        elif not ended and not result.survived.any():
            ended = ["every car fails"]
        if ended:
            lines.append([task.tier, task.name, entry.label, ", ".join(ended)])
    header = ("tier", "task", "controller and estimator", "what happened")
    note = "The share of a cell's episodes; the rest of a failed one is charged at the most."
    table = ResultTable("Cells that went wrong", header, lines, note, keyed=False)
    return [table] if lines else []
