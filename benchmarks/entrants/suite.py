"""The open benchmark as a suite: verdict, tables, rows."""

from pathlib import Path

from rich.console import Console

from ..control.ladder import list_failures
from ..control.tables import make_rows, make_task_table
from ..harness.results import ResultTable, Suite
from .challenge import ComparisonRequest
from .compare import compare
from .verdict import compose_verdict, make_table

_TEXT = "Everybody drives the same episodes; an agent of yours on nominal's filter, or on yours."


def run(
    request: ComparisonRequest,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> Suite:
    """A challenge, driven. keep: a folder for the baselines' finished cases."""
    comparison = compare(request, jobs, console, keep)
    suite = Suite("control", "Your own beside the package's", _TEXT)
    suite.verdict = "\n".join(compose_verdict(comparison))
    suite.tables += [make_table(comparison)]
    title = "Contest by contest"
    suite.tables += [make_task_table(title, comparison.overall, comparison.tasks)]
    lines = [line[1:] for line in list_failures(comparison.results)]
    if lines:
        header = ("contest", "contestant", "what happened")
        suite.tables.append(ResultTable("Cells that went wrong", header, lines, keyed=False))
    for tier in dict.fromkeys(task.tier for task in comparison.tasks):
        for standing in comparison.standings(tier):
            suite.rows += make_rows(standing, comparison.salt)
    return suite
