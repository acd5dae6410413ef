"""A lane through bright points of the road: random consensus, then least squares on circles.

A marking is a parabola Y = c + b X + a X^2 / 2 for the search, and for the fit a circle's arc at
half a lane's width from the lane's middle. The points lie where the road would be under a car that
neither pitches nor rolls; both angles are estimated with the lane, from the markings' convergence
and distance, about zero with a prior. Needs NumPy alone.

The lane finder: from a picture to heading, lateral offset and curvature, with a quality.

The road is resampled to rows of equal steps across it, one for each row of the picture, which
undistorts and undoes the perspective in one look-up. The Laplacian of a Gaussian as wide as a
marking has its ridges on them; `consensus` finds the two that belong together. Needs `vision`.
"""

import itertools
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from ...numerics.jit import as_python
from .analytic import FieldOfView, compute_preview_offset
from .images import Image
from .pinhole import WORKING_WIDTH, Pinhole, resample

Array = npt.NDArray[np.floating[Any]]

N_DRAWS = 3000  # triples of points, of which those that a lane can be are tried
MAX_TRIPLES, MAX_COUNTED = 160, 320  # triples, and points that they are counted on
MAX_SLOPE, MAX_BEND = 0.55, 0.06  # the most of |b| and of |a| in 1/m
MAX_STARTS = 4
PITCHES = np.radians([0.0, -0.6, 0.6, -1.2, 1.2])
WIDTHS = (1.0, 0.88, 1.12)  # of the lane's: a body that rolls beside its middle
PITCH_SD, ROLL_SD = np.radians([1.0, 1.0])  # rad, of the priors
_SPAN = 4.0  # m, of X, that a triple covers at least
_SIDE = 0.15  # of a score, lost for every lane's width that the car would be off the lane


class LaneFit(NamedTuple):
    """A lane's heading, offset and curvature, and the support of the fit."""

    psi: float  # rad, of the car against the lane
    y: float  # m, of the car to the left of its middle
    kappa: float  # 1/m
    pitch: float  # rad, nose down positive
    roll: float  # rad, left side up positive
    side: npt.NDArray[np.int64]  # of each point: 1 on the left marking, -1 on the right one, or 0
    error: Array  # (2,), standard errors of psi in rad and of y_l in m

    def compute_support(self, weight: Array) -> float:
        """Compute the weight of the points on both markings, dominated by the weaker one's.

        Args:
            weight: Weight of each point, shape (n,).

        Returns:
            The support.
        """
        left, right = (float(np.sum(weight[self.side == side])) for side in (1, -1))
        return min(left, right) + 0.25 * (left + right)


class FitStart(NamedTuple):
    """Start of a fit: its score, and psi, y, kappa, pitch and roll."""

    score: float
    values: Array  # (5,)


class CameraMount(NamedTuple):
    """Place of a camera, and the lane that it looks for."""

    height: float  # m
    forward: float  # m
    preview: float  # m, at which y_l is measured
    width: float  # m, of the lane


def compute_tolerance(x: Array) -> Array:
    """Compute the distance from a marking within which a point belongs to it.

    Args:
        x: Distance ahead (m).

    Returns:
        Tolerance (m), in the shape of x.
    """
    return 0.05 + 0.006 * x


def _draw_triples(x: Array, y: Array, weight: Array, rng: np.random.Generator) -> Array:
    """(a, b, c) (3, n) of parabolas through three points each, of those that a marking can be."""
    sums = np.cumsum(weight)
    draws = np.searchsorted(sums, rng.random((3, N_DRAWS)) * sums[-1]).clip(max=len(x) - 1)
    X, Y = x[draws], y[draws]
    with np.errstate(all="ignore"):
        first = (Y[1] - Y[0]) / (X[1] - X[0])
        a = 2.0 * ((Y[2] - Y[0]) / (X[2] - X[0]) - first) / (X[2] - X[1])
        b = first - 0.5 * a * (X[0] + X[1])
        c = Y[0] - b * X[0] - 0.5 * a * X[0] ** 2
    is_marking = (np.abs(a) < MAX_BEND) & (np.abs(b) < MAX_SLOPE) & (np.ptp(X, axis=0) > _SPAN)
    return np.stack([a, b, c])[:, np.flatnonzero(is_marking)[:MAX_TRIPLES]]


def search_starts(x: Array, y: Array, weight: Array, mount: CameraMount) -> list[FitStart]:
    """Search starts for `fit_lane`: pairs of markings that hold many of the points.

    The random draws depend on the number of points alone.

    Args:
        x: Distance of the points ahead (m), shape (n,).
        y: Distance of the points to the left (m), shape (n,).
        weight: Weight of each point, shape (n,).
        mount: Place of the camera.

    Returns:
        Starts, the best first; none where no three points can be a marking.
    """
    if len(x) < 6:
        return []
    rng = np.random.Generator(np.random.SFC64(len(x)))
    a, b, c = _draw_triples(x, y, weight, rng).astype(np.float32)[..., None]
    if not len(a):
        return []
    if len(x) > MAX_COUNTED:
        subset = rng.permutation(len(x))[:MAX_COUNTED]
        x, y, weight = x[subset], y[subset], weight[subset]
    x, y, weight = (array.astype(np.float32) for array in (x, y, weight))
    residual, reach = y - (c + b * x + 0.5 * a * x * x), compute_tolerance(x)
    own_score = (np.abs(residual) < reach) @ weight
    starts = []
    for pitch, width_factor in itertools.product(PITCHES, WIDTHS):
        lane_width = np.float32(width_factor * mount.width) * np.sqrt(1.0 + b * b)
        pitched_width = lane_width * (1.0 + x * np.float32(pitch / mount.height))
        for sign in (1.0, -1.0):  # the marking is the right one, the left one
            other = (np.abs(residual - np.float32(sign) * pitched_width) < reach + 0.04) @ weight
            middle = (c + 0.5 * sign * lane_width)[:, 0]
            score = np.minimum(own_score, other) + 0.25 * (own_score + other)
            score *= 1.0 - _SIDE * np.minimum(np.abs(middle) / mount.width, 3.0)
            i = int(np.argmax(score))
            slope = b[i, 0] - c[i, 0] * pitch / mount.height  # of the marking on the road
            cosine = 1.0 / np.sqrt(1.0 + slope * slope)
            offset = -middle[i] * cosine
            roll_guess = (
                0.5 * (width_factor - 1.0) * mount.height * offset / (offset * offset + 0.1)
            )
            values = -np.arctan(slope), offset, a[i, 0] * cosine**3, pitch, roll_guess
            starts.append(FitStart(float(score[i]), np.array(values, float)))
    return sorted(starts, key=lambda start: -start.score)[:MAX_STARTS]


def correct_attitude(
    x: Array, y: Array, pitch: float, roll: float, mount: CameraMount
) -> tuple[Array, Array]:
    """Compute the places of points of the road from those seen without pitch and roll.

    Args:
        x: Apparent distance ahead (m), shape (n,).
        y: Apparent distance to the left (m), shape (n,).
        pitch: Pitch of the body (rad), nose down positive.
        roll: Roll of the body (rad), left side up positive.
        mount: Place of the camera.

    Returns:
        Distances ahead and to the left (m), shape (n,) each.
    """
    (sp, cp), (sr, cr) = ((np.sin(angle), np.cos(angle)) for angle in (pitch, roll))
    x, up = x - mount.forward, -mount.height
    y, up = y * cr - up * sr, y * sr + up * cr
    x, up = x * cp + up * sp, up * cp - x * sp
    lens_height = mount.height * cr
    lens = (
        mount.forward * cp + lens_height * sp,
        -mount.height * sr,
        lens_height * cp - mount.forward * sp,
    )
    reach = lens[2] / np.maximum(-up, 1e-3)
    return lens[0] + reach * x, lens[1] + reach * y


def project_to_lane(
    x: Array, y: Array, psi: float, offset: float, kappa: float
) -> tuple[Array, Array]:
    """Compute the coordinates of points against the middle of a lane of constant curvature.

    Args:
        x: Distance ahead (m), shape (n,).
        y: Distance to the left (m), shape (n,).
        psi: Heading of the car against the lane (rad).
        offset: Offset of the car to the left of the lane's middle (m).
        kappa: Curvature of the lane (1/m).

    Returns:
        Distances along and across (m), shape (n,) each.
    """
    u = x * np.cos(psi) - y * np.sin(psi)
    v = offset + x * np.sin(psi) + y * np.cos(psi)
    w = 2.0 * v - kappa * (u * u + v * v)
    return u, w / (1.0 + np.sqrt(np.maximum(1.0 - kappa * w, 0.0)))


def fit_lane(
    x: Array, y: Array, deviation: Array, start: Array, mount: CameraMount
) -> LaneFit | None:
    """Fit a lane by least squares from a start, by Gauss and Newton.

    Args:
        x: Distance of the points ahead (m), shape (n,).
        y: Distance of the points to the left (m), shape (n,).
        deviation: Standard deviation of each point across (m), shape (n,).
        start: psi, y, kappa, pitch and roll, shape (5,).
        mount: Place of the camera.

    Returns:
        The fit; None where the points do not hold both markings.
    """
    values, half = start, 0.5 * mount.width
    prior = np.array([0.0, 0.0, 0.0, PITCH_SD**-2, ROLL_SD**-2])
    inverse: Array = np.zeros((5, 5))
    step = 1e-4  # rad, of the derivatives by both angles

    def project_points(pitch: float, roll: float) -> tuple[Array, Array]:
        return project_to_lane(*correct_attitude(x, y, pitch, roll, mount), *values[:3])

    for scale in (2.0, 1.5, 1.2, 1.0, 0.8, 0.8):
        if not (np.abs(values) < [1.0, 50.0, 0.5, 0.1, 0.2]).all():  # nor is NaN
            return None
        pitch, roll = values[3:]
        u, d = project_points(pitch, roll)
        residual, bound = d - half * np.sign(d), scale * compute_tolerance(x)
        is_inlier = np.abs(residual) < bound
        if min(np.sum(is_inlier & (d > 0.0)), np.sum(is_inlier & (d < 0.0))) < 3:
            return None
        slopes = [
            (shifted - d) / step
            for _, shifted in (
                project_points(pitch + step, roll),
                project_points(pitch, roll + step),
            )
        ]
        rows = np.stack([u, np.ones_like(u), -0.5 * u * u, *slopes], 1)[is_inlier]
        normalised = residual[is_inlier] / deviation[is_inlier]
        scatter = max(
            1.0, float(np.mean(normalised * normalised))
        )  # of worn paint, against the priors
        weight = (1.0 - (residual[is_inlier] / bound[is_inlier]) ** 2) ** 2 / (
            deviation[is_inlier] ** 2 * scatter
        )  # Tukey
        try:
            inverse = np.linalg.inv(rows.T @ (weight[:, None] * rows) + np.diag(prior))
        except np.linalg.LinAlgError:
            return None
        values = values - inverse @ (rows.T @ (weight * residual[is_inlier]) + prior * values)
    _, d = project_points(*values[3:])
    side = np.sign(d) * (np.abs(d - half * np.sign(d)) < 0.8 * compute_tolerance(x))
    l_pre = mount.preview
    preview_row = np.array([l_pre, 1.0, -0.5 * l_pre * l_pre])
    error = np.sqrt(np.array([inverse[0, 0], preview_row @ inverse[:3, :3] @ preview_row]))
    psi, offset, kappa, pitch, roll = map(float, values)
    return LaneFit(psi, offset, kappa, pitch, roll, side.astype(np.int64), error)


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
