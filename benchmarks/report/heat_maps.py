"""The matrix as a heat map, and shares over two axes. Needs plotly."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from plotly import graph_objects as go
from plotly.subplots import make_subplots

from ...envs.record import Array
from ...envs.rendering.palette import INK
from ..harness.results import ShareMap
from .colours import SHARE_SCALE

_GOOD_TO_BAD = [(1.0 - at, shade) for at, shade in SHARE_SCALE][::-1]


def draw_heat_map(
    names: Sequence[str], columns: Sequence[str], values: Array, unit: str, good: str = "high"
) -> Any:
    """Names down, columns across, the number in each field; NaN stays empty.

    values: (names, columns). good: "high" or "low" values are the good ones (blue).
    """
    scale = [list(stop) for stop in _GOOD_TO_BAD]
    if good == "high":
        scale = [[at, shade] for (at, _), (_, shade) in zip(scale, scale[::-1], strict=True)]
    text = [[f"{v:.2f}" if np.isfinite(v) else "" for v in row] for row in values]
    low, high = np.nanpercentile(values, [5.0, 95.0])  # one outlier shall not bleach the rest
    trace = go.Heatmap(
        z=[[float(v) if np.isfinite(v) else None for v in row] for row in values],
        x=list(columns),
        y=list(names),
        text=text,
        texttemplate="%{text}",
        textfont={"size": 10},
        colorscale=scale,
        zmin=float(low),
        zmax=float(high),
        xgap=1,
        ygap=1,
        colorbar={"title": {"text": unit}},
        hovertemplate="%{y}<br>%{x}: %{text}<extra></extra>",
    )
    figure = go.Figure(trace)
    figure.update_xaxes(side="top", tickangle=-35, showgrid=False, ticks="", automargin=True)
    figure.update_yaxes(autorange="reversed", showgrid=False, ticks="", automargin=True)
    figure.update_layout(
        height=170 + 22 * len(names), hovermode="closest", showlegend=False, meta="scroll"
    )
    return figure


def draw_share_maps(share_map: ShareMap) -> Any:
    """Shares over two axes, a panel a name, with the line at one half."""
    n_columns = min(3, len(share_map.shares))
    n_rows = -(-len(share_map.shares) // n_columns)
    names = list(share_map.shares)
    gaps = {"horizontal_spacing": 0.06, "vertical_spacing": 0.28 / n_rows}
    figure = make_subplots(n_rows, n_columns, subplot_titles=names, shared_yaxes=True, **gaps)
    for i, (name, share) in enumerate(share_map.shares.items()):
        place = {"row": i // n_columns + 1, "col": i % n_columns + 1}
        hover = f"{name}<br>%{{x:.1f}}, %{{y:.1f}}: %{{z:.2f}}<extra></extra>"
        axes: dict[str, Any] = {"x": share_map.x, "y": share_map.y, "z": share}
        figure.add_trace(go.Heatmap(**axes, coloraxis="coloraxis", hovertemplate=hover), **place)
        half = {"start": 0.5, "end": 0.5, "size": 1.0, "coloring": "none"}
        line = {"color": INK, "width": 1.5}
        figure.add_trace(
            go.Contour(**axes, contours=half, line=line, showscale=False, hoverinfo="skip"), **place
        )
        figure.update_xaxes(title_text=share_map.x_label, **place)
        if place["col"] == 1:
            figure.update_yaxes(title_text=share_map.y_label, **place)
    scale = [list(stop) for stop in SHARE_SCALE]
    bar = {"colorscale": scale, "cmin": 0.0, "cmax": 1.0, "colorbar": {"title": {"text": "share"}}}
    figure.update_layout(height=120 + 230 * n_rows, coloraxis=bar, showlegend=False, meta="scroll")
    figure.update_layout(margin={"t": 34, "l": 60, "b": 52})
    return figure
