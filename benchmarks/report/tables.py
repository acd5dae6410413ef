"""Tables as texts, the one place where numbers are formatted for people; suites on the screen."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from ..harness.results import Cell, Column, ResultTable, Suite
from ..harness.stats import Estimate

_NAME = 32  # letters: a longer text in a table's first column is no name and may wrap
_MIN_WIDTH = 22  # letters that a column of text has at least, and the first one on a narrow screen
_NARROW = 80  # columns
_FEW, _ROWS = 2, 20  # suites of a run whose tables are printed, and the rows of all of them


class TextColumn(NamedTuple):
    """A column of a table as people read it."""

    heading: str
    texts: list[str]
    values: list[float | None]  # numbers by which lines are sorted, in the heading's unit

    @property
    def is_numeric(self) -> bool:
        """Whether the column has numbers, and beside them only empty cells."""
        texts = zip(self.values, self.texts, strict=True)
        numbers = [value is not None for value, text in texts if text]
        return bool(numbers) and all(numbers)


def format_columns(table: ResultTable) -> list[TextColumn]:
    """Format the columns of a table."""
    columns = []
    for i, source in enumerate(table.columns):
        column = source if isinstance(source, Column) else Column(str(source))
        cells = [x.get(column.key) if isinstance(x, Mapping) else x[i] for x in table.cells]
        texts = [_format_cell(cell, column) for cell in cells]
        values = [_get_value(cell, column.scale) for cell in cells]
        columns.append(TextColumn(column.heading or column.key, texts, values))
    return columns


def _format_cell(cell: Cell, column: Column) -> str:
    """Format a cell: a number with its interval in brackets, nothing for NaN."""
    if isinstance(cell, str):
        return cell
    if _get_value(cell) is None or cell is None:
        return ""
    if isinstance(cell, Estimate):
        shown = cell if column.interval else Estimate(cell.value)
        return shown.inline(column.scale, column.form)
    numbers = cell if isinstance(cell, tuple) else (float(cell),)
    scaled = [column.scale * number for number in numbers]
    if "{" in column.form:
        return column.form.format(*scaled)
    return ", ".join(f"{number:{column.form}}" for number in scaled)


def _get_value(cell: Cell, scale: float = 1.0) -> float | None:
    """The number, the first of several; None for a text and NaN."""
    if cell is None or isinstance(cell, str):
        return None
    value = scale * float(cell[0] if isinstance(cell, tuple) else cell)
    return None if math.isnan(value) else value


def print_run(console: Console, suites: Sequence[Suite], reported: bool) -> None:
    """Print a run in about 60 lines: verdicts, up to two tables, and where the rest is.

    Args:
        console: Console to print to.
        suites: Results; of more than two only one line of each verdict is printed.
        reported: Whether a report has the rest.
    """
    is_short = len(suites) <= _FEW
    for suite in suites:
        lines = suite.headlines
        # a verdict's second line is the answer
        _print_head(console, suite, lines if is_short else lines[1:2] or lines)
        shown = [table for table in suite.tables if not table.detail]
        for table in shown[: int(is_short)]:  # the first table of a short run, else none
            max_rows = _ROWS // len(suites)
            left = len(table.cells) - max_rows
            cut = replace(table, cells=table.cells[:max_rows]) if left > 0 else table
            part = _split_table(cut, console)[0]
            console.print(_make_rich_table(table.title, part, console.width))
            if left > 0:
                console.print(f"[dim]and {left} rows more[/]\n", highlight=False)
    count = sum(len(suite.tables) for suite in suites)
    where = "in the report" if reported else "in a report: --html FILE"
    text = f"All {count} tables, with notes and figures, are" if count > 1 else "The table is"
    console.print(f"{text} {where}.", highlight=False)


def _print_head(console: Console, suite: Suite, lines: Sequence[str]) -> None:
    """Print the title and some lines of the verdict."""
    if len(suite.title) + 4 <= console.width:
        console.rule(f"[bold]{escape(suite.title)}")
    else:  # a rule would cut it
        console.print(f"\n[bold]{escape(suite.title)}[/]", highlight=False)
    if lines:
        console.print(f"[bold]{escape(chr(10).join(lines))}[/]\n", highlight=False)


def print_suite(console: Console, suite: Suite) -> None:
    """Print title, verdict, text, and each table with its note, without tables of details."""
    _print_head(console, suite, suite.headlines)
    console.print(f"{escape(suite.text)}\n", highlight=False)
    shown = [table for table in suite.tables if not table.detail]
    for table in shown:
        for i, part in enumerate(_split_table(table, console)):
            title = f"{table.title} (continued)" if i else table.title
            console.print(_make_rich_table(title, part, console.width))
        if table.note:
            console.print(f"[dim]{escape(table.note)}[/]\n", highlight=False)
    if more := len(suite.tables) - len(shown):
        count = f"{more} tables more are" if more > 1 else "1 table more is"
        console.print(f"{count} in the report (--html).\n", highlight=False)


def _split_table(table: ResultTable, console: Console) -> list[list[TextColumn]]:
    """Split a table into parts of as many columns as the screen takes, the first in all."""
    first, *columns = format_columns(table)
    parts, unlimited = [[first]], console.options.update(max_width=10**6)
    for column in columns:
        wider = _make_rich_table("", [*parts[-1], column], console.width)
        if len(parts[-1]) > 1 and console.measure(wider, options=unlimited).minimum > console.width:
            parts.append([first])
        parts[-1].append(column)
    return parts


def _make_rich_table(title: str, columns: list[TextColumn], width: int) -> RichTable:
    """Make a table with numbers to the right and whole, texts to the left and wrapped."""
    style = box.SIMPLE_HEAD
    shown = RichTable(title=title, title_justify="left", box=style, padding=(0, 1, 0, 0))
    for i, column in enumerate(columns):
        right = i > 0 and column.is_numeric
        longest = max(map(len, [column.heading, *column.texts]))
        limit = _NAME if i == 0 and width >= _NARROW else _MIN_WIDTH
        shown.add_column(
            escape(column.heading),
            justify="right" if right else "left",
            no_wrap=right,
            min_width=longest if right else min(longest, limit),
            overflow="fold",  # a long word goes on in the next line
        )
    for line in zip(*(column.texts for column in columns), strict=True):
        shown.add_row(*map(escape, line))
    return shown
