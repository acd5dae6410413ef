"""Cells of tables as texts: the one place where numbers are formatted for people."""

import math
from typing import NamedTuple

from ..harness.results import Cell, Column, ResultTable
from ..harness.stats import Estimate


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
    """Format the columns of a table; ValueError for a line that is not as long.

    Args:
        table: Table.

    Returns:
        Texts and numbers of each column.
    """
    columns = []
    for column, cells in table.split():
        texts = [_format_cell(cell, column) for cell in cells]
        values = [_get_value(cell, column.scale) for cell in cells]
        columns.append(TextColumn(column.heading or column.key, texts, values))
    return columns


def _format_cell(cell: Cell, column: Column) -> str:
    """Format a cell: a number with its interval in brackets, nothing for NaN.

    >>> _format_cell(Estimate(0.0312, 0.03, 0.0325), Column("rmse", "RMSE / mrad", 1e3, ".1f"))
    '31.2 [30.0, 32.5]'
    >>> _format_cell((2.0, 3.5), Column("x", form="{:.0f} of {:.1f}")), _format_cell(7, Column("n"))
    ('2 of 3.5', '7')
    """
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
