"""The matrix as rows for machines and tables for people."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np

from ... import __version__
from ..harness.metrics import EPISODE
from ..harness.results import Row, Table
from ..harness.stats import Estimate, average, geometric_mean, interval, share, won, worst
from .cells import Cell
from .contests import Contest
from .episodes import Array, Driven, control_period
from .scores import NOTHING, Yardstick, score, survived

RATES = {"spin": "spin_rate", "off-road": "departure_rate"}
_FAILED = {"not-finite": "not_finite_rate", "bad-action": "bad_action_rate"}
_OFTEN = 0.1  # nominal's failure rate above which failures rank

Yardsticks = Mapping[Contest, Yardstick]


@dataclass
class Standing:
    """A contestant over the contests of a tier.

    results: of all contests that it was to drive, errors among them. yards: of the tier.
    """

    tier: str
    cell: Cell
    results: dict[Contest, Driven]
    yards: Yardsticks
    us: float = float("nan")

    @property
    def label(self) -> str:
        """As in tables and figures."""
        return self.cell.label

    @cached_property
    def driven(self) -> dict[Contest, Driven]:
        """The contests without an error."""
        return {contest: each for contest, each in self.results.items() if not each.error}

    @cached_property
    def pairs(self) -> dict[Contest, tuple[Array, Array]]:
        """r of the contestant and of the oracle on the episodes that count, where any do."""
        made = {c: self.yards[c].paired(each) for c, each in self.driven.items() if c in self.yards}
        return {contest: pair for contest, pair in made.items() if len(pair[0])}

    @cached_property
    def by_contest(self) -> dict[Contest, dict[str, Estimate]]:
        """Every metric of every contest that was driven."""
        return {contest: self._metrics(contest) for contest in self.driven}

    @cached_property
    def overall(self) -> dict[str, Estimate]:
        """Over all contests; failures of all episodes, NaN where none was driven."""
        all_failed = [~survived(each) for each in self.driven.values()]
        failed = np.concatenate(all_failed) if all_failed else np.empty(0)
        found = {"failure_rate": share(failed)}
        if self.pairs:
            found["cost_vs_nominal"] = geometric_mean(*(-r for r, _ in self.pairs.values()))
            found["score"] = score(list(self.pairs.values()))
            kept = zip(*map(self._kept, self.pairs), strict=True)
            found["share_won"] = won(*map(np.concatenate, kept))
            found["worst_cost"] = worst(np.concatenate([self.driven[c].costs for c in self.pairs]))
        return found

    @property
    def by_failures(self) -> bool:
        """Whether failures rank in this tier: nominal fails in more than 10 %."""
        failing = [1.0 - survived(yard.nominal).mean() for yard in self.yards.values()]
        return bool(failing) and float(np.mean(failing)) > _OFTEN

    @property
    def excluded(self) -> int:
        """Episodes of the compared ones that nominal or the oracle did not survive."""
        everything = sum(len(self.yards[c].kept(len(self.driven[c].costs))) for c in self.pairs)
        return everything - self.n

    @property
    def n(self) -> int:
        """Episodes that count."""
        return sum(len(r) for r, _ in self.pairs.values())

    def mean(self, name: str) -> float:
        """A number of `EPISODE` over all contests in which it means something."""
        turning = next(metric.turning for metric in EPISODE if metric.name == name)
        means = [
            each[name].mean()
            for contest, each in self.driven.items()
            if not (turning and contest.reference == "zero-slip")
        ]
        return float(np.mean(means)) if means else float("nan")

    def _kept(self, contest: Contest) -> tuple[Array, Array]:
        """(its costs, nominal's) of the episodes that count."""
        costs, yard = self.driven[contest].costs, self.yards[contest]
        kept = yard.kept(len(costs))
        return costs[: len(kept)][kept], yard.nominal.costs[: len(kept)][kept]

    def _metrics(self, contest: Contest) -> dict[str, Estimate]:
        driven = self.driven[contest]
        found = {"failure_rate": share(~survived(driven)), "worst_cost": worst(driven.costs)}
        if contest in self.pairs:
            r, own = self.pairs[contest]
            found["cost_vs_nominal"] = geometric_mean(-r)
            found["score"] = score([(r, own)])
            found["gap"] = average(own)
            found["share_won"] = won(*self._kept(contest))
        for metric in EPISODE:
            if metric.name != "failure":
                found[metric.name] = interval(driven[metric.name])
        for failure, name in (RATES | _FAILED).items():
            found[name] = share(driven.failed(failure))
        return found


def standings(found: Mapping[Cell, Driven], tier: str | None, yards: Yardsticks) -> list[Standing]:
    """Every contestant of a tier, None: of all together, the best first: by failures where nominal
    fails in more than 10 %, else by score."""
    mine: dict[tuple[str, str], list[Cell]] = {}
    for cell in found:
        if tier in (None, cell.contest.tier):
            mine.setdefault((cell.controller, cell.estimator), []).append(cell)
    made = [
        Standing(tier or "", cells[0], {cell.contest: found[cell] for cell in cells}, yards)
        for cells in mine.values()
    ]
    return sorted(made, key=_rank)


def _rank(standing: Standing) -> tuple[float, float]:
    """Smaller is better; what has no number comes last."""
    value = standing.overall.get("score", Estimate(float("nan"))).value
    failed = standing.overall["failure_rate"].value if standing.by_failures else 0.0
    return tuple(np.nan_to_num([failed, -value], nan=np.inf).tolist())


def rows_of(standing: Standing, salt: str) -> list[Row]:
    """One row a metric and contest, and the aggregates of the tier."""
    cell = standing.cell
    common: dict[str, Any] = {
        "suite": "control",
        "estimator": cell.estimator,
        "controller": cell.controller,
        "salt": salt,
    }
    rows = []
    for contest, metrics in standing.by_contest.items():
        version = f"{contest.env_id} {__version__}"
        rest = common | {"n": len(standing.driven[contest].costs), "env_version": version}
        rest["spec"] = spec_of(replace(cell, contest=contest))
        rows += [
            Row.of(name, each, scenario=contest.name, **rest)
            for name, each in metrics.items()
            if np.isfinite(each.value)
        ]
    common |= {"scenario": f"tier {standing.tier}", "env_version": __version__}
    rows += [
        Row.of(name, each, n=standing.n, **common)
        for name, each in standing.overall.items()
        if np.isfinite(each.value)
    ]
    if np.isfinite(standing.us):
        rows.append(Row(metric="us_per_decision", value=standing.us, **common))
    return rows


def spec_of(cell: Cell) -> str:
    """The env as JSON: what `gym.make` needs to build it again."""
    env = gym.make(gym.spec(cell.contest.env_id), **cell.env_options)
    return env.spec.to_json() if env.spec is not None else ""


def main_table(title: str, found: Sequence[Standing], note: str = "") -> Table:
    """The contestants, the best first."""
    header = (
        *("controller and estimator", "fails / %", "95 %", "cost / nominal's, %", "95 % "),
        *("score", "95 %  ", "won / %", "worst 5 %", "contests", "episodes", "left out"),
        "us a decision",
    )
    cells = []
    for each in found:
        texts: list[str] = []
        for name, scale, digits in (
            ("failure_rate", 100.0, ".1f"),
            ("cost_vs_nominal", 100.0, ".1f"),
            ("score", 1.0, ".2f"),
        ):
            texts += _texts(each.overall.get(name), scale, digits)
        share_won, tail = (each.overall.get(name) for name in ("share_won", "worst_cost"))
        cells.append(
            [
                each.label,
                *texts,
                _texts(share_won, 100.0, ".0f")[0],
                _texts(tail, 1.0, ".3g")[0],
                f"{len(each.pairs)} of {len(each.results)}",
                str(each.n),
                str(each.excluded),
                f"{each.us:.0f}" if np.isfinite(each.us) else "",
            ]
        )
    return Table(title, header, cells, note)


def _texts(number: Estimate | None, scale: float, digits: str) -> tuple[str, str]:
    """A number and its interval, empty where there is none."""
    if number is None or not np.isfinite(number.value):
        return "", ""
    return number.text(scale, digits)


def contest_table(title: str, found: Sequence[Standing], contests: Sequence[Contest]) -> Table:
    """Cost against nominal in %, every contestant in every contest."""
    cells = []
    for each in found:
        cells.append([each.label, *(_cell_text(each, contest) for contest in contests)])
    note = "Percent of nominal's cost, the paired geometric mean; in brackets failures in percent."
    header = ("controller and estimator", *(c.name for c in contests))
    return Table(title, header, cells, note, detail=True)


def _cell_text(standing: Standing, contest: Contest) -> str:
    """What stands in a square: the number, or why there is none."""
    if contest not in standing.results:
        return ""
    if standing.results[contest].error:
        return "not driven"
    metrics = standing.by_contest[contest]
    failed = f"({100.0 * metrics['failure_rate'].value:.0f})"
    if contest not in standing.yards:
        return f"no yardstick {failed}"
    if contest not in standing.pairs:
        return f"no episode counts {failed}"
    if standing.yards[contest].gap < NOTHING:
        return f"nothing to win here {failed}"
    return f"{100.0 * metrics['cost_vs_nominal'].value:.0f} {failed}"


def motion_table(title: str, found: Sequence[Standing]) -> Table:
    """The motion under each contestant, in the same order: means over all contests."""
    shown = [metric for metric in EPISODE if metric.heading]
    header = ["controller and estimator", *(m.heading for m in shown), "of the period / %"]
    cells = []
    for each in found:
        share_ = f"{1e-4 * each.us / control_period(each.cell):.2f}" if np.isfinite(each.us) else ""
        values = [(metric, each.mean(metric.name)) for metric in shown]
        texts = [metric.text(value) if np.isfinite(value) else "" for metric, value in values]
        cells.append([each.label, *texts, share_])
    note = (
        "Yaw error and path where the reference turns. motors: mechanical work of both. effort: "
        "mean square share of the full yaw moment. Steps: the largest of what is asked between "
        "two decisions. saturated: of the decisions. The last column: a decision's time. What the "
        "tyres dissipate is not measured: no signal of the car has their forces."
    )
    return Table(title, header, cells, note, detail=True)
