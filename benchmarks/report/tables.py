"""Tables of the report: sortable, their numbers to the right, the names in their colours."""

import math
import re
from collections.abc import Iterable, Sequence
from html import escape

from ...envs.rendering.palette import INK, find_base, find_colour
from ..harness.results import ResultTable


def parse_number(cell: str) -> float | None:
    """The number a cell begins with, None for one that begins with none (or with NaN).

    >>> parse_number("0.31 [0.29, 0.33]"), parse_number("-1,250 N m")
    (0.31, -1250.0)
    >>> parse_number("< 2e-3"), parse_number("2-dof")
    (0.002, None)
    """
    match = _NUMBER.match(cell)
    if not match:
        return None
    sign = -1.0 if match["sign"] in ("-", "\u2212") else 1.0
    if match["inf"]:
        return sign * math.inf
    return sign * float(re.sub(r"[,\u00a0\u202f]", "", match["digits"]).replace("\u2212", "-"))


_NUMBER = re.compile(
    r"\s*[\[(<>≤≥~≈±]*\s*(?P<sign>[-+\u2212])?"
    r"(?:(?P<inf>inf\b|∞)"
    r"|(?P<digits>(?>\d+(?:[,\u00a0\u202f]\d{3})*(?:\.\d*)?|\.\d+)(?>e[-+\u2212]?\d+)?)(?!-\w))",
    re.IGNORECASE,
)
_LONG = 40  # letters: a longer cell wraps
_BLANK = {"", "-", "\u2013", "\u2014", "nan", "n/a"}


def is_numeric(cells: Iterable[str]) -> bool:
    """Whether a column is one of numbers: some, and nothing else but blanks."""
    texts = [cell for cell in cells if cell.strip().lower() not in _BLANK]
    return bool(texts) and all(parse_number(cell) is not None for cell in texts)


def format_table(table: ResultTable) -> str:
    """A table, folded; ValueError for a row that is not as long as the header."""
    for row in table.cells:
        if len(row) != len(table.header):
            raise ValueError(
                f"table {table.title!r}: {len(row)} cells under {len(table.header)} headers: {row}"
            )
    columns = list(zip(*table.cells, strict=True)) or [()] * len(table.header)
    are_numbers = [is_numeric(column) for column in columns]
    heads = "".join(
        f'<th scope="col" aria-sort="none"{_format_class(is_number)}>'
        f'<button type="button">{escape(name)}</button></th>'
        for name, is_number in zip(table.header, are_numbers, strict=True)
    )
    body = "\n".join(
        f"<tr>{_format_row(row, are_numbers, table.keyed)}</tr>" for row in table.cells
    )
    title = escape(table.title)
    note = f'\n<p class="note">{inline(table.note)}</p>' if table.note else ""
    return (
        f"<details><summary>{title}</summary>\n"
        f'<div class="scroll" role="region" tabindex="0" aria-label="{title}">\n'
        f'<table class="sortable" aria-label="{title}">\n'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>{note}</details>"
    )


def _format_row(row: Sequence[str], numeric: Sequence[bool], keyed: bool) -> str:
    cells = []
    for i, (cell, is_number) in enumerate(zip(row, numeric, strict=True)):
        value = parse_number(cell) if is_number else None
        data = "" if value is None else f' data-value="{_format_number(value)}"'
        tag, key = ('th scope="row"', _format_key(cell) if keyed else "") if i == 0 else ("td", "")
        kind = ' class="long"' if len(cell) > _LONG else _format_class(is_number)
        cells.append(f"<{tag}{kind}{data}>{key}{escape(cell)}</{tag[:2]}>")
    return "".join(cells)


def _format_class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""


def _format_number(value: float) -> str:
    """A number as JavaScript reads it."""
    return repr(value) if math.isfinite(value) else "-Infinity" if value < 0 else "Infinity"


def _format_key(cell: str) -> str:
    """The colour of an estimator or controller in the figures, as a small square."""
    if find_base(cell) is None:
        return ""
    shade = find_colour(cell)
    return f'<i class="key" style="background:{"var(--ink)" if shade == INK else shade}"></i>'


def inline(text: str) -> str:
    """Escaped text; what stands in backticks becomes code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))
