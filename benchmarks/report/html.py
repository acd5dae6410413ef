"""The report: what the suites found as one HTML file that needs nothing from the network.

The page is `page.html`, its looks `report.css`, what it does `report.js` and `explorer.js`, all
beside this module and put together into one file. plotly.js and the figures lie in it packed. The
page's own policy lets no script run but ours, by its hash, and nothing be loaded.
"""

import base64
import hashlib
import json
from collections.abc import Mapping
from datetime import datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ...envs.rendering.palette import find_colour
from ..harness.explorer import Explorer
from ..harness.results import Suite, write_text
from .pack import encode_figure, encode_steps, pack_text
from .tables import format_table, inline

POINTS = 250
"""Samples of a cell in a figure with menus."""
_FEW = 4  # figures of a suite; more are folded


def write_report(
    path: str | Path, suites: list[Suite], command: str, environment: Mapping[str, str]
) -> None:
    """Write one self-contained HTML file: an answer with a picture, the matrix's where it was run,
    then every suite's verdict, pictures, text and tables.

    command: the command line that made it. environment: versions by name. A figure's own title
    and template are left out: the page has its title above it and draws it light or dark.
    Raises ValueError for no suite or a table whose rows are not as long as its header,
    ModuleNotFoundError for figures without plotly. Nothing is left half-written.
    """
    if not suites:
        raise ValueError("a report needs at least one suite")
    facts = {"made": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"), **environment}
    drawn = any(suite.answers or suite.figures or suite.explorers for suite in suites)
    script = _read_asset("report.js") + "\n\n" + _read_asset("explorer.js")
    plotly = _read_plotly() if drawn else ""
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
            f'<li><a href="#{link}">{escape(suite.title)}</a></li>' for link, suite in linked
        ),
        answer=" ".join(inline(line) for line in lead.headlines[:3]),
        picture="".join(_format_figure(*item) for item in lead.answers[:1]),
        sections="\n".join(_format_section(*item, int(item[1] is lead)) for item in linked),
    )
    write_text(path, page)


def _format_section(link: str, suite: Suite, opened: int) -> str:
    """All of a suite; opened: how many of its answers' pictures the page opens with."""
    blocks = [f"<h2>{escape(suite.title)}</h2>"]
    if suite.headlines:
        lines = "\n".join(f"<li>{inline(line)}</li>" for line in suite.headlines)
        blocks.append(f'<ul class="verdict">\n{lines}\n</ul>')
    answers = sorted(suite.answers[opened:], key=lambda item: bool(item[1].layout.meta))
    pictures = [_format_figure(*item) for item in answers]  # the wide ones below
    pictures += [_format_explorer(item) for item in suite.explorers]
    if pictures:
        blocks.append('<div class="pictures">\n' + "\n".join(pictures) + "\n</div>")
    blocks += [f"<p>{inline(part)}</p>" for part in suite.text.split("\n\n") if part.strip()]
    figures = [_format_figure(*item) for item in suite.figures]
    if len(figures) > _FEW:
        inside = "\n".join(figures)
        figures = [f"<details><summary>{len(figures)} figures</summary>\n{inside}\n</details>"]
    blocks += figures
    blocks += [format_table(table) for table in suite.tables]
    blocks += [_download(*file) for file in suite.files]
    return f'<section id="{link}">\n' + "\n".join(blocks) + "\n</section>"


def _format_figure(title: str, figure: Any, caption: str) -> str:
    """A figure; its layout's meta: "wide" or "scroll", one that keeps its width on a phone."""
    kind = figure.layout.meta or ""
    return (
        f'<figure class="{kind}">\n<h3>{escape(title)}</h3>\n<div class="frame">'
        f'<div class="plot" role="img" aria-label="{escape(title)}"></div></div>\n'
        f"{_format_data('figure', encode_figure(figure))}\n"
        f"<figcaption>{inline(caption)}</figcaption>\n</figure>"
    )


def _format_explorer(explorer: Explorer) -> str:
    """Two cells side by side; `explorer.js` makes the menus and draws."""
    content = {
        "menus": list(explorer.menus),
        "pair": list(explorer.pair),
        "panels": [{"label": p.label, "lines": list(map(list, p.lines))} for p in explorer.panels],
        "bodies": [[list(key), list(size)] for key, size in explorer.bodies.items()],
        "colours": {key[-1]: find_colour(key[-1]) for key in explorer.cells},
        "cells": [
            [
                list(key),
                {name: encode_steps(_select_samples(values)) for name, values in signals.items()},
            ]
            for key, signals in explorer.cells.items()
        ],
    }
    return (
        f'<figure class="explorer wide">\n<h3>{escape(explorer.title)}</h3>\n'
        f"{_format_data('explorer', json.dumps(content, separators=(',', ':')))}\n"
        f"<figcaption>{inline(explorer.caption)}</figcaption>\n</figure>"
    )


def _select_samples(values: Any) -> Any:
    """At most POINTS samples, of every signal of a cell at the same places."""
    n = len(values)
    return values[np.unique(np.linspace(0, n - 1, min(n, POINTS)).astype(int))]


def _format_data(name: str, text: str) -> str:
    """A packed text, which no browser runs."""
    return f'<script type="application/gzip" data-name="{name}">{pack_text(text)}</script>'


def _hash(script: str) -> str:
    """A script as the page's policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def _download(name: str, media: str, text: str) -> str:
    data = base64.b64encode(text.encode()).decode()
    return (
        f'<p class="file"><a download="{escape(name)}" href="data:{media};base64,{data}">'
        f"{escape(name)}</a></p>"
    )


def _read_plotly() -> str:
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs()).replace("\r\n", "\n")


def _read_asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8").strip()
