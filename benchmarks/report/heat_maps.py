"""The matrix as a heat map, and cars in motion. Needs plotly."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from plotly import graph_objects as go
from plotly.subplots import make_subplots

from ...envs.rendering.palette import INK
from ..harness.results import ShareMap
from .colours import SHARE_SCALE, line_styles

Array = npt.NDArray[np.float64]

_FRAMES = 120
_WINDOW = (36.0, 11.0)  # m, what is seen of a run in motion
_GOOD_TO_BAD = [(1.0 - at, shade) for at, shade in SHARE_SCALE][::-1]
_CAR = np.array([[1.0, 0.5], [1.0, -0.5], [-1.0, -0.5], [-1.0, 0.5], [1.0, 0.5]])


def heat_map(
    names: Sequence[str], columns: Sequence[str], values: Array, unit: str, good: str = "high"
) -> Any:
    """Names down, columns across, the number in each field; NaN stays empty.

    values: (names, columns). good: "high" or "low" values are the good ones (blue).
    """
    scale = [list(each) for each in _GOOD_TO_BAD]
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
    figure.update_layout(height=170 + 22 * len(names), hovermode="closest", showlegend=False)
    return figure


def share_maps(shown: ShareMap) -> Any:
    """Shares over two axes, a panel a name, with the line at one half."""
    across = min(3, len(shown.shares))
    down = -(-len(shown.shares) // across)
    names = list(shown.shares)
    gaps = {"horizontal_spacing": 0.06, "vertical_spacing": 0.28 / down}
    figure = make_subplots(down, across, subplot_titles=names, shared_yaxes=True, **gaps)
    for i, (name, share) in enumerate(shown.shares.items()):
        place = {"row": i // across + 1, "col": i % across + 1}
        hover = f"{name}<br>%{{x:.1f}}, %{{y:.1f}}: %{{z:.2f}}<extra></extra>"
        axes: dict[str, Any] = {"x": shown.x, "y": shown.y, "z": share}
        figure.add_trace(go.Heatmap(**axes, coloraxis="coloraxis", hovertemplate=hover), **place)
        half = {"start": 0.5, "end": 0.5, "size": 1.0, "coloring": "none"}
        line = {"color": INK, "width": 1.5}
        figure.add_trace(
            go.Contour(**axes, contours=half, line=line, showscale=False, hoverinfo="skip"), **place
        )
        figure.update_xaxes(title_text=shown.x_label, **place)
        if place["col"] == 1:
            figure.update_yaxes(title_text=shown.y_label, **place)
    scale = [list(each) for each in SHARE_SCALE]
    bar = {"colorscale": scale, "cmin": 0.0, "cmax": 1.0, "colorbar": {"title": {"text": "share"}}}
    figure.update_layout(height=120 + 230 * down, coloraxis=bar, showlegend=False)
    return figure


def animation(
    t: Array,
    paths: Mapping[str, tuple[Array, Array, Array]],
    size: tuple[float, float],
    lines: Mapping[str, tuple[Array, Array]] | None = None,
) -> Any:
    """Cars from above in motion, with a slider for the time.

    t: (n,) s. paths: name to (X, Y in m, psi in rad), at most n long: a car whose episode ended
    stays where it was. size: length and width in m. lines: borders or cones to draw, name to
    (x, y).
    """
    shades = {name: shade for name, (shade, _) in line_styles(paths).items()}
    fixed = [
        go.Scatter(x=x, y=y, name=name, mode="lines", line={"color": INK, "width": 1})
        for name, (x, y) in (lines or {}).items()
    ]
    trails = [
        go.Scatter(x=X, y=Y, name=name, mode="lines", line={"color": shades[name], "width": 1})
        for name, (X, Y, _) in paths.items()
    ]
    at = np.linspace(0, len(t) - 1, min(_FRAMES, len(t))).astype(int)
    figure = go.Figure([*fixed, *trails, *_cars(paths, shades, size, 0)])
    moving = list(range(len(fixed) + len(trails), len(figure.data)))
    names = [f"{t[k]:.2f}" for k in at]
    views = [_view(paths, int(k)) for k in at]
    figure.frames = [
        go.Frame(name=name, data=_cars(paths, shades, size, int(k)), traces=moving, layout=view)
        for name, k, view in zip(names, at, views, strict=True)
    ]
    pace = {"frame": {"duration": 40, "redraw": False}, "transition": {"duration": 0}}
    jump = pace | {"mode": "immediate"}
    steps = [{"label": name, "method": "animate", "args": [[name], jump]} for name in names]
    play = {"label": "play", "method": "animate", "args": [None, pace | {"fromcurrent": True}]}
    stop = {"label": "stop", "method": "animate", "args": [[None], jump]}
    figure.update_layout(
        views[0],
        height=480,
        hovermode="closest",
        legend={"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"},
        sliders=[{"steps": steps, "currentvalue": {"prefix": "t = ", "suffix": " s"}, "x": 0.1}],
        updatemenus=[
            {"type": "buttons", "buttons": [play, stop], "direction": "left", "x": 0, "y": -0.12}
        ],
    )
    figure.update_xaxes(title_text="X / m", automargin=True)
    figure.update_yaxes(title_text="Y / m", automargin=True, scaleanchor="x", scaleratio=1)
    return figure


def _view(paths: Mapping[str, tuple[Array, Array, Array]], k: int) -> dict[str, Any]:
    """The axes' ranges: a window that follows the car that is ahead."""
    ends = [(X[min(k, len(X) - 1)], Y[min(k, len(Y) - 1)]) for X, Y, _ in paths.values()]
    x, y = max(ends)
    low, high = float(x) - 0.7 * _WINDOW[0], float(x) + 0.3 * _WINDOW[0]
    half = 0.5 * _WINDOW[1]
    return {"xaxis": {"range": [low, high]}, "yaxis": {"range": [float(y) - half, float(y) + half]}}


def _cars(
    paths: Mapping[str, tuple[Array, Array, Array]],
    shades: Mapping[str, str],
    size: tuple[float, float],
    k: int,
) -> list[Any]:
    """Each car's outline at a sample."""
    drawn = []
    for name, (X, Y, psi) in paths.items():
        i = min(k, len(X) - 1)
        c, s = np.cos(psi[i]), np.sin(psi[i])
        x, y = (_CAR * [0.5 * size[0], size[1]]).T  # half ahead and behind, half to either side
        look = {"mode": "lines", "fill": "toself", "line": {"color": shades[name], "width": 2}}
        outline = {"x": X[i] + c * x - s * y, "y": Y[i] + s * x + c * y}
        drawn.append(go.Scatter(**outline, **look, showlegend=False, hoverinfo="skip"))
    return drawn
