"""The matrix's verdict: the best controller, the best estimator, and why."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from ..harness.stats import Estimate, geometric_mean
from ..harness.verdict import leader, some, verdict
from .cells import ADAPTIVE, LEARNED, REFERENCE_CONTROLLER, REFERENCE_FILTER, RUNGS, TRUTH, Cell
from .contests import PARAMETERS, Contest
from .episodes import Array
from .ladder import DELAYS, Price
from .tables import Standing

_POLICIES = {pair for pairs in LEARNED.values() for pair in pairs}

Gains = dict[Contest, Array]
"""r of a contestant's episodes in the contests that count."""
Driven = TypeVar("Driven", bound=Collection[Any])


def answer(
    found: Mapping[str, Sequence[Standing]],
    prices: Sequence[Price] = (),
    ahead: Mapping[Contest, Array] | None = None,
) -> str:
    """The verdict over all tiers: the best controller, the best estimator, and why.

    ahead: (n,) log(J_oracle-state / J_clairvoyant) of calibrated contests.
    """
    filters, drivers = _estimators(found), _controllers(found)
    others, none = everywhere(drivers), drivers.get("none", {})
    best = best_controller(found)
    over = _over(others[best], none) if best not in ("", "none") and none else None
    text = f", and {100.0 * over.value:.0f} % as much as no control" if over else ""
    episodes = max((len(r) for each in drivers.values() for r in each.values()), default=0)
    return verdict(
        "Controllers drive on what estimators infer; cost: squared error of slip and yaw rate.",
        f"Of the controllers {_first(others)}{text}.",
        f"Of the estimators, under one controller, {_first(filters)}.",
        _why(found, prices, ahead or {}),
        f"{_elsewhere(found)}Not covered: other cars and roads, and what {episodes} episodes a "
        "contest are too few to show.",
    )


def costs(found: Mapping[str, Sequence[Standing]]) -> dict[str, Estimate]:
    """The cost over nominal's in % of who drives everywhere, the best first."""
    drivers = everywhere(_controllers(found))
    logs = {name: [-r for r in drivers[name].values()] for name in _ranked(drivers)}
    return {
        name: Estimate(*(100.0 * each for each in geometric_mean(*mine)))
        for name, mine in logs.items()
    }


def on_its_own(controller: str, estimator: str) -> bool:
    """Whether that is the filter on which a controller is compared with others: the reference,
    none, the one whose tyres it follows, or a policy's own."""
    follows = ADAPTIVE.get(estimator) == controller
    return estimator in ("", REFERENCE_FILTER) or follows or (estimator, controller) in _POLICIES


def best_controller(found: Mapping[str, Sequence[Standing]]) -> str:
    """Who leads over all tiers of those who drive everywhere, "" where nobody has a score."""
    return next(iter(_ranked(everywhere(_controllers(found)))), "")


def everywhere(those: Mapping[str, Driven]) -> dict[str, Driven]:
    """Who drives every contest that anybody drives: who drives a part is not the best over all.

    those: by name, the contests or what is known of each.
    """
    every = {contest for mine in those.values() for contest in mine}
    return {name: mine for name, mine in those.items() if set(mine) == every}


def _estimators(found: Mapping[str, Sequence[Standing]]) -> dict[str, Gains]:
    """What each estimator under the reference controller gains, the truth left out."""
    return _gains(found, "estimator", lambda cell: (
        cell.controller == REFERENCE_CONTROLLER and cell.estimator != TRUTH))  # fmt: skip


def _controllers(found: Mapping[str, Sequence[Standing]]) -> dict[str, Gains]:
    """What each controller gains on its own filter, the rungs left out."""
    return _gains(found, "controller", lambda cell: (
        cell.controller not in RUNGS and on_its_own(cell.controller, cell.estimator)))  # fmt: skip


def _gains(
    found: Mapping[str, Sequence[Standing]], attribute: str, among: Callable[[Cell], bool]
) -> dict[str, Gains]:
    made: dict[str, Gains] = {}
    for each in (each for standings in found.values() for each in standings if among(each.cell)):
        name = getattr(each.cell, attribute).replace(", ", " with ")  # in a list of names
        mine = made.setdefault(name, {})
        mine |= {contest: r for contest, (r, _) in each.pairs.items()}
    return {name: each for name, each in made.items() if each}


def _over(one: Gains, other: Gains) -> Estimate:
    """One's cost over the other's on the contests and seeds of both; NaN where there are none."""
    both = [(r, other[contest]) for contest, r in one.items() if contest in other]
    return geometric_mean(*(b[: len(a)] - a[: len(b)] for a, b in both))


def _ranked(those: Mapping[str, Gains]) -> dict[str, dict[str, Estimate]]:
    """Each one's cost over its rivals', the best first: who costs more than the fewest, of these
    who costs least of nominal's. Rivals that share no contest are left out, the closest first."""
    over = {
        name: {other: _over(mine, theirs) for other, theirs in those.items() if other != name}
        for name, mine in those.items()
    }
    beaten = {name: sum(each.value > 1.0 for each in over[name].values()) for name in those}
    gained = {name: np.mean([r.mean() for r in mine.values()]) for name, mine in those.items()}
    order = sorted(those, key=lambda name: (beaten[name], -gained[name]))
    return {
        name: dict(sorted(
            ((other, each) for other, each in over[name].items() if np.isfinite(each.value)),
            key=lambda rival: -rival[1].value,
        ))
        for name in order
    }  # fmt: skip


def _first(those: Mapping[str, Gains]) -> str:
    """Who leads, and by how much."""
    ranked = _ranked(those)
    return leader(*next(iter(ranked.items())), "cost") if ranked else "nobody has a score"


def _elsewhere(found: Mapping[str, Sequence[Standing]]) -> str:
    """The tiers in which somebody else surely leads, and who does where he drives a part."""
    parts = []
    for tier, standings in found.items():
        for of in (_estimators, lambda there: everywhere(_controllers(there))):
            overall, here = _ranked(of(found)), _ranked(of({tier: standings}))
            first, best = (next(iter(each), "") for each in (overall, here))
            if best != first and first in here.get(best, {}) and here[best][first].high < 1.0:
                parts.append(f"{best} in tier {tier}")
    drivers, overall_best = _controllers(found), best_controller(found)
    parted = drivers.keys() - everywhere(drivers).keys() if overall_best else ()
    ahead = {name: _over(drivers[name], drivers[overall_best]) for name in parted}
    cheaper = (name for name in ahead if ahead[name].high < 1.0)
    ordered = sorted(cheaper, key=lambda who: ahead[who].value)
    parts += [f"{name} on its own manoeuvres" for name in ordered]
    return f"It costs less with {some(parts)}. " if parts else ""


def _why(
    found: Mapping[str, Sequence[Standing]],
    prices: Sequence[Price],
    ahead: Mapping[Contest, Array],
) -> str:
    """What the rungs save: the price of the model, of sensing, of foresight and of delay."""
    every = [each for standings in found.values() for each in standings]
    rung = [r for each in every if each.cell.controller == PARAMETERS for r in each.pairs.values()]
    steps = (
        ("the true car and road", [r for r, _ in rung]),
        ("its exact motion", [own - r for r, own in rung]),
        ("what is ahead", list(ahead.values())),
    )
    texts = [
        f"{what} saves {100.0 * (1.0 - geometric_mean(*(-r for r in logs)).value):.0f} %"
        for what, logs in steps
        if logs
    ]
    late = [price.over for price in prices if price.cell.controller == REFERENCE_CONTROLLER]
    delay = ""
    if late and np.isfinite(late[0][-1].value):
        grown = 100.0 * (late[0][-1].value / late[0][0].value - 1.0)
        delay = f"; {DELAYS[-1]:g} s of delay costs {grown:.0f} %"
    return f"Knowing {', then '.join(texts)} of the cost{delay}." if rung else ""
