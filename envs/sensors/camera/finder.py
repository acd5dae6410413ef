"""The lane finder: from a picture to heading, lateral offset and curvature, with a quality.

The road is resampled to rows of equal steps across it, one for each row of the picture, which
undistorts and undoes the perspective in one look-up. The Laplacian of a Gaussian as wide as a
marking has its ridges on them; `consensus` finds the two that belong together. Needs `vision`.
"""

from typing import NamedTuple

import cv2
import numpy as np

from ...backend.decorators import as_python
from .analytic import FieldOfView, compute_preview_offset
from .consensus import (
    Array,
    CameraMount,
    LaneFit,
    compute_tolerance,
    correct_attitude,
    fit_lane,
    project_to_lane,
    search_starts,
)
from .pinhole import WORKING_WIDTH, Pinhole, resample
from .road_image import Image

_compute_preview_offset = as_python(compute_preview_offset)

CELL = 0.05  # m across
MARKING = 0.07  # m, of the Gaussian: half a marking's width
CONTRAST = 6.0  # grey levels that a ridge has at least
MAX_POINTS = 800  # points
FULL_SHARE = 0.25  # share of a marking's rows at which the quality is 1
MIN_SHARE = 0.06  # share below which it is lost
CLIPPED = 250  # grey levels from which light is clipped and shows no marking
_WORST = (0.02, 0.08)  # rad, m, standard errors beyond which it is lost


class Lane(NamedTuple):
    """A lane in a picture; all 0 where none was found."""

    psi: float = 0.0  # rad, of the car against the lane, to the left positive
    y_l: float = 0.0  # m, at the preview point, left of the lane's middle: tie-vision (4)
    curvature: float = 0.0  # 1/m, to the left positive
    quality: float = 0.0  # 0: lost, 1: both markings are clear
    y: float = 0.0  # m, of the car left of the lane's middle


LOST = Lane()


class LaneFinder:
    """Finds the lane in a camera's pictures.

    Args:
        camera: The camera.
        lane_width: Distance from marking to marking (m).
        near: Distance ahead of the car where the search begins (m).
        far: Distance ahead where it ends (m).
        side: Distance to either side that is searched (m).
        view: Limits beyond which the lane counts as lost; None for no limits.

    Raises:
        ValueError: For distances out of order, or a camera that does not see this part of the road.
    """

    def __init__(
        self,
        camera: Pinhole,
        lane_width: float = 3.5,
        near: float = 3.5,
        far: float = 24.0,
        side: float = 14.0,
        view: FieldOfView | None = None,
    ) -> None:
        if not (0.0 < near < far and lane_width > 0.0 and side > lane_width):
            raise ValueError(
                "expected 0 < near < far, a lane's width and more than it to either side, got "
                f"{near}, {far}, {lane_width} and {side} m"
            )
        self.camera, self.view = camera, view
        self._scale = scale = camera.size[0] / WORKING_WIDTH
        self._mount = CameraMount(camera.height, camera.ahead, camera.preview, lane_width)
        steps = camera.K[1][1] / scale * camera.height * (1.0 / near - 1.0 / far)  # picture's rows
        self._x = 1.0 / np.linspace(1.0 / near, 1.0 / far, max(int(steps), 20))
        self._y = np.arange(side, -side, -CELL)
        pixels = camera.project_points(self._x[:, None], self._y)
        self._visible = np.isfinite(pixels[..., 0])
        if not self._visible.any():
            raise ValueError(f"the camera does not see the road {near} to {far} m ahead")
        rows = pixels[..., 1][self._visible]
        self.rows = max(int(rows.min()) - 2, 0), min(int(rows.max()) + 3, camera.size[1])
        pixels = (pixels + 0.5) / scale - 0.5
        right, down = np.nan_to_num(np.moveaxis(pixels, -1, 0), nan=-1.0).astype(np.float32)
        self._map, self._fine = cv2.convertMaps(right, down, cv2.CV_16SC2)
        inner = cv2.erode(self._visible.astype(np.uint8), np.ones((1, 7)), borderValue=0)
        self._inner = inner[:, 1:-1] > 0
        u = np.arange(-4, 5) * CELL / MARKING
        bell = np.exp(-0.5 * u * u)
        ridge = (1.0 - u * u) * bell
        ridge -= bell * ridge.sum() / bell.sum()  # flat light gives exactly nothing
        self._ridge = (ridge / np.abs(ridge).sum() * 2.0).astype(np.float32)
        self.fit: LaneFit | None = None  # of the newest picture, with its points for drawing
        self.points: Array = np.zeros((0, 2))

    def find(self, picture: Image) -> Lane:
        """Find the lane in a picture.

        Args:
            picture: Bytes, grey (height, width) or blue, green, red (height, width, 3).

        Returns:
            The lane, `LOST` where none was found.

        Raises:
            ValueError: For a picture of another size than the camera's.
        """
        if picture.shape[1::-1] != self.camera.size or picture.dtype != np.uint8:
            raise ValueError(
                f"expected a picture of {self.camera.size} pixels in bytes, got "
                f"{picture.shape[1::-1]} in {picture.dtype}"
            )
        x, y, strength = self._find_ridges(resample(picture))
        self.points, self.fit = np.stack([x, y], 1), None
        focal = self.camera.K[0][0] / self._scale
        weight, deviation = np.minimum(strength, 40.0), 0.03 + 2.0 * x / focal
        best, quality = None, 0.0
        for start in search_starts(x, y, weight, self._mount):
            candidate = fit_lane(x, y, deviation, start.values, self._mount)
            if candidate is not None and (
                best is None or candidate.compute_support(weight) > best.compute_support(weight)
            ):
                best = candidate
        if best is None or (quality := self._compute_quality(best, x)) == 0.0:
            return LOST
        self.fit = candidate = best
        y_l = _compute_preview_offset(
            candidate.y, candidate.psi, candidate.kappa, self.camera.preview
        )
        return Lane(candidate.psi, y_l, candidate.kappa, quality, candidate.y)

    def _find_ridges(self, picture: Image) -> tuple[Array, Array, Array]:
        """(X, Y, strength): ridges across the road, in m and grey levels, the strongest ones."""
        road = cv2.remap(picture, self._map, self._fine, cv2.INTER_LINEAR)
        if road.ndim == 3:
            road = cv2.max(road[..., 1], road[..., 2])  # yellow is bright in red
        self._clipped = float(np.mean(road[self._visible] >= CLIPPED))
        light = cv2.sepFilter2D(road, cv2.CV_32F, self._ridge, np.ones(1, np.float32))
        middle = light[:, 1:-1]
        level = max(CONTRAST, 4.0 * 1.4826 * float(np.median(np.abs(middle[::4, ::4]))))
        is_ridge = (middle > level) & (middle >= light[:, :-2]) & (middle > light[:, 2:])
        row, column = np.nonzero(is_ridge & self._inner)
        strength = middle[row, column].astype(float)
        if len(row) > MAX_POINTS:
            strongest = np.sort(np.argpartition(strength, -MAX_POINTS)[-MAX_POINTS:])
            row, column, strength = row[strongest], column[strongest], strength[strongest]
        before, after = light[row, column].astype(float), light[row, column + 2].astype(float)
        shift = 0.5 * (before - after) / (before - 2.0 * strength + after)
        return self._x[row], self._y[column + 1] - CELL * shift, strength

    def _compute_quality(self, lane_fit: LaneFit, x: Array) -> float:
        """Compute the fraction of the expected rows in which each marking was found.

        It is less for clipped light, few pixels and an uncertain fit.
        """
        uncertainty = float(np.max(lane_fit.error / _WORST))
        if uncertainty > 1.0:
            return 0.0
        if self.view is not None and (
            abs(lane_fit.psi) > self.view.heading or abs(lane_fit.y) > self.view.offset
        ):
            return 0.0
        shares = []
        density = len(x) / max(self._inner.sum() * CELL, 1.0)  # points in a metre of a row
        for side in (1, -1):
            expected = self._find_visible_rows(lane_fit, side)
            rows = len(np.unique(x[lane_fit.side == side]))
            by_chance = float(np.sum(2.0 * compute_tolerance(self._x[expected]) * density))
            if rows < max(8.0, MIN_SHARE * expected.sum(), by_chance + 6.0 * np.sqrt(by_chance)):
                return 0.0
            shares.append(rows / max(expected.sum(), 1))
        visibility = min(1.0, 2.0 * self._scale) * float(
            np.clip(1.05 - 2.0 * self._clipped, 0.0, 1.0)
        )
        return float(
            min(1.0, min(shares) / FULL_SHARE) * min(1.0, 2.5 * (1.0 - uncertainty)) * visibility
        )

    def _find_visible_rows(self, lane_fit: LaneFit, side: int) -> Array:
        """The rows, of bool, in which a marking would be seen."""
        y = self.locate_marking(lane_fit, side)
        column = np.round((self._y[0] - y) / CELL)
        is_inside = (column >= 1) & (column <= len(self._y) - 2)
        inner_column = np.where(is_inside, column, 1).astype(int) - 1
        return np.asarray(is_inside & self._inner[np.arange(len(y)), inner_column])

    def locate_marking(self, lane_fit: LaneFit, side: int) -> Array:
        """Compute the lateral place of a marking in every row, at `rows_ahead`.

        Args:
            lane_fit: The lane.
            side: 1 for the left marking, -1 for the right one.

        Returns:
            Y to the left of the car (m), shape (rows,).
        """
        offset = 0.5 * side * self._mount.width
        y = np.zeros_like(self._x)
        for _ in range(6):  # Newton, on the distance across the lane
            x, level = correct_attitude(self._x, y, lane_fit.pitch, lane_fit.roll, self._mount)
            _, d = project_to_lane(x, level, lane_fit.psi, lane_fit.y, lane_fit.kappa)
            y = y - (d - offset) / np.cos(lane_fit.psi - lane_fit.kappa * x)
        return y

    @property
    def rows_ahead(self) -> Array:
        """Distance ahead of each row that is searched (m)."""
        return self._x
