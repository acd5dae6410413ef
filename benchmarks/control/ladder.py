"""The ladder of rungs: its yardsticks, whether it falls, what each step of knowledge costs, and the
answer."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ...envs.task.failures import FAILURES
from ..harness.results import Table
from ..harness.stats import Estimate, average, chance_of_no_less, geometric_mean, holm
from ..harness.verdict import leader, some, verdict
from .cells import ADAPTIVE, REFERENCE_CONTROLLER, REFERENCE_FILTER, RUNGS, TRUTH, Cell
from .contests import NOMINAL, PARAMETERS, STATE, TITLES, Contest, oracle_of
from .delay_price import DELAYS, Price
from .episodes import Array
from .run import Results
from .scores import NOTHING, Yardstick, survived
from .tables import Standing

_OF_THE_CAR = ("none", "spin", "off-road")
CLAIRVOYANT = "clairvoyant"


def yardsticks(results: Results, contests: Sequence[Contest]) -> dict[Contest, Yardstick]:
    """The yardstick of each contest in which both rungs were driven."""
    found = {}
    for contest in contests:
        nominal, oracle = (results.of(contest, rung) for rung in (NOMINAL, STATE))
        if not nominal.error and not oracle.error:
            found[contest] = Yardstick(nominal, oracle)
    return found


def ladder_table(
    results: Results, contests: Sequence[Contest], foreseen: Mapping[Contest, Array]
) -> Table:
    """Every contest's rungs and whether they fall in cost.

    foreseen: (n,) log(J_oracle-state / J_clairvoyant) of the clairvoyant's own seeds, where it is
    calibrated.
    """
    yards, cells = yardsticks(results, contests), []
    for contest in contests:
        if contest not in yards:
            errors = [results.of(contest, rung).error for rung in (NOMINAL, STATE)]
            cells.append([contest.name, *[""] * 6, "; ".join(filter(None, errors))])
            continue
        yard = yards[contest]
        own = yard.paired(yard.oracle)[1]
        gap, parameters = average(own), results.of(contest, PARAMETERS)
        known = "" if parameters.error else f"{_mean(yard.paired(parameters)[0]):.2f}"
        ahead = foreseen.get(contest)
        cells.append(
            [
                contest.name,
                f"{100.0 * (1.0 - survived(yard.nominal).mean()):.1f}",
                oracle_of(contest),
                f"{gap.value:.2f} [{gap.low:.2f}, {gap.high:.2f}]",
                known,
                "" if ahead is None else f"{ahead.mean():.2f}",
                f"{len(own)} of {len(yard.kept(len(yard.oracle.costs)))}",
                _fall(yard, own, ahead),
            ]
        )
    header = (
        *("contest", "nominal fails / %", "oracle-state is", "its gap", "oracle-parameters"),
        *("clairvoyant beyond", "episodes", "falls"),
    )
    note = "Mean of log(J_nominal / J), 0.69 for half the cost; the score's 1 is the gap."
    if not foreseen:
        note += " The clairvoyant is not calibrated: its column is empty (`sideslip calibrate`)."
    return Table("The ladder", header, cells, note, keyed=False)


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _fall(yard: Yardstick, own: Array, ahead: Array | None) -> str:
    """Whether each rung costs less than the one below it."""
    if not len(own):
        return "no episode that nominal and oracle-state survive"
    if yard.gap < NOTHING:
        return "nothing to win here"
    if ahead is not None and ahead.mean() <= 0.0:
        return "clairvoyant does not"
    return "yes" if average(own).low > 0.0 else "not surely"


def findings(found: Sequence[Standing]) -> list[str]:
    """The contestants that cost less than oracle-state over their tier, Holm-corrected."""
    others = [
        each
        for each in found
        if each.cell.controller not in RUNGS
        and "score" in each.overall
        and np.isfinite(each.overall["score"].value)
    ]
    ahead = [
        np.concatenate([own - r for r, own in each.pairs.values()]) for each in others
    ]  # below 0 where the contestant is better
    sure = holm([chance_of_no_less(each) for each in ahead])
    return [
        f"Finding: {each.label} costs less than oracle-state in tier {each.tier} "
        f"(score {each.overall['score'].value:.2f})."
        for each, is_sure in zip(others, sure, strict=True)
        if is_sure
    ]


def below_the_clairvoyant(names: Sequence[str], leads: Sequence[Array]) -> list[str]:
    """Of contestants with log(J / J_clairvoyant) (n,) on its seeds: who is surely below it."""
    sure = holm([chance_of_no_less(each) for each in leads])
    return [name for name, is_sure in zip(names, sure, strict=True) if is_sure]


def knowledge_table(results: Results, tiers: Mapping[str, Sequence[Contest]],
                    foreseen: Mapping[Contest, Array]) -> Table:  # fmt: skip
    """What not knowing costs, tier by tier: the ratio of the costs of neighbouring rungs."""
    cells = []
    for tier, contests in tiers.items():
        yards = yardsticks(results, contests)
        steps: list[list[Array]] = [[], [], [c for k, c in foreseen.items() if k in contests]]
        for contest, yard in yards.items():
            parameters = results.of(contest, PARAMETERS)
            if not parameters.error and yard.kept(len(parameters.costs)).any():
                r, own = yard.paired(parameters)
                steps[0].append(r)
                steps[1].append(own - r)
        texts = []
        for logs in steps:
            ratio = geometric_mean(*logs)
            spread = f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"
            texts.append(spread if logs else "")
        cells.append([f"{tier}: {TITLES[tier]}", *texts])
    header = (
        *("tier", "car, friction, biases (model)", "state and disturbances (sensing)"),
        "what is ahead (foresight)",
    )
    note = (
        "Cost without over cost with the knowledge: nominal / oracle-parameters, oracle-parameters "
        "/ oracle-state, oracle-state / clairvoyant. Paired geometric means."
    )
    return Table("What not knowing costs", header, cells, note, keyed=False)


Gains = dict[Contest, Array]
"""r of a contestant's episodes in the contests that count."""


def answer(
    found: Mapping[str, Sequence[Standing]],
    prices: Sequence[Price] = (),
    ahead: Mapping[Contest, Array] | None = None,
) -> str:
    """The verdict over all tiers: the best estimator, the best controller, and why.

    ahead: (n,) log(J_oracle-state / J_clairvoyant) of calibrated contests.
    """
    filters, others = _estimators(found), _controllers(found)
    none = others.get("none", {})
    best = best_controller(found)
    over = _over(others[best], none) if none and best != "none" else None
    text = f", {100.0 * over.value:.0f} % of no control's" if over else ""
    episodes = max((len(r) for each in others.values() for r in each.values()), default=0)
    return verdict(
        "Estimators infer how the car slides, controllers make torque of it; cost: squared error.",
        f"Best estimator: {_first(filters)}.",
        f"Best controller: {_first(others)}{text}.",
        _why(found, prices, ahead or {}),
        f"{_elsewhere(found)}Not covered: other cars and roads, and less than {episodes} "
        "episodes a contest can tell.",
    )


def on_its_own(controller: str, estimator: str) -> bool:
    """Whether that is the filter on which a controller is compared with others: the reference,
    none, or the one whose tyres it follows."""
    return estimator in ("", REFERENCE_FILTER) or ADAPTIVE.get(estimator) == controller


def best_controller(found: Mapping[str, Sequence[Standing]]) -> str:
    """Who leads over all tiers, "" where nobody has a score."""
    return next(iter(_ranked(_controllers(found))), "")


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
        mine = made.setdefault(getattr(each.cell, attribute), {})
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
    """The tiers in which somebody else surely leads."""
    parts = []
    for tier, standings in found.items():
        for of in (_estimators, _controllers):
            overall, here = _ranked(of(found)), _ranked(of({tier: standings}))
            first, best = (next(iter(each), "") for each in (overall, here))
            if best != first and first in here.get(best, {}) and here[best][first].high < 1.0:
                parts.append(f"{best} in tier {tier}")
    return f"But {some(parts)}. " if parts else ""


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
    return f"Why: knowing {', then '.join(texts)} of the cost{delay}." if rung else ""


def refusals_of(results: Results, late: float = 0.0) -> list[list[str]]:
    """A line for every cell that could not be driven, or whose episodes ended by a failure that is
    not the car's (a NaN, an action that is none): tier, contest, contestant, what happened.

    late: s by which the sensors were, of the price of delay.
    """
    lines, more = [], f", sensors {1e3 * late:.0f} ms late" if late else ""
    for cell, result in results.found.items():
        where = [cell.contest.tier, cell.contest.name + more, cell.label]
        if result.error:
            lines.append([*where, f"not driven: {result.error}"])
            continue
        codes = result["failure"].astype(int)
        ended = [
            f"{name} {100.0 * (codes == code).mean():.1f} %"
            for code, name in enumerate(FAILURES)
            if name not in _OF_THE_CAR and (codes == code).any()
        ]
        if ended:
            lines.append([*where, ", ".join(ended)])
        elif (codes != 0).all():
            lines.append([*where, "every car fails"])
    return lines
