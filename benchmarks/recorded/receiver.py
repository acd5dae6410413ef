"""Does noise that follows HDOP filter a receiver's fixes better than one noise for all?

The filter has a constant rate between fixes, disturbed by white noise of density q, on each axis:
of position (east and north) and, where the car moves, of course. A log without a gyro bears no more
at 0.5 to 1 Hz.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from ...envs.arguments import Mask
from ...envs.record import Array
from ...envs.recordings.geodesy import to_metres
from ...envs.recordings.nmea import Epoch
from ...envs.sensors.gps import COURSE_SPEED, HDOP_LAWS
from ...estimators.filters import FILTERS
from ..harness.stats import Estimate, interval

SAME = "constant, same information"
GAP = 10.0  # s without a fix, or back, after which the filter starts anew
SETTLED = 3  # fixes after a start that are not scored
MIN_FIXES = 120  # scored fixes
BLOCK = 30  # fixes, whose mean is one number of an interval
MIN_NOISE = 1e-3  # in m or rad: r of a log that shows none
_LIMITS = math.log(MIN_NOISE), math.log(1e4)  # of q and r
_GRID, _STEP = np.linspace(*_LIMITS, 8), 1.0


class Track(NamedTuple):
    """A receiver's fixes with an HDOP, (n,) each, in rising time; angles in rad."""

    origin: tuple[float, float]  # degrees north and east
    t: Array
    east: Array
    north: Array
    course: Array
    speed: Array
    hdop: Array
    satellites: Array

    def select(self, shown: Mask) -> "Track":
        """Some of the fixes."""
        return Track(self.origin, *(column[shown] for column in self[1:]))


def make_track(epochs: Sequence[Epoch]) -> Track:
    """The fixes around the first one; those without HDOP or out of order are left out.

    A step back beyond `GAP` is a clock that was set, and stays.
    """
    shown, last = [], -math.inf
    for epoch in epochs:
        late = epoch.t > last or epoch.t < last - GAP
        if epoch.has_fix and late and math.isfinite(epoch.hdop):
            shown.append(epoch)
            last = epoch.t
    columns = np.array(shown, np.float64).reshape(-1, len(Epoch._fields)).T
    now = dict(zip(Epoch._fields, columns, strict=True))
    origin = (float(now["latitude"][0]), float(now["longitude"][0])) if shown else (0.0, 0.0)
    east, north = to_metres(now["latitude"], now["longitude"], origin)
    same = {name: now[name] for name in ("t", "course", "speed", "hdop", "satellites")}
    return Track(east=east, north=north, origin=origin, **same)


class Signal(NamedTuple):
    """What is filtered: name, unit, axes (two: real and imaginary part), values (n,), the noise's
    own size (n,), the standard deviation of a rate at the start, which fixes are scored, and the
    row at which half of these lie behind."""

    name: str
    unit: str
    axes: int
    z: npt.NDArray[np.complex128]
    base_size: Array
    spread: float
    track: Track
    scored: Mask
    half: int = 0


class NoiseLawResult(NamedTuple):
    """A law's filter: r, the noise at HDOP 1; q; and per scored fix of the second half the
    prediction's error, its log-likelihood and normalised square."""

    r: float
    q: float
    error: Array
    likelihood: Array
    square: Array
    hdop: Array


def make_signals(track: Track) -> list[Signal]:
    """Position, scored where the car moves, and course, which has a meaning there alone; those
    with `MIN_FIXES` fixes to score.

    Raises ValueError where position has fewer.
    """
    moving: Mask = ~(track.speed < COURSE_SPEED)  # an unknown speed may be one
    positions = np.asarray(track.east + 1j * track.north, np.complex128)
    position = Signal("position", "m", 2, positions, np.ones(len(positions)), 20.0, track, moving)
    part = track.select((track.speed >= COURSE_SPEED) & np.isfinite(track.course))
    all_fixes: Mask = np.ones(len(part.t), bool)
    angle = np.asarray(part.course, np.complex128)
    course = Signal("course", "rad", 1, angle, 1.0 / part.speed, 0.5, part, all_fixes)
    scored = []
    for signal in (position, course):
        known = signal.scored & np.isfinite(predict_fixes(signal, signal.base_size**2, 1.0)[0])
        rows = np.flatnonzero(known)
        if len(rows) >= MIN_FIXES:
            scored.append(signal._replace(scored=known, half=int(rows[len(rows) // 2])))
        elif signal is position:
            raise ValueError(
                f"{len(rows)} fixes to score, where the car moves; {MIN_FIXES} are needed"
            )
    return scored


def compare(signal: Signal) -> dict[str, NoiseLawResult]:
    """Each law of the noise, q and r at their maximum likelihood on the first half; and one noise
    for all with the average information of the law `table`."""
    half = signal.half
    sizes = {
        name: compute_law_size(signal.track.hdop, weight) for name, weight in HDOP_LAWS.items()
    }
    results = {name: _fit_law(signal, size) for name, size in sizes.items()}
    table = (sizes["table"] * signal.base_size)[:half]
    base = signal.base_size[:half]
    r = results["table"].r * math.sqrt(np.mean(base**-2.0) / np.mean(table**-2.0))
    results[SAME] = _fit_law(signal, sizes["constant"], r)
    return results


def compute_law_size(hdop: Array, weight: float) -> Array:
    """The noise's size by HDOP, of the table of double-layer: 1 + weight (table - 1)."""
    knots, factors = zip(*FILTERS["double-layer"].hdop, strict=True)
    return np.asarray(1.0 + weight * (np.interp(hdop, knots, factors) - 1.0))


def compute_gain(result: NoiseLawResult, other: NoiseLawResult) -> Estimate:
    """The mean log-likelihood less that of another law on the same fixes, by blocks of fixes."""
    difference = result.likelihood - other.likelihood
    blocks = np.array_split(difference, max(len(difference) // BLOCK, 1))
    return interval(np.array([block.mean() for block in blocks]))


def _fit_law(signal: Signal, size: Array, r: float | None = None) -> NoiseLawResult:
    """The filter at its maximum likelihood on the first half: the best of a grid, then refined."""
    half = signal.half

    def compute_scores(p: Array, count: int) -> tuple[Array, Array, Array]:
        q, noise = np.exp(p)
        error, S = predict_fixes(signal, (noise * size * signal.base_size)[:count] ** 2, q)
        square = error**2 / S / signal.axes
        return error, -0.5 * signal.axes * (square + np.log(2.0 * math.pi * S)), square

    def compute_cost(p: Array) -> float:
        p = np.clip(p, *_LIMITS) if r is None else np.array([*p[:1], math.log(r)])
        return -float(np.mean(compute_scores(p, half)[1][signal.scored[:half]]))

    axes = [_GRID] * (2 if r is None else 1)
    first = min(itertools.product(*axes), key=lambda p: compute_cost(np.array(p)))
    simplex = np.array([first, *(first + _STEP * np.eye(len(first)))])
    p = minimize(compute_cost, first, method="Nelder-Mead", options={"initial_simplex": simplex}).x
    p = np.clip(p, *_LIMITS) if r is None else np.array([p[0], math.log(r)])
    error, likelihood, square = compute_scores(p, len(signal.z))
    late = signal.scored & (np.arange(len(signal.z)) >= half)
    q, noise = np.exp(p)
    hdop = signal.track.hdop
    return NoiseLawResult(noise, q, error[late], likelihood[late], square[late], hdop[late])


def predict_fixes(signal: Signal, R: Array, q: float) -> tuple[Array, Array]:
    """(size of the error of predicting each fix from those before, its variance on an axis).

    R: (n,) variances. NaN while the filter settles.
    """
    error, variance = np.full((2, len(R)), np.nan)
    t, z, noise = signal.track.t.tolist(), signal.z.tolist(), R.tolist()
    since = SETTLED
    for k, now in enumerate(t[: len(noise)]):
        dt = now - t[k - 1] if k else math.inf
        if not 0.0 < dt <= GAP:
            x, v, a, b, c = z[k], 0.0, noise[k], 0.0, signal.spread**2
            since = 0
            continue
        since += 1
        x += dt * v
        a += dt * (2.0 * b + dt * c) + q * dt**3 / 3.0
        b += dt * c + q * dt**2 / 2.0
        c += q * dt
        S = a + noise[k]
        e = z[k] - x
        if signal.axes == 1:
            e = complex(math.remainder(e.real, 2.0 * math.pi))
        if since > SETTLED:
            error[k], variance[k] = abs(e), S
        x, v = x + a / S * e, v + b / S * e
        a, b, c = a - a / S * a, b - a / S * b, c - b / S * b
    return error, variance
