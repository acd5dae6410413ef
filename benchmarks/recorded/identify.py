"""A car, its steering and its sensors from recorded drives, and what the drives cannot show.

The identified car can drive held-out parts of the log, beside what was measured.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...envs.record import PACKET, Array, Log
from ...envs.recordings.log_file import read_parts
from ...envs.recordings.tables import parse_mapping
from ...envs.vehicle.parameters import GRAVITY, Vehicle, VehicleSource, make_vehicle
from ...estimators.wires import AS_LOGGED, SignalCalibration, apply_wires
from ..harness.results import Column, ResultTable, Suite
from ..harness.stats import Estimate
from ..report.study import format_verdict
from . import quality, sensor_noise
from .bicycle_fit import PRIOR, BicycleFit, Theta, Windows, fit
from .sensor_noise import Finding

TYRES = ("linear", "fiala")
_MIN_WINDOWS = 6
_MILD = 5.0  # m/s2; beyond, a saturating axle looks like another steering ratio
_MAX_FRICTION_SHARE = 0.8  # of the stated friction's acceleration, beyond which that is in doubt
_MAX_RATIO_FACTOR = 2.5  # within this factor of the stated ratio, that one may be right
_MAX_ERROR_RATIO = 0.98  # of the error on held-out stretches, at most, where a latency is applied
_FOLDS = 4
POSSIBLE = (0.6, 1.3)  # I/(m l_f l_r) of cars
_MAX_INTERVAL_SHARE = 0.5  # of the prior's interval, the widest one with which a number is told
_UNKNOWN_GAIN = 0.3  # standard deviation of its share, where no stated ratio is near
_DELAYS = {"steer_delay": "steer", "accel_delay": "accel_y"}
_OF_ACCEL = ("accel_bias", "accel_gain")
_OF_CAR = {"front": "front_stiffness", "rear": "rear_stiffness", "inertia": "yaw_inertia"}


@dataclass
class IdentificationResult:
    """The car and calibration that a log shows: the stated ones with the identified numbers."""

    car: Vehicle
    wires: SignalCalibration
    findings: list[Finding] = field(default_factory=list)
    rates: tuple[float, ...] = ()  # RMS of yaw rate's residual (rad/s): stated, fitted, held out
    slips: tuple[float, ...] = ()  # RMS beside the log's sideslip (rad): stated, fitted
    reason: str = ""  # why nothing is known of the car
    theta: Theta | None = None  # all that was fitted to the car's motion, where it was
    tyres: str = TYRES[0]  # their law in that fit
    remarks: list[str] = field(default_factory=list)


def identify(
    logs: Sequence[Log], car: Vehicle, wires: SignalCalibration = AS_LOGGED,
    tyres: str | None = None,
) -> IdentificationResult:  # fmt: skip
    """Fit the car to the parts of a log, and the noise of its sensors.

    Args:
        logs: Parts of the log; ValueError for swapped columns.
        car: Stated car, where the search starts.
        wires: Stated calibration of the signals, where the search starts.
        tyres: "linear", as stiff as the log's accelerations have them, without roll, or "fiala", as
            stiff as at small slips, with the stated friction and roll; None: what errs less on
            held-out stretches; another: ValueError.
    """
    if tyres not in (None, *TYRES):
        raise ValueError(f"tyres are {' or '.join(TYRES)}, got {tyres!r}")
    if what := quality.find_swapped(logs):
        raise ValueError(f"{logs[0].name}: columns are swapped, {what}")
    car.check_roll()
    logs = [apply_wires(log, SignalCalibration(at=wires.at)) for log in logs]
    if "gps" in wires.at:
        car = car.replace(antenna_ahead=0.0)  # the course is the centre of gravity's now
    result = IdentificationResult(car, wires)
    w = Windows.from_logs(logs, car)
    line = quality.fit_steering(logs, car, steady=False)
    gain, related = (float(line.slope), float(line.rvalue)) if line else (1.0, 0.0)
    if reason := _find_reason(w, related):
        result.reason = reason
        for _, label, value, unit in _list_parameters(car, wires):
            result.findings.append(Finding(label, value, unit=unit, remark=reason))
    else:
        near = 1.0 / _MAX_RATIO_FACTOR < gain / wires.gain < _MAX_RATIO_FACTOR
        start = Theta(gain=wires.gain if near else gain, offset=wires.offset)
        sd = abs(start.gain) * (PRIOR.gain if near else _UNKNOWN_GAIN)
        w = replace(w, centre=start, spread=PRIOR._replace(gain=sd))
        _fit_car(result, w, near, TYRES if tyres is None else (tyres,))
    slips = sensor_noise.estimate_slips(logs, result.car, result.wires)
    both = (sensor_noise.estimate_slips(logs, car, wires), slips)
    result.slips = tuple(_compute_truth_error(logs, angles) for angles in both)
    findings, noise, latency = sensor_noise.make_sensor_findings(logs, slips)
    result.findings += findings
    result.wires = result.wires._replace(noise=noise, latency={**result.wires.latency, **latency})
    return result


def _find_reason(w: Windows, related: float) -> str:
    """Why a log shows nothing of a car, "" if it may; related: steering to yaw rate."""
    if len(w.starts) < _MIN_WINDOWS:
        return f"{len(w.starts)} of {_MIN_WINDOWS} windows of 5 s are fast enough and whole"
    turns = w.rows[2][w.scored_rows] * w.rows[0][w.scored_rows]
    if np.std(turns) < quality.MIN_TURNING:
        return f"no excitation, speed x yaw rate has {np.std(turns):.2g} m/s2 RMS"
    if abs(related) < quality.MIN_CORRELATION:
        return f"steering and yaw rate are unrelated (correlation {related:.2f})"
    return ""


def _list_parameters(car: Vehicle, wires: SignalCalibration) -> list[tuple[str, str, float, str]]:
    """Name in `Theta`, label, stated value and unit of what the car's fit tells."""
    return [
        ("front", "front_stiffness_axle", 2.0 * car.front_stiffness, "N/rad"),
        ("rear", "rear_stiffness_axle", 2.0 * car.rear_stiffness, "N/rad"),
        ("inertia", "yaw_inertia", car.yaw_inertia, "kg m2"),
        ("gain", "steering ratio", wires.ratio, ""),
        ("gain", "steering sign", float(wires.sign), ""),
        ("offset", "steering offset", math.degrees(wires.offset), "deg"),
        ("gyro_bias", "gyro bias", 0.0, "deg/s"),
        ("accel_bias", "accel_y bias", 0.0, "m/s2"),
    ]


def _fit_car(result: IdentificationResult, w: Windows, near: bool, laws: Sequence[str]) -> None:
    """Fill in all that the car's motion tells. near: whether the stated ratio may be right."""
    car, stated = result.car, result.wires
    peak_accel = float(np.percentile(np.abs(w.rows[2] * w.rows[0])[w.scored_rows], 95))
    doubt, without = "", (*(() if w.accel else _OF_ACCEL), *(() if w.course else ("gps_delay",)))
    if near and peak_accel > _MILD:
        doubt = f"at {peak_accel:.0f} m/s2 a saturating axle would look like another ratio"
        without += ("gain",)
    free = [name for name in (*Theta._fields[:8], "gps_delay") if name not in without]
    if len(laws) > 1 and peak_accel > _MAX_FRICTION_SHARE * car.friction * GRAVITY:
        laws = TYRES[:1]  # the stated friction is not this log's, and Fiala's law lives by it
    by_law = [replace(w, tyres=law) for law in laws]
    fits = [(windows, fit(windows, w.centre, free)) for windows in by_law]
    scale = fits[0][1].scale  # one for all laws
    w, base = min(fits, key=lambda pair: np.linalg.norm(_evaluate_folds(*pair) / scale))
    rows, best, free_too = _fit_latencies(w, base)
    theta, gain = best.theta, best.theta.gain
    factors = {key: math.exp(getattr(theta, name)) for name, key in _OF_CAR.items()}
    values = {key: getattr(car, key) * factor for key, factor in factors.items()}
    fitted = car.replace(**values, name=f"{car.name}-identified")
    result.findings = _make_car_findings(stated, w, best, free_too, doubt) + rows
    share = fitted.yaw_inertia / (car.mass * car.front_arm * car.rear_arm)
    if not POSSIBLE[0] <= share <= POSSIBLE[1]:
        low, high = POSSIBLE
        result.reason = f"its fit has I/(m l_f l_r) = {share:.2f}, and cars have {low} to {high}"
    elif not any(row.is_determined for row in result.findings[:3]):
        result.reason = "it tells neither the stiffnesses nor the yaw inertia"
    if result.reason:
        reason, findings = result.reason, result.findings
        result.findings = [x._replace(is_determined=False, remark=reason) for x in findings]
        return
    result.car, result.theta, result.tyres = fitted, theta, w.tyres
    late = {channel: getattr(theta, name) for name, channel in _DELAYS.items() if name in best.free}
    steering = 1.0 / abs(gain), 1 if gain > 0.0 else -1, theta.offset
    result.wires = SignalCalibration(*steering, late, at=stated.at)
    first = Theta(gain=stated.gain, offset=stated.offset)
    residuals = [w.compute_residual(parameters) for parameters in (first, theta)]
    rates = [float(np.sqrt(np.mean(left**2, axis=(0, 2)))[0]) for left in residuals]
    result.rates = (*rates, float(_evaluate_folds(w, best)[0]))
    result.remarks.append(
        f"{len(w.starts)} windows of 4 s, of whose rows 95 % turn with less than "
        f"{peak_accel:.1f} m/s2; "
        f"{w.tyres} tyres" + (" err least on held-out stretches" if len(laws) > 1 else "")
        + (", whose stiffness is that of this drive" if w.tyres == TYRES[0] else
           ", as stiff as at small slips; estimators, whose tyres are linear, rather take "
           "those of --tyres linear")
    )  # fmt: skip


def _fit_latencies(w: Windows, base: BicycleFit) -> tuple[list[Finding], BicycleFit, BicycleFit]:
    """Findings of both latencies, the fit with those that pay, and the one with all free."""
    names = tuple(_DELAYS)[: 2 if w.accel else 1]
    usual, pays, rows = np.linalg.norm(_evaluate_folds(w, base) / base.scale), [], []
    free = fit(w, base.theta, (*base.free, *names), base.scale)
    for name in names:
        half, value = free.halves[name], float(getattr(free.theta, name))
        is_determined, remark = half < sensor_noise.LATE_WITHIN, "within its interval of 0"
        if is_determined and abs(value) > half:
            single_fit = fit(w, base.theta, (*base.free, name), base.scale)
            share = np.linalg.norm(_evaluate_folds(w, single_fit) / base.scale) / usual
            pays += [name] if share < _MAX_ERROR_RATIO else []
            remark = f"{'' if name in pays else 'not '}applied: error held out x {share:.3f}"
        label = f"latency of {_DELAYS[name]}"
        text = remark if is_determined else sensor_noise.WIDE
        rows.append(Finding(label, 0.0, value, half, "s", is_determined, text))
    best = fit(w, base.theta, (*base.free, *pays), base.scale) if pays else base
    return rows, best, free


def _evaluate_folds(w: Windows, best: BicycleFit) -> Array:
    """RMS of the residual of each channel, on each fold of stretches by the fit to the others."""
    squares, labels = [], np.unique(w.stretch)
    for fold in range(_FOLDS):
        moves = best.estimate_shift(labels % _FOLDS == fold)
        moved = {n: getattr(best.theta, n) + m for n, m in zip(best.free, moves, strict=True)}
        inside = w.stretch % _FOLDS == fold
        fold_windows = replace(w, starts=w.starts[inside], stretch=w.stretch[inside])
        theta = best.theta._replace(**moved)
        squares.append(np.mean(fold_windows.compute_residual(theta) ** 2, axis=2))
    return np.asarray(np.sqrt(np.mean(np.concatenate(squares), axis=0)))


def _make_car_findings(
    stated: SignalCalibration, w: Windows, best: BicycleFit, free: BicycleFit, doubt: str
) -> list[Finding]:
    """Findings of `_list_parameters`, intervals with the shift to `free`; doubt: of the ratio."""
    findings = []
    for name, label, value, unit in _list_parameters(w.car, stated):
        at, shifted = float(getattr(best.theta, name)), float(getattr(free.theta, name))
        half = math.hypot(best.halves.get(name, math.inf), shifted - at)
        is_determined = half <= _MAX_INTERVAL_SHARE * 1.96 * getattr(w.spread, name)
        remark = "" if is_determined else sensor_noise.WIDE
        if name in _OF_CAR:
            at, half = value * math.exp(at), value * math.exp(at) * half
        elif label == "steering sign":
            is_determined, at, half, remark = True, math.copysign(1.0, at), math.inf, ""
        elif name == "gain":
            at, half, remark = 1.0 / abs(at), half / at**2, doubt or remark
        elif unit.startswith("deg"):
            at, half = math.degrees(at), math.degrees(half)
        findings.append(Finding(label, value, at, half, unit, is_determined, remark))
    return findings


def _compute_truth_error(logs: Sequence[Log], slips: Sequence[Array]) -> float:
    """RMS of the sideslip's error (rad) where logs have the truth; NaN where none has."""
    errors = [
        (slip - log.truth.get("beta", math.nan))[log.is_moving]
        for log, slip in zip(logs, slips, strict=True)
    ]
    known = np.concatenate(errors)
    known = known[np.isfinite(known)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


_FINDINGS_NOTE = (
    "Intervals by a jackknife over 40 stretches of the log (20 for sensors), and by priors around "
    "what is stated, to which numbers that this log does not tell are drawn. Latencies of steering "
    "and acceleration are applied only where they lower the error on stretches that the fit has "
    "not seen: the lag of tyres looks like one."
)
_BLOCK, _MOST_BLOCKS = 12.0, 16  # s, the shortest; of a part
# ISO 19364 (steady-state circular driving) and ISO 22140 (lateral transient response) compare a
# simulation with tolerances around what was measured. Their texts are not at hand: these numbers
# are assumed. name: factor to the unit shown, unit, offset in it, share of the measured value
_CORRIDORS = {
    "yaw rate": (180.0 / np.pi, "deg/s", 1.0, 0.1),
    "lateral acceleration": (1.0, "m/s2", 0.3, 0.1),
    "sideslip angle": (180.0 / np.pi, "deg", 0.3, 0.15),
}
_MIN_SHARE, _MAX_GAIN_ERROR = 0.95, 0.1  # assumed as well
_VALIDATION_NOTE = (
    "Odd blocks identify, even ones are driven open loop: the model's first second forgets its "
    "start, 4 s count. A sample is inside within offset + share x what was measured; a channel "
    f"stays inside with {100.0 * _MIN_SHARE:.0f} % of its samples and a gain (simulated over "
    f"measured, by least squares) within {100.0 * _MAX_GAIN_ERROR:.0f} % of 1. Form after "
    "ISO 19364 and ISO 22140, whose text was not at hand: all tolerances are assumptions, and "
    "this is no proof of conformity."
)


def identify_file(
    log: str | Path, vehicle: VehicleSource, mapping: Sequence[str] | None = None,
    wires: SignalCalibration = AS_LOGGED, tyres: str | None = None, until: float | None = None,
    validate: bool = False,
) -> tuple[IdentificationResult, Suite]:  # fmt: skip
    """Read a drive and identify its car; return the result and its suite.

    Args:
        log: File of the drive.
        vehicle: Stated vehicle, as for `make_vehicle`.
        mapping: Texts such as "steer_rad=Delta".
        wires: Stated calibration of the signals.
        tyres: Law of the tyres, as for `identify`.
        until: End of the part that is used (s), None for all.
        validate: Whether to say how well a car from half of the log drives the other half.
    """
    logs, remarks = read_parts(log, parse_mapping(mapping), end=until)
    car = make_vehicle(vehicle)
    result = identify(logs, car, wires, tyres)
    warnings, remarks = quality.sort_remarks(remarks, logs, car)
    result.remarks = remarks + result.remarks
    suite = _make_suite(result, logs[0].name)
    suite.warnings = warnings
    if validate:
        suite.tables.append(_make_validation_table(logs, car, wires, tyres))
    return result, suite


def _make_suite(result: IdentificationResult, name: str) -> Suite:
    """Make a suite of what a log shows: a table with a verdict."""
    suite = Suite("identify", f"The car of a recorded drive: {name}", "; ".join(result.remarks))
    missing = [finding.name for finding in result.findings if not finding.is_determined]
    answer = f"Not identified. This log shows nothing of the car: {result.reason}. "
    answer += "It stays as stated."
    if not result.reason:
        text = "The stated car leaves {:.2f} deg/s of the yaw rate, the found one {:.2f} "
        answer = (text + "({:.2f} held out).").format(*map(math.degrees, result.rates))
    slip = ""
    if not any(map(math.isnan, result.slips)):
        text = "Beside the log's own sideslip, which was not used: {:.2f}, now {:.2f} deg."
        slip = text.format(*map(math.degrees, result.slips))
    untold = f"Not told by this log: {', '.join(missing) or 'nothing'}."
    limits = "Not covered: the mass, which scales all; drives beside the part that was used."
    suite.verdict = format_verdict(answer, slip, untold, limits)
    numbers = Column("stated", form=".4g"), Column("found", "found [95 %]", form=".4g")
    columns = ("number", *numbers, "unit", "told by this log?")
    cells = []
    for name, value, at, half, unit, is_determined, remark in result.findings:
        number, is_so = Estimate(at, at - half, at + half), "yes" if is_determined else "no"
        cells.append([name, value, number, unit or "-", ": ".join(filter(None, [is_so, remark]))])
    suite.tables = [ResultTable("What the log shows", columns, cells, _FINDINGS_NOTE, keyed=False)]
    return suite


def _cut(log: Log, start: int, end: int) -> Log:
    """Cut rows out of a log, with the packets that were captured and arrived in them."""
    record, packets = log.record, log.record.packets
    first, behind = record.first + start, record.first + end
    within = (packets[:, PACKET.captured] >= first) & (packets[:, PACKET.arrived] < behind)
    fast = record.fast[start:end]
    record = replace(record, fast=fast, packets=packets[within], first=first)
    truth = {name: values[start:end] for name, values in log.truth.items()}
    return replace(log, record=record, truth=truth)


def _split_blocks(logs: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """Split logs into odd blocks, to identify from, and even ones, which are held out."""
    blocks = []
    for log in logs:
        count = int(np.clip(len(log.time) * log.record.dt / _BLOCK, 1, _MOST_BLOCKS))
        ends = np.linspace(0, len(log.time), count + 1).astype(int).tolist()
        blocks += [_cut(log, *pair) for pair in itertools.pairwise(ends)]
    return blocks[::2], blocks[1::2]


def _make_validation_table(
    logs: Sequence[Log], car: Vehicle, wires: SignalCalibration, tyres: str | None
) -> ResultTable:
    """Compare a car from odd blocks of a log with the even ones; where none is found, why."""
    moved = [apply_wires(log, SignalCalibration(at=wires.at)) for log in logs]
    odd, even = _split_blocks(moved)
    result = identify(odd, car, wires._replace(at={}), tyres)
    w, reason = Windows.from_logs(even, car) if even else None, result.reason
    if w is None or not len(w.starts):
        reason = reason or "no window of 5 s is held out"
    title = "Does the found car stay within assumed corridors of ISO 19364 / 22140?"
    columns = (
        "channel", Column("rmse", "RMSE", form=".3g"), "unit", "corridor",
        Column("inside", "inside / %", 100.0, ".0f"), Column("gain", "gain", form=".3f"), "stays",
    )  # fmt: skip
    if reason or result.theta is None or w is None:
        return ResultTable(title, columns, [], f"Not validated: {reason}.", keyed=False)
    w = replace(w, tyres=result.tyres)
    places, residual = w.scored_rows, w.compute_residual(result.theta)
    rows = zip([*_CORRIDORS][: 2 if w.accel else 1], w.rows, residual.swapaxes(0, 1), strict=False)
    measured = {name: (row[places], row[places] - left) for name, row, left in rows}
    if all("beta" in log.truth for log in even):
        every = round(w.dt / even[0].record.dt)
        truth = np.concatenate([log.truth["beta"][::every] for log in even])
        # with the antenna at the centre of gravity its sideslip angle is the car's
        slip = replace(w, car=car.replace(antenna_ahead=0.0)).simulate(result.theta)[2]
        if np.isfinite(truth[places]).any():
            measured["sideslip angle"] = truth[places], slip[:, places[0] - w.starts[0] - 1]
    cells = [_compare(name, *pair) for name, pair in measured.items()]
    return ResultTable(title, columns, cells, _VALIDATION_NOTE, keyed=False)


def _compare(name: str, measured: Array, simulated: Array) -> list[object]:
    """Cells of a channel: measured and simulated, shape (windows, rows)."""
    factor, unit, offset, share = _CORRIDORS[name]
    known = np.isfinite(measured)
    x, y = factor * measured[known], factor * simulated[known]
    inside = float(np.mean(np.abs(y - x) <= offset + share * np.abs(x)))
    gain = float(x @ y / (x @ x))
    stays = inside >= _MIN_SHARE and abs(gain - 1.0) <= _MAX_GAIN_ERROR
    corridor = f"{offset:g} + {100.0 * share:.0f} %"
    rmse = float(np.sqrt(np.mean((y - x) ** 2)))
    return [name, rmse, unit, corridor, inside, gain, "yes" if stays else "no"]
