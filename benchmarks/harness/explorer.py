"""One figure with menus: the time series of any cell of a table."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

POINTS = 250
_DIGITS = 4


@dataclass(frozen=True)
class Panel:
    """One of the plots above each other: quantity with unit, and its lines.

    lines: (name of a signal, what the legend calls it, colour).
    """

    label: str
    lines: Sequence[tuple[str, str, str]]


@dataclass
class Explorer:
    """Time series to choose from.

    menus: what each part of a cell's key is called. cells: key (one name a menu) to signals, each
    (n,), with the time under "t". panels: what is drawn of them. caption: a sentence.
    """

    title: str
    menus: Sequence[str]
    cells: Mapping[Any, Mapping[str, Array]]
    panels: Sequence[Panel]
    caption: str = ""

    def __post_init__(self) -> None:
        if not self.cells:
            raise ValueError(f"explorer {self.title!r} has no cells")
        for key, signals in self.cells.items():
            if len(key) != len(self.menus):
                raise ValueError(f"cell {key} has {len(key)} names, there are {len(self.menus)}")
            missing = {name for panel in self.panels for name, _, _ in panel.lines} - set(signals)
            if missing or "t" not in signals:
                raise ValueError(f"cell {key} lacks {', '.join(sorted(missing)) or 't'}")

    def html(self) -> str:
        """The figure with its data; `explorer.js` makes the menus and draws."""
        return (
            f'<figure class="explorer">\n<h3>{escape(self.title)}</h3>\n'
            f'<div class="menus"></div>\n<div class="plot" role="img" '
            f'aria-label="{escape(self.title)}"></div>\n'
            f'<script type="application/json">{self._json()}</script>\n'
            f"<figcaption>{escape(self.caption)}</figcaption>\n</figure>"
        )

    def _json(self) -> str:
        content: dict[str, Any] = {
            "menus": list(self.menus),
            "panels": [
                {"label": panel.label, "lines": [list(line) for line in panel.lines]}
                for panel in self.panels
            ],
            "cells": [
                [list(key), {name: _thinned(values) for name, values in signals.items()}]
                for key, signals in self.cells.items()
            ],
        }
        return json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")


def _thinned(values: Array) -> list[float | None]:
    """At most POINTS samples to a few digits; every signal at the same places."""
    shown = np.unique(np.linspace(0, len(values) - 1, min(len(values), POINTS)).astype(int))
    return [float(f"{v:.{_DIGITS}g}") if np.isfinite(v) else None for v in values[shown]]
