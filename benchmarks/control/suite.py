"""The suite `control`: which estimator and controller hold the car, and how far from the oracles?

All pairs of both drive the scored tasks of four tiers on salted seeds.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from ... import __version__
from ...agents.learned.policy import is_policy, load_policy
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
    """Run all tiers, the baselines, the cost of delay, and the pictures.

    Args:
        episodes: Episodes of an entry (slow controllers have at most 64).
        jobs: Processes, None for all processors.
        console: Where progress is shown.
        keep: Folder in which finished cases stay, so that a run that was stopped goes on.
        quick: Whether few tasks are driven, without the slow controllers and the cost of delay.
        clairvoyant: File of `sideslip calibrate`, None for the package's, if there is one.
        salt: Salt of the seeds, "" for `make_salt`'s.

    Returns:
        Suite with verdict, tables and figures.
    """
    salt = salt or make_salt()
    tasks = select_quick_tasks(list_scored_tasks()) if quick else list(list_scored_tasks())
    requested = list(make_entries(tasks, quick))
    records = _read_calibrated(clairvoyant, tasks)
    seeds = make_task_seeds(salt, episodes)
    results = measure(requested, seeds, jobs=jobs, console=console, keep=keep)
    calibrated = measure_calibrated(records, requested, jobs=jobs, console=console, keep=keep)
    suite = Suite("control", "Which controller and estimator hold the car", "")
    names = {task.tier for task in tasks}
    tiers = {tier: [c for c in tasks if c.tier == tier] for tier in TITLES if tier in names}
    regrets = compute_regrets(records, calibrated).items()
    foresight = {entry.task: regret for entry, regret in regrets if entry.controller == STATE}
    by_tier, detail_tables = dict[str, list[Standing]](), list[ResultTable]()
    for tier, tier_tasks in tiers.items():
        by_tier[tier] = rank_entries(results.outcomes, tier, make_score_scales(results, tier_tasks))
        for item in by_tier[tier]:
            if item.drives:
                item.us = measure_decision_time(_find_driven_entry(requested, item))
            suite.rows += make_rows(item, salt)
        title, ranked = f"Tier {tier}: {TITLES[tier]}", by_tier[tier]
        trainings = _describe_policies() if tier == "1" else []
        note = " ".join([_NOTE, *describe_findings(ranked), *trainings])
        suite.tables.append(make_main_table(title, ranked, note))
        detail_tables += [make_task_table(f"{title}, contest by contest", ranked, tier_tasks)]
        detail_tables += [make_motion_table(f"{title}: the motion", ranked)]
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
    outcomes = [drive for x in (results, calibrated, *late) for drive in x.outcomes.values()]
    spent = np.nansum([drive.seconds for drive in outcomes])
    suite.text = f"{_TEXT} Driven in {spent / 60.0:.1f} CPU-minutes."
    return suite


_NOTE = (
    "won: share of the compared episodes that cost less than nominal's. worst 5 %: their mean "
    "cost. contests: with an episode that counts. left out: episodes that nominal or oracle-state "
    "did not survive. A decision is the estimator's step and the controller's, of one car."
)


def _find_driven_entry(entries: Sequence[ControlEntry], standing: Standing) -> ControlEntry:
    """The first entry that the contestant drove without an error."""
    pair = (standing.entry.controller, standing.entry.estimator)
    driven = (entry for entry in entries if (entry.controller, entry.estimator) == pair)
    return next(entry for entry in driven if entry.task in standing.drives)


def _read_calibrated(
    path: Path | None, tasks: Sequence[ControlTask]
) -> dict[ControlTask, CalibrationRecord]:
    """The clairvoyant's records of tasks; ValueError where one is stale."""
    path = FILE if path is None and FILE.is_file() else path
    if path is None:
        return {}
    records = {task: record for task, record in read_calibration(path).items() if task in tasks}
    check_current(records, path)
    return records


def _describe_beaten(records: Mapping[ControlTask, CalibrationRecord], calibrated: Results) -> str:
    """Sentence on who costs less than the clairvoyant on its seeds."""
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
    """Table of the entries that went wrong, also with late sensors; none without such."""
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
    """Rows of the cost of delay; the scenario has the delay."""
    version, rows = f"{DELAY_TASK.env_id} {__version__}", []
    common = {"suite": "control", "n": n, "salt": salt, "env_version": version}
    for price in prices:
        labels = {"estimator": price.entry.estimator, "controller": price.entry.controller}
        for delay, ratio in zip(DELAYS[: len(price.over)], price.over, strict=True):
            scenario = f"{DELAY_TASK.name}, sensors {1e3 * delay:.0f} ms late"
            if np.isfinite(ratio.value):
                columns = {"scenario": scenario, **labels, **common}
                rows.append(ResultRow.from_estimate("cost_vs_nominal", ratio, **columns))
    return rows
