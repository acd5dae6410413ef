"""A suite's text and tables on the screen."""

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from .rows import Suite, Table

_NAME = 32  # letters: a longer text in a table's first column is no name and may wrap
_LEAST = 22  # letters that the first column keeps on a narrow screen


def print_suite(console: Console, suite: Suite) -> None:
    """The title, the text, and each table with its note."""
    console.rule(f"[bold]{suite.title}")
    console.print(escape(suite.text) + "\n", highlight=False)
    for table in suite.tables:
        console.print(_rich(table))
        if table.note:
            console.print(f"[dim]{escape(table.note)}[/]\n", highlight=False)


def _rich(table: Table) -> RichTable:
    """Columns of numbers to the right and whole, those of text to the left, wrapped if long."""
    from .report import numeric

    shown = RichTable(
        title=table.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    columns = zip(*table.cells, strict=True) if table.cells else [()] * len(table.header)
    for i, (name, column) in enumerate(zip(table.header, columns, strict=True)):
        right = i > 0 and numeric(column)
        longest = max(map(len, column), default=0)
        shown.add_column(
            name,
            justify="right" if right else "left",
            no_wrap=right or (i == 0 and longest <= _NAME),
            min_width=min(longest, _LEAST) if i == 0 else None,
        )
    for row in table.cells:
        shown.add_row(*map(escape, row))
    return shown
