"""What the pixels of a frame mean, the close-up's arrows, and that drawing changes nothing."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("pygame")
import math
from pathlib import Path

from pygame import sysfont

from sideslip.envs import StabilityEnv
from sideslip.envs.engine.step import make_step_variant
from sideslip.envs.rendering import canvas
from sideslip.envs.rendering.canvas import Canvas, read_pixels
from sideslip.envs.rendering.charts import (
    _CLOSEUP,
    _ROAD,
    _STRIPS,
    MAGNIFIED,
    MAX_SPAN,
    SIZE,
    _draw_closeup,
    draw_picture,
)
from sideslip.envs.rendering.palette import GREY, INK, PALETTE, find_colour, mix_colours
from sideslip.envs.rendering.road import BLUE, ORANGE, CarScene, make_car_scene
from sideslip.envs.rendering.trace import TRACE_POINT, EpisodeTrace
from sideslip.estimators import EstimateObservation

from ..helpers import FULL, bits, play

HARD = FULL | {"steering": "step", "amplitude": 0.12, "onset": 0.1, "roll": True, "friction": 0.5}


def painted(frame: Any, shade: str, box: Any) -> Any:
    """The places (x, y) within a box that have a colour."""
    left, top, width, height = map(int, box)
    wanted = [int(shade[i : i + 2], 16) for i in (1, 3, 5)]
    y, x = np.nonzero((frame[top : top + height, left : left + width] == wanted).all(2))
    return np.stack([x, y], 1)


def started(scenario: Any = "straight", mode: str = "rgb_array", **state: float) -> StabilityEnv:
    env = StabilityEnv(scenario=scenario, render_mode=mode)
    env.reset(seed=0, options={"state": state} if state else None)
    return env


def seen(env: StabilityEnv) -> Any:
    frame = env.render()
    assert frame is not None
    return frame


def scene(env: StabilityEnv) -> Any:
    return make_car_scene(env.make_render_state())


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_positive_heading_points_up_and_left_of_the_road_is_up(side: float) -> None:
    x, y = painted(seen(started(psi=side * 0.5)), BLUE, _ROAD).T
    assert np.corrcoef(x, -y)[0, 1] * side > 0.5
    aside = painted(seen(started(y=side * 1.5)), BLUE, _ROAD)[:, 1].mean()
    assert (0.5 * _ROAD[3] - aside) * side > 20.0


@pytest.mark.parametrize("action", [1.0, -1.0])
def test_a_positive_yaw_moment_drives_the_right_wheel(action: float) -> None:
    env = started()
    for _ in range(5):
        env.step([action])
    now = scene(env)
    left, right = now.torques
    assert right * action > 50.0 > -50.0 > left * action
    pushed = [wheel.F_x * now.vehicle.wheel_radius for wheel in now.wheels]
    assert pushed == pytest.approx([0.0, 0.0, left, right], abs=1e-6)
    rows = painted(seen(env), BLUE, (44.0, _CLOSEUP[1], 31.0, _CLOSEUP[3]))[:, 1]
    below = rows.mean() > 0.5 * _CLOSEUP[3]  # bars to the right drive; the right motor is below
    assert below == (action > 0.0)


def test_forces_are_the_plants_and_stay_in_their_circles() -> None:
    env, fullest = started(HARD), 0.0
    for _ in range(100):
        before = env.motion
        env.step([0.0])
        now = scene(env)
        assert now.motion == env.motion
        for wheel in now.wheels:
            used = np.hypot(wheel.F_x, wheel.F_y) / wheel.capacity
            fullest = max(fullest, used)
            assert used <= 1.0 + 1e-9
    assert fullest > 0.9
    car, (left, right, *rear) = env.vehicle, now.wheels
    F_y = (left.F_y + right.F_y) * np.cos(left.angle) + sum(each.F_y for each in rear)
    moved = (env.motion.v_y - before.v_y) / 0.01 + env.motion.v_x * env.motion.gamma
    rolled = car.roll_moment_arm * (env.motion.phi_dot - before.phi_dot) / 0.01
    assert abs(F_y - car.mass * moved + rolled) < 0.05 * abs(F_y)
    grip = 0.5 * car.mass * 9.81  # of friction 0.5
    assert sum(each.capacity for each in now.wheels) == pytest.approx(grip, rel=1e-2)


def test_linear_tyres_have_no_circle() -> None:
    env = started(FULL | {"tyres": "linear"})
    assert [wheel.capacity for wheel in scene(env).wheels] == [0.0] * 4
    assert make_step_variant(env._row.p, env._row.switches).law == 0


def test_the_chart_has_the_truth_and_an_estimate_where_a_wrapper_makes_one() -> None:
    bare: Any = gym.make("sideslip/YawVision-v0", scenario=HARD, render_mode="rgb_array")
    for env in (bare, EstimateObservation(bare, "exact-kf")):
        env.reset(seed=0)
        frames = [env.render()]
        for _ in range(60):
            env.step(np.zeros(1, np.float32))
        frames.append(env.render())
        lines = [len(painted(frame, find_colour("exact-kf"), _STRIPS)) for frame in frames]
        assert (lines[1] > 20) == (env is not bare)
        truth = [len(painted(frame, INK, _STRIPS)) for frame in frames]
        assert truth[1] > truth[0] + 100


def test_the_legend_names_the_truth_beside_a_level_line_of_its_colour() -> None:
    left, top = int(_STRIPS[0]) + 48, 262
    x, y = painted(seen(started()), INK, (left, top, 20, 20)).T
    assert set(range(2, 18)) <= set(x) and np.ptp(y) < 4 and abs(y.mean() - 10.0) < 2.0


def test_the_chart_begins_anew_with_an_episode_and_slides() -> None:
    env = started(FULL | {"duration": 12.0})
    assert env.render() is not None
    for _ in range(1100):
        env.step([0.0])
    trace = env.make_render_state().trace
    assert len(trace.select_since(0.0, 10_000)[0]) == 1101
    assert len(trace.select_since(0.0)[0]) <= 800
    newest = trace.rows[-1][TRACE_POINT.t]
    assert newest - trace.select_since(newest - MAX_SPAN)[0][0, 0] <= MAX_SPAN
    env.reset()
    assert len(env.make_render_state().trace.select_since(0.0)[0]) == 1


def test_estimates_are_of_their_moment_and_nan_before() -> None:
    trace, state = EpisodeTrace(), np.zeros(500)
    for k in range(300):
        trace.add(np.full(13, 0.01 * k), state)
        if k > 250:
            trace.add_estimate("mine", float(k), 0.1)
    truth, estimates = trace.select_since(2.0, 1000)
    hats = estimates["mine"][:, 0]
    known = np.isfinite(hats)
    assert known.sum() == 49 and np.allclose(hats[known], 100.0 * truth[known, TRACE_POINT.t])


def test_drawing_changes_no_bit() -> None:
    still = StabilityEnv(scenario="slalom")
    drawn = StabilityEnv(scenario="slalom", render_mode="rgb_array")
    assert bits(still.reset(seed=3)) == bits(drawn.reset(seed=3))
    for _ in range(3):
        drawn.render()
        before = drawn.get_state()["state"].tobytes()
        drawn.render()
        assert drawn.get_state()["state"].tobytes() == before
        assert bits(play(still, [0.3] * 40)) == bits(play(drawn, [0.3] * 40))


def test_nothing_is_remembered_before_the_first_picture() -> None:
    env = started()
    env.step([0.0])
    assert env._traces == []
    env.render()
    env.step([0.0])
    assert len(env.make_render_state().trace.select_since(0.0)[0]) == 2


def test_every_road_is_drawn() -> None:
    car: dict[str, Any] = {"vehicle": "passenger-car", "render_mode": "rgb_array"}
    cones = StabilityEnv(scenario="car-iso-3888-1", **car)
    bend = StabilityEnv(scenario="curved-road", render_mode="rgb_array")
    laid = StabilityEnv(scenario="limit-slalom", **car)
    wind = {"base": "gust", "wind_start": 0.0}
    windy = StabilityEnv(scenario=wind, sensors="gps", render_mode="rgb_array")
    for env in (cones, bend, laid, windy):
        env.reset(seed=0)
        env.render()
        for _ in range(60):
            env.step([0.0])
        assert seen(env).shape == (*SIZE[::-1], 3) and seen(env).dtype == np.uint8
    assert len(painted(seen(cones), ORANGE, _ROAD)) > 50
    assert len(painted(seen(bend), ORANGE, _ROAD)) == 0
    assert scene(windy).wind != 0.0 and scene(windy).field_of_view is None
    assert scene(bend).field_of_view.has_lane


def test_a_ghost_drives_beside() -> None:
    one, other = started(), started(y=2.0, Y=2.0)
    alone = painted(seen(one), GREY, _ROAD)
    ghosts = [("without", other.make_render_state())]
    picture = draw_picture(one.make_render_state(), "with control", ghosts)
    both = painted(read_pixels(picture), GREY, _ROAD)
    assert len(both) > len(alone) + 500
    assert both[:, 1].mean() < 0.5 * _ROAD[3]


def test_both_cars_are_named_in_their_colours() -> None:
    one, other = started().make_render_state(), started(y=2.0, Y=2.0).make_render_state()
    bare = read_pixels(draw_picture(one, "", [("", other)]))
    named = read_pixels(draw_picture(one, "lqr", [("no control", other)]))
    for shade in (BLUE, GREY):
        assert len(painted(named, mix_colours(shade, INK, 0.6), _ROAD)) > 0
        assert np.array_equal(painted(named, shade, _ROAD), painted(bare, shade, _ROAD))


BOX = (0.0, 0.0, 400.0, 300.0)
WIND = PALETTE[3]
ESTIMATE = find_colour("exact-kf")


class Noted(Canvas):
    """A canvas that notes arrows and lines as (start, end, colour), y upwards from the middle."""

    def __init__(self) -> None:
        super().__init__((400, 300))
        self.arrows: list[tuple[Any, Any, str]] = []
        self.lines: list[tuple[Any, Any, str]] = []

    def draw_arrow(self, start: Any, end: Any, colour: str, width: float = 2.0) -> None:
        self.arrows.append((_up(start), _up(end), colour))

    def draw_line(self, points: Any, colour: str, width: float = 1.0, dash: Any = None) -> None:
        self.lines.append((_up(points[0]), _up(points[-1]), colour))


def _up(place: Any) -> Any:
    return np.array([place[0], 0.5 * BOX[3] - place[1]])


def still() -> CarScene:
    """A car at a standstill on which nothing acts."""
    now: CarScene = scene(started())
    wheels = tuple(each._replace(angle=0.0, F_x=0.0, F_y=0.0) for each in now.wheels)
    return now._replace(wheels=wheels, wind=0.0, torques=(0.0, 0.0))


def drawn(scene: CarScene, beta: float = 0.0, estimate: float = 0.0) -> Noted:
    canvas, now = Noted(), np.zeros(len(TRACE_POINT))
    now[TRACE_POINT.beta] = beta
    _draw_closeup(canvas, BOX, scene, now, [(estimate, find_colour("exact-kf"))])
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


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("script", [None, "#!/bin/sh\nexec sleep 9\n"], ids=["missing", "slow"])
def test_text_is_drawn_without_a_warning_where_no_font_is_listed(
    script: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if script is not None:
        (tmp_path / "fc-list").write_text(script)
        (tmp_path / "fc-list").chmod(0o755)
        (tmp_path / "sleep").symlink_to("/bin/sleep")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sysfont, "is_init", False)
    monkeypatch.setattr(sysfont, "Sysfonts", {})
    monkeypatch.setattr(sysfont, "Sysalias", {})
    canvas._load_font.cache_clear()
    canvas._render_words.cache_clear()
    assert canvas.Canvas((80, 40)).draw_text((5, 20), "12 m", "#000000", 19) > 10.0
    canvas._load_font.cache_clear()
    canvas._render_words.cache_clear()
