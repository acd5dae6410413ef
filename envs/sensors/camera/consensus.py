"""A lane through bright points of the road: random consensus, then least squares on circles.

A marking is a parabola Y = c + b X + a X^2 / 2 for the search, and for the fit a circle's arc at
half a lane's width from the lane's middle. The points lie where the road would be under a car that
neither pitches nor rolls; both angles are estimated with the lane, from the markings' convergence
and distance, about zero with a prior. Needs NumPy alone.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

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
