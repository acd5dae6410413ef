"""Rendered pictures: paint lies where a walk along the road puts it, and the seed is all chance."""

from dataclasses import replace
from math import cos, sin

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2")
from sideslip.envs.sensors.camera.images import Appearance, RoadRenderer, RoadScene, _make_rotation
from sideslip.envs.sensors.camera.pinhole import Pinhole
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
        return [
            bool(light > 150) for light in PAINTER.render_picture(RoadScene(s=s))[rows, columns]
        ]

    assert bright(2.0)[:-4] == bright(0.0)[4:] and bright(9.0) == bright(0.0)
    assert 0.3 < np.mean([bright(s) for s in range(9)]) < 0.6


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
