"""Pictures and films from files, lanes drawn on them, and a camera's calibration by them.

The tilt follows from the vanishing point of straight markings, the height from how they spread
below it over a lane of known width, the intrinsics from a chessboard. Needs the extra `vision`.
"""

import dataclasses
import os
from collections.abc import Iterator, Sequence
from math import atan, cos
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from ..slow import FieldOfView
from .images import WORKING_WIDTH, Image, Pinhole, resample
from .lane_finder import Array, Lane, LaneFinder

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")


def read_picture(path: "str | os.PathLike[str]") -> Image:
    """Read a picture from a file, (height, width, 3) bytes of blue, green, red.

    Args:
        path: Path of the file; FileNotFoundError without it, ValueError for a broken one.
    """
    _check_file(path)
    data = np.fromfile(path, np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        raise ValueError(f"{path}: this is no picture that can be read")
    return np.asarray(picture, np.uint8)


class Film:
    """The frames of a film; FileNotFoundError without the file, ValueError without a first frame.

    Args:
        path: Path of the file.
    """

    def __init__(self, path: "str | os.PathLike[str]") -> None:
        _check_file(path)
        self._reader = cv2.VideoCapture(str(path))
        self.frame_count = max(int(self._reader.get(cv2.CAP_PROP_FRAME_COUNT)), 0)  # of the header
        self.rate = float(self._reader.get(cv2.CAP_PROP_FPS)) or 30.0  # frames a second
        if (first := self._read_frame()) is None:
            raise ValueError(f"{path}: this is no film that can be read")
        self._buffer = [first]

    def _read_frame(self) -> Image | None:
        """The next frame of the file; None where it, or its undamaged part, ends."""
        has_frame, frame = self._reader.read()
        return np.asarray(frame, np.uint8) if has_frame else None

    def read_head(self, count: int) -> list[Image]:
        """Read the first frames, at most `count`, which iteration returns again.

        Args:
            count: Largest number of frames.
        """
        while len(self._buffer) < count and (frame := self._read_frame()) is not None:
            self._buffer.append(frame)
        return list(self._buffer)

    def __iter__(self) -> Iterator[Image]:
        """Iterate over the frames, once, until the file or its undamaged part ends."""
        while self.read_head(1):
            yield self._buffer.pop(0)


def draw_lane(picture: Image, finder: LaneFinder, lane: Lane) -> Image:
    """Draw the markings in a finder's newest picture onto a copy in colour, (height, width, 3).

    Args:
        picture: Picture in grey or colour, shape (height, width) or (height, width, 3).
        finder: Finder whose newest picture this is.
        lane: Result of the finder.
    """
    shown = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture.copy()
    thick = max(shown.shape[1] // 400, 1)
    if finder.fit is not None:
        places = [finder.locate_marking(finder.fit, side) for side in (1, -1)]
        edges = [finder.camera.project_points(finder.rows_ahead, y) for y in places]
        left, right = (np.round(edge[np.isfinite(edge[:, 0])]).astype(np.int32) for edge in edges)
        filled = shown.copy()
        cv2.fillPoly(filled, [np.concatenate([left, right[::-1]])], (80, 160, 0))
        shown = cv2.addWeighted(filled, 0.3, shown, 0.7, 0.0)
        for edge, colour in ((left, (0, 120, 255)), (right, (255, 160, 0))):
            cv2.polylines(shown, [edge], False, colour, 2 * thick, cv2.LINE_AA)
    size, font = 0.3 * thick, cv2.FONT_HERSHEY_SIMPLEX
    place = int(30 * size), int(50 * size)
    for grey, width in ((0, 3 * thick), (255, thick)):
        style = font, size, (grey, grey, grey), width, cv2.LINE_AA
        cv2.putText(shown, lane.describe(), place, *style)
    return np.asarray(shown, np.uint8)


def _check_file(path: "str | os.PathLike[str]") -> None:
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not Path(path).is_file():
        raise ValueError(f"{path}: expected a picture or a film, found a folder")


_MIN_BOARDS = 3
_MAX_PAIRS, _MIN_POINTS = 4000, 20  # pairs of points, and points
_TOP, _BOTTOM = 0.55, 0.92  # of the picture's height: the road, without the bonnet
_LINE_TOLERANCE = 0.004  # distance of a point from its line, of the focal length
_SLOPES = 0.35, 4.0  # across over down, of a lane's own markings
_TILTS, _HEIGHTS = (-0.14, 0.45), (0.8, 3.0)  # rad, m
NEAR, FAR, HEADING = 6.0, 30.0, 0.12  # m, m, rad: beyond a bonnet, where markings are wide enough
_STRAIGHT = 0.003, 0.01, 0.05  # 1/m, rad, rad: curvature, pitch and roll of the lane that shows it


def make_default_camera(size: tuple[int, int]) -> Pinhole:
    """Make a camera of unknown properties: 58 degrees wide, without distortion, level.

    Args:
        size: Width and height of its pictures (px).
    """
    width, height = size
    K = ((0.9 * width, 0.0, width / 2), (0.0, 0.9 * width, height / 2), (0.0, 0.0, 1.0))
    return Pinhole(K=K, dist=(0.0,) * 5, size=size, tilt=0.0, ahead=0.0)


def estimate_mounting(camera: Pinhole, picture: Image, lane_width: float) -> Pinhole:
    """Estimate the tilt and the height of a camera from a picture of a straight lane.

    Raises ValueError if two markings are not found, or fit no straight lane from a car's height.

    Args:
        camera: The camera, whose tilt and height are not used.
        picture: Bytes, grey (height, width) or in colour (height, width, 3).
        lane_width: Distance from marking to marking (m).
    """
    if (pair := _find_pair(*_find_ridges(camera, picture))) is None:
        raise ValueError("no lane: no pair of markings was found; pass the camera tilt and height")
    (a, b), (c, d) = pair  # across = a + b down, left and right
    down = (a - c) / (d - b)
    tilt = atan(-down)
    height = lane_width * cos(tilt) / (d - b)
    mounted_camera = dataclasses.replace(camera, tilt=tilt, height=height)
    view = FieldOfView(HEADING, 0.5 * lane_width)
    finder = LaneFinder(mounted_camera, lane_width, NEAR, FAR, view=view)
    finder.find(picture)
    straight = finder.fit is not None and (np.abs(finder.fit[2:5]) < _STRAIGHT).all()
    if not (straight and _HEIGHTS[0] < height < _HEIGHTS[1]):
        what = f"for a camera {height:.2f} m high and tilted by {tilt:.3f} rad"
        raise ValueError(f"no lane: the best markings fit no straight lane {what}; pass both")
    return mounted_camera


def _find_ridges(camera: Pinhole, picture: Image) -> tuple[Array, Array]:
    """Bright ridges across the rows: points (n, 2) on the plane one unit ahead, weights (n,)."""
    grey = resample(picture if picture.ndim == 2 else picture.max(2))
    rows = slice(int(_TOP * len(grey)), int(_BOTTOM * len(grey)))
    smooth = cv2.GaussianBlur(grey[rows].astype(np.float32), (0, 0), 4.0)
    light = -16.0 * cv2.Laplacian(smooth, cv2.CV_32F)
    middle = light[:, 1:-1]
    level = max(8.0, 4.0 * 1.4826 * float(np.median(np.abs(middle))))
    is_ridge = (middle > level) & (middle >= light[:, :-2]) & (middle > light[:, 2:])
    row, column = np.nonzero(is_ridge[::2])
    pixels = np.stack([column + 1.5, 2.0 * row + rows.start + 0.5], 1)
    pixels = pixels * camera.size[0] / WORKING_WIDTH - 0.5
    weight = np.minimum(middle[::2][row, column], 40.0).astype(float)
    return camera.undistort(pixels) if len(pixels) else pixels, weight


def _find_pair(points: Array, weight: Array) -> tuple[Array, Array] | None:
    """(left, right) markings by random consensus: each (2,), a and b of across = a + b down."""
    if len(points) < _MIN_POINTS:
        return None
    across, down = points.T
    rng = np.random.Generator(np.random.SFC64(len(points)))
    sums = np.cumsum(weight)
    i, j = np.searchsorted(sums, rng.random((2, _MAX_PAIRS)) * sums[-1]).clip(max=len(points) - 1)
    with np.errstate(all="ignore"):
        b = (across[j] - across[i]) / (down[j] - down[i])
    is_marking = (np.abs(b) > _SLOPES[0]) & (np.abs(b) < _SLOPES[1])
    is_marking &= np.abs(down[j] - down[i]) > 0.05
    b, i = b[is_marking, None], i[is_marking]
    a = across[i, None] - b * down[i, None]
    support = (np.abs(across - a - b * down) < _LINE_TOLERANCE * (1.0 + np.abs(b))) @ weight
    a, b = a[:, 0], b[:, 0]
    left, right = np.flatnonzero(b < 0.0), np.flatnonzero(b > 0.0)
    if not (len(left) and len(right)):
        return None
    spread = b[right] - b[left, None]  # a lane's: a wider pair holds another lane too
    support_l, support_r = support[left, None], support[right]
    score = np.minimum(support_l, support_r) + 0.25 * (support_l + support_r)
    tilts = np.arctan((a[right] - a[left, None]) / spread)
    score *= ((tilts > _TILTS[0]) & (tilts < _TILTS[1])) / (1.0 + 0.1 * spread)
    best_left, best_right = np.unravel_index(np.argmax(score), score.shape)
    lines = []
    for k in (left[best_left], right[best_right]):
        start, slope = a[k], b[k]
        for _ in range(3):
            near = np.abs(across - start - slope * down) < _LINE_TOLERANCE * (1.0 + abs(slope))
            slope, start = np.polyfit(down[near], across[near], 1, w=weight[near])
        lines.append(np.array([start, slope]))
    return lines[0], lines[1]


def calibrate_camera(
    paths: Sequence[Path], corners: tuple[int, int] = (9, 6)
) -> tuple[Pinhole, float]:
    """Compute a camera's intrinsics and corners' RMS error (px) from photographs of a chessboard.

    Tilt and height are defaults. Raises ValueError if fewer than three show a board, or the
    photographs have different sizes.

    Args:
        paths: Files of the photographs; those without a board are skipped.
        corners: Inner corners of the board along its two sides.
    """
    board = np.zeros((corners[0] * corners[1], 3), np.float32)
    board[:, :2] = np.mgrid[: corners[0], : corners[1]].T.reshape(-1, 2)
    corner_sets: list[Any] = []
    sizes: set[tuple[int, int]] = set()
    for path in paths:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            continue
        is_found, places = cv2.findChessboardCorners(grey, corners)
        if is_found:
            stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
            corner_sets.append(cv2.cornerSubPix(grey, places, (8, 8), (-1, -1), stop))
            sizes.add((grey.shape[1], grey.shape[0]))
    if (count := len(corner_sets)) < _MIN_BOARDS:
        raise ValueError(
            f"{count} of {len(paths)} files show a chessboard of {corners[0]} x {corners[1]} inner "
            f"corners; expected {_MIN_BOARDS} or more"
        )
    if len(sizes) > 1:
        raise ValueError(f"the boards' photographs have different sizes: {sorted(sizes)}")
    (size,), start = sizes, cast(Any, None)
    error, K, dist, *_ = cv2.calibrateCamera([board] * count, corner_sets, size, start, start)
    return Pinhole(K=tuple(map(tuple, K)), dist=tuple(dist.ravel()[:5]), size=size), float(error)
