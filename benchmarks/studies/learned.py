"""Question: what do learned policies cost in conditions that no contest has, against all rivals?

Each shipped policy of `LEARNED` drives contests of its class on salted seeds, beside controllers on
the same late sensors and the rungs of the ladder. Nobody learns of a condition: filters have the
levels of the contest itself. Trainings varied some of the conditions, a few of them two more; the
others nobody ever met.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ... import __version__
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
from ..harness.results import ResultRow, ResultTable, Suite
from ..harness.stats import (
    Estimate,
    compute_profile,
    compute_tail_mean,
    compute_win_rate,
    geometric_mean,
    share,
)
from ..harness.study import format_verdict

NAME, TRAINED = "learned", "as trained"
EPISODES, QUICK_EPISODES = 32, 4
PAPERS = ("two-dof", "model-following")
RIVALS = tuple(ADAPTIVE.values())
"""Against whom episodes are counted, beside nominal and the papers'."""
MIN_SCORED_GAP = (
    0.1  # mean log ratio between nominal and oracle-parameters, of which there are shares
)
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
"""What each one changes of a contest's scenario, as `contests.vary_scenario` takes it."""
NEVER_MET = ("gyro 0.5 deg/s off", "half the pictures lost")
"""Those that no training varied (`distillation.VARIED` has the others)."""
LATELY_MET = ("no camera from 2 to 7 s", "400 N from the side")
"""Those that the trainings of `raw-coms-steering` and `raw-coms-yaw` varied, and no older one."""
QUICK_CONDITIONS = (TRAINED, "tyres 1.4 to 1.8", "no GPS from 2 to 7 s", "400 N from the side")


def make_condition_scenario(task: ControlTask, condition: str) -> dict[str, Any]:
    """A contest's scenario in a condition, over its name."""
    return vary_scenario(task, CONDITIONS[condition])


def list_entries(kind: str) -> list[tuple[str, str]]:
    """(estimator, controller) of everybody who drives a class: rungs, classics, policies."""
    classics = [
        controller
        for controller in PAPERS
        if controller in CONTROLLERS[select_tasks(kind)[0].env_id]
    ]
    return [
        ("", NOMINAL),
        ("", PARAMETERS),
        *((REFERENCE_FILTER, controller) for controller in classics),
        *ADAPTIVE.items(),
        *LEARNED[kind],
    ]


def select_tasks(kind: str) -> list[ControlTask]:
    """Contests of a class: the one in the middle of each of its three tiers, or three of its only
    tier, evenly apart."""
    tasks = [selected for selected in list_scored_tasks() if selected.kind == kind]
    tiers = [[c for c in tasks if c.tier == tier] for tier in dict.fromkeys(c.tier for c in tasks)]
    selected = max(3 // len(tiers), 1)
    return [
        tier_tasks[(2 * i + 1) * len(tier_tasks) // (2 * selected)]
        for tier_tasks in tiers
        for i in range(selected)
    ]


@dataclass
class TransferResult:
    """A class's episodes: of each condition, of each contest in the order of `select_tasks`. salt:
    of their seeds."""

    kind: str
    drives: dict[str, list[dict[str, DriveResult]]] = field(default_factory=dict)
    salt: str = ""

    def score_condition(self, name: str, condition: str) -> Estimate:
        """A contestant's share of the gap in a condition; NaN of one below `MIN_SCORED_GAP`."""
        drives = self.drives[condition]
        scales = [ScoreScale(by_name[NOMINAL], by_name[PARAMETERS]) for by_name in drives]
        gaps = [scale.gap for scale in scales if not np.isnan(scale.gap)]  # NaN: nobody survived
        if not gaps or not np.mean(gaps) > MIN_SCORED_GAP:
            return Estimate(np.nan)
        return score(
            [
                scale.compute_paired_ratios(by_name[name])
                for scale, by_name in zip(scales, drives, strict=True)
            ]
        )

    def ratios(self, name: str) -> Array:
        """Cost over nominal's, of each episode in all conditions and contests; infinite where it
        ended by a failure."""
        ratios = compute_cost_ratios(self.costs(name), self.costs(NOMINAL))
        return np.where(self.mark_failures(name), np.inf, ratios)

    def costs(self, name: str) -> Array:
        """A contestant's in all conditions and contests, one behind the other."""
        return np.concatenate([results[name].costs for results in self._list_drives()])

    def mark_failures(self, name: str) -> Array:
        """Which of those episodes ended by a failure."""
        return np.concatenate([results[name]["failure"] != 0.0 for results in self._list_drives()])

    def _list_drives(self) -> list[dict[str, DriveResult]]:
        return [results for task_results in self.drives.values() for results in task_results]


def run(
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    quick: bool = False,
    salt: str = "",
) -> Suite:
    """Every class that has a policy, in every condition.

    episodes: of each contest and condition. quick: in a few conditions. salt: of the seeds, ""
    for `make_salt`'s. The rest is of `control.run.measure`. Raises ValueError with the reason where
    somebody cannot drive.
    """
    suite = Suite(NAME, "Learned policies where contests never are", _TEXT)
    salt = salt or make_salt()
    seeds, results = make_task_seeds(salt, episodes), dict[str, Results]()
    tasks = [task for kind in LEARNED for task in select_tasks(kind)]
    for condition in QUICK_CONDITIONS if quick else CONDITIONS:
        entries = [
            ControlEntry(task, *pair, {"scenario": make_condition_scenario(task, condition)})
            for task in tasks
            for pair in list_entries(task.kind)
        ]
        results[condition] = measure(
            entries, seeds, jobs=jobs, console=console, keep=keep, title=f"{NAME}, {condition}"
        )
    transfers = [
        TransferResult(
            kind,
            {
                condition: [
                    collect_results(condition_results, task, condition)
                    for task in select_tasks(kind)
                ]
                for condition, condition_results in results.items()
            },
            salt,
        )
        for kind in LEARNED
    ]
    for transfer in transfers:
        scenarios = ", ".join(task.scenario for task in select_tasks(transfer.kind))
        note = f"No training met: {'; '.join(NEVER_MET)}. "
        note += f"Only those of the COMS's policies without a filter met: {'; '.join(LATELY_MET)}."
        add_tables(
            suite, transfer, transfer.kind, select_tasks(transfer.kind)[0].env_id, scenarios, note
        )
    suite.verdict = compose_verdict(transfers)
    add_figures(suite, transfers)
    return suite


def collect_results(results: Results, task: ControlTask, condition: str) -> dict[str, DriveResult]:
    """The episodes of all who drive a contest; ValueError with the reason where somebody cannot."""
    drives = {
        controller: results.select(task, controller, estimator)
        for estimator, controller in list_entries(task.kind)
    }
    wrong = [
        f"{controller}, {condition}: {drive.error}"
        for controller, drive in drives.items()
        if drive.error
    ]
    if wrong:
        raise ValueError("; ".join(wrong))
    return drives


def compose_verdict(transfers: Sequence[TransferResult]) -> str:
    """The verdict: each policy's share of the gap, as trained and in the worst condition."""
    lines = []
    for transfer in transfers:
        _, policy = LEARNED[transfer.kind][0]
        shares = {name: transfer.score_condition(policy, name).value for name in transfer.drives}
        unmet = NEVER_MET + LATELY_MET  # by it, the class's first
        met = [share for name, share in shares.items() if name not in (TRAINED, *unmet)]
        new = [share for name, share in shares.items() if name in unmet]
        better = compute_win_rate(transfer.costs(policy), transfer.costs(RIVALS[0])).value
        lines.append(
            f"{policy} closes {shares[TRAINED]:.2f} of the gap; at worst {_format_min(met)} "
            "where it "
            f"trained, {_format_min(new)} where never; beats {RIVALS[0]} in {100.0 * better:.0f} %."
        )
    return format_verdict(*lines)


def _format_min(shares: Sequence[float]) -> str:
    """The least of those that are, "-" where none is."""
    return (
        f"{min(finite):.2f}" if (finite := [value for value in shares if value == value]) else "-"
    )


def add_tables(
    suite: Suite, transfer: TransferResult, title: str, env_id: str, scenarios: str, remark: str
) -> None:
    """A class's rows and tables; driven: what was, more: to be said of it in the note."""
    names = [controller for _, controller in list_entries(transfer.kind)]
    episodes = len(transfer.costs(NOMINAL))
    rivals = [controller for controller in (NOMINAL, *PAPERS, *RIVALS) if controller in names]
    shares, totals = [], []
    for controller in names:
        scores = {
            condition: transfer.score_condition(controller, condition)
            for condition in transfer.drives
        }
        shares.append([controller, *map(_format_share, scores.values())])
        costs = transfer.costs(controller)
        ratio = compute_tail_mean(compute_cost_ratios(costs, transfer.costs(NOMINAL))).value
        beaten = [
            ""
            if controller == rival
            else f"{100.0 * compute_win_rate(costs, transfer.costs(rival)).value:.0f} %"
            for rival in rivals
        ]
        fails = share(transfer.mark_failures(controller)).value
        totals.append([controller, *beaten, f"{100.0 * fails:.1f} %", f"{ratio:.2f}"])
        labels = {"controller": controller, "n": episodes, "salt": transfer.salt}
        for condition, item in scores.items():
            if not np.isfinite(item.value):
                continue  # there is no gap
            where = {"suite": suite.name, "scenario": f"{transfer.kind}, {condition}"}
            version = {"env_version": f"{env_id} {__version__}"}
            suite.rows.append(ResultRow.from_estimate("score", item, **where, **labels, **version))
    count = episodes // len(transfer.drives)
    note = f"{scenarios}; {count} episodes a condition, the same for everybody. {remark}"
    if any("-" in row for row in shares):
        note += f" -: nominal's mean log ratio to {PARAMETERS} is below {MIN_SCORED_GAP}."
    suite.tables += [
        ResultTable(f"{title}: share of the gap", ("controller", *transfer.drives), shares, note),
        ResultTable(
            f"{title}: all conditions together",
            ("controller", *(f"beats {item}" for item in rivals), "fails", "worst 5 %"),
            totals,
            f"Of {episodes} episodes. worst 5 %: mean of the largest ratios to nominal's cost.",
        ),
    ]


def _format_share(share: Estimate) -> str:
    """A share, or "-" where there is no gap."""
    return share.inline() if np.isfinite(share.value) else "-"


def add_figures(suite: Suite, transfers: Sequence[TransferResult]) -> None:
    """What each costs, and how often it costs how much; nothing without plotly."""
    try:
        from ..report.figures import draw_curves, draw_groups
    except ModuleNotFoundError:
        return
    names = {transfer.kind: [w for _, w in list_entries(transfer.kind)] for transfer in transfers}
    costs: dict[str, dict[str, Estimate]] = {}
    for transfer in transfers:
        logs = {
            controller: np.log(np.minimum(transfer.ratios(controller), FAILURE_RATIO))
            for controller in names[transfer.kind]
        }
        costs[transfer.kind] = {
            controller: Estimate(*(100.0 * end for end in geometric_mean(log)))
            for controller, log in logs.items()
        }
    label = "cost / nominal's, %: less is better"
    figure = draw_groups(costs, label, {100.0: NOMINAL})
    text = (
        f"Geometric means over all conditions; a failure costs {FAILURE_RATIO:.0f} times nominal's."
    )
    suite.answers.append(("Who holds the car where contests never are?", figure, text))
    for transfer in transfers:
        lines = {
            controller: compute_profile(transfer.ratios(controller), _LEVELS)
            for controller in names[transfer.kind]
        }
        label = "share of episodes that cost no more"
        figure = draw_curves(_LEVELS, lines, "cost / nominal's on the same seed", label, "x")
        text = "A performance profile: the higher the better; a failure is never reached."
        suite.figures.append((f"{transfer.kind}: how often at what cost", figure, text))
