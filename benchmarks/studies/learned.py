"""The suite `learned`: what learned policies cost in conditions that no task has.

Each shipped policy of `LEARNED` drives tasks of its class on salted seeds, beside controllers on
the same late sensors and the baselines. Filters have the levels of the task itself; trainings
varied some of the conditions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ...agents.rollout import compute_cost_ratios
from ...envs.record import Array
from ..control.entries import ADAPTIVE, CONTROLLERS, LEARNED, REFERENCE_FILTER, ControlEntry
from ..control.run import DriveResult, Results, measure
from ..control.score import FAILURE_RATIO, ScoreScale, score
from ..control.tasks import (
    NOMINAL,
    PARAMETERS,
    ControlTask,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
    vary_scenario,
)
from ..harness.results import ResultTable, Suite
from ..harness.stats import (
    Estimate,
    compute_profile,
    compute_tail_mean,
    compute_win_rate,
    geometric_mean,
    share,
)
from ..harness.verdict import format_verdict
from ..report.study import add_rows, import_figures

NAME, TRAINED = "learned", "as trained"
EPISODES, QUICK_EPISODES = 32, 4
_PAPERS = ("two-dof", "model-following")
RIVALS = tuple(ADAPTIVE.values())
"""Against whom episodes are counted, beside nominal and the papers'."""
_MIN_SCORED_GAP = 0.1  # mean log ratio from nominal to oracle-parameters, of which there are shares
_LEVELS = np.geomspace(0.1, 10.0, 41)
_TEXT = (
    "The shipped policies beside controllers on the same late sensors, on salted seeds and in "
    "conditions that no contest has, in three contests of a policy's class. Share: of the "
    "paired log ratio of cost from nominal (0) to oracle-parameters (1), which knows car, friction "
    "and biases, over the contests, on the episodes that both survive; a failure counts as 20 "
    "times nominal's cost."
)


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
_QUICK_CONDITIONS = (TRAINED, "tyres 1.4 to 1.8", "no GPS from 2 to 7 s", "400 N from the side")


def list_entries(kind: str) -> list[tuple[str, str]]:
    """List all who drive a class: baselines, classics, policies.

    Args:
        kind: Class of tasks.

    Returns:
        Estimator and controller of each.
    """
    available = CONTROLLERS[_select_tasks(kind)[0].env_id]
    classics = [(REFERENCE_FILTER, name) for name in _PAPERS if name in available]
    return [("", NOMINAL), ("", PARAMETERS), *classics, *ADAPTIVE.items(), *LEARNED[kind]]


def _select_tasks(kind: str) -> list[ControlTask]:
    """Select a class's tasks: the middle one of each of three tiers, or three of its only one."""
    tasks = [task for task in list_scored_tasks() if task.kind == kind]
    tiers = [[c for c in tasks if c.tier == tier] for tier in dict.fromkeys(c.tier for c in tasks)]
    n = max(3 // len(tiers), 1)
    return [tier[(2 * i + 1) * len(tier) // (2 * n)] for tier in tiers for i in range(n)]


@dataclass
class TransferResult:
    """A class's episodes by condition, of each task in the order of `_select_tasks`, by name."""

    kind: str
    drives: dict[str, list[dict[str, DriveResult]]] = field(default_factory=dict)
    salt: str = ""

    def score_condition(self, name: str, condition: str) -> Estimate:
        """Compute an entry's share of the gap in a condition.

        Args:
            name: Name of the entry.
            condition: Name of the condition.

        Returns:
            Share; NaN of a gap below _MIN_SCORED_GAP.
        """
        drives = self.drives[condition]
        scales = [ScoreScale(by_name[NOMINAL], by_name[PARAMETERS]) for by_name in drives]
        gaps = [scale.gap for scale in scales if not np.isnan(scale.gap)]  # NaN: nobody survived
        if not gaps or not np.mean(gaps) > _MIN_SCORED_GAP:
            return Estimate(np.nan)
        pairs = zip(scales, drives, strict=True)
        return score([scale.compute_paired_ratios(by_name[name]) for scale, by_name in pairs])

    def ratios(self, name: str) -> Array:
        """Compute the cost over nominal's of each episode.

        Args:
            name: Name of the entry.

        Returns:
            Ratios, infinite where the episode ended by a failure, shape (n,).
        """
        ratios = compute_cost_ratios(self.select("cost", name), self.select("cost", NOMINAL))
        return np.where(self.select("failure", name) != 0.0, np.inf, ratios)

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


def run(
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    quick: bool = False,
    salt: str = "",
) -> Suite:
    """Run every class that has a policy, in every condition.

    Args:
        episodes: Episodes of each task and condition.
        jobs: Processes, None for all processors.
        console: Where progress is shown.
        keep: Folder in which finished cases stay.
        quick: Whether to run few conditions.
        salt: Salt of the seeds, "" for `make_salt`'s.

    Returns:
        Suite of all classes.

    Raises:
        ValueError: An entry cannot drive.
    """
    suite = Suite(NAME, "Learned policies where contests never are", _TEXT)
    salt = salt or make_salt()
    seeds, results = make_task_seeds(salt, episodes), dict[str, Results]()
    tasks = [task for kind in LEARNED for task in _select_tasks(kind)]
    for condition in _QUICK_CONDITIONS if quick else CONDITIONS:
        entries = [
            ControlEntry(task, *pair, {"scenario": vary_scenario(task, CONDITIONS[condition])})
            for task in tasks
            for pair in list_entries(task.kind)
        ]
        results[condition] = measure(
            entries, seeds, jobs=jobs, console=console, keep=keep, title=f"{NAME}, {condition}"
        )
    transfers = [TransferResult(kind, salt=salt) for kind in LEARNED]
    for transfer in transfers:
        selected = _select_tasks(transfer.kind)
        for condition, drives in results.items():
            by_task = [collect_results(drives, task, condition) for task in selected]
            transfer.drives[condition] = by_task
        scenarios = ", ".join(task.scenario for task in selected)
        note = f"No training met: {'; '.join(NEVER_MET)}. "
        note += f"Only those of the COMS's policies without a filter met: {'; '.join(LATELY_MET)}."
        add_tables(suite, transfer, transfer.kind, selected[0].env_id, scenarios, note)
    suite.verdict = compose_verdict(transfers)
    add_figures(suite, transfers)
    return suite


def collect_results(results: Results, task: ControlTask, condition: str) -> dict[str, DriveResult]:
    """Collect the episodes of all who drive a task.

    Args:
        results: Episodes by entry.
        task: Task whose drives are collected.
        condition: Name of the condition, for the message.

    Returns:
        Episodes by controller.

    Raises:
        ValueError: An entry cannot drive; the message says why.
    """
    pairs = list_entries(task.kind)
    drives = {controller: results.select(task, controller, name) for name, controller in pairs}
    wrong = [f"{name}, {condition}: {run.error}" for name, run in drives.items() if run.error]
    if wrong:
        raise ValueError("; ".join(wrong))
    return drives


def compose_verdict(transfers: Sequence[TransferResult]) -> str:
    """Compose the verdict: each class's first policy's share of the gap, as trained and at worst.

    Args:
        transfers: Episodes of each class.

    Returns:
        Verdict.
    """
    lines = []
    for transfer in transfers:
        _, policy = LEARNED[transfer.kind][0]
        shares = {name: transfer.score_condition(policy, name).value for name in transfer.drives}
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


def add_tables(
    suite: Suite, transfer: TransferResult, title: str, env_id: str, scenarios: str, remark: str
) -> None:
    """Add a class's rows and tables.

    Args:
        suite: Suite that gets the results.
        transfer: Episodes of the class.
        title: Beginning of the tables' titles.
        env_id: Id of the env.
        scenarios: What was driven, for the note.
        remark: End of the note.
    """
    names = [controller for _, controller in list_entries(transfer.kind)]
    all_costs = {name: transfer.select("cost", name) for name in names}
    episodes = len(all_costs[NOMINAL])
    rivals = [controller for controller in (NOMINAL, *_PAPERS, *RIVALS) if controller in names]
    shares, totals = [], []
    for controller in names:
        scores = {name: transfer.score_condition(controller, name) for name in transfer.drives}
        texts = (x.inline() if np.isfinite(x.value) else "-" for x in scores.values())
        shares.append([controller, *texts])
        costs = all_costs[controller]
        ratio = compute_tail_mean(compute_cost_ratios(costs, all_costs[NOMINAL])).value
        won = {rival: compute_win_rate(costs, all_costs[rival]).value for rival in rivals}
        beaten = ["" if x == controller else f"{100.0 * rate:.0f} %" for x, rate in won.items()]
        fails = share(transfer.select("failure", controller) != 0.0).value
        totals.append([controller, *beaten, f"{100.0 * fails:.1f} %", f"{ratio:.2f}"])
        columns = {"controller": controller, "salt": transfer.salt}
        for condition, item in scores.items():
            if np.isfinite(item.value):  # else there is no gap
                where = f"{transfer.kind}, {condition}"
                add_rows(suite, {"score": item}, env_id, scenario=where, n=episodes, **columns)
    count = episodes // len(transfer.drives)
    note = f"{scenarios}; {count} episodes a condition, the same for everybody. {remark}"
    if any("-" in row for row in shares):
        note += f" -: nominal's mean log ratio to {PARAMETERS} is below {_MIN_SCORED_GAP}."
    header = ("controller", *(f"beats {rival}" for rival in rivals), "fails", "worst 5 %")
    text = f"Of {episodes} episodes. worst 5 %: mean of the largest ratios to nominal's cost."
    suite.tables += [
        ResultTable(f"{title}: share of the gap", ("controller", *transfer.drives), shares, note),
        ResultTable(f"{title}: all conditions together", header, totals, text),
    ]


def add_figures(suite: Suite, transfers: Sequence[TransferResult]) -> None:
    """Add figures of what each costs, and how often how much; nothing without plotly.

    Args:
        suite: Suite that gets the results.
        transfers: Episodes of each class.
    """
    if (figures := import_figures()) is None:
        return
    ratios = {
        transfer.kind: {name: transfer.ratios(name) for _, name in list_entries(transfer.kind)}
        for transfer in transfers
    }
    costs = dict[str, dict[str, Estimate]]()
    for kind, by_name in ratios.items():
        logs = {name: np.log(np.minimum(x, FAILURE_RATIO)) for name, x in by_name.items()}
        means = {name: geometric_mean(log) for name, log in logs.items()}
        costs[kind] = {name: Estimate(*(100.0 * end for end in x)) for name, x in means.items()}
    label = "cost / nominal's, %: less is better"
    figure = figures.draw_groups(costs, label, {100.0: NOMINAL})
    failing = f"a failure costs {FAILURE_RATIO:.0f} times nominal's."
    text = f"Geometric means over all conditions; {failing}"
    suite.answers.append(("Who holds the car where contests never are?", figure, text))
    for kind, by_name in ratios.items():
        lines = {name: compute_profile(x, _LEVELS) for name, x in by_name.items()}
        label = "share of episodes that cost no more"
        figure = figures.draw_curves(
            _LEVELS, lines, "cost / nominal's on the same seed", label, "x"
        )
        text = "A performance profile: the higher the better; a failure is never reached."
        suite.figures.append((f"{kind}: how often at what cost", figure, text))
