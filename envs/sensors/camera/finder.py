"""The lane finder: from a picture to heading, lateral offset and curvature, with a quality.

The road is resampled to rows of equal steps across it, one for each row of the picture, which
undistorts and undoes the perspective in one look-up. The Laplacian of a Gaussian as wide as a
marking has its ridges on them; `consensus` finds the two that belong together. Needs `vision`.
"""

from typing import NamedTuple

import cv2
import numpy as np

from ...backend.decorators import plain
from .analytic import View, at_preview
from .consensus import Array, Fit, Place, across, fit, levelled, reach_of, search
from .pinhole import WORKING_WIDTH, Pinhole, resample
from .road_image import Image

_at_preview = plain(at_preview)

CELL = 0.05  # m across
MARKING = 0.07  # m, of the Gaussian: half a marking's width
CONTRAST = 6.0  # grey levels that a ridge has at least
MOST = 800  # points
ENOUGH = 0.25  # share of a marking's rows at which the quality is 1
LEAST = 0.06  # share below which it is lost
CLIPPED = 250  # grey levels from which light is clipped and shows no marking
_WORST = (0.02, 0.08)  # rad, m, standard errors beyond which it is lost


class Lane(NamedTuple):
    """What a picture shows; all 0 where no lane was found."""

    psi: float = 0.0  # rad, of the car against the lane, to the left positive
    y_l: float = 0.0  # m, at the preview point, left of the lane's middle: tie-vision (4)
    curvature: float = 0.0  # 1/m, to the left positive
    quality: float = 0.0  # 0: lost, 1: both markings are clear
    y: float = 0.0  # m, of the car left of the lane's middle


LOST = Lane()


class LaneFinder:
    """Finds the lane in a camera's pictures.

    lane_width: m from marking to marking. near, far: m ahead of the car, where it looks; side: m,
    how far to either side. view: beyond these limits the lane counts as lost (default: none).
    """

    def __init__(
        self,
        camera: Pinhole,
        lane_width: float = 3.5,
        near: float = 3.5,
        far: float = 24.0,
        side: float = 14.0,
        view: View | None = None,
    ) -> None:
        if not (0.0 < near < far and lane_width > 0.0 and side > lane_width):
            raise ValueError(
                "expected 0 < near < far, a lane's width and more than it to either side, got "
                f"{near}, {far}, {lane_width} and {side} m"
            )
        self.camera, self.view = camera, view
        self._scale = scale = camera.size[0] / WORKING_WIDTH
        self._place = Place(camera.height, camera.ahead, camera.preview, lane_width)
        steps = camera.K[1][1] / scale * camera.height * (1.0 / near - 1.0 / far)  # picture's rows
        self._x = 1.0 / np.linspace(1.0 / near, 1.0 / far, max(int(steps), 20))
        self._y = np.arange(side, -side, -CELL)
        pixels = camera.pixels_of(self._x[:, None], self._y)
        self._seen = np.isfinite(pixels[..., 0])
        if not self._seen.any():
            raise ValueError(f"the camera does not see the road {near} to {far} m ahead")
        rows = pixels[..., 1][self._seen]
        self.rows = max(int(rows.min()) - 2, 0), min(int(rows.max()) + 3, camera.size[1])
        pixels = (pixels + 0.5) / scale - 0.5
        right, down = np.nan_to_num(np.moveaxis(pixels, -1, 0), nan=-1.0).astype(np.float32)
        self._map, self._fine = cv2.convertMaps(right, down, cv2.CV_16SC2)
        inner = cv2.erode(self._seen.astype(np.uint8), np.ones((1, 7)), borderValue=0)
        self._inner = inner[:, 1:-1] > 0
        u = np.arange(-4, 5) * CELL / MARKING
        bell = np.exp(-0.5 * u * u)
        ridge = (1.0 - u * u) * bell
        ridge -= bell * ridge.sum() / bell.sum()  # flat light gives exactly nothing
        self._ridge = (ridge / np.abs(ridge).sum() * 2.0).astype(np.float32)
        self.fit: Fit | None = None  # of the newest picture, with its points for drawing
        self.points: Array = np.zeros((0, 2))

    def find(self, picture: Image) -> Lane:
        """The lane in a picture, (height, width) grey or (height, width, 3) blue, green, red.

        Raises ValueError for a picture of another size than the camera's.
        """
        if picture.shape[1::-1] != self.camera.size or picture.dtype != np.uint8:
            raise ValueError(
                f"expected a picture of {self.camera.size} pixels in bytes, got "
                f"{picture.shape[1::-1]} in {picture.dtype}"
            )
        x, y, strength = self._bright(resample(picture))
        self.points, self.fit = np.stack([x, y], 1), None
        focal = self.camera.K[0][0] / self._scale
        weight, deviation = np.minimum(strength, 40.0), 0.03 + 2.0 * x / focal
        best, quality = None, 0.0
        for start in search(x, y, weight, self._place):
            found = fit(x, y, deviation, start.values, self._place)
            if found is not None and (best is None or found.held(weight) > best.held(weight)):
                best = found
        if best is None or (quality := self._quality(best, x)) == 0.0:
            return LOST
        self.fit = found = best
        y_l = _at_preview(found.y, found.psi, found.kappa, self.camera.preview)
        return Lane(found.psi, y_l, found.kappa, quality, found.y)

    def _bright(self, picture: Image) -> tuple[Array, Array, Array]:
        """(X, Y, strength): ridges across the road, in m and grey levels, the strongest ones."""
        road = cv2.remap(picture, self._map, self._fine, cv2.INTER_LINEAR)
        if road.ndim == 3:
            road = cv2.max(road[..., 1], road[..., 2])  # yellow is bright in red
        self._clipped = float(np.mean(road[self._seen] >= CLIPPED))
        light = cv2.sepFilter2D(road, cv2.CV_32F, self._ridge, np.ones(1, np.float32))
        middle = light[:, 1:-1]
        level = max(CONTRAST, 4.0 * 1.4826 * float(np.median(np.abs(middle[::4, ::4]))))
        top_of = (middle > level) & (middle >= light[:, :-2]) & (middle > light[:, 2:])
        row, column = np.nonzero(top_of & self._inner)
        strength = middle[row, column].astype(float)
        if len(row) > MOST:
            strongest = np.sort(np.argpartition(strength, -MOST)[-MOST:])
            row, column, strength = row[strongest], column[strongest], strength[strongest]
        before, after = light[row, column].astype(float), light[row, column + 2].astype(float)
        shift = 0.5 * (before - after) / (before - 2.0 * strength + after)
        return self._x[row], self._y[column + 1] - CELL * shift, strength

    def _quality(self, found: Fit, x: Array) -> float:
        """The share of the rows in which each marking was found, of those in which it must be;
        less for clipped light, few pixels and a fit that is not sure of itself."""
        doubt = float(np.max(found.error / _WORST))
        if doubt > 1.0:
            return 0.0
        if self.view is not None and (
            abs(found.psi) > self.view.heading or abs(found.y) > self.view.offset
        ):
            return 0.0
        shares = []
        chance = len(x) / max(self._inner.sum() * CELL, 1.0)  # points in a metre of a row
        for side in (1, -1):
            expected = self._expected(found, side)
            rows = len(np.unique(x[found.side == side]))
            by_chance = float(np.sum(2.0 * reach_of(self._x[expected]) * chance))
            if rows < max(8.0, LEAST * expected.sum(), by_chance + 6.0 * np.sqrt(by_chance)):
                return 0.0
            shares.append(rows / max(expected.sum(), 1))
        shown = min(1.0, 2.0 * self._scale) * float(np.clip(1.05 - 2.0 * self._clipped, 0.0, 1.0))
        return float(min(1.0, min(shares) / ENOUGH) * min(1.0, 2.5 * (1.0 - doubt)) * shown)

    def _expected(self, found: Fit, side: int) -> Array:
        """The rows, of bool, in which a marking would be seen."""
        y = self.marking(found, side)
        column = np.round((self._y[0] - y) / CELL)
        inside = (column >= 1) & (column <= len(self._y) - 2)
        place = np.where(inside, column, 1).astype(int) - 1
        return np.asarray(inside & self._inner[np.arange(len(y)), place])

    def marking(self, found: Fit, side: int) -> Array:
        """Y in m of a marking (side 1: the left one, -1: the right one) in every row, at
        `rows_ahead`."""
        offset = 0.5 * side * self._place.width
        y = np.zeros_like(self._x)
        for _ in range(6):  # Newton, on the distance across the lane
            x, level = levelled(self._x, y, found.pitch, found.roll, self._place)
            _, d = across(x, level, found.psi, found.y, found.kappa)
            y = y - (d - offset) / np.cos(found.psi - found.kappa * x)
        return y

    @property
    def rows_ahead(self) -> Array:
        """X in m of each row that is searched."""
        return self._x
