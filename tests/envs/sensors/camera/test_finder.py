"""The lane finder on rendered pictures whose truth is known."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from math import radians

import numpy as np
import pytest

pytest.importorskip("cv2")
import cv2

from sideslip.envs.numerics.jit import as_python
from sideslip.envs.sensors.camera.images import Appearance, Pinhole, RoadRenderer, RoadScene
from sideslip.envs.sensors.camera.lane_finder import Lane, LaneFinder, _search_starts
from sideslip.envs.sensors.slow import FieldOfView, compute_preview_offset
from sideslip.envs.vehicle.dynamics import RoadParams, compute_curvature

VIEW = FieldOfView(0.35, 4.0)  # of the scored scenarios
CAMERA = Pinhole()
FINDER = LaneFinder(CAMERA)
CLEAR = RoadRenderer(CAMERA, Appearance(), FINDER.rows)


def truth(scene: RoadScene) -> tuple[float, float]:
    """(psi, y_l) as the analytic camera has them, without noise."""
    kappa = as_python(compute_curvature)(scene.road, scene.s)
    return scene.psi, as_python(compute_preview_offset)(scene.y, scene.psi, kappa, CAMERA.preview)


def errors(
    scenes: Iterable[RoadScene], painter: RoadRenderer = CLEAR
) -> tuple[float, float, list[Lane]]:
    """(rms of psi in degrees, rms of y_l in cm, the lanes); what is lost counts for nothing."""
    lanes, rest = [], []
    for seed, scene in enumerate(scenes):
        lanes.append(FINDER.find(painter.render_picture(scene, seed)))
        if lanes[-1].quality > 0.0:
            rest.append(np.subtract(lanes[-1][:2], truth(scene)))
    psi, y_l = np.sqrt(np.mean(np.square(rest), axis=0))
    return np.degrees(psi), 100.0 * y_l, lanes


def draws(count: int, bend: float = 0.0, view: FieldOfView = VIEW) -> list[RoadScene]:
    rng = np.random.default_rng(5)
    low = np.array([-view.heading, -view.offset, 0.0, -bend])
    places = rng.uniform(low, [view.heading, view.offset, 500.0, bend], (count, 4))
    return [RoadScene(psi, y, s, road=RoadParams(kappa, -1e6, 1.0)) for psi, y, s, kappa in places]


def test_over_the_field_of_view_within_a_fifth_of_a_degree_and_two_centimetres() -> None:
    headings = offsets = np.linspace(-1.0, 1.0, 5)
    places = enumerate(product(headings, offsets))
    grid = [RoadScene(VIEW.heading * a, VIEW.offset * b, 3.0 * k) for k, (a, b) in places]
    for scenes in (grid, draws(25)):
        psi, y_l, lanes = errors(scenes)
        assert psi < 0.2 and y_l < 2.0
        assert min(lane.quality for lane in lanes) > 0.5


def test_bends_are_found_with_their_curvature() -> None:
    scenes = draws(30, 0.02, FieldOfView(0.15, 1.2))
    psi, y_l, lanes = errors(scenes)
    assert psi < 0.2 and y_l < 2.0 and all(lane.quality > 0.5 for lane in lanes)
    kappa = [scene.road.curvature for scene in scenes]
    assert np.std(np.subtract([lane.curvature for lane in lanes], kappa)) < 5e-4


@pytest.mark.parametrize(
    ("look", "psi", "y_l"),
    [
        (Appearance(noise=12.0), 0.3, 3.0),
        (Appearance(shadow=0.6), 0.3, 2.0),
        (Appearance(wear=0.5), 0.5, 4.0),
    ],
)
def test_it_degrades_gently(look: Appearance, psi: float, y_l: float) -> None:
    found = errors(draws(20), RoadRenderer(CAMERA, look, FINDER.rows))
    assert found[0] < psi and found[1] < y_l
    assert np.mean([lane.quality > 0.0 for lane in found[2]]) > 0.9


def test_pitch_and_roll_are_told_from_the_lane() -> None:
    for scene in draws(10, view=FieldOfView(0.1, 1.0)):
        assert FINDER.find(CLEAR.render_picture(scene)).quality > 0.0 and FINDER.fit is not None
        assert abs(FINDER.fit.pitch) < radians(0.1)  # a tilt that is wrong would be seen here
    for pitch in (-0.015, 0.015):
        lane = FINDER.find(CLEAR.render_picture(RoadScene(psi=0.05, y=0.3, pitch=pitch)))
        assert FINDER.fit is not None and FINDER.fit.pitch == pytest.approx(pitch, abs=2e-3)
        assert lane.y_l == pytest.approx(0.3 + 5.135 * 0.05, abs=0.02)
    # in the lane's middle nothing shows a roll
    lane = FINDER.find(CLEAR.render_picture(RoadScene(y=1.5, roll=0.02)))
    assert FINDER.fit is not None and FINDER.fit.roll == pytest.approx(0.02, abs=4e-3)
    assert lane.y_l == pytest.approx(1.5, abs=0.04)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_of_two_lanes_the_cars_own_is_taken(side: float) -> None:
    """Even where the marking beyond the next lane is the fresher one."""
    width = 3.7
    x = np.tile(np.linspace(6.0, 30.0, 60), 3)
    y = np.repeat(side * width * np.array([-0.5, 0.5, 1.5]), 60)
    weight = np.repeat([1.0, 1.2, 1.1], 60)
    best = _search_starts(x, y, weight, Pinhole(height=1.2), width)[0]
    assert best[1] == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("noise", [0.0, 2.0, 30.0])
def test_without_markings_the_lane_is_lost_and_no_number_is_wild(noise: float) -> None:
    bare = RoadRenderer(CAMERA, Appearance(wear=1.0, noise=noise, shadow=0.5), FINDER.rows)
    for seed in range(3):
        assert FINDER.find(bare.render_picture(RoadScene(psi=0.1), seed)) == Lane() == (0.0,) * 5
    assert FINDER.find(np.zeros((720, 1280), np.uint8)).quality == 0.0
    chance = np.random.default_rng(1).integers(0, 256, (720, 1280), np.uint8)
    assert FINDER.find(chance).quality == 0.0


def test_beyond_the_field_of_view_it_is_lost() -> None:
    narrow = LaneFinder(CAMERA, view=FieldOfView(0.1, 1.0))
    for scene, seen in ((RoadScene(psi=0.08), 1), (RoadScene(psi=0.12), 0), (RoadScene(y=-1.1), 0)):
        assert (narrow.find(CLEAR.render_picture(scene)).quality > 0.0) == seen


def test_one_picture_one_answer_in_grey_and_in_colour() -> None:
    picture = CLEAR.render_picture(RoadScene(psi=0.05, y=0.2), 1)
    first = FINDER.find(picture)
    FINDER.find(CLEAR.render_picture(RoadScene(psi=-0.3, y=2.0), 2))
    assert FINDER.find(picture) == first
    assert FINDER.find(np.repeat(picture[..., None], 3, 2)) == first


def scaled(width: int) -> Pinhole:
    """The camera with pictures of so many pixels across."""
    scale = width / CAMERA.size[0]
    K = np.diag([scale, scale, 1.0]) @ np.array(CAMERA.K)
    K[:2, 2] += 0.5 * (scale - 1.0)
    return replace(CAMERA, K=tuple(map(tuple, K)), size=(width, round(scale * CAMERA.size[1])))


@pytest.mark.parametrize("width", [320, 640, 3840])
def test_one_working_scale_finds_the_same_lane_in_a_picture_of_any_size(width: int) -> None:
    finder = LaneFinder(scaled(width))
    way = cv2.INTER_AREA if width < 1280 else cv2.INTER_LINEAR
    bend = RoadScene(-0.04, 0.5, road=RoadParams(0.006, -1e6, 1.0))
    for scene in (RoadScene(psi=0.05, y=-0.4, s=3.0), bend):
        picture = CLEAR.render_picture(scene, 1)
        whole = FINDER.find(picture)
        other = cv2.resize(picture, finder.camera.size, interpolation=way)
        lane = finder.find(np.asarray(other, np.uint8))
        np.testing.assert_allclose(lane[:2], whole[:2], atol=0.01)
        assert lane.curvature == pytest.approx(whole.curvature, abs=1e-3)
        assert lane.quality == pytest.approx(min(1.0, width / 640), abs=0.1)


def test_a_working_scale_asks_for_as_many_rows_and_points_whatever_the_picture() -> None:
    assert len({len(LaneFinder(scaled(width)).rows_ahead) for width in (320, 1280, 3840)}) == 1


def test_quality_falls_with_what_was_seen() -> None:
    picture = CLEAR.render_picture(RoadScene(psi=0.05, y=0.2), 1)
    full = FINDER.find(picture)
    glare, near = picture.copy(), picture.copy()
    glare[:, 900:] = 255  # beside the lane
    lane = FINDER.find(glare)
    assert full.quality == 1.0 and 0.0 < lane.quality < 0.8
    assert lane[:2] == pytest.approx(full[:2], abs=0.01)
    row = float(CAMERA.project_points(np.array(10.0), np.array(0.0))[1])
    near[: round(row)] = 85  # nothing is painted beyond
    assert 0.0 < FINDER.find(near).quality < 0.35


def test_a_picture_of_another_size_and_a_blind_camera_are_refused() -> None:
    with pytest.raises(ValueError, match=r"expected a picture of \(1280, 720\)"):
        FINDER.find(np.zeros((480, 640), np.uint8))
    with pytest.raises(ValueError, match="does not see the road"):
        LaneFinder(Pinhole(tilt=-0.9))
    with pytest.raises(ValueError, match="0 < near < far"):
        LaneFinder(CAMERA, near=9.0, far=5.0)
