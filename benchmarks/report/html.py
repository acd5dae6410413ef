"""The report as one HTML file that needs no network, and tables in Markdown pages.

The page is `page.html` with `report.css`, `report.js` and `explorer.js` beside this module. plotly
and the figures lie in it as gzip in base64. Its policy lets no script run but ours, by its hash.
"""

import base64
import gzip
import hashlib
import json
import re
import textwrap
from collections.abc import Sequence
from datetime import datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...envs.rendering.palette import INK, find_base, find_colour
from ..harness.results import Explorer, ResultTable, Suite, write_text
from .tables import TextColumn, format_columns

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_MAX_LETTERS = 40  # letters: a longer cell wraps


def _format_table(table: ResultTable) -> str:
    """Format a folded table."""
    columns = format_columns(table)
    heads = "".join(
        f'<th scope="col" aria-sort="none"{_format_class(column.is_numeric)}>'
        f'<button type="button">{escape(column.heading)}</button></th>'
        for column in columns
    )
    cells = [_format_column(column, i == 0, table.keyed) for i, column in enumerate(columns)]
    body = "\n".join(f"<tr>{''.join(line)}</tr>" for line in zip(*cells, strict=True))
    title = escape(table.title)
    note = f'\n<p class="note">{_mark_code(table.note)}</p>' if table.note else ""
    return (
        f"<details{' open' * table.opened}><summary>{title}</summary>\n"
        f'<div class="scroll" role="region" tabindex="0" aria-label="{title}">\n'
        f'<table class="sortable" aria-label="{title}">\n'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>{note}</details>"
    )


def _format_column(column: TextColumn, is_first: bool, keyed: bool) -> list[str]:
    cells = []
    for text, value in zip(column.texts, column.values, strict=True):
        has_value = column.is_numeric and value is not None
        data = f' data-value="{value!r}"'.replace("inf", "Infinity") if has_value else ""
        tag = 'th scope="row"' if is_first else "td"
        key = ""
        if is_first and keyed and find_base(text) is not None:  # its colour as a small square
            shade = find_colour(text).replace(INK, "var(--ink)")
            key = f'<i class="key" style="background:{shade}"></i>'
        kind = ' class="long"' if len(text) > _MAX_LETTERS else _format_class(column.is_numeric)
        cells.append(f"<{tag}{kind}{data}>{key}{escape(text)}</{tag[:2]}>")
    return cells


def _format_class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""


def _mark_code(text: str) -> str:
    """Escape a text; what stands in backticks becomes code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def _format_page_table(table: ResultTable) -> str:
    """Format a heading, the table, and its note in lines of 120."""
    columns = format_columns(table)
    lines = zip(*([column.heading, *column.texts] for column in columns), strict=True)
    head, *rows = ([text.replace("|", r"\|") for text in line] for line in lines)
    shown = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    shown.insert(1, "|---" * len(head) + "|")
    note = textwrap.fill(table.note, 120, break_long_words=False, break_on_hyphens=False)
    note = f"\n{note}\n" if table.note else ""
    return "\n".join([f"## {table.title}", "", *shown, ""]) + note


def check_page(path: Path | None, names: Sequence[str]) -> None:
    """Check that a page has marks for a suite that is asked for; ValueError otherwise.

    Args:
        path: File of the page, None for none.
        names: Names of the suites.
    """
    if path is not None:
        text = path.read_text(encoding="utf-8")
        if not any(_compile_pattern(name).search(text) for name in names):
            marks = "<!-- tables of SUITE --> and <!-- end --> for one of"
            raise ValueError(f"{path}: expected the lines {marks} {', '.join(names)}")


def write_page(path: Path, suites: Sequence[Suite]) -> None:
    """Write a page with new tables of its marked suites, but for details."""
    text = path.read_text(encoding="utf-8")
    for suite in suites:
        made = "\n".join(_format_page_table(table) for table in suite.tables if not table.detail)
        before, *marked = _compile_pattern(suite.name).split(text, maxsplit=1)
        text = f"\n{made}\n".join((before, *marked))
    write_text(path, text)


def _compile_pattern(name: str) -> re.Pattern[str]:
    marked = rf"(?<=^<!-- tables of {re.escape(name)} -->\n).*?(?=^<!-- end -->$)"
    return re.compile(marked, re.MULTILINE | re.DOTALL)


_MIN_PACKED = 40  # a shorter array is left as it is
_LEVELS = {"x": 2**13, "y": 2**11}  # more than a screen has pixels


def _encode_steps(values: npt.ArrayLike, levels: int = _LEVELS["y"]) -> dict[str, object]:
    """Encode numbers as steps in quanta; null for a gap."""
    v = np.asarray(values, float)
    finite = np.isfinite(v)
    low, high = (float(v[finite].min()), float(v[finite].max())) if finite.any() else (0.0, 0.0)
    by = (high - low) / (levels - 1) or 1.0
    quanta = np.round((v[finite] - low) / by).astype(int)
    encoded = np.full(len(v), None)
    encoded[finite] = np.diff(quanta, prepend=0)
    return {"from": low, "by": by, "steps": encoded.tolist()}


def _encode_figure(figure: "Figure") -> str:
    """Encode a plotly figure's data and layout as JSON, without template and title."""
    from plotly.utils import PlotlyJSONEncoder

    content = figure.to_plotly_json()
    for name in ("template", "title"):
        content["layout"].pop(name, None)
    for trace, plain in zip(figure.data, content["data"], strict=True):
        for axis, levels in _LEVELS.items():
            values: Any = getattr(trace, axis, None)
            is_line = isinstance(values, np.ndarray) and values.ndim == 1
            if is_line and values.dtype.kind == "f" and len(values) > _MIN_PACKED:
                plain[axis] = _encode_steps(values, levels)
    plain = {name: content[name] for name in ("data", "layout") if content.get(name)}
    return json.dumps(plain, cls=PlotlyJSONEncoder, separators=(",", ":"))


POINTS = 250  # samples of a cell in a figure with menus
_FEW = 4  # figures of a suite; more are folded


def write_report(path: Path, suites: list[Suite], command: str, versions: dict[str, str]) -> None:
    """Write one self-contained HTML file: an answer, then every suite's verdict, pictures, tables.

    Args:
        path: File, written whole or not at all.
        suites: Results of one suite at least.
        command: Command line that made the suites.
        versions: Versions by name.
    """
    facts = {"made": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"), **versions}
    drawn = any(suite.answers or suite.figures or suite.explorers for suite in suites)
    script = _read_asset("report.js") + "\n\n" + _read_asset("explorer.js")
    plotly = ""
    if drawn:
        from plotly.offline import get_plotlyjs

        plotly = str(get_plotlyjs()).replace("\r\n", "\n")
    lead = next((suite for suite in suites if suite.name == "control"), suites[0])
    linked = [(f"suite-{i}", suite) for i, suite in enumerate(suites, 1)]
    page = Template(_read_asset("page.html") + "\n").substitute(
        suites=", ".join(escape(suite.name) for suite in suites),
        css=_read_asset("report.css"),
        allowed=" ".join(_hash(item) for item in (script, plotly) if item),
        js=script,
        plotly=_format_data("plotly", plotly) if drawn else "",
        command=escape(command),
        made=" · ".join(f"{escape(name)} <b>{escape(value)}</b>" for name, value in facts.items()),
        contents="\n".join(
            f'<li><a href="#{x}">{escape(suite.title)}</a></li>' for x, suite in linked
        ),
        answer=" ".join(_mark_code(line) for line in lead.headlines[:3]),
        picture="".join(_format_figure(*item) for item in lead.answers[:1]),
        sections="\n".join(_format_section(*item, int(item[1] is lead)) for item in linked),
    )
    write_text(path, page)


def _format_section(link: str, suite: Suite, opened: int) -> str:
    """Format a suite; opened: how many of its answers' pictures the page opens with."""
    blocks = [f"<h2>{escape(suite.title)}</h2>"]
    if suite.headlines:
        lines = "\n".join(f"<li>{_mark_code(line)}</li>" for line in suite.headlines)
        blocks.append(f'<ul class="verdict">\n{lines}\n</ul>')
    pictures = [_format_figure(*item) for item in suite.answers[opened:]]
    pictures += [_format_explorer(item) for item in suite.explorers]
    if pictures:
        blocks.append('<div class="pictures">\n' + "\n".join(pictures) + "\n</div>")
    blocks += [f"<p>{_mark_code(part)}</p>" for part in suite.text.split("\n\n") if part.strip()]
    figures = [_format_figure(*item) for item in suite.figures]
    if len(figures) > _FEW:
        inside = "\n".join(figures)
        figures = [f"<details><summary>{len(figures)} figures</summary>\n{inside}\n</details>"]
    blocks += figures
    blocks += [_format_table(table) for table in suite.tables]
    return f'<section id="{link}">\n' + "\n".join(blocks) + "\n</section>"


def _format_figure(title: str, figure: "Figure", caption: str) -> str:
    """Format a figure with its title and caption."""
    return (
        f'<figure>\n<h3>{escape(title)}</h3>\n<div class="frame">'
        f'<div class="plot" role="img" aria-label="{escape(title)}"></div></div>\n'
        f"{_format_data('figure', _encode_figure(figure))}\n"
        f"<figcaption>{_mark_code(caption)}</figcaption>\n</figure>"
    )


def _format_explorer(explorer: Explorer) -> str:
    """Format two cells side by side; `explorer.js` makes the menus and draws."""
    cells = []
    for key, signals in explorer.cells.items():  # POINTS samples at most, at the same places
        n = len(signals["t"])
        shown = np.unique(np.linspace(0, n - 1, min(n, POINTS)).astype(int))
        cells.append([list(key), {name: _encode_steps(y[shown]) for name, y in signals.items()}])
    content = {
        "menus": list(explorer.menus),
        "pair": list(explorer.pair),
        "panels": [
            {"label": label, "lines": [list(line) for line in lines]}
            for label, lines in explorer.panels.items()
        ],
        "bodies": [[list(key), list(size)] for key, size in explorer.bodies.items()],
        "colours": {key[-1]: find_colour(key[-1]) for key in explorer.cells},
        "cells": cells,
    }
    return (
        f'<figure class="explorer wide">\n<h3>{escape(explorer.title)}</h3>\n'
        f"{_format_data('explorer', json.dumps(content, separators=(',', ':')))}\n"
        f"<figcaption>{_mark_code(explorer.caption)}</figcaption>\n</figure>"
    )


def _format_data(name: str, text: str) -> str:
    """Pack a text for the page's `unpack`, which no browser runs; it gives the same letters."""
    packed = base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()
    return f'<script type="application/gzip" data-name="{name}">{packed}</script>'


def _hash(script: str) -> str:
    """Hash a script as the page's policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def _read_asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8").strip()
