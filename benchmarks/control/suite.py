"""Question: which estimator and which controller keeps the car where it should be, and how far is
that from knowing its state? The matrix of both on the scored contests of four tiers."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from ... import __version__
from ...agents.learned.files import is_policy, load_policy
from ..harness.results import Row, Suite, Table
from .answer import answer
from .build import decision_time
from .calibration import FILE, Entry, check_fresh, driven_there, leads, read_calibration
from .cells import EPISODES, LEARNED, Cell, cells, some_of
from .contests import STATE, TITLES, Contest, contests
from .episodes import Array
from .figures import illustrate
from .ladder import (
    DELAYS,
    PRICE_CONTEST,
    Price,
    below_the_clairvoyant,
    findings,
    knowledge_table,
    ladder_table,
    price_of_delay,
    refusals_of,
    yardsticks,
)
from .run import Results, measure
from .seeds import salt_of, seeds_of_contests
from .tables import Standing, contest_table, main_table, motion_table, rows_of, standings

_TEXT = """\
In a contest everybody drives the same salted seeds, and everything is paired by episode. \
`nominal` is the LQG that knows the nominal car, `oracle-parameters` knows car, friction and \
biases, `oracle-state` the state too. score: 0 is nominal, 1 oracle-state, a ratio of sums over \
the contests. Only episodes that both rungs survive are compared, a contestant's failure there \
counts as 20 times the cost; failure rates are of all episodes, and rank where nominal fails in \
more than 10 %. Intervals are 95 %. What is not won: a contest without the verdict "scored" in \
contests.json leaves too little between the rungs to tell methods apart."""


def run(
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    quick: bool = False,
    clairvoyant: Path | None = None,
    salt: str = "",
) -> Suite:
    """All tiers, the ladder, the price of delay, and pictures.

    episodes: a cell (slow controllers have at most 64). keep: a folder in which finished cases
    stay, so that a run that was stopped goes on. quick: a few contests, without the slow
    contestants and the price of delay. clairvoyant: a file of `sideslip calibrate`, None: the
    package's, if there is one. salt: of the seeds, "" for `salt_of`'s.
    """
    salt = salt or salt_of()
    played = some_of(contests()) if quick else list(contests())
    asked = list(cells(played, quick))
    entries = _calibrated(clairvoyant, played)
    seeds = seeds_of_contests(salt, episodes)
    results = measure(asked, seeds, jobs=jobs, console=console, keep=keep)
    there = driven_there(entries, asked, jobs=jobs, console=console, keep=keep)
    suite = Suite("control", "Which controller and estimator hold the car", "")
    tiers = {tier: [c for c in played if c.tier == tier] for tier in TITLES}
    tiers = {tier: those for tier, those in tiers.items() if those}
    found, foreseen, more = {}, _foreseen(entries, there), []
    for tier, those in tiers.items():
        found[tier] = standings(results.found, tier, yardsticks(results, those))
        for each in found[tier]:
            if each.driven:
                each.us = decision_time(next(cell for cell in asked if _is_of(cell, each)))
            suite.rows += rows_of(each, salt)
        title = f"Tier {tier}: {TITLES[tier]}"
        note = " ".join([_NOTE, *findings(found[tier]), *(_learned() if tier == "1" else ())])
        suite.tables.append(main_table(title, found[tier], note))
        more += [contest_table(f"{title}, contest by contest", found[tier], those)]
        more += [motion_table(f"{title}: the motion", found[tier])]
    suite.tables.append(knowledge_table(results, tiers, foreseen))
    ladder = ladder_table(results, played, foreseen)
    ladder.note += _beaten(entries, there)
    suite.tables += [ladder, *more]
    late: list[Results] = []
    prices: list[Price] = []
    if not quick:
        prices, late = price_of_delay(seeds(PRICE_CONTEST), jobs=jobs, console=console, keep=keep)
    suite.rows += _price_rows(prices, episodes, salt)
    suite.tables += _refusals(results, late)
    suite.verdict = answer(found, prices, foreseen)
    illustrate(suite, found, results, prices, foreseen)
    spent = np.nansum([c.seconds for each in (results, there, *late) for c in each.found.values()])
    suite.text = f"{_TEXT} Driven in {spent / 60.0:.1f} CPU-minutes."
    return suite


_NOTE = (
    "won: share of the compared episodes that cost less than nominal's. worst 5 %: their mean "
    "cost. contests: with an episode that counts. left out: episodes that nominal or oracle-state "
    "did not survive. A decision is the estimator's step and the controller's, of one car."
)


def _is_of(cell: Cell, standing: Standing) -> bool:
    """Whether it is a cell that the contestant drove without an error."""
    same = (cell.controller, cell.estimator) == (standing.cell.controller, standing.cell.estimator)
    return same and cell.contest in standing.driven


def _calibrated(path: Path | None, played: Sequence[Contest]) -> dict[Contest, Entry]:
    """The clairvoyant's entries of contests; ValueError where one is stale."""
    path = FILE if path is None and FILE.is_file() else path
    if path is None:
        return {}
    read = read_calibration(path)
    entries = {contest: each for contest, each in read.items() if contest in played}
    check_fresh(entries, path)
    return entries


def _foreseen(entries: Mapping[Contest, Entry], there: Results) -> dict[Contest, Array]:
    """(n,) log(J_oracle-state / J_clairvoyant) of each calibrated contest."""
    return {c.contest: each for c, each in leads(entries, there).items() if c.controller == STATE}


def _beaten(entries: Mapping[Contest, Entry], there: Results) -> str:
    """Who costs less than the clairvoyant on its own seeds."""
    if not entries:
        return ""
    found = leads(entries, there)
    names = [f"{cell.label} ({cell.contest.name})" for cell in found]
    below = below_the_clairvoyant(names, list(found.values()))
    who = f"below it: {'; '.join(below)}" if below else "nobody is below it (Holm-corrected)"
    return f" On the clairvoyant's seeds {who}."


def _learned() -> list[str]:
    """The training of the policies in the table."""
    names = [name for pairs in LEARNED.values() for _, name in pairs if is_policy(name)]
    cards = {name: load_policy(name).card for name in names}
    return [
        f"{name}: {card.algorithm}, {card.steps:.2g} steps of {card.env_id} in "
        f"{card.cpu_seconds:.0f} CPU-s, for the reference {card.reference}."
        for name, card in cards.items()
    ]


def _refusals(results: Results, late: Sequence[Results]) -> list[Table]:
    lines = refusals_of(results)
    for delay, each in zip(DELAYS, late, strict=False):
        lines += refusals_of(each, delay)
    if not lines:
        return []
    header = ("tier", "contest", "controller and estimator", "what happened")
    note = (
        "The share of a cell's episodes; the rest of a failed one is charged at the highest cost."
    )
    return [Table("Cells that went wrong", header, lines, note, keyed=False)]


def _price_rows(prices: Sequence[Price], n: int, salt: str) -> list[Row]:
    """Rows of the price of delay; the scenario has the delay."""
    return [
        Row.of(
            "cost_vs_nominal",
            each,
            suite="control",
            scenario=f"{PRICE_CONTEST.name}, sensors {1e3 * delay:.0f} ms late",
            estimator=price.cell.estimator,
            controller=price.cell.controller,
            n=n,
            salt=salt,
            env_version=f"{PRICE_CONTEST.env_id} {__version__}",
        )
        for price in prices
        for delay, each in zip(DELAYS[: len(price.over)], price.over, strict=True)
        if np.isfinite(each.value)
    ]
