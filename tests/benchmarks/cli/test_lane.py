"""`sideslip lane` on rendered pictures and films, whole and broken."""

import dataclasses
import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")
import cv2

from sideslip.envs.io import write_document
from sideslip.envs.sensors.camera.images import Pinhole, RoadRenderer, RoadScene
from tests.benchmarks.conftest import Run

CAMERA = Pinhole()
PAINTER = RoadRenderer(CAMERA)
WIDE = ("--lane-width", 3.5)


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    write_document(tmp_path / "camera.json", dataclasses.asdict(CAMERA))
    return tmp_path / "camera.json"


def filmed(path: Path, count: int) -> Path:
    """A film of a car that drifts to the left; its third frame is black."""
    code = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), code, 30.0, CAMERA.size)
    for k in range(count):
        picture = PAINTER.render_picture(RoadScene(psi=0.03, y=0.1 * k, s=float(k)), k)
        writer.write(cv2.cvtColor(picture * (k != 2), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_a_picture_is_read_drawn_and_written(run: Run, camera: Path, tmp_path: Path) -> None:
    picture = PAINTER.render_picture(RoadScene(psi=0.05, y=-0.4))
    cv2.imwrite(str(tmp_path / "road.png"), picture)
    out, numbers = tmp_path / "found.png", tmp_path / "found.json"
    arguments = ("--intrinsics", camera, *WIDE, "--out", out, "--json", numbers)
    status, text, _ = run("lane", tmp_path / "road.png", *arguments)
    assert status == 0 and "offset -0.40 m" in text
    (frame,) = json.loads(numbers.read_text())["frames"]
    assert frame["psi"] == pytest.approx(0.05, abs=2e-3) and frame["quality"] > 0.5
    assert frame["y_l"] == pytest.approx(-0.4 + 5.135 * 0.05, abs=0.02)
    drawn = cv2.imread(str(out))
    assert drawn is not None and (drawn != picture[..., None]).any(2).mean() > 0.02


def test_geometry_that_no_car_has_is_no_lane(run: Run, camera: Path, tmp_path: Path) -> None:
    for scene, said in (
        (RoadScene(psi=0.08), "quality"), (RoadScene(psi=0.2), "no lane"),
        (RoadScene(y=1.5), "quality"), (RoadScene(y=2.0), "no lane"),
    ):  # fmt: skip
        cv2.imwrite(str(tmp_path / "road.png"), PAINTER.render_picture(scene))
        status, text, _ = run("lane", tmp_path / "road.png", "--intrinsics", camera, *WIDE)
        assert status == 0 and said in text


def test_a_film_is_read_and_its_losses_are_counted(run: Run, camera: Path, tmp_path: Path) -> None:
    film, out, numbers = filmed(tmp_path / "a.avi", 6), tmp_path / "b.avi", tmp_path / "b.json"
    arguments = (*WIDE, "--intrinsics", camera)
    status, text, _ = run("lane", film, *arguments, "--out", out, "--json", numbers)
    assert status == 0 and "a lane in 5 of 6 frames" in text
    frames = json.loads(numbers.read_text())["frames"]
    assert frames[2] == dict.fromkeys(frames[2], 0.0)
    np.testing.assert_allclose(
        [each["y"] for each in frames], [0, 0.1, 0, 0.3, 0.4, 0.5], atol=0.03
    )
    written = cv2.VideoCapture(str(out))
    assert sum(written.read()[0] for _ in range(9)) == 6
    data = film.read_bytes()
    film.write_bytes(data[: len(data) // 2])  # it ends within a frame
    status, text, _ = run("lane", film, *arguments)
    assert status == 0 and "the film ends after" in text and "of the 6 frames" in text


def test_what_cannot_be_read_is_one_line_alone(run: Run, camera: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.png"
    cv2.imwrite(str(broken), PAINTER.render_picture(RoadScene()))
    whole = broken.read_bytes()
    small, no_film = tmp_path / "small.png", tmp_path / "none.mp4"
    cv2.imwrite(str(small), np.zeros((90, 160), np.uint8))
    no_film.write_bytes(b"none")
    broken.write_bytes(b"\x89PNG none")
    out = tmp_path / "out.png"
    for arguments, said in (
        ((tmp_path / "no.png",), "there is no such file"),
        ((broken,), "this is no picture that can be read"),
        ((no_film,), "this is no film that can be read"),
        ((small, "--intrinsics", camera), "1280 x 720 pixels, those of"),
        ((small,), "no pair of markings was found"),
        ((small, "--intrinsics", tmp_path / "no.json"), "there is no such camera file"),
        ((small, "--lane-width", 0.1), "--lane-width is 1 to 10 m"),
        ((small, "--out", tmp_path / "out.txt"), "expected a file that ends in .png"),
        ((), "expected a picture or a film, or --calibrate FOLDER"),
        (("--calibrate", tmp_path, "--json", tmp_path / "c.json"), "show a chessboard"),
    ):
        more = () if "--out" in arguments or not arguments else ("--out", out)
        if "--calibrate" in arguments or (arguments and arguments[0] == no_film):
            more = ()
        status, _, err = run("lane", *arguments, *more)
        assert status == 2 and said in " ".join(err.split()), arguments
        assert not out.exists() and not (tmp_path / "c.json").exists()
    broken.write_bytes(whole)


def chunk(kind: bytes, data: bytes) -> bytes:
    """A part of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_a_small_file_with_a_huge_picture_is_refused(tmp_path: Path) -> None:
    """Before it takes memory, by a fresh process: the limit is read where OpenCV is loaded."""
    size, path = 20_000, tmp_path / "huge.png"
    head = struct.pack(">IIBBBBB", size, size, 1, 0, 0, 0, 0)
    rows = zlib.compress(bytes(1 + size // 8) * size, 9)
    parts = ((b"IHDR", head), (b"IDAT", rows), (b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*each) for each in parts))
    command = [sys.executable, "-m", "sideslip", "lane", str(path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2 and "at most 67108864 pixels" in " ".join(done.stderr.split())


def test_a_number_of_400_digits_is_a_line(run: Run, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "road.png"), PAINTER.render_picture(RoadScene()))
    path = tmp_path / "camera.json"
    K = f"[[1{400 * '0'}, 0, 1], [0, 1, 1], [0, 0, 1]]"
    path.write_text(f'{{"K": {K}, "dist": [0, 0, 0, 0, 0], "size": [1280, 720]}}')
    status, _, error = run("lane", tmp_path / "road.png", "--intrinsics", path)
    assert status == 2 and "camera.json: int too large" in " ".join(error.split())
