"""A picture of one car: the road, the close-up, and the strip charts."""

import math
from collections.abc import Iterable, Sequence

from ..engine.layout import FLAGS, P
from ..task.failures import FAILURES
from ..task.reference import ZERO_SLIP
from ..ticks import TICK
from .canvas import Canvas, pygame
from .closeup import PAPER, draw_closeup
from .palette import GREY, INK, PALETTE, find_colour
from .road import BLUE, ORANGE, SOFT, CarTrack, draw_road
from .scene import CarScene, make_car_scene
from .strips import MAX_SPAN, draw_strips, make_strips
from .trace import TRACE_POINT, RenderState

SIZE = 960, 540
_ROAD, _CLOSEUP, _STRIPS = (
    (0.0, 40.0, 960.0, 216.0),
    (0.0, 262.0, 336.0, 278.0),
    (344.0, 284.0, 608.0, 252.0),
)


def draw_picture(
    shot: RenderState, name: str = "true", ghosts: Sequence[tuple[str, RenderState]] = ()
) -> pygame.Surface:
    """Draw the picture of a car, with ghosts that drive beside it.

    Args:
        shot: State of the car.
        name: Name of its driver.
        ghosts: Name and state of each ghost.

    Returns:
        The picture.
    """
    p, _, switches, _, config, trace, _, draw_world = shot
    now = trace.newest
    span = min(max(float(p[P.task.duration]) * TICK, 2.0), MAX_SPAN)
    first = max(now[TRACE_POINT.t] - span, 0.0)
    truth, estimates = trace.select_since(first)
    shades = _choose_shades(estimates)
    scene = make_car_scene(shot)
    ghost_cars = [
        CarTrack(make_car_scene(item), item.trace.select_since(first)[0], GREY, ghost_name)
        for ghost_name, item in ghosts
    ]
    canvas = Canvas(SIZE)
    canvas.draw_box((0.0, 0.0, *SIZE), PAPER)
    if draw_world is None:
        draw_road(
            canvas, _ROAD, [*ghost_cars, CarTrack(scene, truth, BLUE, name if ghosts else "")]
        )
    newest = {label: (float(item[-1, 0]), shades[label]) for label, item in estimates.items()}
    finite_estimates = {label: item for label, item in newest.items() if math.isfinite(item[0])}
    draw_closeup(
        canvas, _CLOSEUP, scene, now[TRACE_POINT.beta], now[TRACE_POINT.beta_ref], finite_estimates
    )
    has_yaw_reference = int(switches[FLAGS.reference]) != ZERO_SLIP
    others = [(item.truth, item.colour) for item in ghost_cars]
    full_scale = float(p[P.task.yaw_scale])
    strips = make_strips(truth, estimates, shades, others, full_scale, has_yaw_reference)
    draw_strips(canvas, _STRIPS, strips, first, span)
    _draw_legend(canvas, name, [item for item, _ in ghosts], shades)
    failures = [("", scene.failure), *((item.name, item.scene.failure) for item in ghost_cars)]
    _draw_heading(canvas, scene, config.scenario.name, now[TRACE_POINT.t], failures)
    picture = canvas.finish()
    if draw_world is not None:
        size = int(_ROAD[2]), int(_ROAD[3])
        picture.blit(draw_world(size, [item.scene.motion for item in ghost_cars]), _ROAD[:2])
    return picture


def _choose_shades(labels: Iterable[str]) -> dict[str, str]:
    """Choose a colour for each estimator, its own where no other has it."""
    shades: dict[str, str] = {}
    for label in labels:
        used_shades = shades.values()
        choices = (find_colour(label), *PALETTE)
        shades[label] = next(
            (choice for choice in choices if choice not in used_shades), choices[0]
        )
    return shades


def _draw_legend(canvas: Canvas, name: str, ghosts: Sequence[str], shades: dict[str, str]) -> None:
    entries = [(name, INK, False), ("reference", INK, True)]
    entries += [(ghost, GREY, False) for ghost in ghosts]
    entries += [(f"{label} ± 1 std", shade, False) for label, shade in shades.items()]
    x = _STRIPS[0] + 48.0
    for words, shade, dashed in entries:
        draw_sample = canvas.draw_dashes if dashed else canvas.draw_line
        draw_sample([(x, 272.0), (x + 20.0, 272.0)], shade, 2.5 if not dashed else 1.5)
        x += 26.0 + canvas.draw_text((x + 26.0, 272.0), words, INK, 12) + 18.0


def _draw_heading(
    canvas: Canvas, scene: CarScene, scenario: str, t: float, failures: list[tuple[str, int]]
) -> None:
    """Draw the names of scenario and car, the speed, and whose drive failed."""
    x = 30.0 + canvas.draw_text((16.0, 20.0), scenario, INK, 17, bold=True)
    speed = 3.6 * math.hypot(scene.motion.v_x, scene.motion.v_y)
    car = f"{scene.vehicle.name}, {speed:.0f} km/h, friction {scene.friction:.2f}"
    x += 16.0 + canvas.draw_text((x, 21.0), car, SOFT, 14)
    for name, failure in failures:
        if failure:
            words = f"{name}: {FAILURES[failure]}" if name else FAILURES[failure]
            width = canvas.draw_text((x + 10.0, 20.0), words, "#FFFFFF", 13)
            canvas.draw_box((x, 9.0, width + 20.0, 22.0), ORANGE, 11.0)
            x += width + 30.0
    canvas.draw_text((SIZE[0] - 16.0, 20.0), f"{t:.2f} s", INK, 17, 1.0, True)
