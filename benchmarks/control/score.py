"""From episode costs to scores, each drive paired with nominal's on the same seed.

r = log((J_nominal + J_0) / (J + J_0)) where both finish, J_0 as `ControlTask.cost_floor`; a drive
that the entry alone loses counts -2, one that nominal alone loses 2, one that both lose 0. The mean
r is the score; entries that surely lose more cars than nominal stand below all others.

Args:
    loss: r of a drive that nominal alone loses.
    floor_factor: Factor on J_0.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain

import numpy as np
import numpy.typing as npt

from ...agents.rollout import compute_cost_ratios
from ...envs.record import Array
from ..harness import stats
from ..harness.metrics import EPISODE
from ..harness.results import Suite
from ..harness.stats import Estimate
from .entries import ControlCase, Entry
from .run import DriveResult, Results
from .tasks import NOMINAL, ControlTask

LOSS = 2.0  # r of a drive that nominal alone loses, and less it where the entry alone does
CONSTANTS = {
    "as scored": (LOSS, 1.0),
    "a loss: 1": (1.0, 1.0),
    "a loss: 3": (3.0, 1.0),
    "half of J_0": (LOSS, 0.5),
    "twice J_0": (LOSS, 2.0),
}  # other constants of the score: r of a loss, and the factor on J_0
_CLIP = 3.0
FAILURE_RATIO = 20.0  # times nominal's cost, of a failure in `compute_log_ratios`
_RATES = {"spin": "spin_rate", "off-road": "departure_rate", "not-finite": "not_finite_rate"}
_RATES |= {"bad-action": "bad_action_rate"}


def compute_log_ratios(nominal: Array, result: DriveResult) -> Array:
    """Compute log(J_nominal / J) of the first n episodes, clipped to +-3, log(1 / 20) if failed.

    Args:
        nominal: Costs of nominal on the same seeds, shape (n,).
        result: Episodes of at least as many seeds.
    """
    n = len(nominal)
    with np.errstate(invalid="ignore"):
        r = np.log(compute_cost_ratios(nominal, result.costs[:n]))
    return np.where(result.survived[:n], np.clip(r, -_CLIP, _CLIP), -math.log(FAILURE_RATIO))


@dataclass(frozen=True)
class PairedDrives:
    """Drives of an entry and of nominal on the same seeds of a task."""

    nominal: DriveResult
    result: DriveResult  # of the entry; of both the first n count, as many as either has
    floor: float  # cost J_0 of the task

    @cached_property
    def n(self) -> int:
        """Drives that count."""
        return min(len(self.nominal.costs), len(self.result.costs))

    @cached_property
    def costs(self) -> Array:
        """Costs of the entry and of nominal, shape (2, n)."""
        return np.array([drive.costs[: self.n] for drive in (self.result, self.nominal)])

    @cached_property
    def finished(self) -> npt.NDArray[np.bool_]:
        """Whether the entry, and whether nominal, finishes each drive, shape (2, n)."""
        return np.array([drive.survived[: self.n] for drive in (self.result, self.nominal)])

    @cached_property
    def both(self) -> npt.NDArray[np.bool_]:
        """Whether both finish each drive, shape (n,)."""
        return np.asarray(self.finished.all(axis=0))

    def compute_scores(self, loss: float = LOSS, floor_factor: float = 1.0) -> Array:
        """Compute r of each drive, shape (n,)."""
        costs, nominal = self.costs + floor_factor * self.floor
        losses = loss * (self.finished[0].astype(np.float64) - self.finished[1])
        return np.asarray(np.where(self.both, np.log(nominal / costs), losses))


@dataclass
class Standing:
    """An entry over the tasks of a tier."""

    tier: str  # tier, "" for all
    entry: Entry
    results: dict[ControlTask, DriveResult]  # of all its tasks, errors too
    nominal: Mapping[ControlTask, DriveResult]  # nominal's drives, where it could drive
    us: float = math.nan  # time of a decision (us)

    @cached_property
    def drives(self) -> dict[ControlTask, DriveResult]:
        """Results of the tasks without an error."""
        return {task: result for task, result in self.results.items() if not result.error}

    @cached_property
    def pairs(self) -> dict[ControlTask, PairedDrives]:
        """Drives beside nominal's, where there are any."""
        both = {task: x for task, x in self.drives.items() if task in self.nominal}
        return {t: PairedDrives(self.nominal[t], x, t.cost_floor) for t, x in both.items()}

    @cached_property
    def scores(self) -> dict[ControlTask, Array]:
        """r of each drive by task."""
        return {task: pair.compute_scores() for task, pair in self.pairs.items()}

    def compute_score(self, loss: float, floor_factor: float) -> float:
        """Compute the score by other constants, NaN where nothing was driven."""
        means = [pair.compute_scores(loss, floor_factor).mean() for pair in self.pairs.values()]
        return float(np.mean(means)) if means else math.nan

    @cached_property
    def by_task(self) -> dict[ControlTask, dict[str, Estimate]]:
        """Every metric of every task that was driven."""
        measured = {}
        for task, result in self.drives.items():
            metrics = {"failure_rate": stats.share(~result.survived)}
            if task in self.pairs:
                metrics |= _measure_pairs([self.pairs[task]])
            for metric in EPISODE:
                if metric.name != "failure":
                    metrics[metric.name] = stats.interval(result[metric.name])
            for failure, name in _RATES.items():
                metrics[name] = stats.share(result.mark_failures(failure))
            measured[task] = metrics
        return measured

    @cached_property
    def overall(self) -> dict[str, Estimate]:
        """Metrics over all tasks; failures of all episodes, NaN where none was driven."""
        all_failed = [~result.survived for result in self.drives.values()]
        failed = np.concatenate(all_failed) if all_failed else np.empty(0)
        return {"failure_rate": stats.share(failed)} | _measure_pairs([*self.pairs.values()])

    @cached_property
    def loses_more(self) -> bool:
        """Whether it surely loses more cars than nominal, over all its tasks."""
        pairs = self.pairs.values()
        if not pairs:
            return False
        return stats.is_share_larger(*~np.concatenate([pair.finished for pair in pairs], axis=1))

    @property
    def rank(self) -> tuple[int, float]:
        """Key of the order: smaller is better; what has no number comes last."""
        value = self.overall.get("score", Estimate(math.nan)).value
        # who leaves out what it does badly stands below those that drove every task
        below = 2 * self.loses_more + any(result.error for result in self.results.values())
        return below, float(np.nan_to_num(-value, nan=np.inf))

    @property
    def n(self) -> int:
        """Drives that count."""
        return sum(pair.n for pair in self.pairs.values())

    def mean(self, name: str) -> float:
        """Average a metric over the tasks in which it means something, NaN without one.

        Args:
            name: Name of the metric, in `EPISODE`.
        """
        turning = next(metric.turning for metric in EPISODE if metric.name == name)
        runs = self.drives.items()
        counted = [run for task, run in runs if not (turning and task.reference == "zero-slip")]
        means = [run[name].mean() for run in counted]
        return float(np.mean(means)) if means else math.nan

    def add_rows(self, suite: Suite, salt: str) -> None:
        """Add a row for each metric and task, and those of the tier."""
        labels = {"estimator": self.entry.estimator, "controller": self.entry.agent, "salt": salt}
        for task, metrics in self.by_task.items():
            where = {"scenario": task.name, "spec": ControlCase(task, self.entry).spec}
            n = len(self.drives[task].costs)
            suite.add_rows([metrics], task.world_id, n=n, **where, **labels)
        labels["scenario"] = f"tier {self.tier}"
        suite.add_rows([self.overall], n=self.n, **labels)
        suite.add_rows([{"us_per_decision": self.us}], **labels)


def _measure_pairs(pairs: Sequence[PairedDrives]) -> dict[str, Estimate]:
    """Score, and costs of the drives that both finish, over tasks of equal weight."""
    if not pairs:
        return {}
    metrics = {"score": stats.average(*(pair.compute_scores() for pair in pairs))}
    costs = [pair.costs[:, pair.both] for pair in pairs if pair.both.any()]
    if costs:
        logs = [np.log(compute_cost_ratios(*both)) for both in costs]
        metrics["cost_vs_nominal"] = stats.geometric_mean(*logs)
        metrics["share_won"] = stats.compute_win_rate(*np.concatenate(costs, axis=1))
    all_costs = np.concatenate([pair.costs[0] for pair in pairs])
    return metrics | {"worst_cost": stats.compute_tail_mean(all_costs)}


def rank_entries(results: Results, tier: str | None) -> list[Standing]:
    """Rank a tier's entries, the best first; last who surely loses more or leaves out tasks."""
    by_entry: dict[Entry, dict[ControlTask, DriveResult]] = {}
    for (task, entry), result in results.items():
        if tier in (None, task.tier):
            by_entry.setdefault(entry, {})[task] = result
    driven = by_entry.get(Entry(NOMINAL), {}).items()
    nominal = {task: result for task, result in driven if not result.error}
    ranked = [Standing(tier or "", entry, drives, nominal) for entry, drives in by_entry.items()]
    return sorted(ranked, key=lambda standing: standing.rank)


@dataclass(frozen=True)
class Matrix:
    """The matrix of controllers and estimators, as a run measured it."""

    results: Results
    salt: str = ""  # salt of the seeds
    # log of oracle-state's cost over clairvoyant's in each calibrated task, shape (n,)
    foresight: Mapping[ControlTask, Array] = field(default_factory=dict)

    @cached_property
    def tasks(self) -> list[ControlTask]:
        """Tasks that were driven."""
        return list(dict.fromkeys(task for task, _ in self.results))

    @cached_property
    def by_tier(self) -> dict[str, list[Standing]]:
        """Standings by tier, the best first."""
        tiers = dict.fromkeys(task.tier for task in self.tasks)
        return {tier: rank_entries(self.results, tier) for tier in tiers}

    @cached_property
    def overall(self) -> list[Standing]:
        """Standings over all tiers, the best first."""
        return rank_entries(self.results, None)

    def add_rows(self, suite: Suite) -> None:
        """Add the rows of all tiers' standings."""
        for standing in chain(*self.by_tier.values()):
            standing.add_rows(suite, self.salt)
