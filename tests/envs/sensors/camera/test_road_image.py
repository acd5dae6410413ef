"""The pinhole camera, and rendered pictures whose paint lies where it should."""

from dataclasses import replace
from math import cos, sin

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2")
import dataclasses
import json
from math import atan2, hypot, radians, tan
from pathlib import Path
from typing import Any

from sideslip.envs.io import write_document
from sideslip.envs.sensors.camera.images import (
    Appearance,
    Pinhole,
    RoadRenderer,
    RoadScene,
    _compute_rays,
    _make_rotation,
)
from sideslip.envs.vehicle.dynamics import RoadParams

CAMERA = Pinhole()
CLEAR = Appearance(noise=0.0, blur=0.0)
PAINTER = RoadRenderer(CAMERA, CLEAR)


def walked(scene: RoadScene, ahead: float, aside: float) -> tuple[float, float]:
    """A point of the road in car axes, by small steps along its middle from beside the car."""
    x, y, theta, step = 0.0, -scene.y, 0.0, 1e-3
    road = scene.road
    for k in range(round(ahead / step)):
        share = (scene.s + (k + 0.5) * step - road.start) / road.ramp
        theta += road.curvature * min(max(share, 0.0), 1.0) * step
        x, y = x + step * cos(theta), y + step * sin(theta)
    x, y = x - aside * sin(theta), y + aside * cos(theta)
    c, s = cos(scene.psi), sin(scene.psi)
    return c * x + s * y, c * y - s * x


@pytest.mark.parametrize(
    "scene",
    [
        RoadScene(psi=0.1, y=0.5),
        RoadScene(psi=-0.2, y=-1.0, s=7.3),
        RoadScene(0.05, -0.4, road=RoadParams(0.02, -1e6, 1.0)),
        RoadScene(s=12.0, road=RoadParams(-0.03, 20.0, 20.0)),  # the ramp begins 8 m ahead
        RoadScene(s=27.0, psi=-0.1, road=RoadParams(0.02, 20.0, 20.0)),  # the car is on it
    ],
)
def test_the_solid_marking_lies_where_a_walk_along_the_road_ends(scene: RoadScene) -> None:
    picture = PAINTER.render_picture(scene)
    for ahead in (5.0, 8.0, 12.0, 15.0):
        for aside, bright in ((-1.75, True), (-1.55, False), (-1.95, False), (0.0, False)):
            x, y = walked(scene, ahead, aside)
            column, row = np.round(CAMERA.project_points(np.array(x), np.array(y))).astype(int)
            assert (picture[row, column] > 150) == bright, (ahead, aside)


def test_a_body_rolls_and_then_nods() -> None:
    """Left side up and nose down are positive; a rotation keeps lengths and angles."""
    for roll, pitch in ((0.3, 0.0), (0.0, 0.2), (-0.1, 0.05)):
        turned = Rotation.from_euler("YX", [pitch, roll]).as_matrix()
        np.testing.assert_allclose(_make_rotation(roll, pitch), turned, atol=1e-15)
    assert _make_rotation(0.1, 0.0)[2, 1] > 0.0 > _make_rotation(0.0, 0.1)[2, 0]


def test_dashes_move_with_the_car() -> None:
    def bright(s: float) -> list[bool]:
        pixels = CAMERA.project_points(np.arange(5.0, 15.0, 0.5), np.array(1.75))
        columns, rows = np.round(pixels).astype(int).T
        lights = PAINTER.render_picture(RoadScene(s=s))[rows, columns]
        return [bool(light > 150) for light in lights]

    assert bright(2.0)[:-4] == bright(0.0)[4:] and bright(9.0) == bright(0.0)
    assert 0.3 < np.mean([bright(s) for s in range(0, 9, 2)]) < 0.6


def test_one_seed_one_picture() -> None:
    noisy = RoadRenderer(CAMERA, Appearance(noise=5.0), rows=(300, 500))
    first = noisy.render_picture(RoadScene(), (7, 33))
    np.testing.assert_array_equal(first, noisy.render_picture(RoadScene(), (7, 33)))
    for other in ((7, 34), (8, 33)):
        assert (first != noisy.render_picture(RoadScene(), other)).mean() > 0.2
    assert not first[:300].any() and not first[500:].any()
    clear = RoadRenderer(CAMERA, CLEAR, rows=(300, 500)).render_picture(RoadScene())
    np.testing.assert_array_equal(clear[300:500], PAINTER.render_picture(RoadScene())[300:500])
    spread = (first.astype(float) - clear)[320:480][(clear == 85)[320:480]].std()
    assert spread == pytest.approx(5.0, rel=0.05)


def test_wear_takes_paint_and_shadow_light() -> None:
    whole = PAINTER.render_picture(RoadScene())[320:]
    for wear in (0.3, 1.0):
        worn = RoadRenderer(CAMERA, replace(CLEAR, wear=wear)).render_picture(RoadScene())[320:]
        assert (worn > 150).sum() / (whole > 150).sum() == pytest.approx(1.0 - wear, abs=0.1)
    dark = RoadRenderer(CAMERA, replace(CLEAR, shadow=0.5)).render_picture(RoadScene())[320:]
    assert 0.1 < (dark < whole).mean() < 0.7 and dark[dark < whole].max() <= 108


def test_an_appearance_out_of_place_is_named() -> None:
    for fields, said in (({"noise": -1.0}, "noise is zero"), ({"wear": 1.2}, "shares")):
        with pytest.raises(ValueError, match=said):
            Appearance(**fields)


PLAIN = Pinhole(dist=(0.0,) * 5)


def test_the_papers_tilt_and_preview_distance() -> None:
    assert Pinhole().tilt == pytest.approx(radians(8.0)) and Pinhole().preview == 5.135


@pytest.mark.parametrize(("x", "y"), [(5.135, 0.0), (12.0, 2.0), (20.0, -6.0)])
def test_a_point_lies_where_its_angles_put_it(x: float, y: float) -> None:
    """Straight ahead it is seen atan(h / x) below the horizon, and the axis is 8 deg below it."""
    below = atan2(1.3, x - 0.2)
    row = 359.5 + 640.0 * tan(below - radians(8.0))
    depth = hypot(1.3, x - 0.2) * cos(below - radians(8.0))
    found = PLAIN.project_points(np.array(x), np.array(y))
    np.testing.assert_allclose(found, [639.5 - 640.0 * y / depth, row], atol=1e-9)


def test_rays_meet_the_road_where_its_points_are_seen() -> None:
    camera = Pinhole()
    rays = np.moveaxis(_compute_rays(camera, slice(400, 601)), 0, -1)
    rows, columns = np.array([400, 450, 600]), np.array([80, 700, 1250])
    ray = rays[rows - 400, columns]
    reach = -camera.height / ray[:, 2]
    x, y = camera.ahead + reach * ray[:, 0], reach * ray[:, 1]
    np.testing.assert_allclose(camera.project_points(x, y), np.stack([columns, rows], 1), atol=1e-3)


def test_what_is_behind_or_beside_is_not_seen() -> None:
    found = Pinhole().project_points(np.array([-5.0, 5.0, 5.0]), np.array([0.0, 60.0, 0.0]))
    np.testing.assert_array_equal(np.isnan(found[:, 0]), [True, True, False])


def test_a_file_of_a_camera_comes_back(tmp_path: Path) -> None:
    camera = Pinhole(tilt=0.1, height=1.1)
    numbers = dataclasses.asdict(camera) | {"rms_px": 0.8, "boards": 6}
    write_document(tmp_path / "camera.json", numbers)
    assert Pinhole.read(tmp_path / "camera.json") == camera


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"K": [[1.0, 0.0], [0.0, 1.0]]}, "K is a 3 x 3 camera matrix"),
        ({"dist": [0.1]}, "dist is k1, k2, p1, p2"),
        ({"size": [0, 720]}, "size is .width, height. in pixels"),
        ({"size": 7}, "a camera's fields"),
        ({"height": -1.0}, "height and rate are positive"),
        ({"tilt": "steep"}, "tilt is a number"),
        ({"hight": 1.0}, "did you mean 'height'"),
        ({"height": 1.2}, "a camera needs K, dist, size"),
    ],
)
def test_a_value_out_of_place_is_named(values: dict[str, Any], said: str, tmp_path: Path) -> None:
    path, whole = tmp_path / "camera.json", dataclasses.asdict(Pinhole())
    path.write_text(json.dumps(values if said.startswith("a camera needs") else whole | values))
    with pytest.raises(ValueError, match=f"camera.json: .*{said}"):
        Pinhole.read(path)
