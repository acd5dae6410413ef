"""A picture of one car: the road, the close-up, and the strip charts."""

import math
from collections.abc import Iterable, Sequence

from ..engine.layout import FLAGS, P
from ..task.failures import FAILURES
from ..task.reference import ZERO_SLIP
from ..ticks import TICK
from .canvas import Canvas, pygame
from .closeup import PAPER, draw_closeup
from .palette import GREY, INK, PALETTE, colour
from .road import BLUE, ORANGE, SOFT, Driven, draw_road
from .scene import Scene, scene_of
from .strips import SPAN, draw_strips, strips_of
from .trace import MOMENT, Shot

SIZE = 960, 540
_ROAD, _CLOSEUP, _STRIPS = (
    (0.0, 40.0, 960.0, 216.0),
    (0.0, 262.0, 336.0, 278.0),
    (344.0, 284.0, 608.0, 252.0),
)


def draw(shot: Shot, name: str = "true", ghosts: Sequence[tuple[str, Shot]] = ()) -> pygame.Surface:
    """The picture of a car, under the name of its driver; ghosts drive beside it, with theirs."""
    p, _, switches, _, config, trace, _, world = shot
    now = trace.now
    span = min(max(float(p[P.task.duration]) * TICK, 2.0), SPAN)
    first = max(now[MOMENT.t] - span, 0.0)
    truth, estimates = trace.since(first)
    shades = _shades(estimates)
    scene = scene_of(shot)
    beside = [Driven(scene_of(each), each.trace.since(first)[0], GREY, who) for who, each in ghosts]
    canvas = Canvas(SIZE)
    canvas.area((0.0, 0.0, *SIZE), PAPER)
    if world is None:
        draw_road(canvas, _ROAD, [*beside, Driven(scene, truth, BLUE, name if ghosts else "")])
    newest = {label: (float(each[-1, 0]), shades[label]) for label, each in estimates.items()}
    known = {label: each for label, each in newest.items() if math.isfinite(each[0])}
    draw_closeup(canvas, _CLOSEUP, scene, now[MOMENT.beta], now[MOMENT.beta_ref], known)
    judged = int(switches[FLAGS.reference]) != ZERO_SLIP
    others = [(each.truth, each.colour) for each in beside]
    full = float(p[P.task.yaw_scale])
    strips = strips_of(truth, estimates, shades, others, full, judged)
    draw_strips(canvas, _STRIPS, strips, first, span)
    _legend(canvas, name, [each for each, _ in ghosts], shades)
    failures = [("", scene.failure), *((each.name, each.scene.failure) for each in beside)]
    _heading(canvas, scene, config.scenario.name, now[MOMENT.t], failures)
    picture = canvas.finished()
    if world is not None:
        size = int(_ROAD[2]), int(_ROAD[3])
        picture.blit(world(size, [each.scene.motion for each in beside]), _ROAD[:2])
    return picture


def _shades(labels: Iterable[str]) -> dict[str, str]:
    """A colour an estimator, its own where no other has it."""
    shades: dict[str, str] = {}
    for label in labels:
        taken = shades.values()
        choices = (colour(label), *PALETTE)
        shades[label] = next((each for each in choices if each not in taken), choices[0])
    return shades


def _legend(canvas: Canvas, name: str, ghosts: Sequence[str], shades: dict[str, str]) -> None:
    entries = [(name, INK, False), ("reference", INK, True)]
    entries += [(each, GREY, False) for each in ghosts]
    entries += [(f"{label} ± 1 std", shade, False) for label, shade in shades.items()]
    x = _STRIPS[0] + 48.0
    for words, shade, dashed in entries:
        draw = canvas.dashes if dashed else canvas.line
        draw([(x, 272.0), (x + 20.0, 272.0)], shade, 2.5 if not dashed else 1.5)
        x += 26.0 + canvas.text((x + 26.0, 272.0), words, INK, 12) + 18.0


def _heading(
    canvas: Canvas, scene: Scene, scenario: str, t: float, failures: list[tuple[str, int]]
) -> None:
    """What is driven, by which car, how fast, and whose drive failed."""
    x = 30.0 + canvas.text((16.0, 20.0), scenario, INK, 17, bold=True)
    speed = 3.6 * math.hypot(scene.motion.v_x, scene.motion.v_y)
    car = f"{scene.vehicle.name}, {speed:.0f} km/h, friction {scene.friction:.2f}"
    x += 16.0 + canvas.text((x, 21.0), car, SOFT, 14)
    for name, failure in failures:
        if failure:
            words = f"{name}: {FAILURES[failure]}" if name else FAILURES[failure]
            width = canvas.text((x + 10.0, 20.0), words, "#FFFFFF", 13)
            canvas.area((x, 9.0, width + 20.0, 22.0), ORANGE, 11.0)
            x += width + 30.0
    canvas.text((SIZE[0] - 16.0, 20.0), f"{t:.2f} s", INK, 17, 1.0, True)
