"""Each of the five papers' systems on its own ground, beside the benchmark's common score.

`python -m sideslip.benchmarks.own_ground` drives them in their papers' simulations and in the small
car's tasks, and writes docs/own_ground.json and the table in docs/PAPERS.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..agents.baselines import FILTER
from ..envs.record import Array
from .control import tasks
from .control.entries import JOINT, REFERENCE_CONTROLLER, REFERENCE_FILTER, Entry
from .control.run import NUMBERS, measure
from .control.score import rank_entries
from .control.tasks import ControlTask
from .harness.parallel import report_user_errors
from .harness.results import ResultRow, Suite, read_json, write_json, write_text
from .harness.stats import interval, ratio_of_roots
from .papers import dakf_stability, double_layer, dual_rate, tie_vision, uneven_delay
from .papers.ledger import PaperFilter
from .papers.manoeuvres import EstimationSimulation
from .readme import check_driven, format_table, replace_table

PAGE, ROWS = Path("docs/PAPERS.md"), Path("docs/own_ground.json")
_TIER = next(iter(tasks.TIERS))  # of the papers' car
EPISODES = 32  # a task
_HEADS = ("the paper's", "ours", "the paper's / %", "ours / %", "its cost / %", "our cost / %")
_RATIO, _COST = "ratio", "cost_vs_nominal"
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
        numbers = replace(drives, filters=filters).measure(tuple(seeds)).numbers
        original, recommended, rival = (numbers[x.label, self.metric] for x in filters)
        return original, recommended, rival


def _make_task(sensors: str, scenario: str, reference: str = "", **changes: object) -> ControlTask:
    return ControlTask("", f"sideslip/{sensors}-v0", "coms", reference, scenario, changes=changes)


_SLIP, _RECOMMENDED_ENTRY = "error of the sideslip angle", Entry("adaptive-lqr", JOINT)
_FOLLOWING = (
    dakf_stability.PAPER,
    Entry("model-following", dakf_stability.DAKF),
    _RECOMMENDED_ENTRY,
    _make_task("YawGps", dakf_stability.FIG7, steering=True, control_period=1),
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
        _make_task("YawVision", tie_vision.FIG8, "zero-slip", control_period=1),
        "rms_slip",
        "sideslip angle",
        common_entry=Entry("two-dof", REFERENCE_FILTER),
    ),
    _System(*_FOLLOWING, "rms_slip_error", _SLIP),
    _System(*_FOLLOWING, "rms_yaw_error", "error of the yaw rate"),
    *(
        _System(
            module.PAPER,
            Entry(REFERENCE_CONTROLLER, name),
            Entry(REFERENCE_CONTROLLER, JOINT),
            _make_task(sensors, scenario),
            *criterion,
            module.SIMULATIONS,
            label,
        )
        for module, name, sensors, scenario, label, criterion in _FILTERS
    ),
)


def _measure_systems(salt: str, jobs: int | None, console: Console) -> list[ResultRow]:
    """Drive every system on its own ground and, beside nominal, in the small car's tasks."""
    suite, seeds = Suite("own-ground", "", ""), tasks.make_salted_seeds(salt, EPISODES)
    for system in SYSTEMS:
        original, recommended, rival = (x**2 for x in system.measure(seeds, jobs))
        for entry, squares in ((system.entry, original), (system.recommended, recommended)):
            labels = {"estimator": entry.estimator, "controller": entry.agent, "salt": salt}
            labels |= {"scenario": system.scenario, "paper": system.paper}
            ratio = {_RATIO: interval(squares, ratio_of_roots, rival)}
            suite.add_rows([ratio], system.task.env_id, n=EPISODES, **labels)
    scored = [x for x in tasks.list_scored_tasks() if (x.tier, x.env_id) == (_TIER, tasks.STEERING)]
    systems = [x for y in SYSTEMS for x in (y.common_entry or y.entry, y.recommended)]
    drivers = dict.fromkeys((Entry(tasks.NOMINAL), *systems))
    pairs = [(task, entry) for task in scored for entry in drivers]
    seeds_by_task = tasks.make_task_seeds(salt, EPISODES)
    common = measure(pairs, seeds_by_task, jobs=jobs, console=console)
    check_driven(common)
    for standing in rank_entries(common, _TIER):
        standing.add_rows(suite, salt)
    names = {_COST: f"tier {_TIER}"}
    return [row for row in suite.rows if row.scenario == names.get(row.metric, row.scenario)]


def _make_table(rows: Sequence[ResultRow]) -> str:
    """Make the table: a line a system and criterion."""
    cells = {(row.scenario, row.controller, row.estimator, row.metric): row for row in rows}

    def format_cell(scenario: str, entry: Entry, metric: str) -> str:
        row = cells[scenario, entry.agent, entry.estimator, metric]
        value, low, high = (100.0 * x for x in (row.value, row.low, row.high))
        return f"{value:.0f} [{low:.0f}, {high:.0f}]"

    lines = []
    for system in SYSTEMS:
        both = (system.entry, system.recommended)
        ground = [format_cell(system.scenario, entry, _RATIO) for entry in both]
        common_entries = (system.common_entry or system.entry, system.recommended)
        common = [format_cell(f"tier {_TIER}", entry, _COST) for entry in common_entries]
        names = [f"`{x.agent}` on `{x.estimator}`" for x in both]
        lines.append([f"{system.paper}, {system.scenario}", *names, *ground, *common])
    return format_table(lines, _HEADS)


def _main(
    salt: Annotated[str, typer.Option(help="Of the seeds, hexadecimal.")] = "",
    jobs: Annotated[int | None, typer.Option(help="Processes.")] = None,
    driven: Annotated[bool, typer.Option("--driven", help="Make the table of old rows.")] = False,
) -> None:
    """Drive the systems and write their rows and their table."""
    console = Console(stderr=True)
    salt = salt or tasks.make_salt()
    rows = read_json(ROWS) if driven else _measure_systems(salt, jobs, console)
    text = replace_table(PAGE.read_text(encoding="utf-8"), _make_table(rows))
    write_json(ROWS, rows)
    write_text(PAGE, text)


if __name__ == "__main__":
    with report_user_errors():
        typer.run(_main)
