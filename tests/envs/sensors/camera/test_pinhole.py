"""The pinhole: pixels and the road's plane are each other's inverse, and both are trigonometry."""

import dataclasses
import json
from math import atan2, cos, hypot, radians, tan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cv2")
from sideslip.envs.sensors.camera.pinhole import Pinhole

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
    rays = camera.compute_rays(400, 601)
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
    camera.write(tmp_path / "camera.json", rms_px=0.8, boards=6)
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
