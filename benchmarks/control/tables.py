"""What a run of the matrix measured, as tables: standings, baselines, and what went wrong."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ...agents.learned.policy import is_policy, load_policy
from ...envs.record import Array
from ...envs.task import FAILURES
from ..harness.metrics import EPISODE
from ..harness.results import Column, Line, ResultTable
from ..harness.stats import Estimate, average, compute_p_value, geometric_mean, holm
from .entries import LEARNED, ORACLE_NAMES, Entry
from .run import Results
from .score import MIN_GAP, ScoreScale, Standing, make_score_scales
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

    @property
    def episodes(self) -> int:
        """Episodes of a task, of slow entries at most."""
        return max((len(drive.costs) for drive in self.results.values()), default=0)

    @cached_property
    def series(self) -> dict[tuple[ControlTask, Entry], Array]:
        """Time and `SIGNALS` of each case's first seed, where they were kept."""
        drives = self.results.items()
        return {case: drive.series for case, drive in drives if drive.series is not None}

    @cached_property
    def scales(self) -> dict[ControlTask, ScoreScale]:
        """Scales of scores by task."""
        return make_score_scales(self.results, self.tasks)

    @cached_property
    def foresight(self) -> dict[ControlTask, Array]:
        """Log of oracle-state's cost over clairvoyant's in each calibrated task, shape (n,)."""
        return {task: x for (task, entry), x in self.regrets.items() if entry.agent == STATE}


_LABEL = Column("label", "controller and estimator")
_MAIN = (
    _LABEL,
    Column("failure_rate", "fails / %", 100.0, ".1f"),
    Column("cost_vs_nominal", "cost / nominal's, %", 100.0, ".1f"),
    Column("score", form=".2f"),
    Column("share_won", "won / %", 100.0, ".0f", interval=False),
    Column("worst_cost", "worst 5 %", form=".3g", interval=False),
    Column("contests", form="{:.0f} of {:.0f}"),
    Column("n", "episodes"),
    Column("excluded", "left out"),
    Column("us", "us a decision", form=".0f"),
)
_SHOWN = [metric for metric in EPISODE if metric.heading]
_MOTION = (
    _LABEL,
    *(Column(x.name, x.heading, x.scale, f".{x.digits}f") for x in _SHOWN),
    Column("part", "of the period / %", form=".2f"),
)
_BASELINES = (
    "contest",
    Column("fails", "nominal fails / %", 100.0, ".1f"),
    "oracle-state is",
    Column("gap", "its gap", form=".2f"),
    Column("parameters", "oracle-parameters", form=".2f"),
    Column("foresight", "clairvoyant beyond", form=".2f"),
    Column("episodes", form="{:.0f} of {:.0f}"),
    "falls",
)
_KNOWLEDGE = (
    "tier",
    Column("model", "car, friction, biases (model)", form=".2f"),
    Column("sensing", "state and disturbances (sensing)", form=".2f"),
    Column("foresight", "what is ahead (foresight)", form=".2f"),
)
_MAIN_NOTE = (
    "won: share of the compared episodes that cost less than nominal's. worst 5 %: their mean "
    "cost. contests: with an episode that counts. left out: episodes that nominal or oracle-state "
    "did not survive. A decision is the estimator's step and the controller's, of one car."
)
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

    Returns:
        Tables.
    """
    main, detail = [], []
    for tier, ranked in matrix.by_tier.items():
        title = f"Tier {tier}: {TITLES[tier]}"
        trainings = _describe_policies() if tier == "1" else []
        main.append(_make_main_table(title, ranked, *trainings))
        tasks = [task for task in matrix.tasks if task.tier == tier]
        detail.append(make_task_table(f"{title}, contest by contest", ranked, tasks))
        detail.append(_make_motion_table(f"{title}: the motion", ranked))
    runs = ((0.0, matrix.results), *matrix.late)
    failures = [line for delay, results in runs for line in list_failures(results, delay)]
    header = ("tier", "contest", "controller and estimator", "what happened")
    note = (
        "The share of a cell's episodes; the rest of a failed one is charged at the highest cost."
    )
    wrong = ResultTable("Cells that went wrong", header, failures, note, keyed=False)
    baselines = [_make_knowledge_table(matrix), _make_oracle_table(matrix)]
    return [*main, *baselines, *detail, *([wrong] if failures else [])]


def _make_main_table(title: str, ranked: Sequence[Standing], *notes: str) -> ResultTable:
    """Make the table of the entries, the best first."""
    lines = [
        {"label": standing.label, "n": standing.n, "excluded": standing.excluded}
        | {"contests": (len(standing.pairs), len(standing.results)), "us": standing.us}
        | standing.overall
        for standing in ranked
    ]
    note = " ".join([_MAIN_NOTE, *_describe_findings(ranked), *notes])
    return ResultTable(title, _MAIN, lines, note)


def _describe_policies() -> list[str]:
    """The training of the policies in the table."""
    names = [entry.agent for entries in LEARNED.values() for entry in entries]
    cards = {name: load_policy(name).card for name in names if is_policy(name)}
    return [
        f"{name}: {card.algorithm}, {card.steps:.2g} steps of {card.env_id} in "
        f"{card.cpu_seconds:.0f} CPU-s, for the reference {card.reference}."
        for name, card in cards.items()
    ]


def make_task_table(
    title: str, ranked: Sequence[Standing], tasks: Sequence[ControlTask]
) -> ResultTable:
    """Make the table of the cost over nominal's (%), every entry in every task.

    Args:
        title: Title of the table.
        ranked: Standings, the best first.
        tasks: Tasks, a column each.

    Returns:
        Table.
    """
    columns = (_LABEL, *(Column(task.name, scale=100.0, form="{:.0f} ({:.0f})") for task in tasks))
    lines: list[Line] = [
        {"label": item.label} | {task.name: _make_cell(item, task) for task in tasks}
        for item in ranked
    ]
    note = "Percent of nominal's cost, the paired geometric mean; in brackets failures in percent."
    return ResultTable(title, columns, lines, note, detail=True)


def _make_cell(standing: Standing, task: ControlTask) -> tuple[float, float] | str:
    """Cost and failures, or why there is no cost."""
    if task not in standing.results:
        return ""
    if standing.results[task].error:
        return "not driven"
    metrics = standing.by_task[task]
    failed = metrics["failure_rate"].value
    if task not in standing.scales:
        reason = "no yardstick"
    elif task not in standing.pairs:
        reason = "no episode counts"
    elif standing.scales[task].gap < MIN_GAP:
        reason = "nothing to win here"
    else:
        return metrics["cost_vs_nominal"].value, failed
    return f"{reason} ({100.0 * failed:.0f})"


def _make_motion_table(title: str, ranked: Sequence[Standing]) -> ResultTable:
    """Make the table of the motion, means over all tasks."""
    lines = [
        {"label": standing.label, "part": 1e-4 * standing.us / standing.control_period}
        | {metric.name: standing.mean(metric.name) for metric in _SHOWN}
        for standing in ranked
    ]
    return ResultTable(title, _MOTION, lines, _MOTION_NOTE, detail=True)


def _describe_findings(standings: Sequence[Standing]) -> list[str]:
    """Describe the entries that cost less than oracle-state over their tier, Holm-corrected."""
    others = [
        item
        for item in standings
        if item.entry.agent not in ORACLE_NAMES
        and np.isfinite(item.overall.get("score", Estimate(math.nan)).value)
    ]
    excess = [  # log(J / J_oracle-state): below 0 where the entry is better
        np.concatenate([oracle_ratios - ratios for ratios, oracle_ratios in item.pairs.values()])
        for item in others
    ]
    sentences = [
        f"Finding: {item.label} costs less than oracle-state in tier {item.tier} "
        f"(score {item.overall['score'].value:.2f})."
        for item in others
    ]
    return _select_cheaper(sentences, excess)


def _select_cheaper(texts: Sequence[str], logs: Sequence[Array]) -> list[str]:
    """Select the texts whose paired log ratios surely have a mean below 0, Holm-corrected."""
    sure = holm([compute_p_value(item) for item in logs])
    return [text for text, is_sure in zip(texts, sure, strict=True) if is_sure]


def _make_oracle_table(matrix: Matrix) -> ResultTable:
    """Make the table of every task's baselines, and of whether they fall in cost."""
    lines = [_make_oracle_line(matrix, task) for task in matrix.tasks]
    note = "Mean of log(J_nominal / J), 0.69 for half the cost; the score's 1 is the gap."
    if not matrix.foresight:
        note += " The clairvoyant is not calibrated: its column is empty (`sideslip calibrate`)."
    if matrix.regrets:
        names = [f"{entry.label} ({task.name})" for task, entry in matrix.regrets]
        below = "; ".join(_select_cheaper(names, list(matrix.regrets.values())))
        summary = f"below it: {below}" if below else "nobody is below it (Holm-corrected)"
        note += f" On the clairvoyant's seeds {summary}."
    return ResultTable("The ladder", _BASELINES, lines, note, keyed=False)


def _make_oracle_line(matrix: Matrix, task: ControlTask) -> Line:
    if task not in matrix.scales:
        errors = [matrix.results[task, Entry(oracle)].error for oracle in (NOMINAL, STATE)]
        return {"contest": task.name, "falls": "; ".join(filter(None, errors))}
    scale, parameters = matrix.scales[task], matrix.results[task, Entry(PARAMETERS)]
    oracle_ratios, ratios = scale.compute_paired_ratios(scale.oracle)[1], np.empty(0)
    if not parameters.error:
        ratios = scale.compute_paired_ratios(parameters)[0]
    foresight = matrix.foresight.get(task)
    return {
        "contest": task.name,
        "fails": 1.0 - scale.nominal.survived.mean(),
        "oracle-state is": find_oracle(task),
        "gap": average(oracle_ratios),
        "parameters": ratios.mean() if len(ratios) else None,
        "foresight": None if foresight is None else foresight.mean(),
        "episodes": (len(oracle_ratios), len(scale.mark_compared(len(scale.oracle.costs)))),
        "falls": _describe_order(scale, oracle_ratios, foresight),
    }


def _describe_order(scale: ScoreScale, oracle_ratios: Array, foresight: Array | None) -> str:
    """Describe whether each baseline costs less than the one that knows less."""
    if not len(oracle_ratios):
        return "no episode that nominal and oracle-state survive"
    if scale.gap < MIN_GAP:
        return "nothing to win here"
    if foresight is not None and foresight.mean() <= 0.0:
        return "clairvoyant does not"
    return "yes" if average(oracle_ratios).low > 0.0 else "not surely"


def _make_knowledge_table(matrix: Matrix) -> ResultTable:
    """Make the table of what not knowing costs in each tier: ratios of neighbouring baselines."""
    lines = []
    for tier in matrix.by_tier:
        pairs = [
            matrix.scales[task].compute_paired_ratios(parameters)
            for task in matrix.tasks
            if task.tier == tier and task in matrix.scales
            if not (parameters := matrix.results[task, Entry(PARAMETERS)]).error
        ]
        counted = [(ratios, oracle_ratios) for ratios, oracle_ratios in pairs if len(ratios)]
        steps = {
            "model": [ratios for ratios, _ in counted],
            "sensing": [oracle_ratios - ratios for ratios, oracle_ratios in counted],
            "foresight": [x for task, x in matrix.foresight.items() if task.tier == tier],
        }
        saved = {name: geometric_mean(*logs) for name, logs in steps.items() if logs}
        lines.append({"tier": f"{tier}: {TITLES[tier]}"} | saved)
    note = (
        "Cost without over cost with the knowledge: nominal / oracle-parameters, oracle-parameters "
        "/ oracle-state, oracle-state / clairvoyant. Paired geometric means."
    )
    return ResultTable("What not knowing costs", _KNOWLEDGE, lines, note, keyed=False)


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
