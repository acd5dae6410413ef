"""From episode costs to scores: 0 is `nominal`, 1 is `oracle-state`, everything paired by episode.

r = log((J_nominal + 0.001) / (J + 0.001)), clipped to +-3, over the episodes that both baselines
survive; a failure there counts log(1 / 20). The score is the sum over tasks of the mean r over
that of the oracle's: a ratio of sums, so that no small gap decides. Standings become rows and
tables here.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ... import __version__
from ...agents.rollout import compute_cost_ratios
from ...envs.record import Array
from ..harness.metrics import EPISODE
from ..harness.results import ResultRow, ResultTable
from ..harness.stats import (
    Estimate,
    average,
    compute_tail_mean,
    compute_win_rate,
    geometric_mean,
    interval,
    ratio_of_sums,
    share,
)
from .entries import ControlEntry
from .run import DriveResult, get_control_period
from .tasks import ControlTask

MIN_GAP = 0.05  # mean r of the oracle, below which there is nothing to win
_CLIP = 3.0
FAILURE_RATIO = 20.0  # times nominal's cost, of an episode that ends by a failure


def survival_mask(result: DriveResult) -> npt.NDArray[np.bool_]:
    """Mark the episodes that ended by no failure.

    Args:
        result: Episodes.

    Returns:
        Whether each did, shape (seeds,).
    """
    return np.asarray(result["failure"] == 0.0)


def compute_log_ratios(nominal: Array, result: DriveResult) -> Array:
    """Compute r of the first n episodes.

    Args:
        nominal: Costs of nominal on the same seeds, shape (n,).
        result: Episodes of at least as many seeds.

    Returns:
        Values of r, shape (n,).
    """
    n = len(nominal)
    with np.errstate(invalid="ignore"):
        r = np.log(compute_cost_ratios(nominal, result.costs[:n]))
    return np.where(survival_mask(result)[:n], np.clip(r, -_CLIP, _CLIP), -math.log(FAILURE_RATIO))


@dataclass(frozen=True)
class ScoreScale:
    """The scale of scores in a task: the episodes of `nominal`, 0, and of `oracle-state`, 1.

    Raises ValueError with the reason where one of them was not driven.
    """

    nominal: DriveResult
    oracle: DriveResult

    def __post_init__(self) -> None:
        for name, oracle in (("nominal", self.nominal), ("oracle-state", self.oracle)):
            if oracle.error:
                raise ValueError(f"{name}: {oracle.error}")

    def mark_compared(self, n: int) -> npt.NDArray[np.bool_]:
        """Mark the episodes that both survive.

        Args:
            n: Maximum of episodes.

        Returns:
            Whether both survive each, shape (m,).
        """
        n = min(n, len(self.nominal.costs), len(self.oracle.costs))
        return survival_mask(self.nominal)[:n] & survival_mask(self.oracle)[:n]

    def compute_paired_ratios(self, result: DriveResult) -> tuple[Array, Array]:
        """Compute r of an entry and of the oracle on the episodes that count.

        Args:
            result: Episodes of the entry.

        Returns:
            r of both, shape (n,) each.
        """
        compared = self.mark_compared(len(result.costs))
        nominal = self.nominal.costs[: len(compared)]
        r, oracle_ratios = (compute_log_ratios(nominal, x)[compared] for x in (result, self.oracle))
        return r, oracle_ratios

    @property
    def gap(self) -> float:
        """The oracle's mean r; NaN where no episode counts."""
        _, oracle_ratios = self.compute_paired_ratios(self.oracle)
        return float(oracle_ratios.mean()) if len(oracle_ratios) else math.nan


def score(pairs: Sequence[tuple[Array, Array]]) -> Estimate:
    """Compute the score.

    Args:
        pairs: Result of `compute_paired_ratios` in each task.

    Returns:
        Score; NaN without a gap to be won.
    """
    filled = [pair for pair in pairs if len(pair[0])]
    if not filled or np.mean([oracle_ratios.mean() for _, oracle_ratios in filled]) < MIN_GAP:
        return Estimate(math.nan)
    return ratio_of_sums([r for r, _ in filled], [oracle_ratios for _, oracle_ratios in filled])


_RATES = {"spin": "spin_rate", "off-road": "departure_rate", "not-finite": "not_finite_rate"}
_RATES |= {"bad-action": "bad_action_rate"}
_OFTEN = 0.1  # nominal's failure rate above which failures rank

_ScoreScales = Mapping[ControlTask, ScoreScale]


@dataclass
class Standing:
    """An entry over the tasks of a tier."""

    tier: str  # tier, "" for all
    entry: ControlEntry  # its entry in one of the tasks
    results: dict[ControlTask, DriveResult]  # of all its tasks, errors too
    scales: _ScoreScales  # scales of the tier's tasks
    us: float = float("nan")  # time of a decision (us)

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return self.entry.label

    @cached_property
    def drives(self) -> dict[ControlTask, DriveResult]:
        """Results of the tasks without an error."""
        return {task: result for task, result in self.results.items() if not result.error}

    @cached_property
    def pairs(self) -> dict[ControlTask, tuple[Array, Array]]:
        """r of the entry and of the oracle on the episodes that count, where any do."""
        scaled = [(task, run) for task, run in self.drives.items() if task in self.scales]
        paired = {task: self.scales[task].compute_paired_ratios(run) for task, run in scaled}
        return {task: pair for task, pair in paired.items() if len(pair[0])}

    @cached_property
    def by_task(self) -> dict[ControlTask, dict[str, Estimate]]:
        """Every metric of every task that was driven."""
        return {task: self._metrics(task) for task in self.drives}

    @cached_property
    def overall(self) -> dict[str, Estimate]:
        """Metrics over all tasks; failures of all episodes, NaN where none was driven."""
        all_failed = [~survival_mask(result) for result in self.drives.values()]
        failed = np.concatenate(all_failed) if all_failed else np.empty(0)
        metrics = {"failure_rate": share(failed)}
        if self.pairs:
            metrics["cost_vs_nominal"] = geometric_mean(*(-r for r, _ in self.pairs.values()))
            metrics["score"] = score(list(self.pairs.values()))
            compared = zip(*map(self._select_compared, self.pairs), strict=True)
            metrics["share_won"] = compute_win_rate(*map(np.concatenate, compared))
            costs = np.concatenate([self.drives[task].costs for task in self.pairs])
            metrics["worst_cost"] = compute_tail_mean(costs)
        return metrics

    @property
    def by_failures(self) -> bool:
        """Whether failures rank in this tier: nominal fails in more than 10 %."""
        failing = [1.0 - survival_mask(scale.nominal).mean() for scale in self.scales.values()]
        return bool(failing) and float(np.mean(failing)) > _OFTEN

    @property
    def excluded(self) -> int:
        """Episodes of the compared ones that nominal or the oracle did not survive."""
        marks = (self.scales[c].mark_compared(len(self.drives[c].costs)) for c in self.pairs)
        everything = sum(map(len, marks))
        return everything - self.n

    @property
    def n(self) -> int:
        """Episodes that count."""
        return sum(len(r) for r, _ in self.pairs.values())

    def mean(self, name: str) -> float:
        """Average a metric over all tasks in which it means something.

        Args:
            name: Name of the metric, in `EPISODE`.

        Returns:
            Average; NaN without such a task.
        """
        turning = next(metric.turning for metric in EPISODE if metric.name == name)
        runs = self.drives.items()
        counted = [run for task, run in runs if not (turning and task.reference == "zero-slip")]
        means = [run[name].mean() for run in counted]
        return float(np.mean(means)) if means else float("nan")

    def _select_compared(self, task: ControlTask) -> tuple[Array, Array]:
        """Costs of the entry and of nominal on the episodes that count, shape (n,) each."""
        costs, scale = self.drives[task].costs, self.scales[task]
        mask = scale.mark_compared(len(costs))
        return costs[: len(mask)][mask], scale.nominal.costs[: len(mask)][mask]

    def _metrics(self, task: ControlTask) -> dict[str, Estimate]:
        result = self.drives[task]
        metrics = {"failure_rate": share(~survival_mask(result))}
        metrics["worst_cost"] = compute_tail_mean(result.costs)
        if task in self.pairs:
            r, oracle_ratios = self.pairs[task]
            metrics["cost_vs_nominal"] = geometric_mean(-r)
            metrics["score"] = score([(r, oracle_ratios)])
            metrics["gap"] = average(oracle_ratios)
            metrics["share_won"] = compute_win_rate(*self._select_compared(task))
        for metric in EPISODE:
            if metric.name != "failure":
                metrics[metric.name] = interval(result[metric.name])
        for failure, name in _RATES.items():
            metrics[name] = share(result.mark_failures(failure))
        return metrics


def rank_entries(
    results: Mapping[ControlEntry, DriveResult], tier: str | None, scales: _ScoreScales
) -> list[Standing]:
    """Rank the entries of a tier, by failures or by score.

    Args:
        results: Episodes by entry.
        tier: Tier, None for all.
        scales: Scales by task.

    Returns:
        Entries, the best first.
    """
    by_pair: dict[tuple[str, str], list[ControlEntry]] = {}
    for entry in results:
        if tier in (None, entry.task.tier):
            by_pair.setdefault((entry.controller, entry.estimator), []).append(entry)
    ranked = [
        Standing(tier or "", entries[0], {entry.task: results[entry] for entry in entries}, scales)
        for entries in by_pair.values()
    ]
    return sorted(ranked, key=_rank)


def _rank(standing: Standing) -> tuple[float, float]:
    """Key of the order: smaller is better; what has no number comes last."""
    value = standing.overall.get("score", Estimate(float("nan"))).value
    failed = standing.overall["failure_rate"].value if standing.by_failures else 0.0
    return tuple(np.nan_to_num([failed, -value], nan=np.inf).tolist())


def make_rows(standing: Standing, salt: str) -> list[ResultRow]:
    """Make a row for each metric and task, and those of the tier.

    Args:
        standing: Entry.
        salt: Salt of the seeds.

    Returns:
        Rows.
    """
    entry = standing.entry
    common: dict[str, Any] = {"suite": "control", "salt": salt}
    common |= {"estimator": entry.estimator, "controller": entry.controller}
    rows = []
    for task, metrics in standing.by_task.items():
        version = f"{task.env_id} {__version__}"
        rest = common | {"n": len(standing.drives[task].costs), "env_version": version}
        rest["spec"] = make_spec(replace(entry, task=task))
        rows += [
            ResultRow.from_estimate(name, estimate, scenario=task.name, **rest)
            for name, estimate in metrics.items()
            if np.isfinite(estimate.value)
        ]
    common |= {"scenario": f"tier {standing.tier}", "env_version": __version__}
    rows += [
        ResultRow.from_estimate(name, estimate, n=standing.n, **common)
        for name, estimate in standing.overall.items()
        if np.isfinite(estimate.value)
    ]
    if np.isfinite(standing.us):
        rows.append(ResultRow(metric="us_per_decision", value=standing.us, **common))
    return rows


def make_spec(entry: ControlEntry) -> str:
    """Make the JSON of the env from which `gym.make` builds it again.

    Args:
        entry: Entry whose task and options make the env.

    Returns:
        JSON.
    """
    env = gym.make(gym.spec(entry.task.env_id), **entry.env_options)
    return env.spec.to_json() if env.spec is not None else ""


def make_main_table(title: str, ranked: Sequence[Standing], note: str = "") -> ResultTable:
    """Make the table of the entries, the best first.

    Args:
        title: Title of the table.
        ranked: Entries, the best first.
        note: Meaning of the columns.

    Returns:
        Table.
    """
    header = (
        *("controller and estimator", "fails / %", "95 %", "cost / nominal's, %", "95 % "),
        *("score", "95 %  ", "won / %", "worst 5 %", "contests", "episodes", "left out"),
        "us a decision",
    )
    cells = []
    for standing in ranked:
        texts: list[str] = []
        columns = (("failure_rate", 100.0, ".1f"), ("cost_vs_nominal", 100.0, ".1f"))
        for name, scale, digits in (*columns, ("score", 1.0, ".2f")):
            texts += _format_texts(standing.overall.get(name), scale, digits)
        share_won, tail = (standing.overall.get(name) for name in ("share_won", "worst_cost"))
        texts += [_format_texts(share_won, 100.0, ".0f")[0], _format_texts(tail, 1.0, ".3g")[0]]
        texts += [f"{len(standing.pairs)} of {len(standing.results)}", str(standing.n)]
        texts += [str(standing.excluded), f"{standing.us:.0f}" if np.isfinite(standing.us) else ""]
        cells.append([standing.label, *texts])
    return ResultTable(title, header, cells, note)


def _format_texts(number: Estimate | None, scale: float, digits: str) -> tuple[str, str]:
    """A number and its interval, empty where there is none."""
    if number is None or not np.isfinite(number.value):
        return "", ""
    return number.text(scale, digits)


def make_task_table(
    title: str, ranked: Sequence[Standing], tasks: Sequence[ControlTask]
) -> ResultTable:
    """Make the table of the cost over nominal's (%), every entry in every task.

    Args:
        title: Title of the table.
        ranked: Entries, the best first.
        tasks: Tasks, a column each.

    Returns:
        Table.
    """
    cells = [[item.label, *(_format_cell(item, task) for task in tasks)] for item in ranked]
    note = "Percent of nominal's cost, the paired geometric mean; in brackets failures in percent."
    header = ("controller and estimator", *(c.name for c in tasks))
    return ResultTable(title, header, cells, note, detail=True)


def _format_cell(standing: Standing, task: ControlTask) -> str:
    """Text of a cell: the number, or why there is none."""
    if task not in standing.results:
        return ""
    if standing.results[task].error:
        return "not driven"
    metrics = standing.by_task[task]
    failed = f"({100.0 * metrics['failure_rate'].value:.0f})"
    if task not in standing.scales:
        return f"no yardstick {failed}"
    if task not in standing.pairs:
        return f"no episode counts {failed}"
    if standing.scales[task].gap < MIN_GAP:
        return f"nothing to win here {failed}"
    return f"{100.0 * metrics['cost_vs_nominal'].value:.0f} {failed}"


def make_motion_table(title: str, ranked: Sequence[Standing]) -> ResultTable:
    """Make the table of the motion, means over all tasks.

    Args:
        title: Title of the table.
        ranked: Entries, the best first.

    Returns:
        Table.
    """
    shown = [metric for metric in EPISODE if metric.heading]
    header = ["controller and estimator", *(m.heading for m in shown), "of the period / %"]
    cells = []
    for standing in ranked:
        used = 1e-4 * standing.us / get_control_period(standing.entry)
        values = [(metric, standing.mean(metric.name)) for metric in shown]
        texts = [metric.text(value) if np.isfinite(value) else "" for metric, value in values]
        cells.append([standing.label, *texts, f"{used:.2f}" if np.isfinite(used) else ""])
    note = (
        "Yaw error and path where the reference turns. motors: mechanical work of both. effort: "
        "mean square share of the full yaw moment. Steps: the largest of what is asked between "
        "two decisions. saturated: of the decisions. The last column: a decision's time. What the "
        "tyres dissipate is not measured: no signal of the car has their forces."
    )
    return ResultTable(title, header, cells, note, detail=True)
