"""The car close up, its nose to the right: velocity and sideslip angle, tyre forces in their
friction circles, motor torques, wind."""

import math
from collections.abc import Callable

import numpy as np

from ..record import Array
from ..vehicle.vehicle import GRAVITY
from .canvas import Box, Canvas
from .palette import INK, PALETTE, mix_colours
from .road import ORANGE, SOFT, compute_body, make_body_outline, make_wheel_outline
from .scene import CarScene

ToPixels = Callable[[Array], Array]  # from car axes to pixels
GREEN = PALETTE[2]
PAPER = "#F7F8F8"
MAGNIFIED = 4.0  # times the sideslip angle is drawn
_LENGTH, _CIRCLE = 190.0, 38.0  # pixels: the car, and the circle of 0.3 of its weight


def draw_closeup(
    canvas: Canvas,
    box: Box,
    scene: CarScene,
    beta: float,
    reference: float,
    estimates: dict[str, tuple[float, str]],
) -> None:
    """Draw the close-up of a car in a box.

    Args:
        canvas: The canvas.
        box: The box.
        scene: The car.
        beta: Sideslip angle (rad).
        reference: Reference of the sideslip angle (rad).
        estimates: By label, estimate of the sideslip angle (rad) and its colour.
    """
    front, rear, half = compute_body(scene.vehicle)
    scale = _LENGTH / (front - rear)
    x_0 = box[0] + 0.52 * box[2] - 0.5 * scale * (front + rear)
    y_0 = box[1] + 0.5 * box[3]

    def to_pixels(points: Array) -> Array:
        x, y = np.asarray(points, float).T * scale
        return np.stack([x_0 + x, y_0 - y], 1)

    canvas.draw_polygon(to_pixels(make_body_outline(rear, front, half)), "#C9CED4")
    inner = make_body_outline(rear + 0.02, front - 0.02, half - 1.5 / scale)
    canvas.draw_polygon(to_pixels(inner), "#EDEFF1")
    per_newton = _CIRCLE / (0.3 * scene.vehicle.mass * GRAVITY)
    for wheel in scene.wheels:
        centre = to_pixels(np.array([[wheel.x, wheel.y]]))[0]
        if wheel.capacity > 0.0:
            canvas.draw_disc(
                centre, wheel.capacity * per_newton, mix_colours(PALETTE[5], PAPER, 0.16)
            )
            canvas.draw_ring(
                centre, wheel.capacity * per_newton, mix_colours(PALETTE[5], PAPER, 0.7), 1.0
            )
    for wheel in scene.wheels:
        canvas.draw_polygon(
            to_pixels(make_wheel_outline(wheel.x, wheel.y, wheel.angle, scene.vehicle)), "#A9B0B7"
        )
    _draw_forces(canvas, scene, to_pixels, per_newton)
    _draw_motors(canvas, box, scene, to_pixels)
    _draw_directions(canvas, (x_0, y_0), beta, reference, estimates)
    if scene.wind:
        foot = np.array([x_0, y_0 + math.copysign(0.5 * box[3] - 34.0, scene.wind)])
        canvas.draw_arrow(foot, foot - (0.0, math.copysign(34.0, scene.wind)), PALETTE[3], 4.0)
        canvas.draw_text((foot[0] + 12.0, foot[1]), f"wind {abs(scene.wind):.0f} N", PALETTE[3], 12)
    if any(wheel.capacity for wheel in scene.wheels):
        words = "tyre forces in their friction circles"
        canvas.draw_text((box[0] + 14.0, box[1] + 12.0), words, SOFT, 12)
    degrees = round(math.degrees(beta), 1) + 0.0  # no -0.0
    words = f"sideslip angle {degrees:+.1f} deg, drawn x {MAGNIFIED:.0f}"
    canvas.draw_text((box[0] + 14.0, box[1] + box[3] - 12.0), words, INK, 12)


def _draw_forces(canvas: Canvas, scene: CarScene, to_pixels: ToPixels, per_newton: float) -> None:
    """Draw an arrow a tyre, from green to orange as it nears its limit, and the fraction in use."""
    for wheel in scene.wheels:
        cos, sin = math.cos(wheel.angle), math.sin(wheel.angle)
        forward = cos * wheel.F_x - sin * wheel.F_y
        left = sin * wheel.F_x + cos * wheel.F_y
        start = to_pixels(np.array([[wheel.x, wheel.y]]))[0]
        utilisation = math.hypot(forward, left) / wheel.capacity if wheel.capacity else 0.0
        colour = mix_colours(ORANGE, GREEN, min(utilisation, 1.0) ** 3)
        canvas.draw_arrow(start, start + per_newton * np.array([forward, -left]), colour, 3.0)
        if wheel.capacity:
            label_gap = math.copysign(wheel.capacity * per_newton + 10.0, wheel.y)
            canvas.draw_text(
                (start[0], start[1] - label_gap), f"{100.0 * utilisation:.0f} %", colour, 12, 0.5
            )


def _draw_motors(canvas: Canvas, box: Box, scene: CarScene, to_pixels: ToPixels) -> None:
    """Each rear motor's torque as a bar, to the right where it drives."""
    for wheel, torque in zip(scene.wheels[2:], scene.torques, strict=True):
        _, y = to_pixels(np.array([[wheel.x, wheel.y]]))[0]
        x = box[0] + 44.0
        canvas.draw_box((x - 30.0, y + 4.0, 60.0, 7.0), "#E4E7EA", 3.5)
        share = min(max(torque / scene.max_torque, -1.0), 1.0)
        canvas.draw_box((x + min(30.0 * share, 0.0), y + 4.0, abs(30.0 * share), 7.0), PALETTE[0])
        canvas.draw_line([(x, y + 2.0), (x, y + 13.0)], SOFT, 1.0)
        canvas.draw_text((x, y - 6.0), f"{torque:+.0f} N m", INK, 12, 0.5)


def _draw_directions(
    canvas: Canvas,
    centre: tuple[float, float],
    beta: float,
    reference: float,
    estimates: dict[str, tuple[float, str]],
) -> None:
    """Draw the directions of the velocity, of its reference and of the estimates."""

    foot = np.array(centre)

    def find_tip(angle: float, length: float) -> Array:
        drawn_angle = MAGNIFIED * angle
        return foot + length * np.array([math.cos(drawn_angle), -math.sin(drawn_angle)])

    canvas.draw_line(np.array([foot, find_tip(0.0, 138.0)]), "#C3C8CE", 1.0)
    canvas.draw_dashes(np.array([foot, find_tip(reference, 138.0)]), INK, 1.0, 4.0, 3.0)
    for angle, colour in estimates.values():
        canvas.draw_line(np.array([foot, find_tip(angle, 132.0)]), colour, 2.0)
    canvas.draw_arrow(foot, find_tip(beta, 122.0), INK, 3.0)
    canvas.draw_disc(centre, 4.0, INK)
    canvas.draw_disc(centre, 1.8, "#FFFFFF")
