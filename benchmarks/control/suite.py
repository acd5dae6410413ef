"""Question: which estimator and which controller keeps the car where it should be, and how far is
that from knowing its state? The matrix of both on the scored contests of four tiers."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from ... import __version__
from ...agents.learned.policy import is_policy, load_policy
from ...envs.record import Array
from ..harness.results import ResultRow, ResultTable, Suite
from .baseline_gaps import (
    DELAY_TASK,
    DELAYS,
    DelayCost,
    describe_findings,
    find_below_optimum,
    list_failures,
    make_knowledge_table,
    make_oracle_table,
    make_score_scales,
    measure_delay_cost,
)
from .calibration import (
    FILE,
    CalibrationRecord,
    check_current,
    compute_regrets,
    measure_calibrated,
    read_calibration,
)
from .entries import (
    EPISODES,
    LEARNED,
    ControlEntry,
    make_entries,
    measure_decision_time,
    select_quick_tasks,
)
from .report import add_figures, compose_verdict
from .run import Results, measure
from .score import (
    Standing,
    make_main_table,
    make_motion_table,
    make_rows,
    make_task_table,
    rank_entries,
)
from .tasks import STATE, TITLES, ControlTask, list_scored_tasks, make_salt, make_task_seeds

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
    package's, if there is one. salt: of the seeds, "" for `make_salt`'s.
    """
    salt = salt or make_salt()
    tasks = select_quick_tasks(list_scored_tasks()) if quick else list(list_scored_tasks())
    requested = list(make_entries(tasks, quick))
    records = _read_calibrated(clairvoyant, tasks)
    seeds = make_task_seeds(salt, episodes)
    results = measure(requested, seeds, jobs=jobs, console=console, keep=keep)
    calibrated = measure_calibrated(records, requested, jobs=jobs, console=console, keep=keep)
    suite = Suite("control", "Which controller and estimator hold the car", "")
    tiers = {tier: [c for c in tasks if c.tier == tier] for tier in TITLES}
    tiers = {tier: tier_tasks for tier, tier_tasks in tiers.items() if tier_tasks}
    by_tier, foresight, detail_tables = {}, _compute_foresight(records, calibrated), []
    for tier, tier_tasks in tiers.items():
        by_tier[tier] = rank_entries(results.outcomes, tier, make_score_scales(results, tier_tasks))
        for item in by_tier[tier]:
            if item.drives:
                item.us = measure_decision_time(
                    next(entry for entry in requested if _is_driven_entry(entry, item))
                )
            suite.rows += make_rows(item, salt)
        title = f"Tier {tier}: {TITLES[tier]}"
        note = " ".join(
            [
                _NOTE,
                *describe_findings(by_tier[tier]),
                *(_describe_policies() if tier == "1" else ()),
            ]
        )
        suite.tables.append(make_main_table(title, by_tier[tier], note))
        detail_tables += [
            make_task_table(f"{title}, contest by contest", by_tier[tier], tier_tasks)
        ]
        detail_tables += [make_motion_table(f"{title}: the motion", by_tier[tier])]
    suite.tables.append(make_knowledge_table(results, tiers, foresight))
    ladder = make_oracle_table(results, tasks, foresight)
    ladder.note += _describe_beaten(records, calibrated)
    suite.tables += [ladder, *detail_tables]
    late: list[Results] = []
    prices: list[DelayCost] = []
    if not quick:
        prices, late = measure_delay_cost(seeds(DELAY_TASK), jobs=jobs, console=console, keep=keep)
    suite.rows += _make_delay_rows(prices, episodes, salt)
    suite.tables += _make_failure_tables(results, late)
    suite.verdict = compose_verdict(by_tier, prices, foresight)
    add_figures(suite, by_tier, results, prices, foresight)
    spent = np.nansum(
        [c.seconds for item in (results, calibrated, *late) for c in item.outcomes.values()]
    )
    suite.text = f"{_TEXT} Driven in {spent / 60.0:.1f} CPU-minutes."
    return suite


_NOTE = (
    "won: share of the compared episodes that cost less than nominal's. worst 5 %: their mean "
    "cost. contests: with an episode that counts. left out: episodes that nominal or oracle-state "
    "did not survive. A decision is the estimator's step and the controller's, of one car."
)


def _is_driven_entry(entry: ControlEntry, standing: Standing) -> bool:
    """Whether it is a cell that the contestant drove without an error."""
    same = (entry.controller, entry.estimator) == (
        standing.entry.controller,
        standing.entry.estimator,
    )
    return same and entry.task in standing.drives


def _read_calibrated(
    path: Path | None, tasks: Sequence[ControlTask]
) -> dict[ControlTask, CalibrationRecord]:
    """The clairvoyant's entries of contests; ValueError where one is stale."""
    path = FILE if path is None and FILE.is_file() else path
    if path is None:
        return {}
    read = read_calibration(path)
    records = {task: record for task, record in read.items() if task in tasks}
    check_current(records, path)
    return records


def _compute_foresight(
    records: Mapping[ControlTask, CalibrationRecord], calibrated: Results
) -> dict[ControlTask, Array]:
    """(n,) log(J_oracle-state / J_clairvoyant) of each calibrated contest."""
    return {
        c.task: regret
        for c, regret in compute_regrets(records, calibrated).items()
        if c.controller == STATE
    }


def _describe_beaten(records: Mapping[ControlTask, CalibrationRecord], calibrated: Results) -> str:
    """Who costs less than the clairvoyant on its own seeds."""
    if not records:
        return ""
    regrets = compute_regrets(records, calibrated)
    names = [f"{entry.label} ({entry.task.name})" for entry in regrets]
    below = find_below_optimum(names, list(regrets.values()))
    summary = f"below it: {'; '.join(below)}" if below else "nobody is below it (Holm-corrected)"
    return f" On the clairvoyant's seeds {summary}."


def _describe_policies() -> list[str]:
    """The training of the policies in the table."""
    names = [name for pairs in LEARNED.values() for _, name in pairs if is_policy(name)]
    cards = {name: load_policy(name).card for name in names}
    return [
        f"{name}: {card.algorithm}, {card.steps:.2g} steps of {card.env_id} in "
        f"{card.cpu_seconds:.0f} CPU-s, for the reference {card.reference}."
        for name, card in cards.items()
    ]


def _make_failure_tables(results: Results, late: Sequence[Results]) -> list[ResultTable]:
    lines = list_failures(results)
    for delay, delayed in zip(DELAYS, late, strict=False):
        lines += list_failures(delayed, delay)
    if not lines:
        return []
    header = ("tier", "contest", "controller and estimator", "what happened")
    note = (
        "The share of a cell's episodes; the rest of a failed one is charged at the highest cost."
    )
    return [ResultTable("Cells that went wrong", header, lines, note, keyed=False)]


def _make_delay_rows(prices: Sequence[DelayCost], n: int, salt: str) -> list[ResultRow]:
    """Rows of the price of delay; the scenario has the delay."""
    return [
        ResultRow.from_estimate(
            "cost_vs_nominal",
            ratio,
            suite="control",
            scenario=f"{DELAY_TASK.name}, sensors {1e3 * delay:.0f} ms late",
            estimator=price.entry.estimator,
            controller=price.entry.controller,
            n=n,
            salt=salt,
            env_version=f"{DELAY_TASK.env_id} {__version__}",
        )
        for price in prices
        for delay, ratio in zip(DELAYS[: len(price.over)], price.over, strict=True)
        if np.isfinite(ratio.value)
    ]
