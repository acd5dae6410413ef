"""Strip charts over time: truth, references, estimates with their standard deviation."""

import math
from typing import NamedTuple

import numpy as np

from ..record import Array
from .canvas import Box, Canvas
from .palette import INK, mixed
from .road import SOFT
from .trace import MOMENT

SPAN = 10.0  # s that are shown at most
_DEGREES = math.degrees(1.0)
_GRID, _ROW = "#E3E6E9", 20.0


class Line(NamedTuple):
    """A line of a strip: values over time, an estimate's standard deviation around it."""

    t: Array
    values: Array
    colour: str
    dashed: bool = False
    deviation: Array | None = None
    width: float = 1.6


class Strip(NamedTuple):
    """A chart: its title with a unit, the least that its axis reaches to either side, and its
    share of the height."""

    title: str
    least: float
    share: float
    lines: list[Line]


def strips_of(
    truth: Array,
    estimates: dict[str, Array],
    colours: dict[str, str],
    ghosts: list[tuple[Array, str]],
    most_moment: float,
    judged: bool,
) -> list[Strip]:
    """Sideslip angle, yaw rate and yaw moment of a car over time, with those of ghosts.

    estimates: by label (n, 2). ghosts: (truth, colour) of each. most_moment: N m, full scale.
    judged: the yaw rate has a reference.
    """

    def of(column: int, factor: float) -> list[Line]:
        others = [Line(g[:, MOMENT.t], factor * g[:, column], shade) for g, shade in ghosts]
        return [*others, Line(t, factor * truth[:, column], INK, width=2.0)]

    t = truth[:, MOMENT.t]
    believed = [
        Line(t, _DEGREES * hat, colours[name], deviation=_DEGREES * std)
        for name, (hat, std) in ((name, each.T) for name, each in estimates.items())
    ]
    wanted = [
        Line(t, _DEGREES * truth[:, column], INK, True, width=1.0)
        for column in (MOMENT.beta_ref, MOMENT.gamma_ref)
    ]
    return [
        Strip("sideslip angle / deg", 1.0, 1.6, [wanted[0], *of(MOMENT.beta, _DEGREES), *believed]),
        Strip("yaw rate / (deg/s)", 10.0, 1.0, [*wanted[1:][:judged], *of(MOMENT.gamma, _DEGREES)]),
        Strip("yaw moment / (N m)", 0.2 * most_moment, 1.0, of(MOMENT.yaw_moment, 1.0)),
    ]


def draw_strips(canvas: Canvas, box: Box, strips: list[Strip], first: float, span: float) -> None:
    """The strips below one another in a box, over `span` seconds from the `first` on."""
    left, top, width, height = box
    high = (height - _ROW) / sum(strip.share for strip in strips)
    y = top
    for strip in strips:
        inside = left + 48.0, y + _ROW, width - 60.0, strip.share * high - _ROW - 4.0
        _strip(canvas, inside, strip, first, span)
        y += strip.share * high
    step = 1.0 if span <= 10.0 else 2.0
    for t in np.arange(math.ceil(first / step) * step, first + span + 1e-6, step):
        x = left + 48.0 + (width - 60.0) * (t - first) / span
        canvas.text((x, top + height - 10.0), f"{t:g}", SOFT, 11, 0.5)
    canvas.text((left, top + height - 10.0), "time / s", SOFT, 11)


def _strip(canvas: Canvas, box: Box, strip: Strip, first: float, span: float) -> None:
    left, top, width, height = box
    largest = max((_largest(line) for line in strip.lines), default=0.0)
    limit = _nice(max(strip.least, 1.05 * largest))

    def on(t: Array, values: Array) -> Array:
        share = np.clip(values / limit, -1.1, 1.1)
        return np.stack([left + width * (t - first) / span, top + 0.5 * height * (1.0 - share)], 1)

    canvas.area(box, "#FFFFFF")
    for share in (-1.0, 0.0, 1.0):
        y = top + 0.5 * height * (1.0 - share)
        canvas.line([(left, y), (left + width, y)], _GRID, 1.0)
        canvas.text((left - 6.0, y), f"{share * limit:g}", SOFT, 11, 1.0)
    canvas.text((left, top - 0.5 * _ROW + 2.0), strip.title, INK, 12)
    canvas.within(box)
    for line in strip.lines:
        if line.deviation is not None:
            there = np.isfinite(line.values) & np.isfinite(line.deviation)
            t, middle, std = line.t[there], line.values[there], line.deviation[there]
            if len(t) > 1:
                edges = on(t, middle + std), on(t, middle - std)[::-1]
                canvas.polygon(np.concatenate(edges), mixed(line.colour, "#FFFFFF", 0.25))
    for line in strip.lines:
        there = np.isfinite(line.values)
        points = on(line.t[there], line.values[there])
        if len(points) > 1:
            draw = canvas.dashes if line.dashed else canvas.line
            draw(points, line.colour, line.width)
        if len(points) and not line.dashed:
            canvas.disc(points[-1], 2.6, line.colour)
    canvas.within(None)


def _largest(line: Line) -> float:
    return float(np.max(np.abs(line.values), initial=0.0, where=np.isfinite(line.values)))


def _nice(limit: float) -> float:
    """The next of 1, 2, 5, 10, ..., times a power of ten."""
    power = 10.0 ** math.floor(math.log10(limit))
    return next(each * power for each in (1.0, 2.0, 3.0, 5.0, 10.0) if each * power >= limit - 1e-9)
