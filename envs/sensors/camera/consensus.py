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

DRAWS = 3000  # triples of points, of which those that a lane can be are tried
TRIED, COUNTED = 160, 320  # triples, and points that they are counted on
SLOPE, BEND = 0.55, 0.06  # the most of |b| and of |a| in 1/m
STARTS = 4
PITCHES = np.radians([0.0, -0.6, 0.6, -1.2, 1.2])
WIDTHS = (1.0, 0.88, 1.12)  # of the lane's: a body that rolls beside its middle
PITCH_SD, ROLL_SD = np.radians([1.0, 1.0])  # rad, of the priors
_SPAN = 4.0  # m, of X, that a triple covers at least
_SIDE = 0.15  # of a score, lost for every lane's width that the car would be off the lane


class Fit(NamedTuple):
    """A lane's heading, offset and curvature, and what they rest on."""

    psi: float  # rad, of the car against the lane
    y: float  # m, of the car to the left of its middle
    kappa: float  # 1/m
    pitch: float  # rad, nose down positive
    roll: float  # rad, left side up positive
    side: npt.NDArray[np.int64]  # of each point: 1 on the left marking, -1 on the right one, or 0
    error: Array  # (2,), standard errors of psi in rad and of y_l in m

    def held(self, weight: Array) -> float:
        """The weight of the points on both markings, the weaker one's above all."""
        left, right = (float(np.sum(weight[self.side == side])) for side in (1, -1))
        return min(left, right) + 0.25 * (left + right)


class Start(NamedTuple):
    """Where a fit begins: psi, y, kappa, pitch and roll, and what speaks for it."""

    score: float
    values: Array  # (5,)


class Place(NamedTuple):
    """Where a camera is, and what it looks for."""

    height: float  # m
    ahead: float  # m
    preview: float  # m, at which y_l is measured
    width: float  # m, of the lane


def reach_of(x: Array) -> Array:
    """How far in m from a marking a point belongs to it, X metres ahead."""
    return 0.05 + 0.006 * x


def _triples(x: Array, y: Array, weight: Array, rng: np.random.Generator) -> Array:
    """(a, b, c) (3, n) of parabolas through three points each, of those that a marking can be."""
    sums = np.cumsum(weight)
    draws = np.searchsorted(sums, rng.random((3, DRAWS)) * sums[-1]).clip(max=len(x) - 1)
    X, Y = x[draws], y[draws]
    with np.errstate(all="ignore"):
        first = (Y[1] - Y[0]) / (X[1] - X[0])
        a = 2.0 * ((Y[2] - Y[0]) / (X[2] - X[0]) - first) / (X[2] - X[1])
        b = first - 0.5 * a * (X[0] + X[1])
        c = Y[0] - b * X[0] - 0.5 * a * X[0] ** 2
    marking = (np.abs(a) < BEND) & (np.abs(b) < SLOPE) & (np.ptp(X, axis=0) > _SPAN)
    return np.stack([a, b, c])[:, np.flatnonzero(marking)[:TRIED]]


def search(x: Array, y: Array, weight: Array, place: Place) -> list[Start]:
    """Starts for `fit`: pairs of markings that hold many of the points, the best first; none where
    no three points can be a marking. The draws are the same for as many points."""
    if len(x) < 6:
        return []
    rng = np.random.Generator(np.random.SFC64(len(x)))
    a, b, c = _triples(x, y, weight, rng).astype(np.float32)[..., None]
    if not len(a):
        return []
    if len(x) > COUNTED:
        some = rng.permutation(len(x))[:COUNTED]
        x, y, weight = x[some], y[some], weight[some]
    x, y, weight = (each.astype(np.float32) for each in (x, y, weight))
    off, reach = y - (c + b * x + 0.5 * a * x * x), reach_of(x)
    own = (np.abs(off) < reach) @ weight
    starts = []
    for pitch, wide in itertools.product(PITCHES, WIDTHS):
        apart = np.float32(wide * place.width) * np.sqrt(1.0 + b * b)
        grown = apart * (1.0 + x * np.float32(pitch / place.height))
        for sign in (1.0, -1.0):  # the marking is the right one, the left one
            other = (np.abs(off - np.float32(sign) * grown) < reach + 0.04) @ weight
            middle = (c + 0.5 * sign * apart)[:, 0]
            score = np.minimum(own, other) + 0.25 * (own + other)
            score *= 1.0 - _SIDE * np.minimum(np.abs(middle) / place.width, 3.0)
            i = int(np.argmax(score))
            slope = b[i, 0] - c[i, 0] * pitch / place.height  # of the marking on the road
            cosine = 1.0 / np.sqrt(1.0 + slope * slope)
            offset = -middle[i] * cosine
            tipped = 0.5 * (wide - 1.0) * place.height * offset / (offset * offset + 0.1)
            values = -np.arctan(slope), offset, a[i, 0] * cosine**3, pitch, tipped
            starts.append(Start(float(score[i]), np.array(values, float)))
    return sorted(starts, key=lambda start: -start.score)[:STARTS]


def levelled(x: Array, y: Array, pitch: float, roll: float, place: Place) -> tuple[Array, Array]:
    """Points of the road from where they seem to be without pitch and roll."""
    (sp, cp), (sr, cr) = ((np.sin(angle), np.cos(angle)) for angle in (pitch, roll))
    x, up = x - place.ahead, -place.height
    y, up = y * cr - up * sr, y * sr + up * cr
    x, up = x * cp + up * sp, up * cp - x * sp
    high = place.height * cr
    eye = place.ahead * cp + high * sp, -place.height * sr, high * cp - place.ahead * sp
    reach = eye[2] / np.maximum(-up, 1e-3)
    return eye[0] + reach * x, eye[1] + reach * y


def across(x: Array, y: Array, psi: float, offset: float, kappa: float) -> tuple[Array, Array]:
    """(along, across) in m of points against the middle of a lane of constant curvature."""
    u = x * np.cos(psi) - y * np.sin(psi)
    v = offset + x * np.sin(psi) + y * np.cos(psi)
    w = 2.0 * v - kappa * (u * u + v * v)
    return u, w / (1.0 + np.sqrt(np.maximum(1.0 - kappa * w, 0.0)))


def fit(x: Array, y: Array, deviation: Array, start: Array, place: Place) -> Fit | None:
    """The least squares from a start (5,), by Gauss and Newton; None where the points do not hold
    both markings. deviation: m, of each point across."""
    values, half = start, 0.5 * place.width
    prior = np.array([0.0, 0.0, 0.0, PITCH_SD**-2, ROLL_SD**-2])
    inverse: Array = np.zeros((5, 5))
    step = 1e-4  # rad, of the derivatives by both angles

    def seen(pitch: float, roll: float) -> tuple[Array, Array]:
        return across(*levelled(x, y, pitch, roll, place), *values[:3])

    for scale in (2.0, 1.5, 1.2, 1.0, 0.8, 0.8):
        if not (np.abs(values) < [1.0, 50.0, 0.5, 0.1, 0.2]).all():  # nor is NaN
            return None
        pitch, roll = values[3:]
        u, d = seen(pitch, roll)
        rest, bound = d - half * np.sign(d), scale * reach_of(x)
        on = np.abs(rest) < bound
        if min(np.sum(on & (d > 0.0)), np.sum(on & (d < 0.0))) < 3:
            return None
        slopes = [
            (each - d) / step for _, each in (seen(pitch + step, roll), seen(pitch, roll + step))
        ]
        rows = np.stack([u, np.ones_like(u), -0.5 * u * u, *slopes], 1)[on]
        far = rest[on] / deviation[on]
        scatter = max(1.0, float(np.mean(far * far)))  # of worn paint, against the priors
        weight = (1.0 - (rest[on] / bound[on]) ** 2) ** 2 / (deviation[on] ** 2 * scatter)  # Tukey
        try:
            inverse = np.linalg.inv(rows.T @ (weight[:, None] * rows) + np.diag(prior))
        except np.linalg.LinAlgError:
            return None
        values = values - inverse @ (rows.T @ (weight * rest[on]) + prior * values)
    _, d = seen(*values[3:])
    side = np.sign(d) * (np.abs(d - half * np.sign(d)) < 0.8 * reach_of(x))
    l_pre = place.preview
    at_preview = np.array([l_pre, 1.0, -0.5 * l_pre * l_pre])
    error = np.sqrt(np.array([inverse[0, 0], at_preview @ inverse[:3, :3] @ at_preview]))
    psi, offset, kappa, pitch, roll = map(float, values)
    return Fit(psi, offset, kappa, pitch, roll, side.astype(np.int64), error)
