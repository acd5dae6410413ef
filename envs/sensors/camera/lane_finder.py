"""The lane finder: heading, lateral offset, curvature and quality of the lane in a picture.

The road is resampled to rows of equal steps across it; a Laplacian of a Gaussian has its ridges on
the markings. Random consensus finds two parabolas Y = c + b X + a X^2 / 2, from which arcs of
circles at half a lane's width are fitted by least squares, together with the body's pitch and roll
(about zero, with a prior). A camera's tilt follows from the vanishing point of a straight lane's
markings, its height from how they spread below it over a lane of known width. Needs `vision`.
"""

import dataclasses
import itertools
from math import atan, cos
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from ...numerics.jit import as_python
from ..slow import FieldOfView, compute_preview_offset
from .images import WORKING_WIDTH, Image, Pinhole, resample

Array = npt.NDArray[np.floating[Any]]

_N_DRAWS = 3000  # triples of points, of which those that a marking can be are tried
_MAX_TRIPLES, _MAX_COUNTED = 160, 320  # triples, and points that they are counted on
_MAX_SLOPE, _MAX_BEND = 0.55, 0.06  # of |b|, and of |a| in 1/m
_MAX_STARTS = 4
_PITCHES = np.radians([0.0, -0.6, 0.6, -1.2, 1.2])
_WIDTHS = (1.0, 0.88, 1.12)  # factors on the lane's, as for a body that rolls beside its middle
_PITCH_SD, _ROLL_SD = np.radians([1.0, 1.0])  # rad, of the priors
_SPAN = 4.0  # m, smallest range of X of a triple
_SIDE = 0.15  # of a score, lost for every lane's width that the car would be off the lane
_SEARCHED, _CELL = 14.0, 0.05  # m to either side, and across
_MARKING = 0.07  # m, of the Gaussian: half a marking's width
_CONTRAST = 6.0  # grey levels, minimum of a ridge
_MAX_POINTS = 800
_FULL_SHARE, _MIN_SHARE = 0.25, 0.06  # of a marking's rows: quality 1, and lost below
_CLIPPED = 250  # grey levels from which light is clipped and shows no marking
_WORST = (0.02, 0.08)  # rad, m, standard errors beyond which the lane is lost

_compute_preview_offset = as_python(compute_preview_offset)


class _LaneFit(NamedTuple):
    """A lane's heading, offset and curvature, and the support of the fit."""

    psi: float  # rad, of the car against the lane
    y: float  # m, of the car to the left of its middle
    kappa: float  # 1/m
    pitch: float  # rad, nose down positive
    roll: float  # rad, left side up positive
    side: npt.NDArray[np.int64]  # of each point: 1 on the left marking, -1 on the right one, or 0
    error: Array  # (2,), standard errors of psi in rad and of y_l in m

    def _compute_support(self, weight: Array) -> float:
        """Weight of the points on both markings, dominated by the weaker one's."""
        left, right = (float(np.sum(weight[self.side == side])) for side in (1, -1))
        return min(left, right) + 0.25 * (left + right)


def _compute_tolerance(x: Array) -> Array:
    """Distance (m) from a marking within which a point x (m) ahead belongs to it."""
    return 0.05 + 0.006 * x


def _draw_triples(x: Array, y: Array, weight: Array, rng: np.random.Generator) -> Array:
    """(a, b, c), shape (3, n), of parabolas through three points each that a marking can be."""
    sums = np.cumsum(weight)
    draws = np.searchsorted(sums, rng.random((3, _N_DRAWS)) * sums[-1]).clip(max=len(x) - 1)
    X, Y = x[draws], y[draws]
    with np.errstate(all="ignore"):
        first = (Y[1] - Y[0]) / (X[1] - X[0])
        a = 2.0 * ((Y[2] - Y[0]) / (X[2] - X[0]) - first) / (X[2] - X[1])
        b = first - 0.5 * a * (X[0] + X[1])
        c = Y[0] - b * X[0] - 0.5 * a * X[0] ** 2
    is_marking = (np.abs(a) < _MAX_BEND) & (np.abs(b) < _MAX_SLOPE) & (np.ptp(X, axis=0) > _SPAN)
    return np.stack([a, b, c])[:, np.flatnonzero(is_marking)[:_MAX_TRIPLES]]


def _search_starts(x: Array, y: Array, weight: Array, camera: Pinhole, width: float) -> list[Array]:
    """Starts of a fit, (5,) each: pairs of markings that hold many of the points, best first."""
    if len(x) < 6:
        return []
    rng = np.random.Generator(np.random.SFC64(len(x)))  # equal for so many points
    a, b, c = _draw_triples(x, y, weight, rng).astype(np.float32)[..., None]
    if not len(a):
        return []
    subset = rng.permutation(len(x))[:_MAX_COUNTED] if len(x) > _MAX_COUNTED else slice(None)
    x, y, weight = (array[subset].astype(np.float32) for array in (x, y, weight))
    residual, reach = y - (c + b * x + 0.5 * a * x * x), _compute_tolerance(x)
    own_score = (np.abs(residual) < reach) @ weight
    starts = []
    for pitch, width_factor in itertools.product(_PITCHES, _WIDTHS):
        lane_width = np.float32(width_factor * width) * np.sqrt(1.0 + b * b)
        pitched_width = lane_width * (1.0 + x * np.float32(pitch / camera.height))
        for sign in (1.0, -1.0):  # the marking is the right one, the left one
            other = (np.abs(residual - np.float32(sign) * pitched_width) < reach + 0.04) @ weight
            middle = (c + 0.5 * sign * lane_width)[:, 0]
            score = np.minimum(own_score, other) + 0.25 * (own_score + other)
            score *= 1.0 - _SIDE * np.minimum(np.abs(middle) / width, 3.0)
            i = int(np.argmax(score))
            slope = b[i, 0] - c[i, 0] * pitch / camera.height  # of the marking on the road
            cosine = 1.0 / np.sqrt(1.0 + slope * slope)
            offset = -middle[i] * cosine
            roll = 0.5 * (width_factor - 1.0) * camera.height * offset / (offset * offset + 0.1)
            values = -np.arctan(slope), offset, a[i, 0] * cosine**3, pitch, roll
            starts.append((float(score[i]), np.array(values, float)))
    return [start for _, start in sorted(starts, key=lambda item: -item[0])[:_MAX_STARTS]]


def _correct_attitude(
    x: Array, y: Array, pitch: float, roll: float, camera: Pinhole
) -> tuple[Array, Array]:
    """(ahead, left) (m) of points on the road, from their places seen without pitch and roll."""
    (sp, cp), (sr, cr) = ((np.sin(angle), np.cos(angle)) for angle in (pitch, roll))
    x, up = x - camera.ahead, -camera.height
    y, up = y * cr - up * sr, y * sr + up * cr
    x, up = x * cp + up * sp, up * cp - x * sp
    lens_height = camera.height * cr
    lens_x, lens_y = camera.ahead * cp + lens_height * sp, -camera.height * sr
    reach = (lens_height * cp - camera.ahead * sp) / np.maximum(-up, 1e-3)
    return lens_x + reach * x, lens_y + reach * y


def _project_to_lane(
    x: Array, y: Array, psi: float, offset: float, kappa: float
) -> tuple[Array, Array]:
    """(along, across) (m) of points against the middle of a lane of constant curvature."""
    u = x * np.cos(psi) - y * np.sin(psi)
    v = offset + x * np.sin(psi) + y * np.cos(psi)
    w = 2.0 * v - kappa * (u * u + v * v)
    return u, w / (1.0 + np.sqrt(np.maximum(1.0 - kappa * w, 0.0)))


def _fit_lane(
    x: Array, y: Array, deviation: Array, start: Array, camera: Pinhole, width: float
) -> _LaneFit | None:
    """Lane by Gauss-Newton least squares from a start (5,); None without both markings' points."""
    values, half = start, 0.5 * width
    prior = np.array([0.0, 0.0, 0.0, _PITCH_SD**-2, _ROLL_SD**-2])
    inverse: Array = np.zeros((5, 5))
    step = 1e-4  # rad, of the derivatives by both angles

    def project_points(pitch: float, roll: float) -> tuple[Array, Array]:
        return _project_to_lane(*_correct_attitude(x, y, pitch, roll, camera), *values[:3])

    for scale in (2.0, 1.5, 1.2, 1.0, 0.8, 0.8):
        if not (np.abs(values) < [1.0, 50.0, 0.5, 0.1, 0.2]).all():  # nor is NaN
            return None
        pitch, roll = values[3:]
        u, d = project_points(pitch, roll)
        residual, bound = d - half * np.sign(d), scale * _compute_tolerance(x)
        is_inlier = np.abs(residual) < bound
        if min(np.sum(is_inlier & (d > 0.0)), np.sum(is_inlier & (d < 0.0))) < 3:
            return None
        by_pitch = (project_points(pitch + step, roll)[1] - d) / step
        by_roll = (project_points(pitch, roll + step)[1] - d) / step
        rows = np.stack([u, np.ones_like(u), -0.5 * u * u, by_pitch, by_roll], 1)[is_inlier]
        r, limit, sd = (array[is_inlier] for array in (residual, bound, deviation))
        normalised = r / sd
        scatter = max(1.0, float(np.mean(normalised * normalised)))  # of worn paint
        weight = (1.0 - (r / limit) ** 2) ** 2 / (sd**2 * scatter)  # Tukey
        try:
            inverse = np.linalg.inv(rows.T @ (weight[:, None] * rows) + np.diag(prior))
        except np.linalg.LinAlgError:
            return None
        values = values - inverse @ (rows.T @ (weight * r) + prior * values)
    _, d = project_points(*values[3:])
    side = np.sign(d) * (np.abs(d - half * np.sign(d)) < 0.8 * _compute_tolerance(x))
    row = np.array([camera.preview, 1.0, -0.5 * camera.preview * camera.preview])
    error = np.sqrt(np.array([inverse[0, 0], row @ inverse[:3, :3] @ row]))
    psi, offset, kappa, pitch, roll = values.tolist()
    return _LaneFit(psi, offset, kappa, pitch, roll, side.astype(np.int64), error)


class Lane(NamedTuple):
    """A lane in a picture; all 0 where none was found."""

    psi: float = 0.0  # rad, of the car against the lane, to the left positive
    y_l: float = 0.0  # m, at the preview point, left of the lane's middle: tie-vision (4)
    curvature: float = 0.0  # 1/m, to the left positive
    quality: float = 0.0  # 0: lost, 1: both markings are clear
    y: float = 0.0  # m, of the car left of the lane's middle

    def describe(self) -> str:
        """Describe the lane in one line."""
        if self.quality == 0.0:
            return "no lane"
        place = f"psi {np.degrees(self.psi):+.2f} deg, offset {self.y:+.2f} m"
        return f"{place}, curvature {self.curvature:+.4f} 1/m, quality {self.quality:.2f}"


class LaneFinder:
    """Finds the lane in a camera's pictures; ValueError for a camera that does not see the road.

    Args:
        camera: Camera with its mounting.
        lane_width: Distance from marking to marking (m).
        near: Distance ahead of the car where the search begins (m).
        far: Distance ahead where it ends (m).
        view: Limits beyond which the lane counts as lost; None for no limits.
    """

    def __init__(
        self, camera: Pinhole, lane_width: float = 3.5, near: float = 3.5, far: float = 24.0,
        view: FieldOfView | None = None,
    ) -> None:  # fmt: skip
        if not (0.0 < near < far and 0.0 < lane_width < _SEARCHED):
            rule = f"expected 0 < near < far, and a lane's width below {_SEARCHED} m"
            raise ValueError(f"{rule}, got {near}, {far} and {lane_width} m")
        self.camera, self.view, self._width = camera, view, lane_width
        self._scale = scale = camera.size[0] / WORKING_WIDTH
        steps = camera.K[1][1] / scale * camera.height * (1.0 / near - 1.0 / far)  # picture's rows
        self.rows_ahead = 1.0 / np.linspace(1.0 / near, 1.0 / far, max(int(steps), 20))  # m
        self._y = np.arange(_SEARCHED, -_SEARCHED, -_CELL)
        pixels = camera.project_points(self.rows_ahead[:, None], self._y)
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
        u = np.arange(-4, 5) * _CELL / _MARKING
        bell = np.exp(-0.5 * u * u)
        ridge = (1.0 - u * u) * bell
        ridge -= bell * ridge.sum() / bell.sum()  # flat light gives exactly nothing
        self._ridge = (ridge / np.abs(ridge).sum() * 2.0).astype(np.float32)
        self.fit: _LaneFit | None = None  # of the newest picture, for drawing

    def find(self, picture: Image) -> Lane:
        """Find the lane in a picture, all 0 where there is none; ValueError for another size."""
        size = picture.shape[1::-1]
        if size != self.camera.size or picture.dtype != np.uint8:
            got = f"{size} in {picture.dtype}"
            raise ValueError(f"expected a picture of {self.camera.size} pixels in bytes, got {got}")
        x, y, strength = self._find_ridges(resample(picture))
        self.fit = None
        focal = self.camera.K[0][0] / self._scale
        weight, deviation = np.minimum(strength, 40.0), 0.03 + 2.0 * x / focal
        geometry = self.camera, self._width
        starts = _search_starts(x, y, weight, *geometry)
        fits = (_fit_lane(x, y, deviation, start, *geometry) for start in starts)
        candidates = [fit for fit in fits if fit is not None]
        best = max(candidates, key=lambda fit: fit._compute_support(weight), default=None)
        if best is None or (quality := self._compute_quality(best, x)) == 0.0:
            return Lane()
        self.fit = best
        y_l = _compute_preview_offset(best.y, best.psi, best.kappa, self.camera.preview)
        return Lane(best.psi, y_l, best.kappa, quality, best.y)

    def _find_ridges(self, picture: Image) -> tuple[Array, Array, Array]:
        """(X, Y, strength) (m, m, grey levels) of the strongest ridges across the road."""
        road = cv2.remap(picture, self._map, self._fine, cv2.INTER_LINEAR)
        if road.ndim == 3:
            road = cv2.max(road[..., 1], road[..., 2])  # yellow is bright in red
        self._clipped = float(np.mean(road[self._visible] >= _CLIPPED))
        light = cv2.sepFilter2D(road, cv2.CV_32F, self._ridge, np.ones(1, np.float32))
        middle = light[:, 1:-1]
        level = max(_CONTRAST, 4.0 * 1.4826 * float(np.median(np.abs(middle[::4, ::4]))))
        is_ridge = (middle > level) & (middle >= light[:, :-2]) & (middle > light[:, 2:])
        row, column = np.nonzero(is_ridge & self._inner)
        strength = middle[row, column].astype(float)
        if len(row) > _MAX_POINTS:
            strongest = np.sort(np.argpartition(strength, -_MAX_POINTS)[-_MAX_POINTS:])
            row, column, strength = row[strongest], column[strongest], strength[strongest]
        before, after = light[row, column].astype(float), light[row, column + 2].astype(float)
        shift = 0.5 * (before - after) / (before - 2.0 * strength + after)
        return self.rows_ahead[row], self._y[column + 1] - _CELL * shift, strength

    def _compute_quality(self, lane_fit: _LaneFit, x: Array) -> float:
        """The rarer marking's rows, of those that suffice; less in bad light or if uncertain."""
        uncertainty, view = float(np.max(lane_fit.error / _WORST)), self.view
        is_outside = view and (abs(lane_fit.psi) > view.heading or abs(lane_fit.y) > view.offset)
        if uncertainty > 1.0 or is_outside:
            return 0.0
        shares = []
        density = len(x) / max(self._inner.sum() * _CELL, 1.0)  # points in a metre of a row
        for side in (1, -1):
            expected = self._find_visible_rows(lane_fit, side)
            rows = len(np.unique(x[lane_fit.side == side]))
            by_chance = float(np.sum(2.0 * _compute_tolerance(self.rows_ahead[expected]) * density))
            if rows < max(8.0, _MIN_SHARE * expected.sum(), by_chance + 6.0 * np.sqrt(by_chance)):
                return 0.0
            shares.append(rows / max(expected.sum(), 1))
        clarity = float(np.clip(1.05 - 2.0 * self._clipped, 0.0, 1.0))
        visibility = min(1.0, 2.0 * self._scale) * clarity
        certainty = min(1.0, 2.5 * (1.0 - uncertainty))
        return float(min(1.0, min(shares) / _FULL_SHARE) * certainty * visibility)

    def _find_visible_rows(self, lane_fit: _LaneFit, side: int) -> Array:
        """Whether a marking would be seen in each row, shape (rows,)."""
        column = np.round((self._y[0] - self.locate_marking(lane_fit, side)) / _CELL)
        is_inside = (column >= 1) & (column <= len(self._y) - 2)
        inner_column = np.where(is_inside, column, 1).astype(int) - 1
        return np.asarray(is_inside & self._inner[np.arange(len(column)), inner_column])

    def locate_marking(self, lane_fit: _LaneFit, side: int) -> Array:
        """Compute the place of a marking to the left of the car (m) at `rows_ahead`, shape (rows,).

        Args:
            lane_fit: Lane that was fitted to the picture.
            side: 1 for the left marking, -1 for the right one.
        """
        psi, offset, kappa, pitch, roll = lane_fit[:5]
        y = np.zeros_like(self.rows_ahead)
        for _ in range(6):  # Newton, on the distance across the lane
            x, level = _correct_attitude(self.rows_ahead, y, pitch, roll, self.camera)
            _, d = _project_to_lane(x, level, psi, offset, kappa)
            y = y - (d - 0.5 * side * self._width) / np.cos(psi - kappa * x)
        return y


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


_MAX_PAIRS, _MIN_POINTS = 4000, 20  # pairs of points, and points
_TOP, _BOTTOM = 0.55, 0.92  # of the picture's height: the road, without the bonnet
_LINE_TOLERANCE = 0.004  # distance of a point from its line, of the focal length
_SLOPES = 0.35, 4.0  # across over down, of a lane's own markings
_TILTS, _HEIGHTS = (-0.14, 0.45), (0.8, 3.0)  # rad, m
_NEAR, _FAR, _HEADING = 6.0, 30.0, 0.12  # m, m, rad: beyond a bonnet, where markings are wide
_STRAIGHT = 0.003, 0.01, 0.05  # 1/m, rad, rad: curvature, pitch and roll of the lane that shows it


def make_lane_finder(camera: Pinhole, lane_width: float) -> LaneFinder:
    """Make a finder of the car's own lane, beyond its bonnet."""
    view = FieldOfView(_HEADING, 0.5 * lane_width)
    return LaneFinder(camera, lane_width, _NEAR, _FAR, view=view)


def estimate_mounting(camera: Pinhole, picture: Image, lane_width: float) -> Pinhole:
    """Estimate the tilt and the height of a camera from a picture of a straight lane.

    Those that the camera has are not used. Raises ValueError if two markings are not found, or fit
    no straight lane from a car's height.
    """
    if (pair := _find_pair(*_find_ridges(camera, picture))) is None:
        raise ValueError("no lane: no pair of markings was found; pass the camera tilt and height")
    (a, b), (c, d) = pair  # across = a + b down, left and right
    down = (a - c) / (d - b)
    tilt = atan(-down)
    height = lane_width * cos(tilt) / (d - b)
    mounted_camera = dataclasses.replace(camera, tilt=tilt, height=height)
    finder = make_lane_finder(mounted_camera, lane_width)
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
