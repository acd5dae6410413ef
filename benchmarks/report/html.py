"""The report: what the suites found as one HTML file that needs nothing from the network.

The page is `page.html`, its looks `report.css`, what it does `report.js` and `explorer.js`, all
beside this module and put together into one file. The page's own policy forbids it to load more.
"""

import base64
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from ...envs.rendering.palette import INK, base, colour
from ..harness.results import Suite, Table, write_text


def write_report(
    path: str | Path, suites: list[Suite], command: str, environment: Mapping[str, str]
) -> None:
    """Write one self-contained HTML file with every suite's text, tables and figures.

    command: the command line that made it. environment: versions by name. A figure's own title
    and template are left out: the page has its title above it and draws it light or dark.
    Raises ValueError for no suite or a table whose rows are not as long as its header,
    ModuleNotFoundError for figures without plotly. Nothing is left half-written.
    """
    if not suites:
        raise ValueError("a report needs at least one suite")
    made = {"made": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"), **environment}
    drawn = any(suite.figures or suite.explorers for suite in suites)
    page = Template(_beside("page.html") + "\n").substitute(
        suites=", ".join(escape(suite.name) for suite in suites),
        css=_beside("report.css"),
        js=_beside("report.js") + "\n\n" + _beside("explorer.js"),
        plotly=f"<script>{_plotly()}</script>\n" if drawn else "",
        command=escape(command),
        made=" · ".join(f"{escape(name)} <b>{escape(value)}</b>" for name, value in made.items()),
        contents="\n".join(
            f'<li><a href="#{link}">{escape(title)}</a></li>'
            for link, title in [("summary", "What wins"), *_links(suites)]
        ),
        summary="\n".join(
            f'<h3><a href="#{link}">{escape(title)}</a></h3>\n'
            + "\n".join(map(_table, suite.tables[:2]))  # a suite's main comparisons
            for (link, title), suite in zip(_links(suites), suites, strict=True)
            if suite.tables
        ),
        sections="\n".join(
            _section(link, suite) for (link, _), suite in zip(_links(suites), suites, strict=True)
        ),
    )
    write_text(path, page)


def number(cell: str) -> float | None:
    """The number a cell begins with, None for one that begins with none (or with NaN).

    >>> number("0.31 [0.29, 0.33]"), number("-1,250 N m"), number("< 2e-3"), number("2-dof")
    (0.31, -1250.0, 0.002, None)
    """
    found = _NUMBER.match(cell)
    if not found:
        return None
    sign = -1.0 if found["sign"] in ("-", "\u2212") else 1.0
    if found["inf"]:
        return sign * math.inf
    return sign * float(re.sub(r"[,\u00a0\u202f]", "", found["digits"]).replace("\u2212", "-"))


_NUMBER = re.compile(
    r"\s*[\[(<>≤≥~≈±]*\s*(?P<sign>[-+\u2212])?"
    r"(?:(?P<inf>inf\b|∞)"
    r"|(?P<digits>(?>\d+(?:[,\u00a0\u202f]\d{3})*(?:\.\d*)?|\.\d+)(?>e[-+\u2212]?\d+)?)(?!-\w))",
    re.IGNORECASE,
)
_LONG = 40  # letters: a longer cell wraps
_BLANK = {"", "-", "\u2013", "\u2014", "nan", "n/a"}


def numeric(cells: Iterable[str]) -> bool:
    """Whether a column is one of numbers: some, and nothing else but blanks."""
    texts = [cell for cell in cells if cell.strip().lower() not in _BLANK]
    return bool(texts) and all(number(cell) is not None for cell in texts)


def _table(table: Table) -> str:
    for row in table.cells:
        if len(row) != len(table.header):
            raise ValueError(
                f"table {table.title!r}: {len(row)} cells under {len(table.header)} headers: {row}"
            )
    columns = list(zip(*table.cells, strict=True)) or [()] * len(table.header)
    are_numbers = [numeric(column) for column in columns]
    heads = "".join(
        f'<th scope="col" aria-sort="none"{_number_class(is_number)}>'
        f'<button type="button">{escape(name)}</button></th>'
        for name, is_number in zip(table.header, are_numbers, strict=True)
    )
    body = "\n".join(f"<tr>{_row(row, are_numbers, table.keyed)}</tr>" for row in table.cells)
    title = escape(table.title)
    note = f'\n<p class="note">{_inline(table.note)}</p>' if table.note else ""
    return (
        f'<p class="caption">{title}</p>\n'
        f'<div class="scroll" role="region" tabindex="0" aria-label="{title}">\n'
        f'<table class="sortable" aria-label="{title}">\n'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>{note}"
    )


def _row(row: Sequence[str], numeric: Sequence[bool], keyed: bool) -> str:
    cells = []
    for i, (cell, is_number) in enumerate(zip(row, numeric, strict=True)):
        value = number(cell) if is_number else None
        data = "" if value is None else f' data-value="{_plain(value)}"'
        tag, key = ('th scope="row"', _key(cell) if keyed else "") if i == 0 else ("td", "")
        kind = ' class="long"' if len(cell) > _LONG else _number_class(is_number)
        cells.append(f"<{tag}{kind}{data}>{key}{escape(cell)}</{tag[:2]}>")
    return "".join(cells)


def _number_class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""


def _plain(value: float) -> str:
    """A number as JavaScript reads it."""
    return repr(value) if math.isfinite(value) else "-Infinity" if value < 0 else "Infinity"


def _key(cell: str) -> str:
    """The colour of an estimator or controller in the figures, as a small square."""
    if base(cell) is None:
        return ""
    shade = colour(cell)
    return f'<i class="key" style="background:{"var(--ink)" if shade == INK else shade}"></i>'


def _section(link: str, suite: Suite) -> str:
    blocks = [f"<h2>{escape(suite.title)}</h2>"]
    blocks += [f"<p>{_inline(part)}</p>" for part in suite.text.split("\n\n") if part.strip()]
    blocks += [_table(table) for table in suite.tables]
    blocks += [explorer.html() for explorer in suite.explorers]
    blocks += [
        f"<figure>\n<h3>{escape(title)}</h3>\n"
        f'<div class="plot" role="img" aria-label="{escape(title)}"></div>\n'
        f'<script type="application/json">{_json(figure)}</script>\n'
        f"<figcaption>{_inline(caption)}</figcaption>\n</figure>"
        for title, figure, caption in suite.figures
    ]
    blocks += [_download(*file) for file in suite.files]
    return f'<section id="{link}">\n' + "\n".join(blocks) + "\n</section>"


def _download(name: str, media: str, text: str) -> str:
    data = base64.b64encode(text.encode()).decode()
    return (
        f'<p class="file"><a download="{escape(name)}" href="data:{media};base64,{data}">'
        f"{escape(name)}</a></p>"
    )


def _links(suites: Sequence[Suite]) -> list[tuple[str, str]]:
    return [(f"suite-{i}", suite.title) for i, suite in enumerate(suites, 1)]


def _inline(text: str) -> str:
    """Escaped text; what stands in backticks becomes code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def _json(figure: Any) -> str:
    """A figure's data and layout; no text in it can end the script that holds it."""
    from plotly.utils import PlotlyJSONEncoder

    content = figure.to_plotly_json()
    for name in ("template", "title"):
        content["layout"].pop(name, None)
    plain = {name: content[name] for name in ("data", "layout", "frames") if content.get(name)}
    text = json.dumps(plain, cls=PlotlyJSONEncoder, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def _beside(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8").strip()
