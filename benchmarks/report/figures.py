"""Figures as plotly figures; importing this module needs plotly, the extra `report`.

Every axis carries its unit, every name has its colour (`envs.rendering.palette`). Lines longer than
`POINTS` are thinned: those over time keep their peaks and gaps, tracks take even steps.
"""

from collections.abc import Collection, Iterable, Mapping

import numpy as np
import numpy.typing as npt

from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.rendering.palette import FACTS, GREY, find_base, find_colour
from ..harness.stats import Estimate

with require_extra("report", "figures need plotly"):
    from plotly import graph_objects as go

POINTS = 1000  # maximum of points of a line: a figure is no wider in pixels
_DASHES = {"reference": "dash", "bound": "dot"}
_DASH_ORDER = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
_LOG = {"type": "log", "dtick": "D2", "tickformat": "~g"}  # 1, 2, 5, 10, ...


def _choose_line_styles(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Choose (colour, dash) of each line: no two alike, a variant of a known name dashed."""
    styles: dict[str, tuple[str, str]] = {}
    for name in names:
        known = find_base(name)
        first = _DASHES.get(known or "", "solid" if known in (name, None) else "dash")
        choices = [(find_colour(name), dash) for dash in (first, *_DASH_ORDER)]
        taken = styles.values()
        styles[name] = next((style for style in choices if style not in taken), choices[0])
    return styles


def _find_peaks(y: Array) -> npt.NDArray[np.intp]:
    """Find at most POINTS indices of y (n,): extremes and a gap (NaN) of each stretch."""
    n = len(y)
    if n <= POINTS:
        return np.arange(n)
    missing = np.isnan(y)
    size = -(-n // (POINTS // (3 if missing.any() else 2) - 1))
    starts = np.arange(0, n, size)
    table = np.append(y, np.full(len(starts) * size - n, np.nan)).reshape(len(starts), size)
    low = np.where(np.isnan(table), np.inf, table).argmin(axis=1)
    high = np.where(np.isnan(table), -np.inf, table).argmax(axis=1)
    gaps = np.flatnonzero(missing)
    gaps = gaps[np.unique(gaps // size, return_index=True)[1]]
    return np.unique(np.concatenate([starts + low, starts + high, gaps, [0, n - 1]]))


def draw_time_series(
    t: Array,
    series: Mapping[str, Array],
    unit_label: str,
    dots: Collection[str] = (),
    zero_line: bool = False,
) -> go.Figure:
    """Draw series on one axis over time, "truth" on top and thicker.

    Args:
        t: Times (s), shape (n,).
        series: Values by name, shape (n,) each.
        unit_label: Quantity and unit, as "sideslip angle / mrad".
        dots: Names that are drawn as dots, for packets with NaN between them.
        zero_line: Whether a line is drawn at zero, for errors.
    """
    t, lines = np.asarray(t, float), dict[str, tuple[Array, Array]]()
    for name, values in series.items():
        y = np.asarray(values, float)
        present = ~np.isnan(y) if name in dots else np.ones(len(y), bool)
        x, y = t[present], y[present]
        shown = _find_peaks(y)
        lines[name] = x[shown], y[shown]
    width = 1.0 if len(t) > 4 * POINTS else 1.8  # a dense line is noisy: leave room for the others
    figure = _draw_lines(lines, width=width, dots=dots)
    figure.update_xaxes(range=[float(t[0]), float(t[-1])] if len(t) > 1 else None)
    if zero_line:
        figure.add_hline(y=0.0, line={"color": GREY, "width": 1}, layer="below")
    return _finish(figure, "time / s", unit_label, 380, hovermode="x unified")


def draw_curves(x: Array, series: Mapping[str, Array], x_label: str, y_label: str) -> go.Figure:
    """Draw lines with dots.

    Args:
        x: Places of the dots, shape (n,).
        series: Values by name, shape (n,).
        x_label: Quantity and unit of `x`.
        y_label: Quantity and unit of the values.
    """
    at = np.asarray(x, float)
    lines = {name: (at, np.asarray(values, float)) for name, values in series.items()}
    figure = _draw_lines(lines, "lines+markers")
    return _finish(figure, x_label, y_label, 400, hovermode="x unified")


def draw_track(paths: Mapping[str, tuple[Array, Array]]) -> go.Figure:
    """Draw paths, seen from above.

    Args:
        paths: Paths (x, y) (m) by name.
    """
    lines = {}
    for name, (x, y) in paths.items():
        shown = np.unique(np.linspace(0, len(y) - 1, min(len(y), POINTS)).round().astype(int))
        lines[name] = np.asarray(x, float)[shown], np.asarray(y, float)[shown]
    figure = _draw_lines(lines)
    figure.update_yaxes(scaleanchor="x", scaleratio=1)
    return _finish(figure, "x / m", "y / m", 400, hovermode="closest")


def draw_groups(
    groups: Mapping[str, Mapping[str, Estimate]], unit: str, lines: Mapping[float, str]
) -> go.Figure:
    """Draw dots with intervals on a logarithmic axis, group below group; variants' are hollow.

    Args:
        groups: Numbers by name, by the group's title.
        unit: Quantity and unit.
        lines: Meanings of certain values, which are drawn as lines.
    """
    figure, ticks, row = go.Figure(), dict[int, str](), 0
    for title, numbers in groups.items():
        text = {"text": f"<b>{title}</b>", "showarrow": False, "xref": "paper", "x": 1}
        figure.add_annotation(y=row, xanchor="right", font={"size": 12.5}, **text)
        for name, number in numbers.items():
            value, low, high = number
            row += 1
            ticks[row] = name
            ends = {"array": [high - value], "arrayminus": [value - low], "symmetric": False}
            colour = find_colour(name)
            marker = {"color": colour, "size": 10, "line": {"width": 2, "color": colour}}
            marker["symbol"] = "circle" if find_base(name) in (name, None) else "circle-open"
            hover = f"{name}: {number.inline(digits='.3g')}<extra></extra>"
            pen = {"type": "data", "color": colour, "thickness": 1.6, "width": 4}
            figure.add_trace(
                go.Scatter(x=[value], y=[row], error_x=pen | ends, marker=marker,
                           mode="markers", name=name, hovertemplate=hover, showlegend=False)
            )  # fmt: skip
        row += 1
    for value, meaning in lines.items():
        look = {"line": {"color": GREY, "width": 1.2, "dash": "dot"}, "layer": "below"}
        figure.add_shape(type="line", x0=value, x1=value, y0=0, y1=1, yref="paper", **look)
        place = {"x": np.log10(value), "y": 1, "yref": "paper", "yanchor": "bottom"}
        figure.add_annotation(text=meaning, showarrow=False, font={"size": 11}, **place)
    margin = {"t": 28, "b": 12, "l": 12, "r": 12}
    _finish(figure, unit, "", 110 + 21 * row, hovermode="closest", margin=margin)
    figure.update_layout(showlegend=False)
    figure.update_xaxes(**_LOG)
    names = {"tickvals": list(ticks), "ticktext": list(ticks.values())}
    figure.update_yaxes(range=[row - 0.4, -0.6], showgrid=True, ticks="", **names)
    return figure


def _draw_lines(
    lines: Mapping[str, tuple[Array, Array]], mode: str = "lines", width: float = 1.8,
    dots: Collection[str] = (),
) -> go.Figure:  # fmt: skip
    """Draw places (x, y) by name, the truth above the others and thicker, first in the legend."""
    figure = go.Figure()
    for name, (colour, dash) in _choose_line_styles(lines).items():
        x, y = lines[name]
        pen = {"color": colour, "dash": dash, "width": 2.6 if name in FACTS else width}
        look = {"mode": mode, "line": pen}
        if name in dots:
            look = {"mode": "markers", "marker": {"color": colour, "size": 4}}
        figure.add_trace(go.Scatter(x=x, y=y, name=name, **look))
    figure.data = sorted(figure.data, key=lambda trace: trace.name in FACTS)
    figure.update_traces(legendrank=1, selector=lambda trace: trace.name in FACTS)
    return figure


def _finish(figure: go.Figure, x: str, y: str, height: int, **layout: object) -> go.Figure:
    legend = {"orientation": "h", "x": 0, "xanchor": "left", "y": 1.02, "yanchor": "bottom"}
    figure.update_layout(height=height, legend=legend, showlegend=len(figure.data) > 1, **layout)
    figure.update_xaxes(title_text=x, hoverformat=".4~g", automargin=True)
    figure.update_yaxes(title_text=y, hoverformat=".4~g", automargin=True)
    return figure
