"""The pinhole camera on a car: projection of the road's plane to pixels, and back.

Car axes: X forward, Y left, Z up, from the road below the centre of gravity. Needs `vision`.
"""

import dataclasses
import os
from dataclasses import dataclass
from math import cos, radians, sin
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...io import read_document, write_document
from ...validation import describe_unknown, is_finite, short_repr

Array = npt.NDArray[np.floating[Any]]
_MATRIX = ((640.0, 0.0, 639.5), (0.0, 640.0, 359.5), (0.0, 0.0, 1.0))
WORKING_WIDTH = 1280  # px, of a picture in which a lane is looked for
_MEASURED = ("rms_px", "boards")  # further entries of a calibration file


@dataclass(frozen=True)
class Pinhole:
    """A camera's intrinsics and mounting; a value out of place raises ValueError.

    The defaults are the papers' tilt and preview, and a lens that sees both markings throughout the
    analytic camera's field of view.
    """

    K: tuple[tuple[float, ...], ...] = _MATRIX  # px, the camera matrix
    dist: tuple[float, ...] = (-0.1, 0.01, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3
    size: tuple[int, int] = (1280, 720)  # px, width and height
    height: float = 1.3  # m, above the road
    tilt: float = radians(8.0)  # rad, downwards
    ahead: float = 0.2  # m, of the centre of gravity
    preview: float = 5.135  # m, ahead of the centre of gravity, at which y_l is measured
    rate: float = 30.0  # frames a second

    def __post_init__(self) -> None:
        K, dist = np.array(self.K, float), np.array(self.dist, float).ravel()
        if K.shape != (3, 3) or not (np.isfinite(K).all() and K[0, 0] > 0.0 and K[1, 1] > 0.0):
            raise ValueError(f"K is a 3 x 3 camera matrix in pixels, got {short_repr(self.K)}")
        if len(dist) not in (4, 5) or not np.isfinite(dist).all():
            raise ValueError(f"dist is k1, k2, p1, p2 and perhaps k3, got {short_repr(self.dist)}")
        size = tuple(self.size)
        if len(size) != 2 or not all(isinstance(n, int) and 16 <= n <= 1 << 14 for n in size):
            raise ValueError(f"size is (width, height) in pixels, got {short_repr(self.size)}")
        for name in ("height", "tilt", "ahead", "preview", "rate"):
            if not is_finite(getattr(self, name)):
                raise ValueError(f"{name} is a number, got {short_repr(getattr(self, name))}")
        if not (self.height > 0.0 and self.rate > 0.0 and abs(self.tilt) < 1.0):
            rule = "height and rate are positive and the tilt is within 1 rad"
            raise ValueError(f"{rule}, got {self.height} m, {self.rate} 1/s, {self.tilt} rad")
        object.__setattr__(self, "K", tuple(map(tuple, K.tolist())))
        object.__setattr__(self, "dist", tuple(dist.tolist()))
        object.__setattr__(self, "size", size)

    @classmethod
    def read(cls, path: "str | os.PathLike[str]") -> "Pinhole":
        """Read a camera from a TOML or JSON file; ValueError for a field missing or out of place.

        Args:
            path: Path of the file, which has at least K, dist and size.
        """
        values = read_document(path, "camera")
        if missing := {"K", "dist", "size"} - values.keys():
            raise ValueError(f"{path}: a camera needs {', '.join(sorted(missing))}")
        known = [field.name for field in dataclasses.fields(cls)]
        if unknown := [name for name in values if name not in (*known, *_MEASURED)]:
            raise ValueError(f"{path}: {describe_unknown('camera field', unknown, known)}")
        try:
            return cls(**{name: values[name] for name in values if name in known})
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: a camera's fields: {error}") from None

    def write(self, path: "str | os.PathLike[str]", **measured: float) -> None:
        """Write a file that `read` reads back.

        Args:
            path: Path of the file, whose ending chooses the format.
            measured: Further results of a calibration, by name.
        """
        write_document(path, dataclasses.asdict(self) | measured)

    def undistort(self, pixels: Array) -> Array:
        """Undistort pixels to points on the plane one unit ahead of the lens.

        Args:
            pixels: Pixels, shape (..., 2).

        Returns:
            Points, shape (..., 2).
        """
        points = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        K, dist = np.array(self.K), np.array(self.dist)
        straight = cv2.undistortPoints(points, K, dist, criteria=stop)
        return np.asarray(straight, float).reshape(np.shape(pixels))

    def project_points(self, x: Array, y: Array) -> Array:
        """Project points of the road to pixels.

        Args:
            x: Distance ahead of the car (m).
            y: Distance to the left of the car (m), in a shape that broadcasts with x.

        Returns:
            Pixels, shape (..., 2); NaN where they lie outside the picture.
        """
        x, y = np.broadcast_arrays(np.asarray(x, float) - self.ahead, np.asarray(y, float))
        depth = x * cos(self.tilt) + self.height * sin(self.tilt)
        down = self.height * cos(self.tilt) - x * sin(self.tilt)
        is_in_front = depth > 0.1
        points = np.stack([-y, down, np.where(is_in_front, depth, 1.0)], -1).reshape(-1, 1, 3)
        K, dist = np.array(self.K), np.array(self.dist)
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)
        pixels, size = np.asarray(pixels, float).reshape(*x.shape, 2), np.array(self.size, float)
        corners = size * [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
        edge = np.linalg.norm(self.undistort(corners), axis=1).max()  # the polynomial's folds
        is_inside = is_in_front & (np.hypot(y, down) <= 1.02 * edge * depth)
        is_inside &= (pixels >= 0.0).all(-1) & (pixels <= size - 1.0).all(-1)
        return np.where(is_inside[..., None], pixels, np.nan)


def resample(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Resample a picture to `WORKING_WIDTH`, in its proportions.

    Args:
        picture: Bytes, shape (height, width) or (height, width, 3).

    Returns:
        The picture, WORKING_WIDTH wide.
    """
    size = WORKING_WIDTH, round(picture.shape[0] * WORKING_WIDTH / picture.shape[1])
    method = cv2.INTER_AREA if picture.shape[1] > WORKING_WIDTH else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, size, interpolation=method), np.uint8)
