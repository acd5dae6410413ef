"""What a run of the matrix measured, as tables: standings, baselines, and what went wrong."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ...envs.record import Array
from ...envs.task import FAILURES
from ..harness.metrics import EPISODE
from ..harness.results import Column, Line, ResultTable
from ..harness.stats import Estimate, average, compute_p_value, holm
from .entries import ORACLE_NAMES, Entry
from .run import Results
from .score import PairedDrives, Standing, rank_entries
from .tasks import NOMINAL, PARAMETERS, STATE, TITLES, ControlTask, find_oracle

_CAR_OUTCOMES = ("none", "spin", "off-road")  # how an episode ends by the car's own motion


@dataclass
class Matrix:
    """The matrix of controllers and estimators, as a run measured it."""

    results: Results
    by_tier: Mapping[str, Sequence[Standing]]  # standings by tier, the best first
    salt: str = ""  # salt of the seeds
    # log(J / J_clairvoyant) on the clairvoyant's seeds, shape (n,), of the calibrated tasks
    regrets: Mapping[tuple[ControlTask, Entry], Array] = field(default_factory=dict)
    # cost over nominal's with sensors in time, at each of `DELAYS`
    delay_costs: Mapping[Entry, Sequence[Estimate]] = field(default_factory=dict)
    late: Sequence[tuple[float, Results]] = ()  # episodes by delay of camera and GPS (s)
    seconds: float = 0.0  # CPU time of all episodes (s)

    @cached_property
    def tasks(self) -> list[ControlTask]:
        """Tasks that were driven."""
        return list(dict.fromkeys(task for task, _ in self.results))

    @cached_property
    def series(self) -> dict[tuple[ControlTask, Entry], Array]:
        """Time and `SIGNALS` of each case's first seed, where they were kept."""
        drives = self.results.items()
        return {case: drive.series for case, drive in drives if drive.series is not None}

    @cached_property
    def overall(self) -> list[Standing]:
        """Standings over all tiers, the best first."""
        return rank_entries(self.results, None)

    @cached_property
    def foresight(self) -> dict[ControlTask, Array]:
        """Log of oracle-state's cost over clairvoyant's in each calibrated task, shape (n,)."""
        return {task: x for (task, entry), x in self.regrets.items() if entry.agent == STATE}


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
    "falls",
)
_KNOWLEDGE = (
    "tier",
    Column("model", "car, friction, biases (model)", form=".2f"),
    Column("sensing", "state and disturbances (sensing)", form=".2f"),
    Column("foresight", "what is ahead (foresight)", form=".2f"),
)
_MAIN_NOTE = (
    "score: mean r, 0 as nominal. cost, won: of the drives that nominal finishes too. worst 5 %: "
    "their mean cost. tasks: driven, with nominal. A decision is the estimator's step and the "
    "controller's, of one car."
)
_LINE = "surely lose more cars than nominal:"
_MOTION_NOTE = (
    "Yaw error and path where the reference turns. motors: mechanical work of both. effort: "
    "mean square share of the full yaw moment. Steps: the largest of what is asked between "
    "two decisions. saturated: of the decisions. The last column: a decision's time. What the "
    "tyres dissipate is not measured: no signal of the car has their forces."
)


def make_tables(matrix: Matrix) -> list[ResultTable]:
    """Make all tables of the suite, those for the report alone behind the others.

    Args:
        matrix: Measurements.
    """
    main, detail = [], []
    for tier, ranked in matrix.by_tier.items():
        title = f"Tier {tier}: {TITLES[tier]}"
        main.append(_make_main_table(title, ranked))
        tasks = [task for task in matrix.tasks if task.tier == tier]
        detail.append(make_task_table(f"{title}, task by task", ranked, tasks))
        detail.append(_make_motion_table(f"{title}: the motion", ranked))
    runs = ((0.0, matrix.results), *matrix.late)
    failures = [line for delay, results in runs for line in list_failures(results, delay)]
    header = ("tier", "task", "controller and estimator", "what happened")
    note = "The share of a cell's episodes; the rest of a failed one is charged at the highest "
    wrong = ResultTable("Cells that went wrong", header, failures, note + "cost.", keyed=False)
    baselines = [_make_knowledge_table(matrix), _make_oracle_table(matrix)]
    return [*main, *baselines, *detail, *([wrong] if failures else [])]


def _make_main_table(title: str, ranked: Sequence[Standing]) -> ResultTable:
    """Make the table of the entries, the best first."""
    lines: list[Line] = [
        {"label": x.label, "n": x.n, "us": x.us, **x.overall}
        | {"tasks": (len(x.pairs), len(x.results))}
        for x in ranked
    ]
    if below := sum(standing.loses_more for standing in ranked):
        lines.insert(len(lines) - below, {"label": _LINE})
    note = " ".join([_MAIN_NOTE, *_describe_findings(ranked)])
    return ResultTable(title, _MAIN, lines, note)


def make_task_table(
    title: str, ranked: Sequence[Standing], tasks: Sequence[ControlTask]
) -> ResultTable:
    """Make the table of the scores, every entry in every task.

    Args:
        title: Title of the table.
        ranked: Standings, the best first.
        tasks: Tasks, a column each.
    """
    columns = (_LABEL, *(Column(task.name, form="{:.2f} ({:.0f})") for task in tasks))
    lines: list[Line] = [
        {"label": item.label} | {task.name: _make_cell(item, task) for task in tasks}
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
        {"label": x.label, "part": 1e-4 * x.us / next(iter(x.results)).control_period}
        | {metric.name: x.mean(metric.name) for metric in _SHOWN}
        for x in ranked
    ]
    return ResultTable(title, _MOTION, lines, _MOTION_NOTE, detail=True)


def _describe_findings(standings: Sequence[Standing]) -> list[str]:
    """Describe the entries whose score is above oracle-state's over their tier, Holm-corrected."""
    best = next((item.scores for item in standings if item.entry == Entry(STATE)), {})
    rivals = [item for item in standings if item.entry.agent not in ORACLE_NAMES]
    others = [item for item in rivals if item.scores.keys() & best.keys()]
    excess = [  # below 0 where the entry is better
        np.concatenate([_subtract(best[task], r) for task, r in x.scores.items() if task in best])
        for x in others
    ]
    sentences = [
        f"Finding: {item.label} scores more than oracle-state in tier {item.tier} "
        f"({item.overall['score'].value:.2f})."
        for item in others
    ]
    return _select_cheaper(sentences, excess)


def _subtract(values: Array, others: Array) -> Array:
    """Subtract numbers of the seeds that both have, shape (min(n, m),)."""
    n = min(len(values), len(others))
    return values[:n] - others[:n]


def _select_cheaper(texts: Sequence[str], logs: Sequence[Array]) -> list[str]:
    """Select the texts whose paired differences surely have a mean below 0, Holm-corrected."""
    sure = holm([compute_p_value(item) for item in logs])
    return [text for text, is_sure in zip(texts, sure, strict=True) if is_sure]


def _make_oracle_table(matrix: Matrix) -> ResultTable:
    """Make the table of every task's demand and baselines, and of whether they fall in cost."""
    note = (
        "Gaps: medians by which oracle-state's root mean square errors are below nominal's. r is "
        "0.69 for half of nominal's cost."
    )
    if not matrix.foresight:
        note += " The clairvoyant is not calibrated: its column is empty (`sideslip calibrate`)."
    if matrix.regrets:
        names = [f"{entry.label} ({task.name})" for task, entry in matrix.regrets]
        below = "; ".join(_select_cheaper(names, list(matrix.regrets.values())))
        summary = f"below it: {below}" if below else "nobody is below it (Holm-corrected)"
        note += f" On the clairvoyant's seeds {summary}."
    lines = [_make_oracle_line(matrix, task) for task in matrix.tasks]
    return ResultTable("The oracles", _BASELINES, lines, note, keyed=False)


def _make_oracle_line(matrix: Matrix, task: ControlTask) -> Line:
    names = ("none", NOMINAL, PARAMETERS, STATE)
    none, nominal, parameters, state = (matrix.results[task, Entry(name)] for name in names)
    errors = [drive.error for drive in (none, nominal, state) if drive.error]
    if errors:
        return {"task": task.name, "falls": "; ".join(errors)}
    pair = PairedDrives(nominal, state, task.cost_floor)
    state_scores, foresight = pair.compute_scores(), matrix.foresight.get(task)
    scores = [np.zeros(pair.n), state_scores]
    if not parameters.error:
        scores[1:1] = [PairedDrives(nominal, parameters, task.cost_floor).compute_scores()]
    slip, yaw = compute_gaps(pair, task)
    return {
        "task": task.name,
        "peak": float(np.degrees(np.median(none["peak_slip"]))),
        "lost": tuple(100.0 * float(np.mean(~x.survived)) for x in (none, nominal, state)),
        "oracle-state is": find_oracle(task),
        "slip": slip,
        "yaw": yaw,
        "parameters": scores[1].mean() if len(scores) > 2 else None,
        "state": average(state_scores),
        "foresight": None if foresight is None else foresight.mean(),
        "falls": _describe_order(scores, foresight),
    }


def compute_gaps(pair: PairedDrives, task: ControlTask) -> tuple[float, float]:
    """Compute by how much an entry's errors are below nominal's, medians of the drives of both.

    Args:
        pair: Drives of the entry and of nominal.
        task: Their task.

    Returns:
        Gap of slip (deg) and yaw rate (deg/s), NaN where not judged, or both finish no drive.
    """
    gaps = []
    for name in ("rms_slip_error", "rms_yaw_error"):
        drives = (pair.result, pair.nominal)
        errors, nominal = (drive[name][: pair.n][pair.both] for drive in drives)
        is_judged = len(errors) and not (name == "rms_yaw_error" and task.reference == "zero-slip")
        gaps.append(float(np.degrees(np.median(nominal - errors))) if is_judged else math.nan)
    return gaps[0], gaps[1]


def _describe_order(scores: Sequence[Array], foresight: Array | None) -> str:
    """Describe whether a baseline surely scores less than the one before it, which knows less."""
    if foresight is not None and foresight.mean() <= 0.0:
        return "clairvoyant does not"
    rises = [average(_subtract(more, less)) for less, more in itertools.pairwise(scores)]
    if any(rise.high < 0.0 for rise in rises):
        return "no"
    return "yes" if average(scores[-1]).low > 0.0 else "not surely"


def list_knowledge(
    standings: Sequence[Standing], foresight: Sequence[Array]
) -> dict[str, list[Array]]:
    """List r gained by knowing the car, then its state, then what is ahead, of each task's drives.

    Args:
        standings: Standings with the oracles.
        foresight: Log of oracle-state's cost over the clairvoyant's, shape (n,) each.

    Returns:
        Numbers by what is known, empty without an oracle.
    """
    by_name = {x.entry.agent: x.scores for x in standings if x.entry.is_oracle}
    parameters, state = (by_name.get(name, {}) for name in (PARAMETERS, STATE))
    sensing = [_subtract(state[x], r) for x, r in parameters.items() if x in state]
    return {"model": [*parameters.values()], "sensing": sensing, "foresight": [*foresight]}


def _make_knowledge_table(matrix: Matrix) -> ResultTable:
    """Make the table of what not knowing costs in each tier: differences of neighbours' scores."""
    lines = []
    for tier, ranked in matrix.by_tier.items():
        foresight = [x for task, x in matrix.foresight.items() if task.tier == tier]
        steps = list_knowledge(ranked, foresight)
        saved = {name: average(*logs) for name, logs in steps.items() if logs}
        lines.append({"tier": f"{tier}: {TITLES[tier]}"} | saved)
    note = (
        "Scores gained: oracle-parameters over nominal, oracle-state over oracle-parameters; "
        "clairvoyant over oracle-state by the logarithm of cost alone."
    )
    return ResultTable("What knowing is worth", _KNOWLEDGE, lines, note, keyed=False)


def list_failures(results: Results, late: float = 0.0) -> list[list[str]]:
    """List where a failure is not the car's, such as a NaN.

    Args:
        results: Episodes.
        late: Delay of the sensors (s).

    Returns:
        Tier, task, entry and what happened of each.
    """
    lines, more = [], f", sensors {1e3 * late:.0f} ms late" if late else ""
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
            lines.append([task.tier, task.name + more, entry.label, ", ".join(ended)])
    return lines
