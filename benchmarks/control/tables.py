"""The matrix as rows for machines and tables for people."""

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from ... import __version__
from ..harness.metrics import EPISODE
from ..harness.results import Row, Table
from ..harness.stats import Estimate
from .ceiling import judged
from .cells import INFORMED, REFERENCE_CONTROLLER, REFERENCE_FILTER, Cell
from .episodes import NUMBERS, Driven, control_period
from .run import Results
from .scores import Ceiling, Resampled, improvement

RATES = {"spin": "spin_rate", "off-road": "departure_rate"}
_FAILED = {"not-finite": "not_finite_rate", "bad-action": "bad_action_rate"}
_MEANS = tuple(name for name in NUMBERS if name not in ("cost", "failure"))


@dataclass
class Standing:
    """A contestant over all manoeuvres of a table.

    by_scenario: {scenario: {metric: Estimate}}. overall: "score" and "iqm" over the scored
    manoeuvres, "cost_over_informed" (the geometric mean) and "probability_of_improvement" (on
    two-dof with exact-kf, without interval) over all.
    """

    cell: Cell
    results: dict[str, Driven]
    by_scenario: dict[str, dict[str, Estimate]]
    overall: dict[str, Estimate]
    us: float = float("nan")

    @property
    def label(self) -> str:
        """As in tables and figures."""
        return self.cell.label

    def mean(self, name: str) -> float:
        """A number of NUMBERS over all episodes of all manoeuvres."""
        return float(np.mean([driven[name].mean() for driven in self.results.values()]))

    def rate(self, failure: str) -> float:
        """The share of episodes of all manoeuvres that ended so."""
        return float(np.mean([driven.failed(failure).mean() for driven in self.results.values()]))


def standings(results: Results, env_id: str, tops: dict[str, Ceiling]) -> list[Standing]:
    """Every contestant of a table, the best first; tops: the ceilings by manoeuvre."""
    cells = [cell for cell in results.found if cell.env_id == env_id]
    contestants: dict[tuple[str, str], Cell] = {}
    for cell in cells:
        contestants.setdefault((cell.controller, cell.estimator), cell)
    scenarios = list(dict.fromkeys(cell.scenario for cell in cells))
    scored = judged(results, env_id, tops)
    draws: dict[int, Resampled] = {}
    found = []
    for (controller, estimator), first in contestants.items():
        mine = {s: results.of(env_id, s, controller, estimator) for s in scenarios}
        n = len(mine[scenarios[0]].costs)
        draw = draws.setdefault(n, Resampled(n, len(scenarios)))
        yard = {s: results.of(env_id, s, "none").costs[:n] for s in scenarios}
        informed = {s: results.of(env_id, s, INFORMED).costs[:n] for s in scenarios}
        by = {
            s: _metrics(draw, i, mine[s], yard[s], informed[s], tops[s] if s in scored else None)
            for i, s in enumerate(scenarios)
        }
        overall = {}
        if scored:
            none, costs = [yard[s] for s in scored], [mine[s].costs for s in scored]
            overall = draw.aggregate(np.array(none), np.array(costs), [tops[s] for s in scored])
        overall["cost_over_informed"] = _geometric([by[s]["cost_over_informed"] for s in scenarios])
        overall["probability_of_improvement"] = _improvement(results, env_id, mine)
        found.append(Standing(first, mine, by, overall))
    return sorted(found, key=lambda each: -_rank(each))


def _rank(standing: Standing) -> float:
    score = standing.overall["score"].value if "score" in standing.overall else np.nan
    if np.isnan(score):
        score = -standing.overall["cost_over_informed"].value
    return -np.inf if np.isnan(score) else score


def _metrics(
    draw: Resampled, which: int, mine: Driven, none: Any, informed: Any, top: Ceiling | None
) -> dict[str, Estimate]:
    found = {
        "cost": draw.mean(mine.costs, which),
        "cost_over_informed": draw.over(mine.costs, informed, which),
    }
    if top is not None:
        found["score"] = draw.score(none, mine.costs, top, which)
    for name in _MEANS:
        found[name] = draw.mean(mine[name], which)
    for failure, metric in (RATES | _FAILED).items():
        found[metric] = draw.mean(mine.failed(failure), which)
    return found


def _improvement(results: Results, env_id: str, mine: dict[str, Driven]) -> Estimate:
    """Over the reference pair, on every manoeuvre alike."""
    pairs = [
        (r.costs, results.of(env_id, s, REFERENCE_CONTROLLER, REFERENCE_FILTER).costs)
        for s, r in mine.items()
    ]
    value = float(np.mean([improvement(ours, theirs) for ours, theirs in pairs]))
    return Estimate(value)


def _geometric(ratios: list[Estimate]) -> Estimate:
    """The geometric mean of ratios; its interval as if the manoeuvres' were independent."""
    logs = np.log([each.value for each in ratios])
    errors = np.log([[each.low, each.high] for each in ratios]) - logs[:, None]
    low, high = np.sqrt((errors**2).sum(axis=0)) / len(logs)
    middle = logs.mean()
    return Estimate(*np.exp([middle, middle - low, middle + high]).tolist())


def rows_of(standing: Standing, salt: str) -> list[Row]:
    """One row a metric and manoeuvre, and the aggregates under the scenario "all"."""
    cell = standing.cell
    common: dict[str, Any] = {
        "suite": "control",
        "estimator": cell.estimator,
        "controller": cell.controller,
        "salt": salt,
        "env_version": f"{cell.env_id} {__version__}",
    }
    rows = []
    for scenario, metrics in standing.by_scenario.items():
        n, spec = len(standing.results[scenario].costs), spec_of(replace(cell, scenario=scenario))
        rest = common | {"n": n, "spec": spec}
        rows += [Row.of(name, each, scenario=scenario, **rest) for name, each in metrics.items()]
    common |= {"scenario": "all", "n": sum(len(r.costs) for r in standing.results.values())}
    rows += [Row.of(name, each, **common) for name, each in standing.overall.items()]
    if np.isfinite(standing.us):
        rows.append(Row(metric="us_per_decision", value=standing.us, **common))
    return rows


def spec_of(cell: Cell) -> str:
    """The env as JSON: what `gym.make` needs to build it again."""
    env = gym.make(gym.spec(cell.env_id), **cell.env_options)
    return env.spec.to_json() if env.spec is not None else ""


def main_table(title: str, found: list[Standing], note: str) -> Table:
    """The contestants' scores, the best first."""
    header = (
        *("controller and estimator", "score", "95 % interval", "IQM", "cost / informed"),
        *("better / %", "spin / %", "left road / %", "us a decision"),
    )
    cells = []
    for each in found:
        score, overall = each.overall.get("score"), each.overall
        cells.append(
            [
                each.label,
                *(score.text() if score else ("", "")),
                f"{overall['iqm'].value:.3f}" if score else "",
                f"{overall['cost_over_informed'].value:.2f}",
                f"{100 * overall['probability_of_improvement'].value:.0f}",
                f"{100 * each.rate('spin'):.1f}",
                f"{100 * each.rate('off-road'):.1f}",
                f"{each.us:.0f}" if np.isfinite(each.us) else "",
            ]
        )
    return Table(title, header, cells, note)


def motion_table(title: str, found: list[Standing]) -> Table:
    """The motion under each contestant, in the same order: means over all manoeuvres."""
    shown = [metric for metric in EPISODE if metric.heading]
    header = ["controller and estimator", *(m.heading for m in shown), "of the period / %"]
    cells = []
    for each in found:
        share = f"{1e-4 * each.us / control_period(each.cell):.2f}" if np.isfinite(each.us) else ""
        cells.append([each.label, *(m.text(each.mean(m.name)) for m in shown), share])
    note = (
        "effort: mean square share of the full yaw moment. Steps: the largest of what is asked "
        "between two decisions. saturated: of the decisions. The last column: a decision's time."
    )
    return Table(title, header, cells, note)


def yardsticks(results: Results, env_id: str, tops: dict[str, Ceiling]) -> Table:
    """The costs that scores of 0 and 1 stand for on every manoeuvre, and where there is a score."""
    cells, scored = [], judged(results, env_id, tops)
    for scenario in dict.fromkeys(c.scenario for c in results.found if c.env_id == env_id):
        none = results.of(env_id, scenario, "none")
        informed = results.of(env_id, scenario, INFORMED)
        top = tops.get(scenario)
        failed = 100.0 * np.mean(none["failure"] != 0.0)
        cells.append(
            [
                scenario,
                f"{none.costs.mean():.3f}",
                f"{failed:.1f}",
                f"{informed.costs.mean():.3f}",
                f"{top.mean:.3f}" if top else "",
                f"{top.error:.3f}" if top else "",
                "yes" if scenario in scored else "no",
            ]
        )
    return Table(
        f"{env_id}: what 0 and 1 mean (mean cost an episode)",
        ("manoeuvre", "none", "fails / %", "informed", "clairvoyant", "+-", "scored"),
        cells,
        "The clairvoyant's mean is carried over from its calibration seeds by regression on the "
        "uncontrolled cost. A manoeuvre is scored where the uncontrolled car costs more than twice "
        "what `informed` does and the ceiling's error is below a tenth of what can be gained.",
        keyed=False,
    )
