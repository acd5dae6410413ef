"""Pictures and films from files, and lanes drawn on them. Needs the extra `vision`."""

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from .images import Image
from .lane_finder import Lane, LaneFinder

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")


def read_picture(path: "str | os.PathLike[str]") -> Image:
    """Read a picture from a file; FileNotFoundError where it is missing.

    Args:
        path: Path of the file.

    Returns:
        Bytes in blue, green, red, shape (height, width, 3).

    Raises:
        ValueError: For a file that is no whole picture.
    """
    _check_file(path)
    data = np.fromfile(path, np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        raise ValueError(f"{path}: this is no picture that can be read")
    return np.asarray(picture, np.uint8)


class Film:
    """The frames of a film, as pictures; FileNotFoundError where the file is missing.

    Args:
        path: Path of the file.

    Attributes:
        frame_count: Number of frames by the file's header.
        rate: Frames per second.

    Raises:
        ValueError: For a file without a first frame.
    """

    def __init__(self, path: "str | os.PathLike[str]") -> None:
        _check_file(path)
        self._reader = cv2.VideoCapture(str(path))
        self.frame_count = max(int(self._reader.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        self.rate = float(self._reader.get(cv2.CAP_PROP_FPS)) or 30.0
        first = self._read_frame()
        if first is None:
            raise ValueError(f"{path}: this is no film that can be read")
        self._buffer = [first]

    def _read_frame(self) -> Image | None:
        """The next frame of the file; None where it, or its undamaged part, ends."""
        has_frame, frame = self._reader.read()
        return np.asarray(frame, np.uint8) if has_frame else None

    def read_head(self, count: int) -> list[Image]:
        """Read the first frames, which iteration returns again.

        Args:
            count: Largest number of frames.

        Returns:
            At most `count` pictures.
        """
        while len(self._buffer) < count and (frame := self._read_frame()) is not None:
            self._buffer.append(frame)
        return list(self._buffer)

    def __iter__(self) -> Iterator[Image]:
        """Iterate over the frames, once, until the file or its undamaged part ends."""
        while self._buffer:
            yield self._buffer.pop(0)
        while (frame := self._read_frame()) is not None:
            yield frame


def draw_lane(picture: Image, finder: LaneFinder, lane: Lane) -> Image:
    """Draw the markings that a finder found in its newest picture onto a copy of it.

    Args:
        picture: Picture in grey or colour, shape (height, width) or (height, width, 3).
        finder: Finder whose newest picture this is.
        lane: Result of the finder.

    Returns:
        Picture in colour, shape (height, width, 3).
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
    size = 0.3 * thick
    place = int(30 * size), int(50 * size)
    for colour, width in (((0, 0, 0), 3 * thick), ((255, 255, 255), thick)):
        cv2.putText(
            shown, describe_lane(lane), place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, width,
            cv2.LINE_AA,
        )  # fmt: skip
    return np.asarray(shown, np.uint8)


def describe_lane(lane: Lane) -> str:
    """Describe a lane in one line.

    Args:
        lane: Result of a finder.

    Returns:
        The text.
    """
    if lane.quality == 0.0:
        return "no lane"
    return (
        f"psi {np.degrees(lane.psi):+.2f} deg, offset {lane.y:+.2f} m, "
        f"curvature {lane.curvature:+.4f} 1/m, quality {lane.quality:.2f}"
    )


def _check_file(path: "str | os.PathLike[str]") -> None:
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not Path(path).is_file():
        raise ValueError(f"{path}: expected a picture or a film, found a folder")
