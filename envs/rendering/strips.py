"""Strip charts over time: truth, references, estimates with their standard deviation."""

import math
from typing import NamedTuple

import numpy as np

from ..record import Array
from .canvas import Box, Canvas
from .palette import INK, mix_colours
from .road import SOFT
from .trace import TRACE_POINT

MAX_SPAN = 10.0  # s that are shown at most
_DEGREES = math.degrees(1.0)
_GRID, _ROW = "#E3E6E9", 20.0


class ChartLine(NamedTuple):
    """A line of a strip: values over time, an estimate's standard deviation around it."""

    t: Array
    values: Array
    colour: str
    dashed: bool = False
    deviation: Array | None = None
    width: float = 1.6


class Strip(NamedTuple):
    """A chart.

    Attributes:
        title: Title with a unit.
        min_limit: Least that its axis reaches to either side, in that unit.
        share: Weight of its height among all strips.
        lines: Its lines.
    """

    title: str
    min_limit: float
    share: float
    lines: list[ChartLine]


def make_strips(
    truth: Array,
    estimates: dict[str, Array],
    colours: dict[str, str],
    ghosts: list[tuple[Array, str]],
    max_moment: float,
    has_yaw_reference: bool,
) -> list[Strip]:
    """Make the charts of a car's sideslip angle, yaw rate and yaw moment, with those of ghosts.

    Args:
        truth: Rows of `TracePoint`, shape (n, len(TracePoint)).
        estimates: By label, estimates and standard deviations (rad), shape (n, 2).
        colours: Colours by label.
        ghosts: Rows of `TracePoint` and colour of each ghost.
        max_moment: Full scale of the yaw moment (N m).
        has_yaw_reference: Whether the yaw rate has a reference.

    Returns:
        The charts.
    """

    def make_lines(column: int, factor: float) -> list[ChartLine]:
        others = [
            ChartLine(g[:, TRACE_POINT.t], factor * g[:, column], shade) for g, shade in ghosts
        ]
        return [*others, ChartLine(t, factor * truth[:, column], INK, width=2.0)]

    t = truth[:, TRACE_POINT.t]
    estimate_lines = [
        ChartLine(t, _DEGREES * hat, colours[name], deviation=_DEGREES * std)
        for name, (hat, std) in ((name, columns.T) for name, columns in estimates.items())
    ]
    reference_lines = [
        ChartLine(t, _DEGREES * truth[:, column], INK, True, width=1.0)
        for column in (TRACE_POINT.beta_ref, TRACE_POINT.gamma_ref)
    ]
    return [
        Strip(
            "sideslip angle / deg",
            1.0,
            1.6,
            [reference_lines[0], *make_lines(TRACE_POINT.beta, _DEGREES), *estimate_lines],
        ),
        Strip(
            "yaw rate / (deg/s)",
            10.0,
            1.0,
            [*reference_lines[1:][:has_yaw_reference], *make_lines(TRACE_POINT.gamma, _DEGREES)],
        ),
        Strip("yaw moment / (N m)", 0.2 * max_moment, 1.0, make_lines(TRACE_POINT.yaw_moment, 1.0)),
    ]


def draw_strips(canvas: Canvas, box: Box, strips: list[Strip], first: float, span: float) -> None:
    """Draw strips below one another in a box.

    Args:
        canvas: The canvas.
        box: The box.
        strips: The charts.
        first: Time at their left end (s).
        span: Time that they show (s).
    """
    left, top, width, height = box
    high = (height - _ROW) / sum(strip.share for strip in strips)
    y = top
    for strip in strips:
        inside = left + 48.0, y + _ROW, width - 60.0, strip.share * high - _ROW - 4.0
        _draw_strip(canvas, inside, strip, first, span)
        y += strip.share * high
    step = 1.0 if span <= 10.0 else 2.0
    for t in np.arange(math.ceil(first / step) * step, first + span + 1e-6, step):
        x = left + 48.0 + (width - 60.0) * (t - first) / span
        canvas.draw_text((x, top + height - 10.0), f"{t:g}", SOFT, 11, 0.5)
    canvas.draw_text((left, top + height - 10.0), "time / s", SOFT, 11)


def _draw_strip(canvas: Canvas, box: Box, strip: Strip, first: float, span: float) -> None:
    left, top, width, height = box
    largest = max((_find_largest(line) for line in strip.lines), default=0.0)
    limit = _find_nice_limit(max(strip.min_limit, 1.05 * largest))

    def to_pixels(t: Array, values: Array) -> Array:
        share = np.clip(values / limit, -1.1, 1.1)
        return np.stack([left + width * (t - first) / span, top + 0.5 * height * (1.0 - share)], 1)

    canvas.draw_box(box, "#FFFFFF")
    for share in (-1.0, 0.0, 1.0):
        y = top + 0.5 * height * (1.0 - share)
        canvas.draw_line([(left, y), (left + width, y)], _GRID, 1.0)
        canvas.draw_text((left - 6.0, y), f"{share * limit:g}", SOFT, 11, 1.0)
    canvas.draw_text((left, top - 0.5 * _ROW + 2.0), strip.title, INK, 12)
    canvas.set_clip(box)
    for line in strip.lines:
        if line.deviation is not None:
            is_known = np.isfinite(line.values) & np.isfinite(line.deviation)
            t, middle, std = line.t[is_known], line.values[is_known], line.deviation[is_known]
            if len(t) > 1:
                edges = to_pixels(t, middle + std), to_pixels(t, middle - std)[::-1]
                canvas.draw_polygon(
                    np.concatenate(edges), mix_colours(line.colour, "#FFFFFF", 0.25)
                )
    for line in strip.lines:
        is_known = np.isfinite(line.values)
        points = to_pixels(line.t[is_known], line.values[is_known])
        if len(points) > 1:
            draw_points = canvas.draw_dashes if line.dashed else canvas.draw_line
            draw_points(points, line.colour, line.width)
        if len(points) and not line.dashed:
            canvas.draw_disc(points[-1], 2.6, line.colour)
    canvas.set_clip(None)


def _find_largest(line: ChartLine) -> float:
    return float(np.max(np.abs(line.values), initial=0.0, where=np.isfinite(line.values)))


def _find_nice_limit(limit: float) -> float:
    """The next of 1, 2, 5, 10, ..., times a power of ten."""
    power = 10.0 ** math.floor(math.log10(limit))
    return next(
        factor * power for factor in (1.0, 2.0, 3.0, 5.0, 10.0) if factor * power >= limit - 1e-9
    )
