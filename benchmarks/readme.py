"""The tables of results in README.md, docs/results/benchmark.md and docs/PAPERS.md.

`python -m sideslip.benchmarks.readme` writes the rows of the entries to docs/first.json. Columns of
transfer are made of docs/procedures.json (`sideslip bench procedures --json`). With --papers the
papers' systems drive, and docs/own_ground.json and the table of docs/PAPERS.md are written.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from ..agents.baselines import FILTER
from ..envs.record import Array
from ..envs.scenarios.world import GROUPS, make_world
from .control.entries import JOINT, LEARNED, REFERENCE_CONTROLLER, REFERENCE_FILTER, Entry
from .control.run import NUMBERS, Results, measure
from .control.score import CONSTANTS, Standing, rank_entries
from .control.tasks import (
    NOMINAL,
    PARAMETERS,
    STATE,
    STEERING,
    TIERS,
    TITLES,
    WORLD,
    ControlTask,
    list_scored_tasks,
    make_salt,
    make_salted_seeds,
    make_task_seeds,
)
from .harness.parallel import report_user_errors
from .harness.results import ResultRow, Suite, read_json, write_json, write_text
from .harness.stats import Estimate, interval, ratio_of_roots
from .papers import dakf_stability, double_layer, dual_rate, tie_vision, uneven_delay
from .papers.ledger import join_numbers
from .papers.manoeuvres import EstimationSimulation, PaperFilter

README, PAGE = Path("README.md"), Path("docs/results/benchmark.md")
ROWS, TRANSFER = Path("docs/first.json"), Path("docs/procedures.json")
METRICS = COST, FAILURES, SCORE = ("cost_vs_nominal", "failure_rate", "score")
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
    salt: str, jobs: int | None = None, console: Console | None = None, keep: Path | None = None
) -> list[ResultRow]:
    """Drive the entries and nominal in every scored task with steering; return their rows."""
    policies = {entry.agent: kind for kind, entries in LEARNED.items() for entry in entries}
    pairs = [(NOMINAL, ""), *(pair for pairs in PAGE_ENTRIES.values() for pair in pairs)]
    rows = list[ResultRow]()
    for changes, episodes in (({}, EPISODES), ({"world": _double_ranges()}, _DOUBLED_EPISODES)):
        cases = [
            (replace(task, changes=changes), Entry(*pair))
            for task in _list_tasks()
            for pair in pairs
            if policies.get(pair[0], task.kind) == task.kind
        ]
        seeds = make_task_seeds(salt, episodes)
        results = measure(cases, seeds, jobs=jobs, console=console, keep=keep, title="README")
        suite = Suite("control", "", "")
        for standing in _rank_driven(results, TITLES):
            standing.add_rows(suite, salt)
            if not changes:
                suite.add_rows(_score_otherwise(standing), salt=salt)
        end = _DOUBLED if changes else ""
        rows += [replace(x, scenario=x.scenario + end) for x in suite.rows if x.metric in METRICS]
    return rows


def _score_otherwise(standing: Standing) -> list[dict[str, Any]]:
    """Make rows of an entry's score by other constants."""
    entry = standing.entry
    shared = {"controller": entry.agent, "estimator": entry.estimator, "n": standing.n}
    return [
        shared | {"scenario": f"tier {standing.tier}, {x}", SCORE: standing.compute_score(*numbers)}
        for x, numbers in CONSTANTS.items()
    ]


def _list_tasks() -> list[ControlTask]:
    return [task for task in list_scored_tasks() if task.env_id == STEERING]


def _double_ranges() -> dict[str, Any]:
    """Make the world with all ranges doubled, which designs are told as they are told their own."""
    world = make_world(WORLD)
    for group in GROUPS:
        world = world.scale(group, 2.0)
    return world.to_dict()


def _rank_driven(results: Results, tiers: Iterable[str]) -> list[Standing]:
    """Rank the entries of each tier; ValueError for one that could not drive."""
    for (task, entry), result in results.items():
        if result.error:
            raise ValueError(f"{entry.label} in {task.name}: {result.error}")
    return [standing for tier in tiers for standing in rank_entries(results, tier)]


def _read_cells(rows: Sequence[ResultRow]) -> dict[tuple[str, ...], Estimate]:
    """Read the numbers of rows by scenario, controller, estimator and metric."""
    return {
        (x.scenario, x.controller, x.estimator, x.metric): Estimate(x.value, x.low, x.high)
        for x in rows
    }


def _format_cell(
    cells: Mapping[tuple[str, ...], Estimate], scenario: str, pairs: Iterable[tuple[str, str]]
) -> str:
    """Cost in % of nominal's with its interval, and cars lost, of the first pair that drove."""
    for pair in pairs:
        cost, lost = (cells.get((scenario, *pair, metric)) for metric in (COST, FAILURES))
        if lost is not None:
            shown = "-" if cost is None else cost.inline(100.0, ".0f")
            return f"{shown} ({100.0 * lost.value:.0f})"
    return ""


def _make_table(rows: Sequence[ResultRow], transfer: Sequence[ResultRow]) -> str:
    """Make README's table: a line an entry, a column a tier, and columns of transfer."""
    # a line has room for numbers alone, without their intervals
    cells, lines = _read_cells([replace(x, low=math.nan) for x in rows]), []
    far = {(row.scenario, row.controller, row.metric): row for row in transfer}
    for name, pairs in ENTRIES.items():
        agent = _PROCEDURES.get(pairs[0][0], pairs[0][0])
        line = [name, *(_format_cell(cells, f"tier {tier}", pairs) for tier in TITLES)]
        for scenario, metric, factor, form in _TRANSFER.values():
            row = far.get((scenario, agent, metric))
            is_rival = (agent, metric) == (REFERENCE_CONTROLLER, "ratio")  # beside itself: 1
            value = row.value if row else 1.0 if is_rival else None
            line.append("" if value is None else f"{factor * value:{form}}")
        lines.append(line)
    tiers = (f"{tier}, {SPEEDS[tier]}" for tier in TITLES)
    return _format_table(lines, [*tiers, *_TRANSFER])


def _make_task_table(rows: Sequence[ResultRow]) -> str:
    """Make the table by task: a line a task, a column an entry, with 95 % intervals."""
    cells, entries = _read_cells(rows), PAGE_ENTRIES.values()
    lines = [
        [task.scenario, *(_format_cell(cells, task.name, pairs) for pairs in entries)]
        for task in _list_tasks()
    ]
    return _format_table(lines, list(PAGE_ENTRIES))


def _make_doubled_table(rows: Sequence[ResultRow]) -> str:
    """Make the table of the world whose ranges are doubled: a line an entry, a column a tier."""
    cells, heads = _read_cells(rows), [f"tier {tier}{_DOUBLED}" for tier in TITLES]
    entries = PAGE_ENTRIES.items()
    lines = [[name, *(_format_cell(cells, x, pairs) for x in heads)] for name, pairs in entries]
    return _format_table(lines, heads)


def _format_table(lines: Sequence[Sequence[str]], heads: Sequence[str]) -> str:
    """Format a table whose first column has no head."""
    body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([f"| | {' | '.join(heads)} |", "|---" * (1 + len(heads)) + "|", *body])


def _replace_table(text: str, new_table: str) -> str:
    """Replace a page's table with the same first column head; ValueError for none or several."""
    first = re.escape(new_table.split(" | ")[1].split(",")[0])
    pattern = re.compile(rf"^\| \| {first}[^\n]*\n(\|[^\n]*\n)+", re.MULTILINE)
    if len(pattern.findall(text)) != 1:
        raise ValueError(f"the page has no table that begins with {first!r}, or several")
    return pattern.sub(lambda _: new_table + "\n", text)


PAPERS, SYSTEM_ROWS = Path("docs/PAPERS.md"), Path("docs/own_ground.json")
_TIER = next(iter(TIERS))  # of the papers' car
SYSTEM_EPISODES = 32  # a task
_HEADS = ("the paper's", "ours", "the paper's / %", "ours / %", "its cost / %", "our cost / %")
_RATIO = "ratio"
_RECOMMENDED = PaperFilter(JOINT, JOINT)
_INFORMED = PaperFilter("informed", FILTER, vehicle="true")
"""The filter against which those of papers without a controller stand: it knows the true car."""


@dataclass(frozen=True)
class _System:
    """A paper's system, where it was shown and what counts there."""

    paper: str  # short name of the paper
    entry: Entry  # its controller on its filter; of a paper without a controller LQR on its filter
    recommended: Entry  # what this project recommends instead
    task: ControlTask  # the paper's simulation, with its sensors and its reference
    metric: str  # metric of an episode, or estimate of the filter, whose root mean square counts
    criterion: str  # the metric in words
    simulations: Sequence[EstimationSimulation] = ()  # of a paper without a controller
    label: str = ""  # the paper's filter among those of the simulations
    # who drives the tasks where its own filter takes no lost or uneven frames
    common_entry: Entry | None = None

    @property
    def scenario(self) -> str:
        """Name of its rows."""
        return f"{self.task.scenario}, {self.criterion}"

    def measure(self, seeds: Sequence[int], jobs: int | None) -> tuple[Array, Array, Array]:
        """Measure root mean squares (n,) of the paper's system, ours and a rival.

        The rival is tuned LQG with the same sensors; a filter stands beside `_INFORMED` instead.
        """
        sensor = "camera" if "Vision" in self.task.env_id else "gps"
        rival_entry = Entry(REFERENCE_CONTROLLER, f"{FILTER}, {sensor}")
        entries = (self.entry, self.recommended, rival_entry)
        if self.metric in NUMBERS:
            driven = measure([(self.task, entry) for entry in entries], seeds, jobs=jobs)
            first, second, rival = (driven[self.task, entry][self.metric] for entry in entries)
            return first, second, rival
        (drives,) = (x for x in self.simulations if x.name == self.task.scenario)
        paper_filters = [x for x in drives.filters if x.label == self.label]
        filters = (*paper_filters, _RECOMMENDED, _INFORMED)
        numbers = join_numbers(replace(drives, filters=filters).run(seeds))
        original, recommended, rival = (numbers[x.label, self.metric] for x in filters)
        return original, recommended, rival


def _make_ground(sensors: str, scenario: str, reference: str = "", **changes: Any) -> ControlTask:
    return ControlTask("", f"sideslip/{sensors}-v0", "coms", reference, scenario, changes=changes)


_SLIP, _RECOMMENDED_ENTRY = "error of the sideslip angle", Entry("adaptive-lqr", JOINT)
_FOLLOWING = (
    dakf_stability.PAPER,
    Entry("model-following", dakf_stability.DAKF),
    _RECOMMENDED_ENTRY,
    _make_ground("YawGps", dakf_stability.FIG7, steering=True, control_period=1),
)
_FIG5, _FIG9, _FIG4 = uneven_delay.FIG5, double_layer.FIG9, dual_rate.FIG4
_OFFSET = "error of the lateral offset"
_FILTERS = (
    (uneven_delay, "uneven-delay-kf", "YawVision", _FIG5, uneven_delay.PROPOSED, ("y_l", _OFFSET)),
    (double_layer, "double-layer", "YawGps", _FIG9, double_layer.PROPOSED, ("beta", _SLIP)),
    (dual_rate, "dual-rate", "YawGps", _FIG4, dual_rate.PSEUDO, ("beta", _SLIP)),
)
SYSTEMS = (
    _System(
        "tie-vision",
        Entry("two-dof", "multirate-residual-kf", {"filter": {}, "controller": {}}),  # untuned
        _RECOMMENDED_ENTRY,
        _make_ground("YawVision", tie_vision.FIG8, "zero-slip", control_period=1),
        "rms_slip", "sideslip angle", common_entry=Entry("two-dof", REFERENCE_FILTER),
    ),
    _System(*_FOLLOWING, "rms_slip_error", _SLIP),
    _System(*_FOLLOWING, "rms_yaw_error", "error of the yaw rate"),
    *(
        _System(
            module.PAPER, Entry(REFERENCE_CONTROLLER, name), Entry(REFERENCE_CONTROLLER, JOINT),
            _make_ground(sensors, scenario), *criterion, module.SIMULATIONS, label,
        )
        for module, name, sensors, scenario, label, criterion in _FILTERS
    ),
)  # fmt: skip


def _measure_systems(
    salt: str, jobs: int | None, console: Console, keep: Path | None
) -> list[ResultRow]:
    """Drive every system on its own ground and, beside nominal, in the small car's tasks."""
    suite, seeds = Suite("own-ground", "", ""), make_salted_seeds(salt, SYSTEM_EPISODES)
    for system in SYSTEMS:
        original, recommended, rival = (x**2 for x in system.measure(seeds, jobs))
        for entry, squares in ((system.entry, original), (system.recommended, recommended)):
            labels = {"estimator": entry.estimator, "controller": entry.agent, "salt": salt}
            labels |= {"scenario": system.scenario, "paper": system.paper}
            ratio = {_RATIO: interval(squares, ratio_of_roots, rival)}
            suite.add_rows([ratio], system.task.env_id, n=SYSTEM_EPISODES, **labels)
    scored = [x for x in list_scored_tasks() if (x.tier, x.env_id) == (_TIER, STEERING)]
    systems = [x for y in SYSTEMS for x in (y.common_entry or y.entry, y.recommended)]
    drivers = dict.fromkeys((Entry(NOMINAL), *systems))
    pairs = [(task, entry) for task in scored for entry in drivers]
    seeds_by_task = make_task_seeds(salt, SYSTEM_EPISODES)
    common = measure(pairs, seeds_by_task, jobs=jobs, console=console, keep=keep)
    for standing in _rank_driven(common, [_TIER]):
        standing.add_rows(suite, salt)
    names = {COST: f"tier {_TIER}"}
    return [row for row in suite.rows if row.scenario == names.get(row.metric, row.scenario)]


def _make_system_table(rows: Sequence[ResultRow]) -> str:
    """Make the table of docs/PAPERS.md: a line a system and criterion."""
    cells, lines = _read_cells(rows), []

    def format_cell(scenario: str, entry: Entry, metric: str) -> str:
        return cells[scenario, entry.agent, entry.estimator, metric].inline(100.0, ".0f")

    for system in SYSTEMS:
        both = (system.entry, system.recommended)
        ground = [format_cell(system.scenario, entry, _RATIO) for entry in both]
        common_entries = (system.common_entry or system.entry, system.recommended)
        common = [format_cell(f"tier {_TIER}", entry, COST) for entry in common_entries]
        names = [f"`{x.agent}` on `{x.estimator}`" for x in both]
        lines.append([f"{system.paper}, {system.scenario}", *names, *ground, *common])
    return _format_table(lines, _HEADS)


def _main(
    salt: Annotated[str, typer.Option(help="Of the seeds, hexadecimal.")] = "",
    keep: Annotated[Path | None, typer.Option(help="Folder for finished cases.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes.")] = None,
    driven: Annotated[bool, typer.Option("--driven", help="Make the tables of old rows.")] = False,
    papers: Annotated[bool, typer.Option("--papers", help="The table of docs/PAPERS.md.")] = False,
) -> None:
    """Drive README's entries, or the papers' systems, and write their rows and tables."""
    console, salt = Console(stderr=True), salt or make_salt()
    file, measure_rows = (SYSTEM_ROWS, _measure_systems) if papers else (ROWS, _measure_entries)
    rows = read_json(file) if driven else measure_rows(salt, jobs, console, keep)
    tables = [(PAPERS, _make_system_table)]
    if not papers:
        pages = (PAGE, _make_task_table), (PAGE, _make_doubled_table)
        tables = [(README, partial(_make_table, transfer=read_json(TRANSFER))), *pages]
    texts = {page: page.read_text(encoding="utf-8") for page, _ in tables}
    for page, make_table in tables:
        texts[page] = _replace_table(texts[page], make_table(rows))
    write_json(file, rows)
    for page, text in texts.items():
        write_text(page, text)


if __name__ == "__main__":
    with report_user_errors():
        typer.run(_main)
