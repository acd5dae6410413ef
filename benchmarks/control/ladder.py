"""The ladder of rungs: its yardsticks, whether it falls, what each step of knowledge costs, and
what knowing late does: the price of delay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from ...envs.task.failures import FAILURES
from ..harness.results import Table
from ..harness.stats import Estimate, average, chance_of_no_less, geometric_mean, holm
from .cells import REFERENCE_CONTROLLER, REFERENCE_FILTER, RUNGS, Cell
from .contests import (
    NOMINAL,
    ORACLES,
    PARAMETERS,
    STATE,
    TITLES,
    YAW,
    Contest,
    oracle_of,
)
from .episodes import Array
from .run import Results, measure
from .scores import NOTHING, Yardstick, gains, survived
from .tables import Standing

_OF_THE_CAR = ("none", "spin", "off-road")
CLAIRVOYANT = "clairvoyant"
DELAYS = (0.0, 0.05, 0.1, 0.2, 0.3)  # s, of camera and GPS alike, beside what the seed draws
FRAME = 0.05  # s: so slow that a camera's frames 0.3 s late find room under way
PRICE_CONTEST = Contest("1", YAW, "coms", "zero-slip", "coms-random")
CONTESTANTS = (
    *((NOMINAL, ""), (ORACLES[PARAMETERS][0], ""), (ORACLES[STATE][0], "")),
    *((REFERENCE_CONTROLLER, each) for each in (REFERENCE_FILTER, "multirate-kf", "bicycle-kf")),
)


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
                gap.inline(),
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
            texts.append(geometric_mean(*logs).inline() if logs else "")
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


@dataclass
class Price:
    """A contestant's cost over that of nominal with sensors in time, at each delay."""

    cell: Cell
    over: list[Estimate]


def late_cells(delay: float) -> list[Cell]:
    """The contestants with camera (every FRAME) and GPS a delay (s) late."""
    late = {"camera_delays": [delay], "camera_jitter": 0.0, "gps_delays": [delay]}
    scenario = {"base": PRICE_CONTEST.scenario, **late}
    options = {"scenario": scenario, "camera": {"period": FRAME}}
    return [Cell(PRICE_CONTEST, estimator, who, options) for who, estimator in CONTESTANTS]


def price_of_delay(
    seeds: Sequence[int],
    *,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> tuple[list[Price], list[Results]]:
    """Every contestant at each of DELAYS, all on the same seeds, and the results by delay."""
    found = [measure(late_cells(d), seeds, jobs=jobs, console=console, keep=keep) for d in DELAYS]
    in_time = found[0].of(PRICE_CONTEST, NOMINAL)
    prices = []
    for who, estimator in CONTESTANTS:
        price = Price(Cell(PRICE_CONTEST, estimator, who), [])
        for results in found:
            driven = results.of(PRICE_CONTEST, who, estimator)
            there = survived(in_time)[: len(driven.costs)]
            wrong = driven.error or in_time.error
            logs = np.empty(0) if wrong else -gains(in_time.costs[: len(there)], driven)[there]
            price.over.append(geometric_mean(logs))
        prices.append(price)
    return prices, found


def lines(prices: Sequence[Price]) -> Mapping[str, tuple[Array, Array, Array]]:
    """name to (value, low, high) over the delays, of those that were driven at all of them."""
    return {
        price.cell.label: (*np.array(price.over).T,)
        for price in prices
        if np.isfinite(price.over).all()
    }
