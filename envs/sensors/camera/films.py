"""Pictures and films from files. Needs the extra `vision`."""

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from .road_image import Image

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")


def read_picture(path: "str | os.PathLike[str]") -> Image:
    """A picture, (height, width, 3) bytes in blue, green, red.

    Raises FileNotFoundError, and ValueError for a file that is no whole picture.
    """
    _check(path)
    data = np.fromfile(path, np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        raise ValueError(f"{path}: this is no picture that can be read")
    return np.asarray(picture, np.uint8)


class Film:
    """The frames of a film, as pictures; `promised` is how many its header promises.

    Raises FileNotFoundError, and ValueError for a file without a first frame.
    """

    def __init__(self, path: "str | os.PathLike[str]") -> None:
        _check(path)
        self._path = str(path)
        self._reader = cv2.VideoCapture(self._path)
        self.promised = max(int(self._reader.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        self.rate = float(self._reader.get(cv2.CAP_PROP_FPS)) or 30.0
        there, first = self._reader.read()
        if not there:
            raise ValueError(f"{path}: this is no film that can be read")
        self.first = np.asarray(first, np.uint8)

    def __iter__(self) -> Iterator[Image]:
        """The frames, the first one again; it ends where the file does, or what is whole of it."""
        yield self.first
        while True:
            there, frame = self._reader.read()
            if not there:
                return
            yield np.asarray(frame, np.uint8)


def _check(path: "str | os.PathLike[str]") -> None:
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not Path(path).is_file():
        raise ValueError(f"{path}: expected a picture or a film, found a folder")
