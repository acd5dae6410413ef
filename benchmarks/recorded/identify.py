"""A car, its steering and its sensors from recorded drives, and what the drives cannot show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ...envs.record import FAST, Array, Log
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ...estimators.make import make_estimator
from ...estimators.wires import NOISES, SignalCalibration, apply_wires
from . import quality
from .bicycle_fit import PRIOR, BicycleFit, Theta, Windows, compute_residual, fit, make_windows
from .emulate import (
    BLOCKS,
    COURSE,
    SPEED,
    LoggedMotion,
    collect_fixes,
    compute_remainder,
    find_latency,
    jackknife,
)
from .suite import GYRO_ONLY

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
_WIDE = "its interval is too wide"
_LATE = (-0.2, 1.2)  # s, of the GPS
_LATE_WITHIN = 0.05  # s, half of the widest interval of a latency
_FAST = {"gyro": "rad/s", "accel_y": "m/s2", "roll_rate": "rad/s", "wheel_left": "m/s"}


class Finding(NamedTuple):
    """A number with half of its 95 % interval, and whether the log determines it."""

    name: str
    stated: float
    value: float = math.nan
    half: float = math.inf
    unit: str = ""
    is_determined: bool = False
    remark: str = ""


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
    logs: Sequence[Log],
    car: Vehicle,
    wires: SignalCalibration | None = None,
    tyres: str | None = None,
) -> IdentificationResult:
    """Fit the car to the parts of a log, and the noise of its sensors.

    Args:
        logs: Parts of the log.
        car: Stated car, where the search starts.
        wires: Stated calibration, where the search starts.
        tyres: "linear", as stiff as the log's accelerations have them, without roll, or "fiala", as
            stiff as at small slips, with the stated friction and roll; None: what errs less on
            held-out stretches.

    Returns:
        Car, calibration and findings.

    Raises:
        ValueError: Swapped columns, or an unknown law of tyres.
    """
    if tyres not in (None, *TYRES):
        raise ValueError(f"tyres are {' or '.join(TYRES)}, got {tyres!r}")
    if what := quality.find_swapped(logs):
        raise ValueError(f"{logs[0].name}: columns are swapped, {what}")
    car.check_roll()
    stated = wires or SignalCalibration()
    logs = [apply_wires(log, SignalCalibration(at=stated.at)) for log in logs]
    if "gps" in stated.at:
        car = car.replace(antenna_ahead=0.0)  # the course is the centre of gravity's now
    result = IdentificationResult(car, stated)
    w = make_windows(logs, [quality.find_saturated(log) for log in logs])
    gain, related = quality.estimate_steering_gain(logs, car)
    if reason := _find_reason(w, related):
        result.reason = reason
        for _, label, value, unit in _list_parameters(car, stated):
            result.findings.append(Finding(label, value, unit=unit, remark=reason))
    else:
        near = 1.0 / _MAX_RATIO_FACTOR < gain / stated.gain < _MAX_RATIO_FACTOR
        start = Theta(gain=stated.gain if near else gain, offset=stated.offset)
        sd = abs(start.gain) * (PRIOR.gain if near else _UNKNOWN_GAIN)
        w = replace(w, centre=start, spread=PRIOR._replace(gain=sd))
        _fit_car(result, w, near, TYRES if tyres is None else (tyres,))
    slips = estimate_slips(logs, result.car, result.wires._replace(at={}))
    both = (estimate_slips(logs, car, stated._replace(at={})), slips)
    result.slips = tuple(_compute_truth_error(logs, angles) for angles in both)
    findings, noise, latency = _make_sensor_findings(logs, slips)
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
    held = ["gain"] if near and peak_accel > _MILD else []
    without = (*held, *(() if w.accel else _OF_ACCEL), *(() if w.course else ("gps_delay",)))
    free = [name for name in (*Theta._fields[:8], "gps_delay") if name not in without]
    if len(laws) > 1 and peak_accel > _MAX_FRICTION_SHARE * car.friction * GRAVITY:
        laws = TYRES[:1]  # the stated friction is not this log's, and Fiala's law lives by it
    by_law = [replace(w, tyres=law) for law in laws]
    fits = [(windows, fit(car, windows, w.centre, free)) for windows in by_law]
    scale = fits[0][1].scale  # one for all laws
    w, base = min(fits, key=lambda pair: np.linalg.norm(_evaluate_folds(car, *pair) / scale))
    rows, best, free_too = _fit_latencies(car, w, base)
    theta, gain = best.theta, best.theta.gain
    factors = {key: math.exp(getattr(theta, name)) for name, key in _OF_CAR.items()}
    values = {key: getattr(car, key) * factor for key, factor in factors.items()}
    fitted = car.replace(**values, name=f"{car.name}-identified")
    result.findings = _make_car_findings(car, stated, w, (best, free_too), held, peak_accel) + rows
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
    residuals = [compute_residual(car, parameters, w) for parameters in (first, theta)]
    rates = [float(np.sqrt(np.mean(left**2, axis=(0, 2)))[0]) for left in residuals]
    result.rates = (*rates, float(_evaluate_folds(car, w, best)[0]))
    result.remarks.append(
        f"{len(w.starts)} windows of 4 s, of whose rows 95 % turn with less than "
        f"{peak_accel:.1f} m/s2; "
        f"{w.tyres} tyres" + (" err least on held-out stretches" if len(laws) > 1 else "")
        + (", whose stiffness is that of this drive" if w.tyres == TYRES[0] else
           ", as stiff as at small slips; estimators, whose tyres are linear, rather take "
           "those of --tyres linear")
    )  # fmt: skip


def _fit_latencies(
    car: Vehicle, w: Windows, base: BicycleFit
) -> tuple[list[Finding], BicycleFit, BicycleFit]:
    """Findings of both latencies, the fit with those that pay, and the one with all free."""
    names = tuple(_DELAYS)[: 2 if w.accel else 1]
    usual, pays, rows = np.linalg.norm(_evaluate_folds(car, w, base) / base.scale), [], []
    free = fit(car, w, base.theta, (*base.free, *names), base.scale)
    for name in names:
        half, value = free.halves[name], float(getattr(free.theta, name))
        is_determined, remark = half < _LATE_WITHIN, "within its interval of 0"
        if is_determined and abs(value) > half:
            single_fit = fit(car, w, base.theta, (*base.free, name), base.scale)
            share = np.linalg.norm(_evaluate_folds(car, w, single_fit) / base.scale) / usual
            pays += [name] if share < _MAX_ERROR_RATIO else []
            remark = f"{'' if name in pays else 'not '}applied: error held out x {share:.3f}"
        label = f"latency of {_DELAYS[name]}"
        text = remark if is_determined else _WIDE
        rows.append(Finding(label, 0.0, value, half, "s", is_determined, text))
    best = fit(car, w, base.theta, (*base.free, *pays), base.scale) if pays else base
    return rows, best, free


def _evaluate_folds(car: Vehicle, w: Windows, best: BicycleFit) -> Array:
    """RMS of the residual of each channel, on each fold of stretches by the fit to the others."""
    squares, labels = [], np.unique(w.stretch)
    for fold in range(_FOLDS):
        moves = best.estimate_shift(labels % _FOLDS == fold)
        moved = {n: getattr(best.theta, n) + m for n, m in zip(best.free, moves, strict=True)}
        inside = w.stretch % _FOLDS == fold
        fold_windows = replace(w, starts=w.starts[inside], stretch=w.stretch[inside])
        theta = best.theta._replace(**moved)
        squares.append(np.mean(compute_residual(car, theta, fold_windows) ** 2, axis=2))
    return np.asarray(np.sqrt(np.mean(np.concatenate(squares), axis=0)))


def _make_car_findings(
    car: Vehicle,
    stated: SignalCalibration,
    w: Windows,
    fits: tuple[BicycleFit, BicycleFit],
    held: Sequence[str],
    peak_accel: float,
) -> list[Finding]:
    """Findings of `_list_parameters`; intervals with the shift by free latencies in fit 2."""
    findings, (best, free) = [], fits
    for name, label, value, unit in _list_parameters(car, stated):
        at = float(getattr(best.theta, name))
        half = math.hypot(best.halves.get(name, math.inf), float(getattr(free.theta, name)) - at)
        is_determined = half <= _MAX_INTERVAL_SHARE * 1.96 * getattr(w.spread, name)
        remark = "" if is_determined else _WIDE
        if name in _OF_CAR:
            at, half = value * math.exp(at), value * math.exp(at) * half
        elif label == "steering sign":
            is_determined, at, half, remark = True, math.copysign(1.0, at), math.inf, ""
        elif name == "gain":
            at, half = 1.0 / abs(at), half / at**2
            if held:
                remark = f"at {peak_accel:.0f} m/s2 a saturating axle would look like another ratio"
        elif unit.startswith("deg"):
            at, half = math.degrees(at), math.degrees(half)
        findings.append(Finding(label, value, at, half, unit, is_determined, remark))
    return findings


def estimate_slips(logs: Sequence[Log], car: Vehicle, wires: SignalCalibration) -> list[Array]:
    """Estimate the sideslip angle of drives by the gyro alone.

    Args:
        logs: Recorded drives, at least one.
        car: Car that is assumed.
        wires: Calibration of the steering.

    Returns:
        Sideslip angle (rad) of each, shape (rows,).
    """
    dt = logs[0].record.dt
    estimator = make_estimator(GYRO_ONLY, vehicle=car, dt=dt, q_beta=1e-3, q_gamma=0.1)
    steered = wires._replace(latency={})
    return [estimator.run(apply_wires(log, steered))["beta"] for log in logs]


def _compute_truth_error(logs: Sequence[Log], slips: Sequence[Array]) -> float:
    """RMS of the sideslip's error (rad) where logs have the truth; NaN where none has."""
    errors = [np.zeros(0)]
    for log, slip in zip(logs, slips, strict=True):
        if "beta" in log.truth:
            errors.append((slip - log.truth["beta"])[LoggedMotion(log).is_moving])
    combined = np.concatenate(errors)
    combined = combined[np.isfinite(combined)]
    return float(np.sqrt(np.mean(combined**2))) if len(combined) else math.nan


def _estimate_white_noise(parts: Sequence[Array]) -> tuple[float, float]:
    """Estimate standard deviation and half interval of a channel's white noise.

    From third differences of new samples: a slower sensor repeats its last one.
    """
    blocks = []
    for values in parts:
        new = np.concatenate([[True], np.diff(values) != 0.0])
        third = np.diff(values if new.mean() > 0.7 else values[new], 3) / math.sqrt(20.0)
        blocks += [np.array([block @ block, len(block)]) for block in np.array_split(third, BLOCKS)]
    # each block: sum of squares and count
    return jackknife(np.array(blocks), lambda x: math.sqrt(float(x[0]) / max(float(x[1]), 1.0)))


def _make_sensor_findings(
    logs: Sequence[Log], slips: Sequence[Array]
) -> tuple[list[Finding], dict[str, float], dict[str, float]]:
    """Make findings of the sensors, noise by the estimators' options, latency by sensor (s).

    slips: Sideslip angle (rad) of each log, shape (rows,), by which the course is predicted.
    """
    findings: list[Finding] = []
    noise: dict[str, float] = {}
    for channel, unit in _FAST.items():
        if all(channel in log.record.present for log in logs):
            column = getattr(FAST, channel)
            sd, half = _estimate_white_noise([log.record.fast[:, column] for log in logs])
            is_determined = half < 0.3 * sd
            remark = "" if is_determined else _WIDE if sd > 0.0 else "none is seen"
            row = Finding(f"noise of {channel}", math.nan, sd, half, unit, is_determined, remark)
            findings.append(row)
            noise |= {NOISES[channel]: sd} if is_determined else {}
    times = np.arange(*_LATE, max(logs[0].record.dt, 0.01))
    courses = collect_fixes(logs, COURSE, slips, times)
    speeds = collect_fixes(logs, SPEED, None, times)
    if not courses:
        return findings, noise, {}
    late, half = find_latency(courses, times)
    with_slip, _ = find_latency(courses, times, 1.0)  # had the slip its size
    half = math.hypot(half, late - with_slip)
    is_determined = half < _LATE_WITHIN
    pays = is_determined and late > half
    remark = ("applied" if pays else "within its interval of 0") if is_determined else _WIDE
    findings.append(Finding("latency of gps", 0.0, late, half, "s", is_determined, remark))
    at = int(np.argmin(np.abs(times - late)))
    for name, unit, scale, blocks in (
        ("course", "deg", math.degrees(1.0), courses), ("gps_speed", "m/s", 1.0, speeds)
    ):  # fmt: skip
        if blocks:  # a difference has twice the variance
            left = np.array(blocks)
            sd, half = jackknife(left, lambda sums: math.sqrt(0.5 * compute_remainder(sums)[at]))
            row = Finding(f"noise of {name}", math.nan, scale * sd, scale * half, unit, True)
            findings, noise = [*findings, row], noise | {NOISES[name]: sd}
    return findings, noise, {"gps": late} if pays else {}
