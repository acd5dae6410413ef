"""From episode costs to scores: 0 is `nominal`, 1 is `oracle-state`, everything paired by episode.

r = log((J_nominal + 0.001) / (J + 0.001)), clipped to +-3, over the episodes that both baselines
survive; a failure there counts log(1 / 20). The score is the sum over tasks of the mean r over
that of the oracle's: a ratio of sums, so that no small gap decides. Standings become rows here.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ...agents.rollout import compute_cost_ratios
from ...envs.record import Array
from ..harness.metrics import EPISODE
from ..harness.results import Suite
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
from .entries import ControlCase, Entry
from .run import DriveResult, Results
from .tasks import NOMINAL, STATE, ControlTask

MIN_GAP = 0.05  # mean r of the oracle, below which there is nothing to win
_CLIP = 3.0
FAILURE_RATIO = 20.0  # times nominal's cost, of an episode that ends by a failure
_RATES = {"spin": "spin_rate", "off-road": "departure_rate", "not-finite": "not_finite_rate"}
_RATES |= {"bad-action": "bad_action_rate"}
_OFTEN = 0.1  # nominal's failure rate above which failures rank
_Pair = tuple[Array, Array]  # r of an entry and of the oracle on the episodes that count


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
    return np.where(result.survived[:n], np.clip(r, -_CLIP, _CLIP), -math.log(FAILURE_RATIO))


@dataclass(frozen=True)
class ScoreScale:
    """The scale of scores in a task: the episodes of `nominal`, 0, and of `oracle-state`, 1.

    Raises ValueError with the reason where one of them was not driven.
    """

    nominal: DriveResult
    oracle: DriveResult

    def __post_init__(self) -> None:
        for name, baseline in ((NOMINAL, self.nominal), (STATE, self.oracle)):
            if baseline.error:
                raise ValueError(f"{name}: {baseline.error}")

    def mark_compared(self, n: int) -> npt.NDArray[np.bool_]:
        """Mark the episodes that both survive.

        Args:
            n: Maximum of episodes.

        Returns:
            Whether both survive each, shape (m,).
        """
        n = min(n, len(self.nominal.costs), len(self.oracle.costs))
        return self.nominal.survived[:n] & self.oracle.survived[:n]

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


def make_score_scales(
    results: Results, tasks: Sequence[ControlTask]
) -> dict[ControlTask, ScoreScale]:
    """Make the scale of scores of each task in which both baselines were driven.

    Args:
        results: Episodes.
        tasks: Tasks to make scales for.

    Returns:
        Scales by task.
    """
    ends = {task: (results[task, Entry(NOMINAL)], results[task, Entry(STATE)]) for task in tasks}
    return {
        task: ScoreScale(nominal, oracle)
        for task, (nominal, oracle) in ends.items()
        if not (nominal.error or oracle.error)
    }


def score(pairs: Sequence[_Pair]) -> Estimate:
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


@dataclass
class Standing:
    """An entry over the tasks of a tier."""

    tier: str  # tier, "" for all
    entry: Entry
    results: dict[ControlTask, DriveResult]  # of all its tasks, errors too
    scales: Mapping[ControlTask, ScoreScale]  # scales of the tier's tasks
    us: float = math.nan  # time of a decision (us)

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return self.entry.label

    @cached_property
    def drives(self) -> dict[ControlTask, DriveResult]:
        """Results of the tasks without an error."""
        return {task: result for task, result in self.results.items() if not result.error}

    @cached_property
    def pairs(self) -> dict[ControlTask, _Pair]:
        """r of the entry and of the oracle on the episodes that count, where any do."""
        scaled = [(task, run) for task, run in self.drives.items() if task in self.scales]
        paired = {task: self.scales[task].compute_paired_ratios(run) for task, run in scaled}
        return {task: pair for task, pair in paired.items() if len(pair[0])}

    @cached_property
    def by_task(self) -> dict[ControlTask, dict[str, Estimate]]:
        """Every metric of every task that was driven."""
        return {task: self._measure_task(task) for task in self.drives}

    @cached_property
    def overall(self) -> dict[str, Estimate]:
        """Metrics over all tasks; failures of all episodes, NaN where none was driven."""
        all_failed = [~result.survived for result in self.drives.values()]
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
    def rank(self) -> tuple[float, float]:
        """Key of the order: smaller is better; what has no number comes last.

        Failures rank in a tier in which nominal fails in more than 10 %.
        """
        failing = [1.0 - scale.nominal.survived.mean() for scale in self.scales.values()]
        by_failures = bool(failing) and float(np.mean(failing)) > _OFTEN
        failed = self.overall["failure_rate"].value if by_failures else 0.0
        value = self.overall.get("score", Estimate(math.nan)).value
        return tuple(np.nan_to_num([failed, -value], nan=np.inf).tolist())

    @property
    def excluded(self) -> int:
        """Episodes of the compared ones that nominal or the oracle did not survive."""
        marks = (self.scales[c].mark_compared(len(self.drives[c].costs)) for c in self.pairs)
        return sum(map(len, marks)) - self.n

    @property
    def control_period(self) -> float:
        """Time between two decisions (s)."""
        return next(iter(self.results)).control_period

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
        return float(np.mean(means)) if means else math.nan

    def _select_compared(self, task: ControlTask) -> tuple[Array, Array]:
        """Costs of the entry and of nominal on the episodes that count, shape (n,) each."""
        costs, scale = self.drives[task].costs, self.scales[task]
        mask = scale.mark_compared(len(costs))
        return costs[: len(mask)][mask], scale.nominal.costs[: len(mask)][mask]

    def _measure_task(self, task: ControlTask) -> dict[str, Estimate]:
        result = self.drives[task]
        metrics = {"failure_rate": share(~result.survived)}
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

    def add_rows(self, suite: Suite, salt: str) -> None:
        """Add a row for each metric and task, and those of the tier.

        Args:
            suite: Suite to which the rows are added.
            salt: Salt of the seeds.
        """
        labels = {"estimator": self.entry.estimator, "controller": self.entry.agent, "salt": salt}
        for task, metrics in self.by_task.items():
            where = {"scenario": task.name, "spec": ControlCase(task, self.entry).spec}
            n = len(self.drives[task].costs)
            suite.add_rows([metrics], task.env_id, n=n, **where, **labels)
        labels["scenario"] = f"tier {self.tier}"
        suite.add_rows([self.overall], n=self.n, **labels)
        suite.add_rows([{"us_per_decision": self.us}], **labels)


def rank_entries(
    results: Results, tier: str | None, scales: Mapping[ControlTask, ScoreScale]
) -> list[Standing]:
    """Rank the entries of a tier, by failures or by score.

    Args:
        results: Episodes.
        tier: Tier, None for all.
        scales: Scales by task.

    Returns:
        Standings, the best first.
    """
    by_entry: dict[Entry, dict[ControlTask, DriveResult]] = {}
    for (task, entry), result in results.items():
        if tier in (None, task.tier):
            by_entry.setdefault(entry, {})[task] = result
    ranked = [Standing(tier or "", entry, drives, scales) for entry, drives in by_entry.items()]
    return sorted(ranked, key=lambda standing: standing.rank)
