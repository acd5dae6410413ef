"""The picture of a car: the road, a close-up and strip charts over time.

The close-up has its nose to the right: velocity, tyre forces in their friction circles,
motor torques and wind. The charts show truth, references and estimates with their deviation.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..engine.layout import FLAGS, P
from ..numerics.functions import TICK
from ..record import Array
from ..task import FAILURES, ZERO_SLIP
from ..vehicle.parameters import GRAVITY
from . import road
from .canvas import Box, Canvas, pygame
from .palette import GREY, INK, PALETTE, find_colour, mix_colours
from .trace import TRACE_POINT, RenderState

MAX_SPAN = 10.0  # s that are shown at most
_DEGREES = math.degrees(1.0)
_GRID, _ROW = "#E3E6E9", 20.0
_DASH = (6.0, 5.0)  # pixels of a dash and a gap


class _ChartLine(NamedTuple):
    """A line of a chart: values over time (s), an estimate's standard deviation around it."""

    t: Array
    values: Array
    colour: str
    dashed: bool = False
    deviation: Array | None = None
    width: float = 1.6


class _Strip(NamedTuple):
    """A chart; `min_limit` is the smallest half range of its axis, `share` its weight in height."""

    title: str  # with the unit
    min_limit: float
    share: float
    lines: list[_ChartLine]


def _make_strips(
    truth: Array, estimates: dict[str, Array], shades: dict[str, str], ghosts: list[Array],
    max_moment: float, turns: bool,
) -> list[_Strip]:  # fmt: skip
    """Make the charts of sideslip angle, yaw rate (turns: with a reference) and yaw moment."""
    t, point = truth[:, TRACE_POINT.t], TRACE_POINT

    def make_lines(column: int, factor: float = _DEGREES, reference: int = 0) -> list[_ChartLine]:
        lines = [_ChartLine(g[:, point.t], factor * g[:, column], GREY) for g in ghosts]
        if reference:
            lines.insert(0, _ChartLine(t, factor * truth[:, reference], INK, True, width=1.0))
        return [*lines, _ChartLine(t, factor * truth[:, column], INK, width=2.0)]

    slip = make_lines(point.beta, reference=point.beta_ref)
    for name, columns in estimates.items():
        hat, std = _DEGREES * columns.T
        slip.append(_ChartLine(t, hat, shades[name], deviation=std))
    rate = make_lines(point.gamma, reference=point.gamma_ref if turns else 0)
    return [
        _Strip("sideslip angle / deg", 1.0, 1.6, slip),
        _Strip("yaw rate / (deg/s)", 10.0, 1.0, rate),
        _Strip("yaw moment / (N m)", 0.2 * max_moment, 1.0, make_lines(point.yaw_moment, 1.0)),
    ]


def _draw_strips(canvas: Canvas, box: Box, strips: list[_Strip], first: float, span: float) -> None:
    """Draw charts below one another in a box, from the time `first` on for `span` seconds."""
    left, top, width, height = box
    high, y = (height - _ROW) / sum(strip.share for strip in strips), top
    for strip in strips:
        inside = left + 48.0, y + _ROW, width - 60.0, strip.share * high - _ROW - 4.0
        _draw_strip(canvas, inside, strip, first, span)
        y += strip.share * high
    for t in np.arange(math.ceil(first), first + span + 1e-6):
        x = left + 48.0 + (width - 60.0) * (t - first) / span
        canvas.draw_text((x, top + height - 10.0), f"{t:g}", road.SOFT, 11, 0.5)
    canvas.draw_text((left, top + height - 10.0), "time / s", road.SOFT, 11)


def _draw_strip(canvas: Canvas, box: Box, strip: _Strip, first: float, span: float) -> None:
    left, top, width, height = box
    values = np.abs(np.concatenate([line.values for line in strip.lines]))
    largest = float(np.max(values, initial=0.0, where=np.isfinite(values)))
    limit = _find_nice_limit(max(strip.min_limit, 1.05 * largest))

    def to_pixels(t: Array, values: Array) -> Array:
        share = np.clip(values / limit, -1.1, 1.1)
        return np.stack([left + width * (t - first) / span, top + 0.5 * height * (1.0 - share)], 1)

    canvas.draw_box(box, "#FFFFFF")
    for share in (-1.0, 0.0, 1.0):
        y = top + 0.5 * height * (1.0 - share)
        canvas.draw_line([(left, y), (left + width, y)], _GRID, 1.0)
        canvas.draw_text((left - 6.0, y), f"{share * limit:g}", road.SOFT, 11, 1.0)
    canvas.draw_text((left, top - 0.5 * _ROW + 2.0), strip.title, INK, 12)
    canvas.set_clip(box)
    for line in strip.lines:
        std = np.full_like(line.t, np.nan) if line.deviation is None else line.deviation
        is_known = np.isfinite(line.values + std)
        edges = [to_pixels(line.t, line.values + sign * std)[is_known] for sign in (1.0, -1.0)]
        if len(edges[0]) > 1:
            shade = mix_colours(line.colour, "#FFFFFF", 0.25)
            canvas.draw_polygon(np.concatenate([edges[0], edges[1][::-1]]), shade)
    for line in strip.lines:
        points = to_pixels(line.t, line.values)[np.isfinite(line.values)]
        if len(points) > 1:
            canvas.draw_line(points, line.colour, line.width, _DASH * line.dashed)
        if len(points) and not line.dashed:
            canvas.draw_disc(points[-1], 2.6, line.colour)
    canvas.set_clip(None)


def _find_nice_limit(limit: float) -> float:
    """Find the next of 1, 2, 3, 5, 10 times a power of ten."""
    limits = 10.0 ** math.floor(math.log10(limit)) * np.array([1.0, 2.0, 3.0, 5.0, 10.0])
    return float(limits[limits >= limit - 1e-9][0])


_GREEN = PALETTE[2]
_PAPER = "#F7F8F8"
MAGNIFIED = 4.0  # times the sideslip angle is drawn
_LENGTH, _CIRCLE = 190.0, 38.0  # pixels: the car, and the circle of 0.3 of its weight


def _draw_closeup(
    canvas: Canvas, box: Box, scene: road.CarScene, now: Array, estimates: list[tuple[float, str]]
) -> None:
    """Draw a car with its tyres' forces, wind, and sideslip angles, of estimates with colours."""
    body = front, rear, _ = road.compute_body(scene.vehicle)
    scale = _LENGTH / (front - rear)
    x_0, y_0 = box[0] + 0.52 * box[2] - 0.5 * scale * (front + rear), box[1] + 0.5 * box[3]
    to_pixels = road.Projection((x_0, y_0), scale)
    canvas.draw_polygon(to_pixels(body.outline), "#DFE2E5")
    per_newton = _CIRCLE / (0.3 * scene.vehicle.mass * GRAVITY)
    for wheel in scene.wheels:
        _draw_wheel(canvas, wheel, scene.vehicle.wheel_radius, to_pixels, per_newton)
    for wheel, torque in zip(scene.wheels[2:], scene.torques, strict=True):
        place = box[0] + 44.0, to_pixels(np.array([[wheel.x, wheel.y]]))[0, 1]
        _draw_motor(canvas, place, torque, torque / scene.max_torque)
    _draw_directions(canvas, (x_0, y_0), now, estimates)
    if scene.wind:
        foot = np.array([x_0, y_0 + math.copysign(0.5 * box[3] - 34.0, scene.wind)])
        canvas.draw_arrow(foot, foot - (0.0, math.copysign(34.0, scene.wind)), PALETTE[3], 4.0)
        canvas.draw_text((foot[0] + 12.0, foot[1]), f"wind {abs(scene.wind):.0f} N", PALETTE[3], 12)
    x = box[0] + 14.0
    if any(wheel.capacity for wheel in scene.wheels):
        canvas.draw_text((x, box[1] + 12.0), "tyre forces in their friction circles", road.SOFT, 12)
    degrees = round(math.degrees(now[TRACE_POINT.beta]), 1) + 0.0  # no -0.0
    words = f"sideslip angle {degrees:+.1f} deg, drawn x {MAGNIFIED:.0f}"
    canvas.draw_text((x, box[1] + box[3] - 12.0), words, INK, 12)


def _draw_wheel(
    canvas: Canvas, wheel: road.Wheel, r: float, to_pixels: road.Projection, per_newton: float
) -> None:
    """Draw a wheel and its force in its friction circle, from green to orange at the limit."""
    cos, sin = math.cos(wheel.angle), math.sin(wheel.angle)
    forward, left = cos * wheel.F_x - sin * wheel.F_y, sin * wheel.F_x + cos * wheel.F_y
    centre, radius = to_pixels(np.array([[wheel.x, wheel.y]]))[0], wheel.capacity * per_newton
    utilisation = math.hypot(forward, left) / wheel.capacity if wheel.capacity else 0.0
    colour = mix_colours(road.ORANGE, _GREEN, min(utilisation, 1.0) ** 3)
    if wheel.capacity:
        canvas.draw_disc(centre, radius, mix_colours(PALETTE[5], _PAPER, 0.16))
        canvas.draw_disc(centre, radius, mix_colours(PALETTE[5], _PAPER, 0.7), 1.0)
        place = centre[0], centre[1] - math.copysign(radius + 10.0, wheel.y)
        canvas.draw_text(place, f"{100.0 * utilisation:.0f} %", colour, 12, 0.5)
    canvas.draw_polygon(to_pixels(wheel.outline(r)), "#A9B0B7")
    canvas.draw_arrow(centre, centre + per_newton * np.array([forward, -left]), colour, 3.0)


def _draw_motor(canvas: Canvas, place: tuple[float, float], torque: float, share: float) -> None:
    """Draw a rear motor's torque as a bar, to the right where it drives."""
    x, y = place
    length = 30.0 * min(max(share, -1.0), 1.0)
    canvas.draw_box((x - 30.0, y + 4.0, 60.0, 7.0), "#E4E7EA", 3.5)
    canvas.draw_box((x + min(length, 0.0), y + 4.0, abs(length), 7.0), PALETTE[0])
    canvas.draw_line([(x, y + 2.0), (x, y + 13.0)], road.SOFT, 1.0)
    canvas.draw_text((x, y - 6.0), f"{torque:+.0f} N m", INK, 12, 0.5)


def _draw_directions(
    canvas: Canvas, centre: tuple[float, float], now: Array, estimates: list[tuple[float, str]]
) -> None:
    """Draw the directions of the velocity, of its reference and of the estimates."""

    def make_ray(angle: float, length: float) -> Array:
        direction = np.array([math.cos(MAGNIFIED * angle), -math.sin(MAGNIFIED * angle)])
        return np.array([centre, centre + length * direction])

    canvas.draw_line(make_ray(0.0, 138.0), "#C3C8CE", 1.0)
    canvas.draw_line(make_ray(now[TRACE_POINT.beta_ref], 138.0), INK, 1.0, (4.0, 3.0))
    for angle, shade in estimates:
        canvas.draw_line(make_ray(angle, 132.0), shade, 2.0)
    canvas.draw_arrow(centre, make_ray(now[TRACE_POINT.beta], 122.0)[1], INK, 3.0)
    canvas.draw_disc(centre, 4.0, INK)
    canvas.draw_disc(centre, 1.8, "#FFFFFF")


SIZE = 960, 540
_ROAD = (0.0, 40.0, 960.0, 216.0)
_CLOSEUP, _STRIPS = (0.0, 262.0, 336.0, 278.0), (344.0, 284.0, 608.0, 252.0)


def draw_picture(
    shot: RenderState, name: str = "true", ghosts: Sequence[tuple[str, RenderState]] = ()
) -> pygame.Surface:
    """Draw the picture of a car, with ghosts that drive beside it.

    Args:
        shot: State of the car.
        name: Name of its driver.
        ghosts: Name and state of each ghost.
    """
    (p, _, switches, _, config, *_), trace, _, draw_world = shot
    now = trace.rows[-1]
    span = min(max(float(p[P.task.duration]) * TICK, 2.0), MAX_SPAN)
    first = max(now[TRACE_POINT.t] - span, 0.0)
    truth, estimates = trace.select_since(first)
    shades = _choose_shades(estimates)
    scene = road.make_car_scene(shot)
    ghost_cars = [
        road.CarTrack(road.make_car_scene(ghost), ghost.trace.select_since(first)[0], GREY, label)
        for label, ghost in ghosts
    ]
    canvas = Canvas(SIZE)
    canvas.draw_box((0.0, 0.0, *SIZE), _PAPER)
    if draw_world is None:
        driven_car = road.CarTrack(scene, truth, road.BLUE, name if ghosts else "")
        road.draw_road(canvas, _ROAD, [*ghost_cars, driven_car])
    newest = [(float(x[-1, 0]), shades[label]) for label, x in estimates.items()]
    newest = [(angle, shade) for angle, shade in newest if math.isfinite(angle)]
    _draw_closeup(canvas, _CLOSEUP, scene, now, newest)
    turns, scale = int(switches[FLAGS.reference]) != ZERO_SLIP, float(p[P.task.yaw_scale])
    others = [x.truth for x in ghost_cars]
    strips = _make_strips(truth, estimates, shades, others, scale, turns)
    _draw_strips(canvas, _STRIPS, strips, first, span)
    _draw_legend(canvas, name, [item for item, _ in ghosts], shades)
    failures = [("", scene.failure), *((item.name, item.scene.failure) for item in ghost_cars)]
    _draw_heading(canvas, scene, config.scenario.name, now[TRACE_POINT.t], failures)
    picture = canvas.finish()
    if draw_world is not None:
        motions = [item.scene.motion for item in ghost_cars]
        picture.blit(draw_world((int(_ROAD[2]), int(_ROAD[3])), motions), _ROAD[:2])
    return picture


def _choose_shades(labels: Iterable[str]) -> dict[str, str]:
    """Choose a colour for each estimator: its own unless another has it."""
    shades: dict[str, str] = {}
    for label in labels:
        colour = find_colour(label)
        free = (choice for choice in (colour, *PALETTE) if choice not in shades.values())
        shades[label] = next(free, colour)
    return shades


def _draw_legend(canvas: Canvas, name: str, ghosts: list[str], shades: dict[str, str]) -> None:
    entries = [(name, INK, False), ("reference", INK, True)]
    entries += [(ghost, GREY, False) for ghost in ghosts]
    entries += [(f"{label} ± 1 std", shade, False) for label, shade in shades.items()]
    x = _STRIPS[0] + 48.0
    for words, shade, dashed in entries:
        ends, width = [(x, 272.0), (x + 20.0, 272.0)], 1.5 if dashed else 2.5
        canvas.draw_line(ends, shade, width, _DASH * dashed)
        x += 26.0 + canvas.draw_text((x + 26.0, 272.0), words, INK, 12) + 18.0


def _draw_heading(
    canvas: Canvas, scene: road.CarScene, scenario: str, t: float, failures: list[tuple[str, int]]
) -> None:
    """Draw the names of scenario and car, the speed, and whose drive failed."""
    x = 30.0 + canvas.draw_text((16.0, 20.0), scenario, INK, 17, bold=True)
    speed = 3.6 * math.hypot(scene.motion.v_x, scene.motion.v_y)
    car = f"{scene.vehicle.name}, {speed:.0f} km/h, friction {scene.friction:.2f}"
    x += 16.0 + canvas.draw_text((x, 21.0), car, road.SOFT, 14)
    for name, failure in failures:
        if failure:
            words = f"{name}: {FAILURES[failure]}" if name else FAILURES[failure]
            width = canvas.draw_text((x + 10.0, 20.0), words, "#FFFFFF", 13)
            canvas.draw_box((x, 9.0, width + 20.0, 22.0), road.ORANGE, 11.0)
            x += width + 30.0
    canvas.draw_text((SIZE[0] - 16.0, 20.0), f"{t:.2f} s", INK, 17, 1.0, True)
