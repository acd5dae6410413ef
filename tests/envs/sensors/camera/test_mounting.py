"""Tilt, height and intrinsics from pictures: rendered ones, and recordings where they are."""

from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")
import cv2

from sideslip.envs.sensors.camera.images import (
    Image,
    Pinhole,
    RoadRenderer,
    RoadScene,
    calibrate_camera,
    make_default_camera,
    read_picture,
)
from sideslip.envs.sensors.camera.lane_finder import Lane, LaneFinder, estimate_mounting
from sideslip.envs.vehicle.dynamics import RoadParams

ROOT = Path(__file__).resolve().parents[4]
PLACES = [folder / "shared" / "data" / "lane_images" for folder in (ROOT, ROOT.parent)]
IMAGES = next(filter(Path.is_dir, PLACES), PLACES[0])
recorded = pytest.mark.skipif(not IMAGES.is_dir(), reason="the shared recordings are not here")
WIDTH = 3.7  # m, of the recordings' lanes


@pytest.mark.parametrize("tilt", [0.0, radians(8.0)])
def test_the_vanishing_point_has_tilt_and_height(tilt: float) -> None:
    camera = Pinhole(tilt=tilt, height=1.2)
    picture = RoadRenderer(camera).render_picture(RoadScene(psi=0.02, y=0.2, s=1.0))
    found = estimate_mounting(replace(camera, tilt=0.05, height=2.0), picture, 3.5)
    assert found.tilt == pytest.approx(tilt, abs=radians(0.6))
    assert found.height == pytest.approx(1.2, rel=0.05)
    with pytest.raises(ValueError, match="no pair of markings"):
        estimate_mounting(camera, np.zeros((720, 1280), np.uint8), 3.5)


CAR = Pinhole(tilt=0.05, height=1.2)


@pytest.mark.parametrize(
    ("scene", "camera"),
    [
        (RoadScene(psi=0.16, y=0.2), CAR),  # no heading in a lane
        (RoadScene(road=RoadParams(0.008, -1e6, 1.0)), CAR),  # not straight
        (RoadScene(y=0.2), replace(CAR, height=4.0)),
        (RoadScene(y=0.2), replace(CAR, height=0.6)),
        (RoadScene(y=0.2), replace(CAR, tilt=-0.18)),
    ],
)
def test_geometry_that_no_car_has_is_no_lane(scene: RoadScene, camera: Pinhole) -> None:
    with pytest.raises(ValueError, match="no lane"):
        estimate_mounting(camera, RoadRenderer(camera).render_picture(scene), 3.5)


@pytest.mark.parametrize("turns", [1, 2])
def test_a_picture_on_its_side_or_its_head_is_no_lane(turns: int) -> None:
    upright = RoadRenderer(Pinhole(tilt=0.0)).render_picture(RoadScene(y=0.2))
    picture = np.rot90(upright, turns).copy()
    with pytest.raises(ValueError, match="no lane"):
        estimate_mounting(make_default_camera((picture.shape[1], picture.shape[0])), picture, 3.5)


@pytest.mark.parametrize("width", [320, 640, 3840])
def test_one_working_scale_has_the_mounting_at_any_size(width: int) -> None:
    camera = replace(make_default_camera((1280, 720)), height=1.3)
    picture = RoadRenderer(camera).render_picture(RoadScene(psi=0.02, y=0.2, s=1.0))
    size = width, width * 9 // 16
    resized = np.asarray(cv2.resize(picture, size), np.uint8)
    found = estimate_mounting(make_default_camera(size), resized, 3.5)
    assert found.size == size and found.tilt == pytest.approx(0.0, abs=radians(0.6))
    assert found.height == pytest.approx(1.3, rel=0.05)


@recorded
@pytest.mark.parametrize("name", ["straight_lines1.jpg", "solidWhiteRight.jpg"])
def test_a_recording_has_one_lane_at_any_size_mirrored_and_none_on_its_side(name: str) -> None:
    picture = read_picture(IMAGES / name)
    height, width = picture.shape[:2]

    def lane(picture: Image) -> Lane:
        unmounted = make_default_camera((picture.shape[1], picture.shape[0]))
        camera = estimate_mounting(unmounted, picture, WIDTH)
        assert 0.8 < camera.height < 1.8
        return LaneFinder(camera, WIDTH, near=6.0, far=30.0).find(picture)

    whole = lane(picture)
    assert whole.quality > 0.5 and abs(whole.y) < 0.4 and abs(np.degrees(whole.psi)) < 2.0
    for wide in (320, 1920):
        size = wide, wide * height // width
        found = lane(np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8))
        assert abs(np.degrees(found.psi - whole.psi)) < 0.5 and abs(found.y - whole.y) < 0.1
    mirrored = lane(np.ascontiguousarray(picture[:, ::-1]))
    assert abs(np.degrees(mirrored.psi + whole.psi)) < 0.5 and abs(mirrored.y + whole.y) < 0.1
    for turns in (1, 2):
        with pytest.raises(ValueError, match="no lane"):
            lane(np.rot90(picture, turns).copy())


@recorded
def test_both_lines_of_the_calibrated_recording() -> None:
    """Its README reads -1.42 deg and a height of 1.25 m."""
    picture = read_picture(IMAGES / "straight_lines1.jpg")
    intrinsics = Pinhole.read(IMAGES / "udacity_1280x720_intrinsics.json")
    camera = estimate_mounting(intrinsics, picture, WIDTH)
    lane = LaneFinder(camera, WIDTH, near=6.0, far=30.0).find(picture)
    assert camera.height == pytest.approx(1.25, abs=0.05)
    assert np.degrees(lane.psi) == pytest.approx(-1.42, abs=0.3)
    assert lane.quality > 0.5 and abs(lane.y) < 0.4 and abs(lane.curvature) < 1e-3


@recorded
def test_six_chessboards_give_the_intrinsics_on_file() -> None:
    known = Pinhole.read(IMAGES / "udacity_1280x720_intrinsics.json")
    found, error = calibrate_camera(sorted((IMAGES / "camera_cal").glob("*.jpg")))
    np.testing.assert_allclose(np.diag(found.K), np.diag(known.K), rtol=0.01)
    assert found.size == known.size and error < 1.0


def test_too_few_boards_are_refused(tmp_path: Path) -> None:
    (tmp_path / "board.jpg").write_bytes(b"none")
    with pytest.raises(ValueError, match="0 of 1 files show a chessboard of 9 x 6"):
        calibrate_camera([tmp_path / "board.jpg"])
