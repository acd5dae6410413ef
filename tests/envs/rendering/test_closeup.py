"""The close-up's nose is to the right: left is up, for whatever an arrow stands for."""

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pygame")
from sideslip.envs import StabilityEnv
from sideslip.envs.rendering.canvas import Canvas
from sideslip.envs.rendering.charts import MAGNIFIED, _draw_closeup
from sideslip.envs.rendering.palette import INK, PALETTE
from sideslip.envs.rendering.road import CarScene, make_car_scene

BOX = (0.0, 0.0, 400.0, 300.0)
WIND = PALETTE[3]
ESTIMATE = "#123456"


class Noted(Canvas):
    """A canvas that notes arrows and lines as (start, end, colour), y upwards from the middle."""

    def __init__(self) -> None:
        super().__init__((400, 300))
        self.arrows: list[tuple[Any, Any, str]] = []
        self.lines: list[tuple[Any, Any, str]] = []

    def draw_arrow(self, start: Any, end: Any, colour: str, width: float = 2.0) -> None:
        self.arrows.append((_up(start), _up(end), colour))

    def draw_line(self, points: Any, colour: str, width: float = 1.0) -> None:
        self.lines.append((_up(points[0]), _up(points[-1]), colour))


def _up(place: Any) -> Any:
    return np.array([place[0], 0.5 * BOX[3] - place[1]])


def still() -> CarScene:
    """A car at a standstill on which nothing acts."""
    env = StabilityEnv(scenario="straight", render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
    now = make_car_scene(env.make_render_state())
    wheels = tuple(each._replace(angle=0.0, F_x=0.0, F_y=0.0) for each in now.wheels)
    return now._replace(wheels=wheels, wind=0.0, torques=(0.0, 0.0))


def drawn(scene: CarScene, beta: float = 0.0, estimate: float = 0.0) -> Noted:
    canvas = Noted()
    _draw_closeup(canvas, BOX, scene, beta, 0.0, {"filter": (estimate, ESTIMATE)})
    return canvas


def vectors(canvas: Noted) -> list[Any]:
    """Of the tyres' arrows, in the order of the wheels."""
    return [end - start for start, end, colour in canvas.arrows if colour not in (INK, WIND)]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_left_is_up(side: float) -> None:
    """A slip angle to the left, an estimate of one, a force, a steered wheel's drive, the wind."""
    scene, angle = still(), side * 0.1
    length = 122.0, 132.0
    canvas = drawn(scene, beta=angle, estimate=angle)
    velocity = next(end - start for start, end, colour in canvas.arrows if colour == INK)
    estimate = next(end - start for start, end, colour in canvas.lines if colour == ESTIMATE)
    turned = np.array([math.cos(MAGNIFIED * angle), math.sin(MAGNIFIED * angle)])
    np.testing.assert_allclose([velocity, estimate], np.outer(length, turned))
    front, *others = scene.wheels
    for pushed in (front._replace(F_y=side * 500.0), front._replace(F_x=500.0, angle=angle)):
        forces = vectors(drawn(scene._replace(wheels=(pushed, *others))))
        direction = (pushed.F_x * math.cos(angle), pushed.F_x * math.sin(angle) + pushed.F_y)
        assert forces[0] / np.hypot(*forces[0]) == pytest.approx(np.array(direction) / 500.0)
        assert not np.any(forces[1:])
    (start, end, _), = (each for each in drawn(scene._replace(wind=side * 300.0)).arrows
                        if each[2] == WIND)  # fmt: skip
    assert (end - start)[1] * side > 10.0 and end[0] == start[0]
    assert start[1] * side < end[1] * side < 0.0  # it blows on the car


def test_a_mirrored_drive_is_drawn_mirrored() -> None:
    """Every arrow's image is an arrow; left and right wheels change places."""
    rng, scene = np.random.default_rng(0), still()
    wheels = [
        each._replace(F_x=F_x, F_y=F_y, angle=angle if each.x > 0.0 else 0.0)
        for each, (F_x, F_y, angle) in zip(
            scene.wheels, rng.normal(size=(4, 3)) * (300.0, 300.0, 0.2), strict=True
        )
    ]
    image = [wheels[i]._replace(y=-wheels[i].y, F_y=-wheels[i].F_y, angle=-wheels[i].angle)
             for i in (1, 0, 3, 2)]  # fmt: skip
    one = drawn(scene._replace(wheels=tuple(wheels), wind=200.0), beta=0.07, estimate=0.05)
    other = drawn(scene._replace(wheels=tuple(image), wind=-200.0), beta=-0.07, estimate=-0.05)
    order = [1, 0, 3, 2, 4, 5]
    for (start, end, colour), i in zip(one.arrows, order, strict=True):
        np.testing.assert_allclose(
            np.stack(other.arrows[i][:2]), np.stack([start, end]) * (1.0, -1.0), atol=1e-9
        )
        assert other.arrows[i][2] == colour
