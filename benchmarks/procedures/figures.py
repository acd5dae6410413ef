"""The suite's figures: yaw rate with its criteria, tracks with cones, frequency responses."""

from collections.abc import Mapping

import numpy as np
from plotly import graph_objects as go
from plotly.subplots import make_subplots

from ...envs.record import Array
from ...envs.rendering.palette import GREY, INK, find_colour
from ..report.figures import draw_time_series, draw_track
from . import fmvss126, iso3888, iso7401
from .drive import CARS, CaseResults, ProcedureCase, Series


def draw_figures(results: Mapping[str, CaseResults]) -> list[tuple[str, go.Figure, str]]:
    """Draw every figure of the results.

    Args:
        results: Results of the cases by procedure.

    Returns:
        Titles, figures and captions.
    """
    figures = []
    for car in CARS:
        of_car = {x: {k: y for k, y in z.items() if k.car == car} for x, z in results.items()}
        title = f"FMVSS 126, {car}: yaw rate at 5 A over its own peak"
        text = (
            "Bars: at most 35 % and 20 % of the peak after the steer reversal may be left. A car "
            "that spins before completion of steer is left out."
        )
        figures.append((title, _draw_yaw_rates(of_car["fmvss-126"]), text))
        for name in iso3888.TRACKS:
            runs = {
                case: max((x for x in result if x.passed), key=lambda x: x.speed, default=result[0])
                for case, result in of_car[name].items()
            }
            speeds = ", ".join(f"{k.agent} {3.6 * run.speed:.0f} km/h" for k, run in runs.items())
            text = f"The fastest clean run, or the slowest where none is clean: {speeds}."
            figures.append((f"{name}, {car}: way and cones", _draw_cones(runs), text))
        for result in of_car["iso-7401"].values():
            text = "Dots: measured by a swept sine, no control. Line: the linear model."
            title = f"ISO 7401, {car}: frequency response to steering"
            figures.append((title, _draw_bode(result), text))
    return figures


def _draw_yaw_rates(done: CaseResults) -> go.Figure:
    """Draw the yaw rate at 5 A over its peak after the reversal, with the two limits."""
    drives = {case.agent: results[0].shown for case, results in done.items()}
    t = max((shown.t for shown in drives.values()), key=len)
    whole = {agent: x for agent, x in drives.items() if x.t[-1] >= fmvss126.COMPLETION}
    series = {agent: _compute_shares(shown, t) for agent, shown in whole.items()}
    figure = draw_time_series(t, series, "yaw rate / its peak after the reversal")
    for time, max_ratio in fmvss126.RATIOS:
        position = fmvss126.COMPLETION + time
        for level in (max_ratio, -max_ratio):
            ends = {"x0": position - 0.1, "x1": position + 0.1, "y0": level, "y1": level}
            figure.add_shape(type="line", **ends, line={"color": INK, "width": 3})
    figure.update_yaxes(range=[-1.5, 1.5])
    return figure


def _compute_shares(shown: Series, t: Array) -> Array:
    """Compute the yaw rate over its peak at the times t; NaN after the drive's end."""
    steered = (shown.t >= fmvss126.REVERSAL) & (shown.t <= fmvss126.COMPLETION)
    peak = np.max(-shown.gamma[steered], initial=1e-9)  # the first half steers to the left
    return np.interp(t, shown.t, -shown.gamma / peak, right=np.nan)


def _draw_cones(done: dict[ProcedureCase, iso3888.TrackRun]) -> go.Figure:
    """Draw the paths of the centre of gravity, from where the first lane begins, and the cones."""
    starts = {case: run.speed * iso3888.ONSET for case, run in done.items()}
    paths = {x.agent: (run.series.X - starts[x], run.series.Y) for x, run in done.items()}
    case, run = list(done.items())[-1]
    figure = draw_track(paths)
    places = [
        (x - starts[case], lane.offset + side * 0.5 * lane.width)
        for lane in run.lanes
        for x in np.linspace(lane.start, lane.start + lane.length, 5)
        for side in (-1.0, 1.0)
    ]
    x, y = np.array(places).T
    marker = {"color": "#D55E00", "symbol": "triangle-up", "size": 7}
    figure.add_trace(go.Scatter(x=x, y=y, mode="markers", marker=marker, name="cones"))
    reach = float(x.max()) + iso3888.RUN_OUT
    figure.update_xaxes(range=[float(x.min()) - iso3888.RUN_OUT, reach])
    return figure


def _draw_bode(result: iso7401.Transient) -> go.Figure:
    figure = make_subplots(rows=2, cols=2, shared_xaxes=True, vertical_spacing=0.06)
    for column, name in enumerate(iso7401.OUTPUTS, 1):
        measured, linear = result.sweep[name], result.linear_sweep[name]
        kinds = (measured.H, "markers", "measured"), (linear, "lines", "linear model")
        for H, mode, label in kinds:
            for row, values in ((1, np.abs(H)), (2, np.degrees(np.unwrap(np.angle(H))))):
                legend = {"name": label, "legendgroup": label, "showlegend": row == column == 1}
                pen = {"marker": {"color": find_colour("two-dof")}, "line": {"color": GREY}}
                trace = go.Scatter(x=measured.frequency, y=values, mode=mode, **legend, **pen)
                figure.add_trace(trace, row=row, col=column)
    figure.update_xaxes(title_text="frequency / Hz", row=2, automargin=True)
    for column, unit in enumerate(("yaw rate / (1/s)", "a_y / (m/s2/rad)"), 1):
        figure.update_yaxes(title_text=unit, row=1, col=column, automargin=True)
        figure.update_yaxes(title_text="phase / deg", row=2, col=column, automargin=True)
    legend = {"orientation": "h", "x": 0, "xanchor": "left", "y": 1.02, "yanchor": "bottom"}
    figure.update_layout(height=520, legend=legend)
    return figure
