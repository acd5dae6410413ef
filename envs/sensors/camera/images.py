"""The pinhole camera on a car: its calibration, pictures from files, and those of rendered roads.

Car axes: X forward, Y left, Z up, from the road below the centre of gravity. A rendered picture has
markings, bends, roll and pitch, shadow, wear, blur and noise; each pixel has the road's brightness
averaged over its footprint. Needs the extra `vision`.
"""

import dataclasses
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import cos, radians, sin
from pathlib import Path
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
import numpy.typing as npt

from ...io import read_document
from ...validation import describe_unknown, is_finite, short_repr
from ...vehicle.dynamics import RoadParams

Array = npt.NDArray[np.floating[Any]]
Image = npt.NDArray[np.uint8]
_Flat = npt.NDArray[np.float32]

_MATRIX = ((640.0, 0.0, 639.5), (0.0, 640.0, 359.5), (0.0, 0.0, 1.0))
WORKING_WIDTH = 1280  # px, of a picture in which a lane is looked for
_MEASURED = ("rms_px", "boards")  # further entries of a calibration file
_MIN_BOARDS = 3
PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")


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
        """Read a camera from a TOML or JSON file that has at least K, dist and size.

        Raises ValueError for a field missing or out of place.
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

    def undistort(self, pixels: Array) -> Array:
        """Undistort pixels to points (..., 2) on the plane one unit ahead of the lens.

        Args:
            pixels: Pixels, shape (..., 2).
        """
        points = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        K, dist = np.array(self.K), np.array(self.dist)
        straight = cv2.undistortPoints(points, K, dist, criteria=stop)
        return np.asarray(straight, float).reshape(np.shape(pixels))

    def project_points(self, x: Array, y: Array) -> Array:
        """Project points of the road to pixels (..., 2), NaN where they lie outside the picture.

        Args:
            x: Distance ahead of the car (m).
            y: Distance to the left of the car (m), in a shape that broadcasts with x.
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
    """Resample a picture to a width of `WORKING_WIDTH`, in its proportions."""
    size = WORKING_WIDTH, round(picture.shape[0] * WORKING_WIDTH / picture.shape[1])
    method = cv2.INTER_AREA if picture.shape[1] > WORKING_WIDTH else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, size, interpolation=method), np.uint8)


def make_default_camera(size: tuple[int, int]) -> Pinhole:
    """Make a camera of unknown properties: 58 degrees wide, without distortion, level.

    Args:
        size: Width and height of its pictures (px).
    """
    width, height = size
    K = ((0.9 * width, 0.0, width / 2), (0.0, 0.9 * width, height / 2), (0.0, 0.0, 1.0))
    return Pinhole(K=K, dist=(0.0,) * 5, size=size, tilt=0.0, ahead=0.0)


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


def read_picture(path: "str | os.PathLike[str]") -> Image:
    """Read a picture from a file, (height, width, 3) bytes of blue, green, red.

    Raises FileNotFoundError without the file, ValueError for a broken one.
    """
    _check_file(path)
    data = np.fromfile(path, np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        raise ValueError(f"{path}: this is no picture that can be read")
    return np.asarray(picture, np.uint8)


class Film:
    """A film's frames; FileNotFoundError without the file, ValueError without a first frame."""

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


def _check_file(path: "str | os.PathLike[str]") -> None:
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not Path(path).is_file():
        raise ValueError(f"{path}: expected a picture or a film, found a folder")


_ASPHALT, _PAINT, _GRASS, _SKY = 85.0, 215.0, 60.0, 200.0  # grey levels
_VERGE = 1.6  # m, from a marking's middle to the grass
_FAR = 80.0  # m, of the road that is drawn
_PATCH, _FLAKE = 0.25, 0.03  # m, along and across, of paint that wears off together


@dataclass(frozen=True)
class Appearance:
    """Looks of the road and the picture; a value out of place raises ValueError."""

    noise: float = 2.0  # grey levels, standard deviation of a pixel
    blur: float = 0.5  # px, standard deviation of the lens
    shadow: float = 0.0  # fraction of the light that bands of shadow across the road take
    wear: float = 0.0  # fraction of the paint that has gone
    lane_width: float = 3.5  # m, from marking to marking
    marking_width: float = 0.12  # m
    dash: float = 4.0  # m, length of the left marking's dashes; the right one is solid
    gap: float = 5.0  # m

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (is_finite(value) and value >= 0.0):
                raise ValueError(f"{field.name} is zero or more, got {short_repr(value)}")
        if max(self.shadow, self.wear) > 1.0:
            raise ValueError(f"shadow and wear are shares, got {self.shadow} and {self.wear}")
        if not min(self.lane_width, self.marking_width, self.dash) > 0.0:
            raise ValueError("lane_width, marking_width and dash are positive")


class RoadScene(NamedTuple):
    """Place of the car against the road, and the road's bend."""

    psi: float = 0.0  # rad, heading against the road, to the left positive
    y: float = 0.0  # m, left of the lane's middle
    s: float = 0.0  # m, along the road
    roll: float = 0.0  # rad, left side up positive, about the road below the car
    pitch: float = 0.0  # rad, nose down positive
    height: float = 1.0  # of the camera, over that of its mounting
    road: RoadParams = RoadParams(0.0, 0.0, 1.0)


class RoadRenderer:
    """Renders a camera's pictures.

    Args:
        camera: Camera with its mounting.
        appearance: Looks of the road; None for the defaults.
        rows: First row that is painted and the row behind the last, the rest is black; None: all.
    """

    def __init__(
        self, camera: Pinhole, appearance: Appearance | None = None,
        rows: tuple[int, int] | None = None,
    ) -> None:  # fmt: skip
        self.camera, self.appearance = camera, appearance or Appearance()
        self.rows = slice(*(rows or (0, camera.size[1])))
        self._rays = np.array(_compute_rays(camera, self.rows), np.float32)

    def render_picture(self, scene: RoadScene, seed: int | tuple[int, int] = 0) -> Image:
        """Render the picture of a scene in grey levels, shape (height, width).

        Args:
            scene: Place of the car on the road.
            seed: Key of the noise's `np.random.Philox`, or (key, tick) with its counter.
        """
        style, light = self.appearance, self._render_road(scene)
        if style.blur > 0.0:
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), style.blur), np.float32)
        if style.noise > 0.0:
            key, tick = seed if isinstance(seed, tuple) else (int(seed), 0)
            rng = np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, tick]))
            light += style.noise * rng.standard_normal(light.shape, np.float32)
        image = np.zeros(self.camera.size[::-1], np.uint8)
        image[self.rows] = np.clip(light + 0.5, 0.0, 255.0)
        return image

    def _render_road(self, scene: RoadScene) -> _Flat:
        """Brightness of the painted rows, without blur and noise, shape (rows, width)."""
        camera, style = self.camera, self.appearance
        rotation = _make_rotation(scene.roll, scene.pitch)
        lens = rotation @ [camera.ahead, 0.0, scene.height * camera.height]
        forward, left, up = np.tensordot(rotation.astype(np.float32), self._rays, 1)
        reach = np.float32(lens[2]) / np.maximum(-up, 1e-4)
        X, Y = np.float32(lens[0]) + reach * forward, np.float32(lens[1]) + reach * left
        is_road = (up < -1e-3) & (X < _FAR)
        d, s = _compute_lane_coordinates(X, Y, scene)
        pixel_width = reach / np.float32(camera.K[0][0])  # m of a pixel, across and along the view
        pixel_length = pixel_width * np.maximum(X, 1.0) / np.float32(lens[2])
        footprint_width = np.hypot(pixel_width, pixel_length * np.float32(sin(scene.psi)))
        paint = _compute_coverage(d + 0.5 * style.lane_width, style.marking_width, footprint_width)
        dashes = _compute_coverage(d - 0.5 * style.lane_width, style.marking_width, footprint_width)
        period = style.dash + style.gap
        place = np.mod(s + np.float32(scene.s % period) + 0.5 * style.gap, period)
        paint += dashes * _compute_coverage(place - 0.5 * period, style.dash, pixel_length)
        if style.wear > 0.0:
            first = int(np.floor(scene.s / _PATCH))
            patches = np.floor((s + np.float32(scene.s - first * _PATCH)) / _PATCH)
            paint *= _hash_cells(patches.astype(np.int64) + first, d / _FLAKE) >= style.wear
        light = _ASPHALT + (_PAINT - _ASPHALT) * paint
        if style.shadow > 0.0:
            bands = np.mod(s + np.float32(scene.s % 11.0) + 0.7 * d, 11.0) < 4.5
            light *= 1.0 - np.float32(style.shadow) * bands
        verge = np.abs(d) > 0.5 * style.lane_width + _VERGE
        light = np.where(is_road, np.where(verge, np.float32(_GRASS), light), np.float32(_SKY))
        return np.asarray(light, np.float32)


def _compute_rays(camera: Pinhole, rows: slice) -> npt.NDArray[np.float64]:
    """Compute the pixels' directions in car axes, of unit depth, shape (3, rows, width)."""
    grid = np.stack(np.meshgrid(np.arange(camera.size[0]), np.arange(rows.start, rows.stop)), -1)
    across, down = np.moveaxis(camera.undistort(grid.astype(float)), -1, 0)
    s, c = sin(camera.tilt), cos(camera.tilt)
    return np.stack([c - s * down, -across, -s - c * down])


def _make_rotation(roll: float, pitch: float) -> npt.NDArray[np.float64]:
    """Rotation matrix (3, 3) from body axes to the road's."""
    roll_matrix = np.array([[1, 0, 0], [0, cos(roll), -sin(roll)], [0, sin(roll), cos(roll)]])
    pitch_matrix = np.array([[cos(pitch), 0, sin(pitch)], [0, 1, 0], [-sin(pitch), 0, cos(pitch)]])
    return np.asarray(pitch_matrix @ roll_matrix, float)


def _compute_lane_coordinates(X: _Flat, Y: _Flat, scene: RoadScene) -> tuple[_Flat, _Flat]:
    """(d, s): distance left of the lane's middle and along it (m) of points in car axes."""
    # Exact on the osculating circle; where the curvature changes ahead, to first order about it.
    sine, cosine = np.float32(sin(scene.psi)), np.float32(cos(scene.psi))
    u, v = X * cosine - Y * sine, np.float32(scene.y) + X * sine + Y * cosine
    road = scene.road
    from_ramp, slope = scene.s - road.start, road.curvature / road.ramp
    kappa = slope * min(max(from_ramp, 0.0), road.ramp)
    w = 2.0 * v - kappa * (u * u + v * v)
    d = w / (1.0 + np.sqrt(np.maximum(1.0 - kappa * w, 0.0)))
    s = u if abs(kappa) < 1e-9 else np.arctan2(kappa * u, 1.0 - kappa * v) / kappa
    if slope and from_ramp < road.ramp:  # the curvature's double integral beyond the circle's
        x, a, b = np.maximum(s, 0.0), from_ramp, from_ramp - road.ramp
        cubes = np.maximum(x + a, 0.0) ** 3 - np.maximum(x + b, 0.0) ** 3
        start, rise = max(a, 0.0), 0.5 * max(a, 0.0) ** 2
        d = d - (slope * (cubes - start**3) / 6.0 - slope * rise * x - 0.5 * kappa * x * x)
    return d.astype(np.float32), np.asarray(s, np.float32)


def _compute_coverage(offset: _Flat, width: float, footprint: _Flat) -> _Flat:
    """Fraction of a footprint that a stripe covers."""
    share = np.clip((0.5 * width - np.abs(offset)) / footprint + 0.5, 0.0, 1.0)
    return np.asarray(np.minimum(share, width / footprint), np.float32)


def _hash_cells(cells_s: npt.NDArray[np.int64], cells_d: _Flat) -> _Flat:
    """Hash in [0, 1) of each cell of the road."""
    word = cells_s.astype(np.uint32) * np.uint32(0x9E3779B1)
    word ^= np.floor(cells_d).astype(np.int64).astype(np.uint32) * np.uint32(0x85EBCA77)
    word ^= word >> np.uint32(15)
    word *= np.uint32(0x2C1B3C6D)
    word ^= word >> np.uint32(13)
    return np.asarray((word >> np.uint32(8)) / float(1 << 24), np.float32)
