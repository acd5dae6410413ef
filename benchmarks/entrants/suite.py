"""The open benchmark as a suite: verdict, tables, rows."""

from pathlib import Path

from rich.console import Console

from ..control.ladder import refusals_of
from ..control.tables import contest_table, rows_of
from ..harness.results import Suite, Table
from .challenge import Challenge
from .compare import compare
from .verdict import table, verdict

_TEXT = "Everybody drives the same episodes; an agent of yours on nominal's filter, or on yours."


def run(
    challenge: Challenge,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> Suite:
    """A challenge, driven. keep: a folder for the baselines' finished cases."""
    found = compare(challenge, jobs, console, keep)
    suite = Suite("control", "Your own beside the package's", _TEXT)
    suite.verdict = "\n".join(verdict(found))
    suite.tables += [table(found)]
    title = "Contest by contest"
    suite.tables += [contest_table(title, found.overall, found.contests)]
    lines = [line[1:] for line in refusals_of(found.results)]
    if lines:
        header = ("contest", "contestant", "what happened")
        suite.tables.append(Table("Cells that went wrong", header, lines, keyed=False))
    for tier in dict.fromkeys(contest.tier for contest in found.contests):
        for each in found.standings(tier):
            suite.rows += rows_of(each, found.salt)
    return suite
