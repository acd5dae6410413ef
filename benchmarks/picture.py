"""The benchmark at a glance: one PNG from the rows, for a README."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..envs.backend.files import whole
from .control.cells import REFERENCE_FILTER, YAW
from .harness.metrics import METRICS
from .harness.results import Row, Suite
from .report.colours import INK, colour


def write_picture(path: str | Path, suites: Sequence[Suite]) -> None:
    """Bars of every estimator's error and the controllers' scores, with their intervals.

    Needs the extra `report`. Raises ValueError if no suite has a row to draw.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "pictures need matplotlib: pip install 'sideslip[report]'"
        ) from None
    rows = [row for suite in suites for row in suite.rows]
    error, score = "error of sideslip / mrad", "score (1: clairvoyant)"
    panels = [
        (title, [r for r in rows if (r.scenario, r.metric) == key and _shown(r)], label)
        for title, key, label in (
            ("Estimating with a late camera", ("tie-vision-fig7", "rmse"), error),
            ("Estimating with GPS, wind, outage", ("dakf-fig6", "rmse"), error),
            (f"Controlling, on {REFERENCE_FILTER}", ("all", "score"), score),
        )
    ]
    panels = [panel for panel in panels if panel[1]]
    if not panels:
        raise ValueError("nothing to draw: the picture needs the suites estimation or control")
    figure = Figure(figsize=(4.0 * len(panels), 2.6), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (title, mine, label) in zip(axes, panels, strict=True):
        _bars(axis, mine, title, label)
        over = {r.estimator: r.value for r in rows
                if r.metric == "rmse_over_bound" and r.scenario == mine[0].scenario}  # fmt: skip
        for row in mine:
            if row.estimator in over:
                _limit(axis, 1e3 * row.value / over[row.estimator])
                break
    with whole(path) as file:
        figure.savefig(file, format="png", dpi=110)


def _shown(row: Row) -> bool:
    """Whether a row stands in the picture: of the scores those on the best filter, yaw moment."""
    best = row.env_version.startswith(YAW) and row.estimator in ("", REFERENCE_FILTER)
    return row.metric != "score" or best


def _limit(axis: Any, value: float) -> None:
    axis.axvline(value, color=INK, linewidth=1.5)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0}
    axis.text(value, -0.4, " the bound", color=INK, fontsize=8, va="center", bbox=box)


def _bars(axis: Any, rows: Sequence[Row], title: str, label: str) -> None:
    """Horizontal bars, the best on top: the smallest error or the highest score."""
    sign = 1.0 if rows[0].metric == "score" else -1.0
    ordered = sorted(rows, key=lambda row: sign * row.value)
    names = [row.estimator if row.metric == "rmse" else row.controller for row in ordered]
    scale = 1e3 if METRICS[rows[0].metric] == "rad" else 1.0
    values = [scale * row.value for row in ordered]
    colours = [colour(name) for name in names]
    errors = [
        [scale * (row.value - row.low) for row in ordered],
        [scale * (row.high - row.value) for row in ordered],
    ]
    bars = axis.barh(names, values, color=colours, xerr=errors, ecolor="0.3", capsize=2)
    for bar, name in zip(bars, names, strict=True):
        if "," in name:  # a variant of a known name wears its colour, hatched
            bar.set(hatch="//", edgecolor="white")
    axis.set_title(title, fontsize=9)
    axis.set_xlabel(label, fontsize=8)
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
