"""Receivers' logs (NMEA): does noise that follows HDOP filter fixes better than one for all?

The filter's rate is constant but for white noise of density q, on each axis of position and, where
the car moves, of course: a log without a gyro bears no more at 0.5 to 1 Hz.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.stats import spearmanr

from ... import __version__
from ...envs.io import atomic_file
from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.recordings.dialect import to_metres
from ...envs.recordings.nmea import HOUR, Counts, Epoch
from ...envs.recordings.sources import read_nmea
from ...envs.sensors.slow import COURSE_SPEED, HDOP_LAWS
from ...envs.validation import Mask
from ...estimators.filters import FILTERS
from ..harness.results import Column, ResultTable, Suite, write_text
from ..harness.stats import Estimate, interval
from ..report.film import make_track_kml
from ..report.study import format_verdict

_GAP = 10.0  # s without a fix, or back, after which the filter starts anew
SETTLED = 3  # fixes after a start that are not scored
_MIN_FIXES = 120  # scored fixes
_BLOCK = 30  # fixes, whose mean is one number of an interval
_MIN_NOISE = 1e-3  # in m or rad: r of a log that shows none
_LIMITS = math.log(_MIN_NOISE), math.log(1e4)  # of q and r
_GRID, _STEP = np.linspace(*_LIMITS, 8), 1.0


class _Track(NamedTuple):
    """A receiver's fixes with an HDOP, shape (n,) each, in rising time; SI units, angles in rad."""

    origin: tuple[float, float]  # degrees north and east
    t: Array
    east: Array
    north: Array
    course: Array
    speed: Array
    hdop: Array


def _make_track(epochs: Sequence[Epoch]) -> _Track:
    """Make the track of fixes around the first one, without those that lack HDOP or are late.

    A step back beyond `_GAP` is a clock that was set, and stays.
    """
    shown, last = [], -math.inf
    for epoch in epochs:
        late = epoch.t > last or epoch.t < last - _GAP
        if epoch.has_fix and late and math.isfinite(epoch.hdop):
            shown.append(epoch)
            last = epoch.t
    if not shown:
        raise ValueError("no fix has an HDOP: expected GGA, GNS or GSA sentences with one")
    now = dict(zip(Epoch._fields, np.array(shown, np.float64).T, strict=True))
    origin = float(now["latitude"][0]), float(now["longitude"][0])
    east, north = to_metres(now["latitude"], now["longitude"], origin)
    return _Track(origin, now["t"], east, north, now["course"], now["speed"], now["hdop"])


class _Signal(NamedTuple):
    """A filtered quantity of a receiver's fixes."""

    name: str
    axes: int  # number of axes; two are real and imaginary part
    z: npt.NDArray[np.complex128]  # values, shape (n,)
    base_size: Array  # size of the noise beside HDOP, shape (n,)
    spread: float  # standard deviation of the rate at the start
    track: _Track  # fixes
    scored: Mask  # mask of the fixes that are scored
    half: int = 0  # row at which half of these lie behind


class _NoiseLawResult(NamedTuple):
    """A law's noise r at HDOP 1, density q, and numbers of each scored fix of the second half."""

    r: float
    q: float
    error: Array
    likelihood: Array
    square: Array
    hdop: Array


def _make_signals(track: _Track) -> list[_Signal]:
    """Make position and course, scored where the car moves; ValueError for too few fixes."""
    moving: Mask = ~(track.speed < COURSE_SPEED)  # an unknown speed may be one
    positions = np.asarray(track.east + 1j * track.north, np.complex128)
    position = _Signal("position", 2, positions, np.ones(len(positions)), 20.0, track, moving)
    has_course = (track.speed >= COURSE_SPEED) & np.isfinite(track.course)
    part = _Track(track.origin, *(column[has_course] for column in track[1:]))
    all_fixes: Mask = np.ones(len(part.t), bool)
    angle = np.asarray(part.course, np.complex128)
    course = _Signal("course", 1, angle, 1.0 / part.speed, 0.5, part, all_fixes)
    scored = []
    for signal in (position, course):
        known = signal.scored & np.isfinite(_predict_fixes(signal, signal.base_size**2, 1.0)[0])
        rows = np.flatnonzero(known)
        if len(rows) >= _MIN_FIXES:
            scored.append(signal._replace(scored=known, half=int(rows[len(rows) // 2])))
        elif signal is position:
            text = f"{len(rows)} fixes to score, where the car moves"
            raise ValueError(f"{text}; {_MIN_FIXES} are needed")
    return scored


def _compare(signal: _Signal) -> dict[str, _NoiseLawResult]:
    """Fit each law on the first half: noise of size 1 + weight (double-layer's table - 1)."""
    knots, factors = zip(*FILTERS["double-layer"].hdop_table, strict=True)
    excess = np.interp(signal.track.hdop, knots, factors) - 1.0
    return {law: _fit_law(signal, 1.0 + weight * excess) for law, weight in HDOP_LAWS.items()}


def _compute_gain(result: _NoiseLawResult, other: _NoiseLawResult) -> Estimate:
    """Compute the mean log-likelihood less that of another law, by blocks of the same fixes."""
    difference = result.likelihood - other.likelihood
    blocks = np.array_split(difference, max(len(difference) // _BLOCK, 1))
    return interval(np.array([block.mean() for block in blocks]))


def _fit_law(signal: _Signal, size: Array) -> _NoiseLawResult:
    """Filter at its maximum likelihood on the first half: the best of a grid, then refined."""
    half = signal.half

    def compute_scores(p: Array, count: int) -> tuple[Array, Array, Array]:
        q, noise = np.exp(p)
        error, S = _predict_fixes(signal, (noise * size * signal.base_size)[:count] ** 2, q)
        square = error**2 / S / signal.axes
        return error, -0.5 * signal.axes * (square + np.log(2.0 * math.pi * S)), square

    def compute_cost(p: Array) -> float:
        scores = compute_scores(np.clip(p, *_LIMITS), half)
        return -float(np.mean(scores[1][signal.scored[:half]]))

    first = min(itertools.product(_GRID, _GRID), key=lambda p: compute_cost(np.array(p)))
    simplex = np.array([first, *(first + _STEP * np.eye(2))])
    p = minimize(compute_cost, first, method="Nelder-Mead", options={"initial_simplex": simplex}).x
    p = np.clip(p, *_LIMITS)
    error, likelihood, square = compute_scores(p, len(signal.z))
    late = signal.scored & (np.arange(len(signal.z)) >= half)
    q, noise = np.exp(p)
    columns = (error, likelihood, square, signal.track.hdop)
    return _NoiseLawResult(noise, q, *(column[late] for column in columns))


def _predict_fixes(signal: _Signal, R: Array, q: float) -> tuple[Array, Array]:
    """Predict each fix from those before, of variances R, (n,): size and variance of the error."""
    error, variance = np.full((2, len(R)), np.nan)
    t, z, noise = signal.track.t.tolist(), signal.z.tolist(), R.tolist()
    since = SETTLED
    for k, now in enumerate(t[: len(noise)]):
        dt = now - t[k - 1] if k else math.inf
        if not 0.0 < dt <= _GAP:
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


_DEGREES = 180.0 / math.pi
_TUNED, _FIXED = "table", "constant"
_NEGLIGIBLE = 0.01  # of log-likelihood a fix: nobody would notice
_WEAK_CORRELATION = 0.3  # a rank correlation that explains little
_ROWS = {"position": "prediction_error", "course": "course_prediction_error"}


class ReceiverReplay(NamedTuple):
    """A receiver's log: its fixes, and each signal with the results of the laws."""

    name: str
    track: _Track
    outcomes: list[tuple[_Signal, dict[str, _NoiseLawResult]]]
    counts: Counts


def replay_nmea(log: str | Path) -> ReceiverReplay:
    """Read a receiver's log and compare the laws of its noise on it (needs the extra `wires`).

    Args:
        log: Path of the log; ValueError for one too short, or that `read_nmea` refuses.
    """
    path = Path(log)
    epochs, counts = read_nmea(path)
    try:
        track = _make_track(epochs)
        outcomes = [(signal, _compare(signal)) for signal in _make_signals(track)]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return ReceiverReplay(f"{path.resolve().parent.name}/{path.stem}", track, outcomes, counts)


def make_receiver_suite(replay: ReceiverReplay) -> Suite:
    """Make a suite of the verdict, the counts and the numbers of each law."""
    track = replay.track
    low, middle, high = np.percentile(track.hdop, (5, 50, 95))
    step = np.diff(track.t)
    set_anew = np.abs(step) >= HOUR  # a clock that was set, or a pause
    parts = f" in {set_anew.sum() + 1} parts" if set_anew.any() else ""
    text = (
        f"{step[~set_anew].sum():.0f} s with {len(track.t)} fixes{parts}; HDOP {middle:.1f}, from "
        f"{low:.1f} to {high:.1f} in 90 % of them. "
        "A filter with a constant rate, disturbed by white noise, predicts each fix from those "
        "before, where the car moves. Its two noises are those of maximum likelihood on the first "
        "half of the log; all numbers are of the second."
    )
    suite = Suite("replay", f"A receiver's log: {replay.name}", text)
    suite.verdict = _compose_verdict(replay)
    for signal, results in replay.outcomes:
        _add_table(suite, replay, signal, results)
    counts = [[what, str(n)] for what, n in replay.counts.rows()]
    title = "What came from the receiver"
    suite.tables.append(ResultTable(title, ("what", "count"), counts, keyed=False))
    return suite


def _compose_verdict(replay: ReceiverReplay) -> str:
    tuned, fixed = (replay.outcomes[0][1][law] for law in (_TUNED, _FIXED))
    rank = float(spearmanr(fixed.hdop, fixed.error).statistic)
    pairs = [(np.median(x.error), np.percentile(x.error, 95)) for x in (tuned, fixed)]
    errors = [f"{middle:.2f} m ({high:.1f} m)" for middle, high in pairs]
    why = "." if abs(rank) > _WEAK_CORRELATION else ", as of a receiver that smooths its fixes."
    return format_verdict(
        *(_describe_gain(signal.name, results) for signal, results in replay.outcomes),
        f"Error of the next fix, median (95 %): {errors[0]} tuned by HDOP, {errors[1]} constant.",
        f"Why: the rank correlation of that error with HDOP is {rank:.2f}{why}",
        "Not covered: how far fixes are from the truth; other receivers. Likelihood: nats a fix.",
    )


def _describe_gain(name: str, results: Mapping[str, _NoiseLawResult]) -> str:
    number = _compute_gain(results[_TUNED], results[_FIXED])
    what, (value, low, high) = f"Tuning the noise of {name} by HDOP", number
    if max(abs(low), abs(high)) < _NEGLIGIBLE:
        return f"{what} changes nothing: log-likelihood {value:+.3f}."
    how = "pays" if low > 0.0 else "costs" if high < 0.0 else "is not seen to pay"
    return f"{what} {how}: log-likelihood {number.inline(digits='+.2f')}."


def _add_table(
    suite: Suite, replay: ReceiverReplay, signal: _Signal, results: Mapping[str, _NoiseLawResult]
) -> None:
    scale, unit = (_DEGREES, "deg") if signal.axes == 1 else (1.0, "m")
    records = []
    for law, result in results.items():
        rms = np.sqrt(np.mean(result.error**2))
        record = {
            "scenario": f"{replay.name}: {signal.name}", "estimator": law, "n": len(result.error),
            _ROWS[signal.name]: rms, "log_likelihood": result.likelihood.mean(),
            "nis": result.square.mean(), "median": np.median(result.error),
            "high": np.percentile(result.error, 95),
            "noise": result.r if result.r > 1.5 * _MIN_NOISE else "none seen",
        }  # fmt: skip
        gain = {"difference": _compute_gain(result, results[_FIXED])} if law != _FIXED else {}
        records.append(record | gain)
    suite.add_rows(records, salt="", env_version=f"replay {__version__}")
    columns = (
        Column("estimator", "noise"), Column("noise", f"at HDOP 1 / {unit}", scale, ".3g"),
        Column("median", form=".2f", scale=scale), Column(_ROWS[signal.name], "rms", scale, ".2f"),
        Column("high", "95 %", scale, ".2f"),
        Column("log_likelihood", "log-likelihood", form=".2f"), Column("nis", "NIS", form=".2f"),
        Column("difference", "against constant", form="+.3f"),
    )  # fmt: skip
    note = (
        f"Errors in {unit} of {records[0]['n']} fixes. constant, half, table: how the noise "
        "follows HDOP. NIS is 1 for a filter that knows its errors; intervals by blocks of fixes."
    )
    if signal.axes == 1:
        note += " The noise of course is that at 1 m/s, it falls with speed."
    title = f"The next {signal.name}, predicted"
    suite.tables.append(ResultTable(title, columns, records, note, keyed=False))


def write_kml(path: Path, replay: ReceiverReplay) -> None:
    """Write the fixes as a track for a map."""
    track = replay.track
    write_text(path, make_track_kml(replay.name, "fixes", track.east, track.north, track.origin))


def draw(path: Path, replay: ReceiverReplay) -> None:
    """Draw the track and the errors of the next fix by HDOP as a picture (extra `report`)."""
    with require_extra("report", "pictures need matplotlib"):
        from matplotlib.colors import LogNorm
        from matplotlib.figure import Figure
    track, result = replay.track, replay.outcomes[0][1][_FIXED]
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(4, 3))
    look = {"c": track.hdop, "norm": LogNorm(1.0, 20.0), "cmap": "cividis_r", "s": 5}
    dots = left.scatter(track.east, track.north, **look)
    figure.colorbar(dots, ax=left, label="HDOP", ticks=[1, 2, 5, 10, 20], format="%g")
    left.set(aspect="equal", adjustable="datalim", xlabel="east / m", ylabel="north / m")
    left.set_title(replay.name, fontsize=10)
    right.scatter(result.hdop, np.maximum(result.error, 0.01), s=6, color="#0072B2", alpha=0.5)
    line = np.array([1.0, 20.0])
    right.plot(line, line * np.median(result.error / result.hdop), color="#D55E00")
    right.set(xscale="log", yscale="log", xlabel="HDOP", ylabel="error of the next fix / m")
    right.set_title("line: errors that follow HDOP", fontsize=10)
    with atomic_file(path) as file:
        figure.savefig(file, format=path.suffix[1:] or "png", dpi=100)
