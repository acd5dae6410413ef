"""The suite `learned`: what learned policies cost in conditions that no task has.

Each shipped policy of `LEARNED` drives tasks of its class on salted seeds, beside controllers on
the same late sensors and the baselines. Filters have the levels of the task itself; trainings
varied some of the conditions.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import numpy as np

from ...agents.rollout import compute_cost_ratios
from ...envs.record import Array
from ..control.entries import ADAPTIVE, CONTROLLERS, JOINT, LEARNED, REFERENCE_FILTER, Entry
from ..control.run import DriveResult, Results, measure
from ..control.score import FAILURE_RATIO, compute_log_ratios
from ..control.tasks import (
    NOMINAL,
    PARAMETERS,
    QUICK_LEAD_IN,
    ControlTask,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
    vary_scenario,
)
from ..harness.results import Column, Line, ResultTable, Suite
from ..harness.stats import (
    Estimate,
    compute_tail_mean,
    compute_win_rate,
    geometric_mean,
    ratio_of_sums,
    share,
)
from ..harness.verdict import format_verdict
from ..report.study import Request, Study

TRAINED = "as trained"
EPISODES = 32, 4  # of a usual and of a quick run
_PAPERS = ("two-dof", "model-following")
RIVALS = ADAPTIVE
"""Against whom episodes are counted, beside nominal and the papers'."""
_MIN_SCORED_GAP = 0.1  # mean log ratio from nominal to oracle-parameters, of which there are shares
_LEVELS = np.geomspace(0.1, 10.0, 41)


def _scale_tyres(low: float, high: float) -> dict[str, Any]:
    return dict.fromkeys(("front_stiffness", "rear_stiffness"), (low, high))


CONDITIONS: Mapping[str, Mapping[str, Any]] = {
    TRAINED: {},
    "tyres 0.45 to 0.6": _scale_tyres(0.45, 0.6),
    "tyres 1.4 to 1.8": _scale_tyres(1.4, 1.8),
    "camera 100 ms late": {"camera_delays": [0.1], "camera_jitter": 0.0},
    "no GPS from 2 to 7 s": {"gps_outage": (2.0, 7.0)},
    "gyro 0.5 deg/s off": {"noise": {"gyro_bias": float(np.radians(0.5))}},
    "a quarter heavier": {"mass": 1.25},
    "no camera from 2 to 7 s": {"camera_outage": (2.0, 7.0)},
    "400 N from the side": {"wind_force": 400.0, "wind_start": 2.0, "wind_length": 3.0},
    "half the pictures lost": {"camera_loss": 0.5},
}
"""Changes of a task's scenario by condition, as for `vary_scenario`."""
NEVER_MET = ("gyro 0.5 deg/s off", "half the pictures lost")
"""Conditions that no training varied (`policies.VARIED` has the others)."""
LATELY_MET = ("no camera from 2 to 7 s", "400 N from the side")
"""Conditions that only the trainings of `raw-coms-steering` and `raw-coms-yaw` varied."""
_QUICK_CONDITIONS = (TRAINED, "no GPS from 2 to 7 s", "400 N from the side")


def list_entries(kind: str) -> list[Entry]:
    """List all who drive a class: baselines, classics, policies.

    Args:
        kind: Class of tasks.

    Returns:
        Entries.
    """
    available = CONTROLLERS[_select_tasks(kind)[0].env_id]
    classics = [Entry(name, REFERENCE_FILTER) for name in _PAPERS if name in available]
    adaptive = [Entry(name, JOINT) for name in ADAPTIVE]
    return [Entry(NOMINAL), Entry(PARAMETERS), *classics, *adaptive, *LEARNED[kind]]


def _select_tasks(kind: str) -> list[ControlTask]:
    """Select three of a class's tasks, evenly from the first to the last."""
    tasks = [task for task in list_scored_tasks() if task.kind == kind]
    return [tasks[(2 * i + 1) * len(tasks) // 6] for i in range(3)]


@dataclass
class TransferResult:
    """A class's episodes by condition, of each task in the order of `_select_tasks`, by name."""

    kind: str
    drives: dict[str, list[dict[str, DriveResult]]] = field(default_factory=dict)
    salt: str = ""
    env_id: str = ""
    title: str = ""  # beginning of the tables' titles
    scenarios: str = ""  # what was driven
    remark: str = ""  # end of the tables' note

    def _score(self, name: str, condition: str) -> Estimate:
        """An entry's share of the gap in a condition; NaN of a gap below _MIN_SCORED_GAP."""
        ratios, gaps = list[Array](), list[Array]()
        for by_name in self.drives[condition]:
            nominal, oracle = by_name[NOMINAL], by_name[PARAMETERS]
            if (compared := nominal.survived & oracle.survived).any():
                ratios.append(compute_log_ratios(nominal.costs, by_name[name])[compared])
                gaps.append(compute_log_ratios(nominal.costs, oracle)[compared])
        if not gaps or not np.mean([gap.mean() for gap in gaps]) > _MIN_SCORED_GAP:
            return Estimate(np.nan)
        return ratio_of_sums(ratios, gaps)

    def _compute_ratios(self, name: str) -> Array:
        """Cost over nominal's of each episode, infinite where it ended by a failure, shape (n,)."""
        ratios = compute_cost_ratios(self.select("cost", name), self.select("cost", NOMINAL))
        return np.where(self.select("failure", name) != 0.0, np.inf, ratios)

    def compute_cost_ratio(self, name: str, rival: str, conditions: Iterable[str]) -> Estimate:
        """Compute the geometric mean of an entry's cost over a rival's, where the rival survives.

        Args:
            name: Name of the entry.
            rival: Name of the entry by whose costs on the same seeds the costs are divided.
            conditions: Names of the conditions.

        Returns:
            Ratio of the costs, paired; NaN where the rival never survives.
        """
        logs = []
        for results in (by_name for condition in conditions for by_name in self.drives[condition]):
            ratios = compute_log_ratios(results[rival].costs, results[name])
            logs.append(-ratios[results[rival].survived])
        return geometric_mean(*logs)

    def select(self, metric: str, name: str) -> Array:
        """Select a number of each episode, in all conditions and tasks one behind the other.

        Args:
            metric: One of `NUMBERS`.
            name: Name of the entry.

        Returns:
            Numbers, shape (n,).
        """
        by_task = (results for drives in self.drives.values() for results in drives)
        return np.concatenate([results[name][metric] for results in by_task])


def _measure(request: Request) -> list[TransferResult]:
    """Run every class that has a policy in every condition; ValueError: an entry cannot drive."""
    salt, results = request.salt or make_salt(), dict[str, Results]()
    seeds = make_task_seeds(salt, request.episodes or 0)
    tasks = {kind: _select_tasks(kind) for kind in LEARNED}
    for condition in request.choose(tuple(CONDITIONS), _QUICK_CONDITIONS):
        change = CONDITIONS[condition]
        cases = [
            (replace(task, changes=changes), entry)
            for kind, class_tasks in tasks.items()
            for task in class_tasks
            for changes in [{"scenario": vary_scenario(task, change), "lead_in": QUICK_LEAD_IN}]
            for entry in list_entries(kind)
        ]
        results[condition] = measure(
            cases, seeds, jobs=request.jobs, console=request.console, keep=request.keep,
            title=f"learned, {condition}",
        )  # fmt: skip
    remark = f"No training met: {'; '.join(NEVER_MET)}. "
    remark += f"Only those of the COMS's policies without a filter met: {'; '.join(LATELY_MET)}."
    transfers = []
    for kind, selected in tasks.items():
        drives = {
            condition: [collect_results(outcomes, task, condition) for task in selected]
            for condition, outcomes in results.items()
        }
        scenarios, env_id = ", ".join(task.scenario for task in selected), selected[0].env_id
        scenarios += f", after {QUICK_LEAD_IN:g} s of gentle driving"
        transfers.append(TransferResult(kind, drives, salt, env_id, kind, scenarios, remark))
    return transfers


def collect_results(results: Results, task: ControlTask, condition: str) -> dict[str, DriveResult]:
    """Collect the episodes of all who drive a task.

    Args:
        results: Episodes by entry.
        task: Task that was driven.
        condition: Name of the condition, for the message.

    Returns:
        Episodes by controller.

    Raises:
        ValueError: An entry cannot drive; the message says why.
    """
    drives = {entry.agent: results[task, entry] for entry in list_entries(task.kind)}
    wrong = [f"{name}, {condition}: {run.error}" for name, run in drives.items() if run.error]
    if wrong:
        raise ValueError("; ".join(wrong))
    return drives


def _compose_verdict(transfers: Sequence[TransferResult]) -> str:
    """The share of the gap of each class's first policy, as trained and at worst."""
    lines = []
    for transfer in transfers:
        policy = LEARNED[transfer.kind][0].agent
        shares = {name: transfer._score(policy, name).value for name in transfer.drives}
        unmet = NEVER_MET + LATELY_MET  # by it, the class's first
        met = [share for name, share in shares.items() if name not in (TRAINED, *unmet)]
        new = [share for name, share in shares.items() if name in unmet]
        better = compute_win_rate(*(transfer.select("cost", x) for x in (policy, RIVALS[0]))).value
        lines.append(
            f"{policy} closes {shares[TRAINED]:.2f} of the gap; at worst {_format_min(met)} where "
            f"it trained, {_format_min(new)} where never; "
            f"beats {RIVALS[0]} in {100.0 * better:.0f} %."
        )
    return format_verdict(*lines)


def _format_min(shares: Sequence[float]) -> str:
    """The smallest share that is no NaN, "-" for none."""
    finite = [value for value in shares if value == value]
    return f"{min(finite):.2f}" if finite else "-"


def add_tables(suite: Suite, transfers: Sequence[TransferResult]) -> None:
    """Add each class's rows and tables.

    Args:
        suite: Suite that gets the rows and tables.
        transfers: Episodes of each class.
    """
    for transfer in transfers:
        _add_tables(suite, transfer)


def _add_tables(suite: Suite, transfer: TransferResult) -> None:
    names = [entry.agent for entry in list_entries(transfer.kind)]
    costs = {name: transfer.select("cost", name) for name in names}
    episodes = len(costs[NOMINAL])
    count = episodes // len(transfer.drives)
    rivals = [controller for controller in (NOMINAL, *_PAPERS, *RIVALS) if controller in names]
    shares, totals = list[Line](), list[Line]()
    for name in names:
        scores = {x: transfer._score(name, x) for x in transfer.drives}
        shares.append({"controller": name} | scores)
        for condition, item in scores.items():
            where = {"controller": name, "scenario": f"{transfer.kind}, {condition}"}
            cost = transfer.compute_cost_ratio(name, NOMINAL, [condition])
            numbers = {"score": item, "cost_vs_nominal": cost}
            suite.add_rows([numbers], transfer.env_id, **where, salt=transfer.salt, n=count)
        won = {x: compute_win_rate(costs[name], costs[x]).value for x in rivals if x != name}
        total: dict[str, Any] = {"controller": name} | won
        total["fails"] = share(transfer.select("failure", name) != 0.0).value
        total["tail"] = compute_tail_mean(compute_cost_ratios(costs[name], costs[NOMINAL])).value
        totals.append(total)
    note = f"{transfer.scenarios}; {count} episodes a condition, the same for everybody. "
    note += f"{transfer.remark} Empty where nominal's mean log ratio to {PARAMETERS} is below "
    note += f"{_MIN_SCORED_GAP}."
    columns = ("controller", *(Column(name, form=".2f") for name in transfer.drives))
    beaten = (Column(rival, f"beats {rival} / %", 100.0, ".0f") for rival in rivals)
    ends = Column("fails", "fails / %", 100.0, ".1f"), Column("tail", "worst 5 %", form=".2f")
    text = f"Of {episodes} episodes. worst 5 %: mean of the largest ratios to nominal's cost."
    title = f"{transfer.title}: all conditions together"
    suite.tables += [
        ResultTable(f"{transfer.title}: share of the gap", columns, shares, note),
        ResultTable(title, ("controller", *beaten, *ends), totals, text),
    ]


def add_figures(suite: Suite, transfers: Sequence[TransferResult], draw: ModuleType) -> None:
    """Add figures of what each costs, and how often how much.

    Args:
        suite: Suite that gets the figures.
        transfers: Episodes of each class.
        draw: `report.figures`.
    """
    costs, profiles = dict[str, dict[str, Estimate]](), []
    for transfer in transfers:
        names = [entry.agent for entry in list_entries(transfer.kind)]
        ratios = {name: transfer._compute_ratios(name) for name in names}
        costs[transfer.kind] = {
            name: geometric_mean(np.log(np.minimum(x, FAILURE_RATIO))).rescale(100.0)
            for name, x in ratios.items()
        }
        lines = {name: _compute_profile(x, _LEVELS) for name, x in ratios.items()}
        labels = "cost / nominal's on the same seed", "share of episodes that cost no more"
        text = "A performance profile: the higher the better; a failure is never reached."
        title = f"{transfer.kind}: how often at what cost"
        profiles.append((title, draw.draw_curves(_LEVELS, lines, *labels, "x"), text))
    figure = draw.draw_groups(costs, "cost / nominal's, %: less is better", {100.0: NOMINAL})
    failing = f"a failure costs {FAILURE_RATIO:.0f} times nominal's."
    text = f"Geometric means over all conditions; {failing}"
    suite.answers.append(("Who holds the car where contests never are?", figure, text))
    suite.figures += profiles


def _compute_profile(values: Array, levels: Array) -> tuple[Array, Array, Array]:
    """Fraction of numbers at most each level, with Wilson's interval: Dolan and Moré 2002."""
    value, low, high = np.array([share(values <= level) for level in levels]).T
    return value, low, high


STUDY = Study(
    "learned",
    "Learned policies where contests never are",
    "The shipped policies beside controllers on the same late sensors, on salted seeds and in "
    "conditions that no contest has, in three contests of a policy's class. Share: of the "
    "paired log ratio of cost from nominal (0) to oracle-parameters (1), which knows car, friction "
    "and biases, over the contests, on the episodes that both survive; a failure counts as 20 "
    "times nominal's cost.",
    EPISODES,
    _measure,
    add_tables,
    _compose_verdict,
    add_figures,
)
