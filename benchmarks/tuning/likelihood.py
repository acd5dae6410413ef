"""Noise and latency of a log's sensors by the likelihood of a filter's innovations, without truth.

Half of the log is searched; the other half says whether the numbers predict its next samples better
than the defaults. Intervals are a jackknife over blocks of the searched half.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.vehicle.parameters import Vehicle
from ...estimators.analysis.innovations import compute_log_densities
from ...estimators.design.models import INERTIAL, MEASUREMENTS
from ...estimators.design.options import NOISE
from ...estimators.estimator import Estimator
from ...estimators.wires import NOISES, SignalCalibration, apply_wires
from ..harness.drives import SETTLED, make_unchecked_filter
from ..harness.results import Column, ResultTable, Suite
from ..harness.stats import margin_of_error
from ..harness.verdict import format_verdict
from ..recorded.emulate import compute_ground_speed
from ..recorded.identify import MIN_TURNING, Finding, make_findings_table
from ..recorded.validate import cut

_RANGE = 30.0  # times the default noise and as much below it
_MOST_LATE = 0.5  # s
_BLOCKS = 20  # of the searched half, which the intervals take for independent
_SWEEPS = 2
_COARSE = 0.05  # s
_WIDEST = {"noise": math.log(2.0), "latency": 0.125}  # half of the widest interval: of ln, in s
_STEP = 0.15  # of ln(noise), of slopes
_NOTE = (
    "The most likely numbers of the first half of the log; intervals by a jackknife over 20 blocks "
    "of it. What is not told stays as stated. A filter's noise is raised, never lowered: it also "
    "covers what the model lacks."
)


class Parameter(NamedTuple):
    """A number that is searched: ln of a standard deviation, or a latency (s)."""

    name: str  # an option, or a slow sensor
    is_noise: bool
    start: float
    low: float
    high: float


class LogTuning:
    """A filter on one half of a log as a function of its noise and the slow sensors' latency.

    Args:
        name: Name of the filter.
        log: Recorded drive.
        car: Car that the filter assumes.
        options: Its options that are held.
        wires: Stated calibration, whose latencies and noise are where the search starts.
    """

    def __init__(
        self,
        name: str,
        log: Log,
        car: Vehicle,
        options: Mapping[str, Any],
        wires: SignalCalibration,
    ) -> None:
        self.name, self.car, self.options, self.wires = name, car, dict(options), wires
        self.log = log
        default = self.make_filter(log)
        noises = [f"{INERTIAL[i]}_noise" for i in range(int(default.filters[0].fasts))]
        for sensor in default.sensors:
            noises += [f"{row.noise}_noise" for row in MEASUREMENTS[sensor].rows]
        width, of_filter = math.log(_RANGE), default.config.noise
        starts = {key: math.log(of_filter[key.removesuffix("_noise")]) for key in noises}
        self.parameters = [
            Parameter(key, True, at, at - width, at + width) for key, at in starts.items()
        ]
        for sensor in default.sensors:
            late = wires.latency.get(sensor, 0.0)
            self.parameters.append(Parameter(sensor, False, late, 0.0, max(_MOST_LATE, late)))

    def make_filter(self, log: Log, x: Array | None = None) -> Estimator:
        """Make the filter of a log.

        Args:
            log: Recorded drive.
            x: Values of the parameters, None for the filter's own noise.

        Returns:
            The filter.
        """
        pairs = [] if x is None else zip(self.parameters, x, strict=True)
        noise = {p.name: math.exp(v) for p, v in pairs if p.is_noise}
        return make_unchecked_filter(self.name, log, self.car, self.options | noise)

    def delay(self, log: Log, x: Array) -> Log:
        """Apply the calibration and latencies to a log.

        Args:
            log: Recorded drive as it was logged.
            x: Values of the parameters.

        Returns:
            Log whose slow samples were captured earlier.
        """
        late = {p.name: float(v) for p, v in zip(self.parameters, x, strict=True) if not p.is_noise}
        return apply_wires(log, self.wires._replace(latency={**self.wires.latency, **late}))

    def compute_blocks(self, log: Log, x: Array) -> Array:
        """Compute the log likelihood of each block of a log.

        Args:
            log: Recorded drive as it was logged.
            x: Values of the parameters.

        Returns:
            Sums of log densities, shape (20,); `-inf` where the filter refuses the numbers.
        """
        delayed = self.delay(log, x)
        record = delayed.record
        try:
            fast, packets, _ = compute_log_densities(self.make_filter(delayed, x), delayed)
        except (ValueError, np.linalg.LinAlgError):
            return np.full(_BLOCKS, -math.inf)
        arrived = (record.packets[:, PACKET.arrived] - record.first).astype(int)
        np.add.at(fast, np.clip(arrived, 0, len(fast) - 1), packets)
        return np.array(
            [part.sum() for part in np.array_split(fast[_count_settled(log) :], _BLOCKS)]
        )

    def search(self, cost: Callable[[Array], float], is_free: Array | None = None) -> Array:
        """Search the parameters one after the other, twice.

        Args:
            cost: Function of their values, to be made small.
            is_free: Mask of the searched ones, None for all; the others stay where they start.

        Returns:
            Values of the parameters.
        """
        x, dt = np.array([p.start for p in self.parameters]), self.log.record.dt
        free = np.arange(len(x)) if is_free is None else np.flatnonzero(is_free)
        order = sorted(free.tolist(), key=lambda i: self.parameters[i].is_noise)  # latency first

        def vary(i: int, value: float) -> float:
            y = x.copy()
            y[i] = value
            return cost(y)

        for sweep in range(_SWEEPS):
            for i in order:
                low, high = self.parameters[i][3:]
                if self.parameters[i].is_noise:
                    found = minimize_scalar(
                        lambda v, i=i: vary(i, v), bounds=(low, high), method="bounded",
                        options={"xatol": 0.03, "maxiter": 12},
                    )  # fmt: skip
                    x[i] = found.x
                    continue
                for step in (_COARSE, max(dt, 0.01))[sweep:]:
                    span = high if step == _COARSE else _COARSE
                    start = 0.0 if step == _COARSE else x[i]
                    grid = start + np.arange(-math.floor(span / step), span / step + 0.5) * step
                    grid = grid[(grid >= low - 1e-9) & (grid <= high + 1e-9)]
                    x[i] = min(grid, key=lambda v, i=i: vary(i, v))
        return x

    def compute_intervals(self, log: Log, x: Array) -> Array:
        """Compute half of the 95 % interval of each parameter by a jackknife over blocks.

        Args:
            log: Recorded drive as it was logged.
            x: Values where the likelihood is largest.

        Returns:
            Halves, infinite where the likelihood does not bend.
        """
        n, dt = len(x), log.record.dt
        h = np.array([_STEP if p.is_noise else 2.0 * dt for p in self.parameters])
        lows = np.array([p.low for p in self.parameters])
        centre = np.maximum(x, lows + h)
        middle, steps = self.compute_blocks(log, centre), np.diag(h)
        plus, minus = (
            np.array([self.compute_blocks(log, centre + sign * e) for e in steps])
            for sign in (1.0, -1.0)
        )
        g = ((plus - minus) / (2.0 * h[:, None])).T
        H = np.zeros((_BLOCKS, n, n))
        for i in range(n):
            H[:, i, i] = (2.0 * middle - plus[i] - minus[i]) / h[i] ** 2
            for j in range(i):
                both = self.compute_blocks(log, centre + steps[i] + steps[j])
                H[:, i, j] = H[:, j, i] = (plus[i] + plus[j] - both - middle) / (h[i] * h[j])
        total, halves = H.sum(axis=0), np.full(n, math.inf)
        bends = np.flatnonzero(np.isfinite(g).all(axis=0) & (np.diag(total) > 0.0))
        H, g, total = H[:, bends][:, :, bends], g[:, bends], total[np.ix_(bends, bends)]
        if len(bends) and np.linalg.eigvalsh(total)[0] > 0.0:
            without = np.array([
                np.linalg.solve(total - one, g.sum(axis=0) - slope)
                for one, slope in zip(H, g, strict=True)
            ])  # fmt: skip
            by_blocks = [margin_of_error((_BLOCKS - 1.0) * moves) for moves in without.T]
            halves[bends] = np.maximum(by_blocks, 1.96 * np.sqrt(np.diag(np.linalg.inv(total))))
        return halves


def _count_settled(log: Log) -> int:
    """Count the rows that do not count."""
    return round(SETTLED / log.record.dt)


def cut_half(log: Log, second: bool) -> Log:
    """Cut a log in two.

    Args:
        log: Recorded drive.
        second: Whether to return the second half.

    Returns:
        The half.
    """
    rows = len(log.time)
    return cut(log, rows // 2, rows) if second else cut(log, 0, rows // 2)


def tune(
    name: str,
    log: Log,
    car: Vehicle,
    options: Mapping[str, Any] | None = None,
    wires: SignalCalibration | None = None,
) -> tuple[Suite, SignalCalibration, dict[str, float]]:
    """Find noise and latency from the first half of a log, and judge them on the second.

    Args:
        name: Name of a filter with gains "covariance".
        log: Recorded drive.
        car: Car that the filter assumes.
        options: Options that are held.
        wires: Stated calibration.

    Returns:
        Suite, calibration with the found numbers, and the filter's options; both as stated where
        the log is too poor.

    Raises:
        ValueError: The drive is too short, or the filter has no likelihood.
    """
    stated = wires or SignalCalibration()
    first, second = cut_half(log, False), cut_half(log, True)
    if len(first.time) < 3 * _count_settled(log):
        raise ValueError(f"{log.name}: half of it lasts under {3.0 * SETTLED:g} s")
    tuning = LogTuning(name, first, car, options or {}, stated)
    start = np.array([p.start for p in tuning.parameters])
    turning = float(np.std(compute_ground_speed(first) * first.record.fast[:, FAST.gyro]))

    def cost(v: Array) -> float:
        return -float(tuning.compute_blocks(first, v).sum())

    reason, x, halves = "", start, np.full(len(start), math.inf)
    if turning < MIN_TURNING:
        reason = f"no excitation, speed x yaw rate has {turning:.2g} m/s2 RMS"
    else:
        x = tuning.search(cost)
        halves = tuning.compute_intervals(first, x)
    findings = _make_findings(tuning, x, halves, reason)
    is_determined = np.array([finding.is_determined for finding in findings])
    if is_determined.any() and not is_determined.all():  # the others' best is now another
        x = tuning.search(cost, is_determined)
        halves = tuning.compute_intervals(first, x)
        again = _make_findings(tuning, x, halves, "")
        findings = [new if old.is_determined else old
                    for new, old in zip(again, findings, strict=True)]  # fmt: skip
        is_determined = np.array([finding.is_determined for finding in findings])
    # a filter's own noise also covers what its model lacks: it is raised, never lowered
    x = np.where([p.is_noise for p in tuning.parameters], np.maximum(x, start), x)
    x = np.where(is_determined, x, start)
    rows = [_score(tuning, second, "stated", start, True), _score(tuning, second, "found", x)]
    gain = rows[1]["density"] - rows[0]["density"]
    if not reason and not is_determined.any():
        reason = "every interval is too wide"
    elif not reason and gain <= 0.0:
        reason = "the numbers found predict the second half no better than those stated"
    if reason:
        return _make_suite(name, log, findings, rows, reason, ""), stated, {}
    values = {p.name: v for p, v, is_sure in zip(tuning.parameters, x, is_determined, strict=True)
              if is_sure}  # fmt: skip
    noise = {key: float(f"{math.exp(v):.3g}") for key, v in values.items() if key in NOISE}
    late = {key: round(float(v), 4) for key, v in values.items() if key not in NOISE}
    calibration = stated._replace(
        latency={**stated.latency, **late},
        noise={**stated.noise, **{k: v for k, v in noise.items() if k in NOISES.values()}},
    )
    words = [f"--latency {key}={value:g}" for key, value in late.items()]
    words += [f"--estimator-option {name}.{key}={value:g}" for key, value in noise.items()]
    return _make_suite(name, log, findings, rows, "", " ".join(words)), calibration, noise | late


def _make_findings(tuning: LogTuning, x: Array, halves: Array, reason: str) -> list[Finding]:
    """Rows of the table."""
    rows = zip(tuning.parameters, x, halves, strict=True)
    return [_make_finding(*row, reason) for row in rows]


def _make_finding(p: Parameter, value: float, half: float, reason: str) -> Finding:
    """A row of the table; the interval of a noise is that of its logarithm, to first order."""
    widest = _WIDEST["noise" if p.is_noise else "latency"]
    at_end = (min(value - p.low, p.high - value) < widest and p.is_noise) or value >= p.high
    remark = reason or ("at the end of its range" if at_end else "")
    remark = remark or ("" if half <= widest else "its interval is too wide")
    numbers = (p.start, value, half)
    if p.is_noise:
        numbers = math.exp(p.start), math.exp(value), math.exp(value) * half
    label = f"{p.name}" if p.is_noise else f"latency of {p.name}"
    unit = "SI" if p.is_noise else "s"
    if reason:
        numbers = numbers[0], math.nan, math.inf
    return Finding(label, *numbers, unit, not remark, remark)


def _score(
    tuning: LogTuning, log: Log, label: str, x: Array, is_default: bool = False
) -> dict[str, Any]:
    """A record of how a filter predicts a log's next samples; with truth, its error too."""
    delayed, late = tuning.delay(log, x), _count_settled(log)
    filter_ = tuning.make_filter(delayed, None if is_default else x)
    fast, packets, residuals = compute_log_densities(filter_, delayed)
    record = {
        "numbers": label,
        "density": float((fast[late:].sum() + packets.sum()) / (len(fast) - late)),
        "gyro": float(np.sqrt(np.mean(residuals[late:, 0] ** 2))),
    }
    if "beta" in log.truth:
        error = (filter_.run(delayed)["beta"] - log.truth["beta"])[late:]
        record["rmse"] = float(np.sqrt(np.nanmean(error**2)))
    return record


def _make_suite(
    name: str,
    log: Log,
    findings: Sequence[Finding],
    rows: Sequence[dict[str, Any]],
    reason: str,
    words: str,
) -> Suite:
    """Make the suite; words: options of `sideslip replay` with what was found."""
    suite = Suite("tune", f"Noise and latency of a recorded drive: {log.name}", "")
    missing = [finding.name for finding in findings if not finding.is_determined]
    answer = f"Too poor a log: {reason}. All stays as stated."
    suite.verdict = format_verdict(
        answer
        if reason
        else f"{name}'s log density of the next samples rises on the second half, "
        f"{rows[0]['density']:.3f} to {rows[1]['density']:.3f} a row.",
        f"Not told by this log: {', '.join(missing) or 'nothing'}.",
        "Not covered: process noise; errors that stand still, which no innovation shows.",
    )
    columns = [
        "numbers", Column("density", "log density a row", form=".3f"),
        Column("gyro", "one-step error of yaw rate / (deg/s)", math.degrees(1.0), ".3f"),
    ]  # fmt: skip
    if "rmse" in rows[0]:
        columns.append(Column("rmse", "error of sideslip / deg", math.degrees(1.0), ".3f"))
    note = f"`sideslip replay {words}` uses them." if words else ""
    held = ResultTable("On the second half", tuple(columns), rows, note, keyed=False)
    suite.tables = [make_findings_table(findings, _NOTE), held]
    return suite
