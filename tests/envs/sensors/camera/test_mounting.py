"""Tilt, height and intrinsics from pictures: rendered ones, and recordings where they are."""

from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")

from sideslip.envs.sensors.camera.chessboard import calibrated
from sideslip.envs.sensors.camera.films import read_picture
from sideslip.envs.sensors.camera.finder import LaneFinder
from sideslip.envs.sensors.camera.mounting import default_camera, mounted
from sideslip.envs.sensors.camera.pinhole import Pinhole
from sideslip.envs.sensors.camera.road_image import Painter, Scene

ROOT = Path(__file__).resolve().parents[4]
PLACES = [folder / "shared" / "data" / "lane_images" for folder in (ROOT, ROOT.parent)]
IMAGES = next(filter(Path.is_dir, PLACES), PLACES[0])
recorded = pytest.mark.skipif(not IMAGES.is_dir(), reason="the shared recordings are not here")
WIDTH = 3.7  # m, of the recordings' lanes


@pytest.mark.parametrize("tilt", [0.0, radians(8.0)])
def test_the_vanishing_point_has_tilt_and_height(tilt: float) -> None:
    camera = Pinhole(tilt=tilt, height=1.2)
    picture = Painter(camera).picture(Scene(psi=0.02, y=0.2, s=1.0))
    found = mounted(replace(camera, tilt=0.05, height=2.0), picture, 3.5)
    assert found.tilt == pytest.approx(tilt, abs=radians(0.6))
    assert found.height == pytest.approx(1.2, rel=0.05)
    with pytest.raises(ValueError, match="no pair of markings"):
        mounted(camera, np.zeros((720, 1280), np.uint8), 3.5)


@recorded
def test_both_lines_of_the_calibrated_recording() -> None:
    """Its README reads -1.42 deg and a height of 1.25 m."""
    picture = read_picture(IMAGES / "straight_lines1.jpg")
    camera = mounted(Pinhole.read(IMAGES / "udacity_1280x720_intrinsics.json"), picture, WIDTH)
    lane = LaneFinder(camera, WIDTH, near=6.0, far=30.0).find(picture)
    assert camera.height == pytest.approx(1.25, abs=0.05)
    assert np.degrees(lane.psi) == pytest.approx(-1.42, abs=0.3)
    assert lane.quality > 0.5 and abs(lane.y) < 0.4 and abs(lane.curvature) < 1e-3


@recorded
def test_both_lines_of_the_recording_without_intrinsics() -> None:
    picture = read_picture(IMAGES / "solidWhiteRight.jpg")
    camera = mounted(default_camera((960, 540)), picture, WIDTH)
    lane = LaneFinder(camera, WIDTH, near=6.0, far=30.0).find(picture)
    assert lane.quality > 0.5 and abs(lane.y) < 0.4 and abs(np.degrees(lane.psi)) < 2.0
    assert 0.8 < camera.height < 1.8


@recorded
def test_six_chessboards_give_the_intrinsics_on_file() -> None:
    known = Pinhole.read(IMAGES / "udacity_1280x720_intrinsics.json")
    found, error = calibrated(sorted((IMAGES / "camera_cal").glob("*.jpg")))
    np.testing.assert_allclose(np.diag(found.K), np.diag(known.K), rtol=0.01)
    assert found.size == known.size and error < 1.0


def test_too_few_boards_are_refused(tmp_path: Path) -> None:
    (tmp_path / "board.jpg").write_bytes(b"none")
    with pytest.raises(ValueError, match="0 of 1 files show a chessboard of 9 x 6"):
        calibrated([tmp_path / "board.jpg"])
