"""The car close up, its nose to the right: velocity and sideslip angle, tyre forces in their
friction circles, motor torques, wind."""

import math
from collections.abc import Callable

import numpy as np

from ..record import Array
from ..vehicle.vehicle import GRAVITY
from .canvas import Box, Canvas
from .palette import INK, PALETTE, mixed
from .road import ORANGE, SOFT, body, rounded, wheel_outline
from .scene import Scene

On = Callable[[Array], Array]  # from car axes to pixels
GREEN = PALETTE[2]
PAPER = "#F7F8F8"
MAGNIFIED = 4.0  # times the sideslip angle is drawn
_LENGTH, _CIRCLE = 190.0, 38.0  # pixels: the car, and the circle of 0.3 of its weight


def draw_closeup(
    canvas: Canvas,
    box: Box,
    scene: Scene,
    beta: float,
    reference: float,
    estimates: dict[str, tuple[float, str]],
) -> None:
    """The close-up in a box; angles in rad, estimates by label with their colour."""
    front, rear, half = body(scene.vehicle)
    scale = _LENGTH / (front - rear)
    x_0 = box[0] + 0.52 * box[2] - 0.5 * scale * (front + rear)
    y_0 = box[1] + 0.5 * box[3]

    def on(points: Array) -> Array:
        x, y = np.asarray(points, float).T * scale
        return np.stack([x_0 + x, y_0 - y], 1)

    canvas.polygon(on(rounded(rear, front, half)), "#C9CED4")
    inner = rounded(rear + 0.02, front - 0.02, half - 1.5 / scale)
    canvas.polygon(on(inner), "#EDEFF1")
    per_newton = _CIRCLE / (0.3 * scene.vehicle.mass * GRAVITY)
    for wheel in scene.wheels:
        centre = on(np.array([[wheel.x, wheel.y]]))[0]
        if wheel.capacity > 0.0:
            canvas.disc(centre, wheel.capacity * per_newton, mixed(PALETTE[5], PAPER, 0.16))
            canvas.ring(centre, wheel.capacity * per_newton, mixed(PALETTE[5], PAPER, 0.7), 1.0)
    for wheel in scene.wheels:
        canvas.polygon(on(wheel_outline(wheel.x, wheel.y, wheel.angle, scene.vehicle)), "#A9B0B7")
    _forces(canvas, scene, on, per_newton)
    _motors(canvas, box, scene, on)
    _directions(canvas, (x_0, y_0), beta, reference, estimates)
    if scene.wind:
        foot = np.array([x_0, y_0 + math.copysign(0.5 * box[3] - 34.0, scene.wind)])
        canvas.arrow(foot, foot - (0.0, math.copysign(34.0, scene.wind)), PALETTE[3], 4.0)
        canvas.text((foot[0] + 12.0, foot[1]), f"wind {abs(scene.wind):.0f} N", PALETTE[3], 12)
    if any(wheel.capacity for wheel in scene.wheels):
        words = "tyre forces in their friction circles"
        canvas.text((box[0] + 14.0, box[1] + 12.0), words, SOFT, 12)
    degrees = round(math.degrees(beta), 1) + 0.0  # no -0.0
    words = f"sideslip angle {degrees:+.1f} deg, drawn x {MAGNIFIED:.0f}"
    canvas.text((box[0] + 14.0, box[1] + box[3] - 12.0), words, INK, 12)


def _forces(canvas: Canvas, scene: Scene, on: On, per_newton: float) -> None:
    """An arrow a tyre, from green to orange as it nears its limit, and the share of it in use."""
    for wheel in scene.wheels:
        cos, sin = math.cos(wheel.angle), math.sin(wheel.angle)
        ahead = cos * wheel.F_x - sin * wheel.F_y
        left = sin * wheel.F_x + cos * wheel.F_y
        start = on(np.array([[wheel.x, wheel.y]]))[0]
        used = math.hypot(ahead, left) / wheel.capacity if wheel.capacity else 0.0
        colour = mixed(ORANGE, GREEN, min(used, 1.0) ** 3)
        canvas.arrow(start, start + per_newton * np.array([ahead, -left]), colour, 3.0)
        if wheel.capacity:
            away = math.copysign(wheel.capacity * per_newton + 10.0, wheel.y)
            canvas.text((start[0], start[1] - away), f"{100.0 * used:.0f} %", colour, 12, 0.5)


def _motors(canvas: Canvas, box: Box, scene: Scene, on: On) -> None:
    """Each rear motor's torque as a bar, to the right where it drives."""
    for wheel, torque in zip(scene.wheels[2:], scene.torques, strict=True):
        _, y = on(np.array([[wheel.x, wheel.y]]))[0]
        x = box[0] + 44.0
        canvas.area((x - 30.0, y + 4.0, 60.0, 7.0), "#E4E7EA", 3.5)
        share = min(max(torque / scene.most, -1.0), 1.0)
        canvas.area((x + min(30.0 * share, 0.0), y + 4.0, abs(30.0 * share), 7.0), PALETTE[0])
        canvas.line([(x, y + 2.0), (x, y + 13.0)], SOFT, 1.0)
        canvas.text((x, y - 6.0), f"{torque:+.0f} N m", INK, 12, 0.5)


def _directions(
    canvas: Canvas,
    centre: tuple[float, float],
    beta: float,
    reference: float,
    estimates: dict[str, tuple[float, str]],
) -> None:
    """Where the car goes, where it should, and where the estimates believe it goes."""

    foot = np.array(centre)

    def to(angle: float, length: float) -> Array:
        turned = MAGNIFIED * angle
        return foot + length * np.array([math.cos(turned), -math.sin(turned)])

    canvas.line(np.array([foot, to(0.0, 138.0)]), "#C3C8CE", 1.0)
    canvas.dashes(np.array([foot, to(reference, 138.0)]), INK, 1.0, 4.0, 3.0)
    for angle, colour in estimates.values():
        canvas.line(np.array([foot, to(angle, 132.0)]), colour, 2.0)
    canvas.arrow(foot, to(beta, 122.0), INK, 3.0)
    canvas.disc(centre, 4.0, INK)
    canvas.disc(centre, 1.8, "#FFFFFF")
