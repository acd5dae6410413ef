"""The suite's figures: yaw rate with its criteria, tracks with cones, frequency responses."""

from typing import Any

import numpy as np
from plotly import graph_objects as go
from plotly.subplots import make_subplots

from ...envs.rendering.palette import GREY, INK, colour
from ...envs.scenarios.tracks import Section
from ..harness.results import Suite
from ..report.figures import time_series, track
from . import fmvss126, iso3888, iso7401
from .cases import Case, Done, Sine, Transient, of
from .contestants import CARS, CONTESTANTS
from .drive import Array


def add(suite: Suite, done: Done) -> None:
    """Every figure of what was found."""
    for car in CARS:
        mine = {case: found for case, found in done.items() if case.car == car}
        title = f"FMVSS 126, {car}: yaw rate at 5 A over its own peak"
        text = (
            "Bars: at most 35 % and 20 % of the peak after the steer reversal may be left. A car "
            "that spins before completion of steer is left out."
        )
        suite.figures.append((title, yaw_rates(of(mine, "fmvss-126")), text))
        for name in iso3888.TRACKS:
            runs = {case: _best(found) for case, found in of(mine, name).items()}
            speeds = ", ".join(f"{_label(k)} {3.6 * run.speed:.0f} km/h" for k, run in runs.items())
            text = f"The fastest clean run, or the slowest where none is clean: {speeds}."
            suite.figures.append((f"{name}, {car}: way and cones", cones(runs), text))
        for found in of(mine, "iso-7401").values():
            text = "Dots: measured by a swept sine, no control. Line: the linear model."
            title = f"ISO 7401, {car}: frequency response to steering"
            suite.figures.append((title, bode(found), text))


def yaw_rates(done: dict[Case, Sine]) -> Any:
    """Yaw rate at 5 A as a share of its peak after the reversal, with the two limits."""
    t = max((found.shown.t for found in done.values()), key=len)
    whole = {k: found for k, found in done.items() if found.shown.t[-1] >= fmvss126.COMPLETION}
    series = {_label(case): _shares(found, t) for case, found in whole.items()}
    figure = time_series(t, series, "yaw rate / its peak after the reversal")
    for time, most in fmvss126.RATIOS:
        at = fmvss126.COMPLETION + time
        for level in (most, -most):
            line = {"color": INK, "width": 3}
            figure.add_shape(type="line", x0=at - 0.1, x1=at + 0.1, y0=level, y1=level, line=line)
    figure.update_yaxes(range=[-1.5, 1.5])
    return figure


def _shares(found: Sine, t: Array) -> Array:
    """The yaw rate over its peak at the times t; NaN after the drive's end."""
    shown = found.shown
    steered = (shown.t >= fmvss126.REVERSAL) & (shown.t <= fmvss126.COMPLETION)
    peak = np.max(-shown.gamma[steered], initial=1e-9)  # the first half steers to the left
    return np.interp(t, shown.t, -shown.gamma / peak, right=np.nan)


def _best(runs: list[iso3888.Pass]) -> iso3888.Pass:
    """The fastest clean run, or the first of all."""
    return max((run for run in runs if run.passed), key=lambda run: run.speed, default=runs[0])


def cones(done: dict[Case, iso3888.Pass]) -> Any:
    """The ways of the centre of gravity, from where the first lane begins, and the cones."""
    ways: dict[str, tuple[Array, Array]] = {}
    lanes: tuple[Section, ...] = ()
    speed = 0.0
    for case, run in done.items():
        speed = run.speed
        ways[_label(case)] = run.series.X - speed * iso3888.ONSET, run.series.Y
        lanes = iso3888.lanes_of(CARS[case.car], case.procedure, speed)
    figure = track(ways)
    places = [
        (x - speed * iso3888.ONSET, lane.offset + side * 0.5 * lane.width)
        for lane in lanes
        for x in np.linspace(lane.start, lane.start + lane.length, 5)
        for side in (-1.0, 1.0)
    ]
    x, y = np.array(places).T
    marker = {"color": "#D55E00", "symbol": "triangle-up", "size": 7}
    figure.add_trace(go.Scatter(x=x, y=y, mode="markers", marker=marker, name="cones"))
    reach = float(x.max()) + iso3888.RUN_OUT
    figure.update_xaxes(range=[float(x.min()) - iso3888.RUN_OUT, reach])
    return figure


def bode(found: Transient) -> Any:
    """Magnitude and phase of both outputs over the frequency."""
    figure = make_subplots(rows=2, cols=2, shared_xaxes=True, vertical_spacing=0.06)
    for column, name in enumerate(iso7401.OUTPUTS, 1):
        measured, linear = found.sweep[name], found.linear_sweep[name]
        for H, mode, who in (
            (measured.H, "markers", "measured"),
            (linear, "lines", "linear model"),
        ):
            for row, values in ((1, np.abs(H)), (2, np.degrees(np.unwrap(np.angle(H))))):
                legend = {"name": who, "legendgroup": who, "showlegend": row == column == 1}
                pen = {"marker": {"color": colour("two-dof")}, "line": {"color": GREY}}
                trace = go.Scatter(x=measured.frequency, y=values, mode=mode, **legend, **pen)
                figure.add_trace(trace, row=row, col=column)
    figure.update_xaxes(title_text="frequency / Hz", row=2, automargin=True)
    for column, unit in enumerate(("yaw rate / (1/s)", "a_y / (m/s2/rad)"), 1):
        figure.update_yaxes(title_text=unit, row=1, col=column, automargin=True)
        figure.update_yaxes(title_text="phase / deg", row=2, col=column, automargin=True)
    legend = {"orientation": "h", "x": 0, "xanchor": "left", "y": 1.02, "yanchor": "bottom"}
    figure.update_layout(height=520, legend=legend)
    return figure


def _label(case: Case) -> str:
    return CONTESTANTS[case.contestant].agent
