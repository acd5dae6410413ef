"""The matrix's verdict: the best controller, the best estimator, and why."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from ...envs.record import Array
from ..harness.stats import Estimate, geometric_mean
from ..harness.verdict import describe_leader, format_verdict, summarise_names
from .cells import (
    ADAPTIVE,
    LEARNED,
    ORACLE_NAMES,
    REFERENCE_CONTROLLER,
    REFERENCE_FILTER,
    TRUTH,
    ControlEntry,
)
from .contests import PARAMETERS, ControlTask
from .ladder import DELAYS, DelayCost
from .tables import Standing

_POLICIES = {pair for pairs in LEARNED.values() for pair in pairs}

Gains = dict[ControlTask, Array]
"""r of a contestant's episodes in the contests that count."""
Driven = TypeVar("Driven", bound=Collection[Any])


def compose_verdict(
    by_tier: Mapping[str, Sequence[Standing]],
    prices: Sequence[DelayCost] = (),
    foresight: Mapping[ControlTask, Array] | None = None,
) -> str:
    """The verdict over all tiers: the best controller, the best estimator, and why.

    foresight: (n,) log(J_oracle-state / J_clairvoyant) of calibrated contests.
    """
    filters, drivers = _group_estimators(by_tier), _group_controllers(by_tier)
    others, none = select_complete(drivers), drivers.get("none", {})
    best = find_best_controller(by_tier)
    ratio = _compute_cost_ratio(others[best], none) if best not in ("", "none") and none else None
    text = f", and {100.0 * ratio.value:.0f} % as much as no control" if ratio else ""
    episodes = max((len(r) for gains in drivers.values() for r in gains.values()), default=0)
    return format_verdict(
        "Controllers drive on what estimators infer; cost: squared error of slip and yaw rate.",
        f"Of the controllers {_describe_first(others)}{text}.",
        f"Of the estimators, under one controller, {_describe_first(filters)}.",
        _describe_reasons(by_tier, prices, foresight or {}),
        f"{_describe_exceptions(by_tier)}Not covered: other cars and roads, and what "
        f"{episodes} episodes a contest are too few to show.",
    )


def compute_relative_costs(standings: Mapping[str, Sequence[Standing]]) -> dict[str, Estimate]:
    """The cost over nominal's in % of who drives everywhere, the best first."""
    drivers = select_complete(_group_controllers(standings))
    logs = {name: [-r for r in drivers[name].values()] for name in _rank_entries(drivers)}
    return {
        name: Estimate(*(100.0 * value for value in geometric_mean(*ratios)))
        for name, ratios in logs.items()
    }


def is_default_filter(controller: str, estimator: str) -> bool:
    """Whether that is the filter on which a controller is compared with others: the reference,
    none, the one whose tyres it follows, or a policy's own."""
    follows = ADAPTIVE.get(estimator) == controller
    return estimator in ("", REFERENCE_FILTER) or follows or (estimator, controller) in _POLICIES


def find_best_controller(by_tier: Mapping[str, Sequence[Standing]]) -> str:
    """Who leads over all tiers of those who drive everywhere, "" where nobody has a score."""
    return next(iter(_rank_entries(select_complete(_group_controllers(by_tier)))), "")


def select_complete(by_name: Mapping[str, Driven]) -> dict[str, Driven]:
    """Who drives every contest that anybody drives: who drives a part is not the best over all.

    by_name: by name, the contests or what is known of each.
    """
    all_tasks = {task for tasks in by_name.values() for task in tasks}
    return {name: tasks for name, tasks in by_name.items() if set(tasks) == all_tasks}


def _group_estimators(by_tier: Mapping[str, Sequence[Standing]]) -> dict[str, Gains]:
    """What each estimator under the reference controller gains, the truth left out."""
    return _collect_gains(by_tier, "estimator", lambda entry: (
        entry.controller == REFERENCE_CONTROLLER and entry.estimator != TRUTH))  # fmt: skip


def _group_controllers(by_tier: Mapping[str, Sequence[Standing]]) -> dict[str, Gains]:
    """What each controller gains on its own filter, the rungs left out."""
    return _collect_gains(by_tier, "controller", lambda entry: (
        entry.controller not in ORACLE_NAMES and is_default_filter(entry.controller,
                                                                   entry.estimator)))  # fmt: skip


def _collect_gains(
    by_tier: Mapping[str, Sequence[Standing]], attribute: str, among: Callable[[ControlEntry], bool]
) -> dict[str, Gains]:
    by_name: dict[str, Gains] = {}
    for item in (item for standings in by_tier.values() for item in standings if among(item.entry)):
        name = getattr(item.entry, attribute).replace(", ", " with ")  # in a list of names
        gains = by_name.setdefault(name, {})
        gains |= {task: r for task, (r, _) in item.pairs.items()}
    return {name: item for name, item in by_name.items() if item}


def _compute_cost_ratio(one: Gains, other: Gains) -> Estimate:
    """One's cost over the other's on the contests and seeds of both; NaN where there are none."""
    both = [(r, other[task]) for task, r in one.items() if task in other]
    return geometric_mean(*(b[: len(a)] - a[: len(b)] for a, b in both))


def _rank_entries(by_name: Mapping[str, Gains]) -> dict[str, dict[str, Estimate]]:
    """Each one's cost over its rivals', the best first: who costs more than the fewest, of these
    who costs least of nominal's. Rivals that share no contest are left out, the closest first."""
    ratios = {
        name: {
            other: _compute_cost_ratio(gains, rival_gains)
            for other, rival_gains in by_name.items()
            if other != name
        }
        for name, gains in by_name.items()
    }
    beaten = {name: sum(ratio.value > 1.0 for ratio in ratios[name].values()) for name in by_name}
    gained = {name: np.mean([r.mean() for r in gains.values()]) for name, gains in by_name.items()}
    order = sorted(by_name, key=lambda name: (beaten[name], -gained[name]))
    return {
        name: dict(sorted(
            ((other, ratio) for other, ratio in ratios[name].items() if np.isfinite(ratio.value)),
            key=lambda rival: -rival[1].value,
        ))
        for name in order
    }  # fmt: skip


def _describe_first(by_name: Mapping[str, Gains]) -> str:
    """Who leads, and by how much."""
    ranked = _rank_entries(by_name)
    return describe_leader(*next(iter(ranked.items())), "cost") if ranked else "nobody has a score"


def _describe_exceptions(by_tier: Mapping[str, Sequence[Standing]]) -> str:
    """The tiers in which somebody else surely leads, and who does where he drives a part."""
    parts = []
    for tier, standings in by_tier.items():
        for collect in (
            _group_estimators,
            lambda tiers: select_complete(_group_controllers(tiers)),
        ):
            overall, tier_ranking = (
                _rank_entries(collect(by_tier)),
                _rank_entries(collect({tier: standings})),
            )
            first, best = (next(iter(ranking), "") for ranking in (overall, tier_ranking))
            if (
                best != first
                and first in tier_ranking.get(best, {})
                and tier_ranking[best][first].high < 1.0
            ):
                parts.append(f"{best} in tier {tier}")
    drivers, overall_best = _group_controllers(by_tier), find_best_controller(by_tier)
    parted = drivers.keys() - select_complete(drivers).keys() if overall_best else ()
    ratios = {name: _compute_cost_ratio(drivers[name], drivers[overall_best]) for name in parted}
    cheaper = (name for name in ratios if ratios[name].high < 1.0)
    ordered = sorted(cheaper, key=lambda label: ratios[label].value)
    parts += [f"{name} on its own manoeuvres" for name in ordered]
    return f"It costs less with {summarise_names(parts)}. " if parts else ""


def _describe_reasons(
    by_tier: Mapping[str, Sequence[Standing]],
    prices: Sequence[DelayCost],
    foresight: Mapping[ControlTask, Array],
) -> str:
    """What the rungs save: the price of the model, of sensing, of foresight and of delay."""
    all_standings = [standing for standings in by_tier.values() for standing in standings]
    parameter_pairs = [
        r
        for standing in all_standings
        if standing.entry.controller == PARAMETERS
        for r in standing.pairs.values()
    ]
    steps = (
        ("the true car and road", [r for r, _ in parameter_pairs]),
        ("its exact motion", [oracle_gain - r for r, oracle_gain in parameter_pairs]),
        ("what is ahead", list(foresight.values())),
    )
    texts = [
        f"{what} saves {100.0 * (1.0 - geometric_mean(*(-r for r in logs)).value):.0f} %"
        for what, logs in steps
        if logs
    ]
    late = [price.over for price in prices if price.entry.controller == REFERENCE_CONTROLLER]
    delay = ""
    if late and np.isfinite(late[0][-1].value):
        grown = 100.0 * (late[0][-1].value / late[0][0].value - 1.0)
        delay = f"; {DELAYS[-1]:g} s of delay costs {grown:.0f} %"
    return f"Knowing {', then '.join(texts)} of the cost{delay}." if parameter_pairs else ""
