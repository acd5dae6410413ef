"""Suites on the screen: the verdict first, and tables that fit its width."""

from collections.abc import Sequence
from dataclasses import replace

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from ..harness.results import ResultTable, Suite
from .html import is_numeric

_NAME = 32  # letters: a longer text in a table's first column is no name and may wrap
_MIN_WIDTH = 22  # letters that a column of text has at least, and the first one on a narrow screen
_NARROW = 80  # columns
_FEW, _ROWS = 2, 20  # suites of a run whose tables are printed, and the rows of all of them


def print_run(console: Console, suites: Sequence[Suite], reported: bool) -> None:
    """Print a run in about 60 lines: verdicts, up to two tables, and where the rest is.

    Args:
        console: Console to print to.
        suites: Results; of more than two only one line of each verdict is printed.
        reported: Whether a report has the rest.
    """
    is_short = len(suites) <= _FEW
    for suite in suites:
        _print_title(console, suite)
        lines = suite.headlines
        if not is_short:
            lines = lines[1:2] or lines  # a verdict's second line is the answer
        console.print(f"[bold]{escape(chr(10).join(lines))}[/]\n", highlight=False)
        shown = [table for table in suite.tables if not table.detail]
        for table in shown[: int(is_short)]:  # the first table of a short run, else none
            max_rows = _ROWS // len(suites)
            left = len(table.cells) - max_rows
            cut = replace(table, cells=table.cells[:max_rows]) if left > 0 else table
            console.print(_make_rich_table(_split_table(cut, console.width)[0], console.width))
            if left > 0:
                console.print(f"[dim]and {left} rows more[/]\n", highlight=False)
    count = sum(len(suite.tables) for suite in suites)
    where = "in the report" if reported else "in a report: --html FILE"
    console.print(f"All {count} tables, with notes and figures, are {where}.", highlight=False)


def _print_title(console: Console, suite: Suite) -> None:
    if len(suite.title) + 4 <= console.width:
        console.rule(f"[bold]{escape(suite.title)}")
    else:  # a rule would cut it
        console.print(f"\n[bold]{escape(suite.title)}[/]", highlight=False)


def print_suite(console: Console, suite: Suite) -> None:
    """Print title, verdict, text, and each table with its note, without tables of details.

    Args:
        console: Console to print to.
        suite: Results.
    """
    _print_title(console, suite)
    if suite.verdict:
        console.print(f"[bold]{escape(chr(10).join(suite.headlines))}[/]\n", highlight=False)
    console.print(f"{escape(suite.text)}\n", highlight=False)
    shown = [table for table in suite.tables if not table.detail]
    for table in shown:
        for part in _split_table(table, console.width):
            console.print(_make_rich_table(part, console.width))
        if table.note:
            console.print(f"[dim]{escape(table.note)}[/]\n", highlight=False)
    if more := len(suite.tables) - len(shown):
        count = f"{more} tables more are" if more > 1 else "1 table more is"
        console.print(f"{count} in the report (--html).\n", highlight=False)


def _split_table(table: ResultTable, width: int) -> list[ResultTable]:
    """Split a table into parts of as many columns as the width takes, the first in all."""
    columns = list(zip(table.header, *table.cells, strict=True))
    lengths = [max(map(len, column)) for column in columns]
    widths = [
        (length if is_numeric(column[1:]) else min(length, _MIN_WIDTH)) + 2
        for length, column in zip(lengths, columns, strict=True)
    ]
    groups: list[list[int]] = [[0]]
    used = first = min(widths[0], _choose_width(width) + 2) + 2
    for i in range(1, len(columns)):
        if used + widths[i] > width and len(groups[-1]) > 1:
            groups.append([0])
            used = first
        groups[-1].append(i)
        used += widths[i]
    parts = list[ResultTable]()
    for group in groups:
        header = [table.header[i] for i in group]
        cells = [[row[i] for i in group] for row in table.cells]
        title = f"{table.title} (continued)" if parts else table.title
        parts.append(replace(table, title=title, header=header, cells=cells))
    return parts


def _choose_width(width: int) -> int:
    """Choose the maximum of letters in the first column by the width of the screen (letters)."""
    return _NAME if width >= _NARROW else _MIN_WIDTH


def _make_rich_table(table: ResultTable, width: int) -> RichTable:
    """Make a table with numbers to the right and whole, texts to the left and wrapped."""
    title, style = table.title, box.SIMPLE_HEAD
    shown = RichTable(title=title, title_justify="left", box=style, padding=(0, 1, 0, 0))
    columns = zip(*table.cells, strict=True) if table.cells else [()] * len(table.header)
    for i, (name, column) in enumerate(zip(table.header, columns, strict=True)):
        right = i > 0 and is_numeric(column)
        longest = max(map(len, column), default=0)
        shown.add_column(
            name,
            justify="right" if right else "left",
            no_wrap=right,
            min_width=min(longest, _choose_width(width)) if i == 0 else None,
            overflow="fold",  # a long word goes on in the next line
        )
    for row in table.cells:
        shown.add_row(*map(escape, row))
    return shown
