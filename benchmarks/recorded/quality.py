"""Columns of a drive that contradict each other.

Args:
    log: Part of a recorded drive.
    name: Column, "gyro" or "accel_y".
    steady: Whether steady turns count alone.
    tyres: Factor of the understeer gradient, 0 for a neutral car.
    stated: Calibration of the steering that was applied to the logs.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label, median_filter, uniform_filter1d
from scipy.stats import linregress

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.recordings.log_file import WARNING_PREFIX
from ...envs.task import make_reference_params
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ...estimators.wires import AS_LOGGED, SignalCalibration

BLOCKER, WARNING, OK = LEVELS = ("BLOCKER", "WARNING", "OK")
"""Levels: no estimate is right before it is cured; an estimate is worse; nothing to do."""


class LogFinding(NamedTuple):
    """What a check says of a channel."""

    check: str  # name of the check
    level: str  # one of `LEVELS`
    channel: str  # quantity of the log, "" for all
    text: str  # sentence without a full stop, with number and unit
    cure: str = ""  # option or column that mends it


MIN_CORRELATION = 0.5  # correlation, below which steering and yaw rate have nothing in common
TRUTH = "the sideslip truth"  # how a warning begins that puts the score in doubt
COMPASS = "degrees from north, clockwise? --map course_degnorth=COLUMN reads it"
FACTOR = 1.8  # by which a column may differ from what the others imply
_SURE = 3.0  # standard errors beyond it
MIN_TURNING = 0.3  # m/s2 RMS, below which nothing is judged
_MILD = 5.0  # m/s2, up to which tyres are linear
_QUANTITIES = {
    "speed": "speed_x", "gyro": "yaw_rate", "the yaw rate": "yaw_rate", "steering": "steer",
    "the change of the course": "course", TRUTH: "sideslip",
}  # fmt: skip
_MAPPED = {  # unit in which a column of another one may be
    "speed_x": "kmh", "yaw_rate": "degps", "accel_y": "g", "steer": "deg", "course": "deg",
    "sideslip": "deg",
}  # fmt: skip
_FEW = 10  # samples, below which nothing is judged
_LIMITED = {"gyro": "the gyro", "accel_y": "accel_y"}
_LARGE = {"gyro": 0.02, "accel_y": 0.5}  # rad/s and m/s2, below which nothing is a limit
_LONG, _STEPS = 5.0, 100.0  # usual runs that a gyro stays at its limit; steps up to there
_SMOOTH = 0.2  # s
_BESIDE = {0.05: 4, 0.5: 2}  # rad by which a fix is beside the gyro: how often it is no chance
_JUMPS = {  # what no column changes from row to row: so much, and so much a second
    "speed": (3.0, 50.0), "gyro": (0.5, 20.0), "accel_y": (30.0, 0.0), TRUTH: (0.05, 3.0)
}  # fmt: skip
_ZEROS = {"gyro": 0.02, "accel_y": 0.02, TRUTH: 0.02, "steer": 0.1}  # share of rows
_UNITS = {
    180.0 / math.pi: "degrees in a column of radians?",
    math.pi / 180.0: "radians in a column of degrees?",
    3.6: "km/h in a column of m/s?",
    2.237: "mph in a column of m/s?",
    1.0 / GRAVITY: "g in a column of m/s2?",
    1.0 / 3.6: "the speed in km/h?",
}
_WRONG = ("swapped", "unrelated", "sign", "unit", "ratio")  # checks that no estimate survives
_GUESSES = {  # a ratio of steering angles, and what it looks like from there on
    300.0: "degrees of the steering wheel in a column of radians?",
    35.0: "degrees in a column of radians?",
    6.0: "the angle of the steering wheel?",
    0.05: "another unit or another car?",
    0.0: "radians in a column of degrees?",
}


def _get_columns(log: Log) -> dict[str, Array]:
    names = {"gyro", "accel_y", "accel_x", "steer"} & set(log.record.present)
    columns = {name: log.record.fast[:, getattr(FAST, name)] for name in names}
    columns |= {TRUTH: log.truth["beta"]} if "beta" in log.truth else {}
    return {"speed": log.speed, **columns}


def _find_jumps(log: Log, name: str) -> npt.NDArray[np.bool_]:
    """Mask of a column's rows beside a jump that no car makes, or between two."""
    x = _get_columns(log)[name]
    known = np.isfinite(x) & (log.is_moving | (name == "speed")) & ~log.is_backward
    if known.sum() < _FEW:
        return np.zeros(len(x), np.bool_)
    x = np.interp(log.time, log.time[known], x[known])
    steps = np.abs(np.diff(x, prepend=x[0]))
    if name == TRUTH and np.abs(x).max() < 1.01 * math.pi:
        steps = np.minimum(steps, np.abs(2.0 * math.pi - steps))
    min_step, rate = _JUMPS[name]
    limit = max(min_step + rate * log.record.dt, 10.0 * float(np.percentile(steps, 90)))
    if (jumps := steps > limit).any():
        usual = median_filter(x, max(round(2.0 / log.record.dt), 3), mode="nearest")
        jumps |= np.abs(x - usual) > limit
    return np.asarray(jumps)


def smooth_columns(logs: Sequence[Log], *names: str) -> list[Array]:
    """Smooth the columns of undisturbed rows, (rows,) each, zeros for one that is not logged.

    Args:
        logs: Parts of the log.
        names: Columns; "turning": speed x yaw rate; "slipping": change of speed x truth (m/s2).
    """
    columns: list[list[Array]] = [[] for _ in names]
    for log in logs:
        dt, raw = log.record.dt, _get_columns(log)
        width, none = max(round(_SMOOTH / dt), 1), np.zeros(len(log.time))
        bad = ~log.is_moving | log.is_backward
        for name in _JUMPS.keys() & raw.keys():
            bad |= _find_jumps(log, name) | ~np.isfinite(raw[name])
        used = uniform_filter1d(bad.astype(float), width + 2, mode="nearest") < 1e-9
        slipping = np.gradient(raw["speed"] * np.nan_to_num(raw.get(TRUTH, none)), dt)
        raw |= {"turning": raw["speed"] * raw["gyro"], "slipping": slipping}
        for name, into in zip(names, columns, strict=True):
            smooth = uniform_filter1d(raw.get(name, none), width, mode="nearest")
            into.append(smooth[used][:: max(width // 2, 1)])
    return [np.concatenate(parts) for parts in columns]


def _fit_line(y: Array, x: Array, *beside: Array) -> Any:
    """SciPy's line of y over x, less what others explain of both; None where one is constant."""
    others = np.column_stack([*beside, np.ones(len(y))])
    if len(y) < _FEW:
        return None
    x, y = (v - others @ np.linalg.lstsq(others, v, rcond=None)[0] for v in (x, y))
    return linregress(x, y) if min(x.std(), y.std()) > 1e-9 else None


def _make_finding(check: str, name: str, text: str, cure: str = "") -> LogFinding:
    """A finding on a column by the name that sentences have for it; no estimate reads the truth."""
    quantity = _QUANTITIES.get(name, name)
    level = BLOCKER if check in _WRONG and name != TRUTH else WARNING
    return LogFinding(check, level, quantity, text, cure or f"--map {quantity}_UNIT=COLUMN")


def _describe_contradiction(
    line: Any, column: str, implied: str, inverse: bool = False, factor: float = FACTOR
) -> list[LogFinding]:
    """A finding if a line's slope, or its inverse, is surely not within a factor of 1."""
    margin = _SURE * line.stderr if line else math.inf
    if not line or 1.0 / factor - margin < line.slope < factor + margin:
        return []
    if abs(line.rvalue) < MIN_CORRELATION:
        text = f"{column} and {implied} are unrelated (correlation {line.rvalue:.2f})"
        return [_make_finding("unrelated", column, text, "--map names another column")]
    factor = 1.0 / line.slope if inverse else line.slope
    guess = "its sign?" if factor < 0.0 else "another unit?"
    guess = next((text for x, text in _UNITS.items() if 0.8 < x / factor < 1.25), guess)
    text = f"{column} is {factor:.3g} times {implied}: {guess}"
    if factor < 0.0:
        return [_make_finding("sign", column, text, "turn the column's sign")]
    column = "speed" if "the speed" in guess else column
    quantity = _QUANTITIES.get(column, column)
    cure = f"--map {quantity}_{_MAPPED.get(quantity, 'UNIT')}=COLUMN"
    return [_make_finding("unit", column, text, cure)]


def compute_understeer(car: Vehicle) -> float:
    """Compute the understeer gradient (rad s2/m) of a car, 0 for one that oversteers."""
    return max(float(make_reference_params(car).G) * car.wheelbase, 0.0)


def fit_steering(logs: Sequence[Log], car: Vehicle, steady: bool, tyres: float = 1.0) -> Any:
    """Fit the linear car's steering for its yaw rate over the logged one; None if constant."""
    speed, gyro, steer, accel_y = smooth_columns(logs, "speed", "gyro", "steer", "accel_y")
    under = tyres * compute_understeer(car)
    slides = np.abs(accel_y - speed * gyro) > (1.0 if accel_y.any() else math.inf)
    used = (np.abs(speed * gyro) < _MILD) & ~slides
    used |= (used.sum() < _FEW) | (not steady)
    return _fit_line((gyro * (car.wheelbase / speed + under * speed))[used], steer[used])


def estimate_resolution(values: Array) -> float:
    """Estimate the step between the values of a column, 0 for one too fine to be seen.

    Args:
        values: Values, shape (n,).
    """
    steps = np.diff(np.unique(values))
    step = float(np.median(steps)) if 2 <= len(steps) < len(values) / 3 else math.inf
    even = np.abs(steps / step - np.rint(steps / step)).max(initial=0.0) < 0.1
    return step if even and math.isfinite(step) and steps.min() > 0.5 * step else 0.0


def find_saturated(log: Log, name: str = "gyro") -> npt.NDArray[np.bool_]:
    """Mark rows in which a column stays at its limit: long, many steps of its resolution."""
    x = log.record.fast[:, getattr(FAST, name)]
    runs = np.cumsum(np.diff(x, prepend=x[0]) != 0.0)
    length = np.bincount(runs)
    long = (length >= _LONG * np.percentile(length, 95))[runs]
    is_large = np.abs(x) > max(_LARGE[name], _STEPS * estimate_resolution(x))
    return np.asarray(long & is_large & ((x == x.max()) | (x == x.min())))


def find_swapped(logs: Sequence[Log]) -> str:
    """Find what columns seem to be swapped and why, "" for none that can be seen."""
    present = set.intersection(*(set(log.record.present) for log in logs))
    names = ("speed", "turning", "accel_y", "accel_x", "steer")
    speed, turning, accel_y, accel_x, steer = smooth_columns(logs, *names)
    turn, instead = _fit_line(accel_y, turning), _fit_line(accel_y, speed * steer)
    across = _fit_line(accel_x, turning)
    if "accel_y" not in present or not turn or max(turning.std(), accel_y.std()) < MIN_TURNING:
        return ""
    fits = instead and 0.5 < abs(instead.slope) < 2.0 and abs(instead.rvalue) > 0.8
    if fits and not 0.5 < abs(turn.slope) < 2.0 and abs(instead.rvalue) > abs(turn.rvalue) - 0.05:
        return "steering and yaw rate: speed x steering is the lateral acceleration"
    fits = across and 0.3 < abs(across.slope) < 3.0 and abs(across.rvalue) > 0.7
    if fits and abs(turn.rvalue) < 0.5:
        return "accel_x and accel_y: speed x yaw rate is in accel_x"
    return ""


def _describe_zeros(logs: Sequence[Log], name: str) -> list[LogFinding]:
    """A finding if a column is filled with zeros where the car turns."""
    x, moves = [np.zeros(0)], sum(log.is_moving.sum() for log in logs)
    for log in (log for log in logs if name in _get_columns(log)):
        columns = _get_columns(log)
        turns = np.hypot(columns["speed"] * columns["gyro"], columns.get("accel_y", 0.0)) > 1.0
        x.append(columns[name][turns & log.is_moving])
    values, counts = np.unique(np.concatenate(x), return_counts=True)
    zeros, others = counts[values == 0.0].sum(), counts[values != 0.0]
    if zeros <= max(_ZEROS[name] * moves, 5 * others.max(initial=1)):
        return []
    text = f"{name} is 0 in {zeros} of {counts.sum()} rows in which the car turns"
    return [_make_finding("stuck", name, text, "log it, or leave the column out")]


def compute_course_steps(logs: Sequence[Log], lag: float) -> Array:
    """Compute the steps between fixes.

    Args:
        logs: Parts of the log.
        lag: Time between them at least (s).

    Returns:
        The course before and after; the changes of course, of the integral of the gyro, and of
        sideslip by the truth, 0 without (rad), shape (5, steps).
    """
    parts = [np.zeros((5, 0))]
    for log in (log for log in logs if "gps" in log.slow):
        fixes = log.record.select_packets("gps")
        place = fixes[:, PACKET.captured].astype(int) - log.record.first
        good = (fixes[:, PACKET.quality] > 0.0) & (place >= 0) & (place < len(log.time))
        good[good] &= (log.is_moving & ~log.is_backward)[place[good]]
        place, course = place[good], fixes[good, PACKET.value]
        if len(place) < 2:
            continue
        usual = max(float(np.median(np.diff(place))), 1.0)
        n = max(math.ceil(lag / (usual * log.record.dt) - 1e-9), 1)
        slip = log.truth.get("beta", np.zeros(len(log.time)))
        columns = np.stack([np.unwrap(course), log.heading[place], slip[place]])
        steps = np.vstack([course[:-n], course[n:], columns[:, n:] - columns[:, :-n]])
        parts.append(steps[:, (place[n:] - place[:-n] < 1.5 * n * usual) & np.isfinite(steps[4])])
    return np.concatenate(parts, axis=1)


def _describe_fixes(logs: Sequence[Log]) -> list[LogFinding]:
    """Findings on a course that is held while the gyro turns, or jumps for a fix or two."""
    before, after, change, turned, _ = compute_course_steps(logs, 0.0)
    runs, _ = label(change == 0.0)
    held = (runs > 0) & (np.bincount(runs, np.abs(turned), 1) > 0.1)[runs]
    if held.any():
        text = f"the course stands still in {held.sum()} fixes while the gyro turns"
        return [_make_finding("stuck", "course", text, "--map course_UNIT_held=COLUMN")]
    beside = np.angle(np.exp(1j * (change - turned)))
    for min_angle, few in _BESIDE.items():
        out = np.abs(beside) > min_angle
        values, counts = np.unique((before[out], after[out]), return_counts=True)
        back = abs(beside[out].sum()) < 0.2 * np.abs(beside[out]).sum()
        if back and counts.max() >= max(few, 0.8 * np.count_nonzero(out)):
            value = math.degrees(values[counts.argmax()])
            text = f"the course jumps to {value:.3g} deg and back: where it is not known?"
            return [_make_finding("jumps", "course", text, "leave these rows empty")]
    return []


def _describe_steering(
    logs: Sequence[Log], car: Vehicle, steady: bool, stated: SignalCalibration
) -> list[LogFinding]:
    """Findings on the steering, by steady turns and all rows; a cure replaces what is stated."""
    line, *lines = (fit_steering(logs, car, *how) for how in ((steady,), (False,), (False, 0.0)))
    sentences = _describe_contradiction(line, "steering", "yaw rate")
    if not all(_describe_contradiction(candidate, "", "") for candidate in lines):
        return []
    if not sentences or abs(line.rvalue) < MIN_CORRELATION:
        return sentences
    ratio, sentences = 1.0 / abs(line.slope), []
    if line.slope < 0.0:
        cure = f"--steering-sign {-stated.sign}"
        text = f"steering and yaw rate differ in sign ({cure} turns it)"
        sentences.append(_make_finding("sign", "steering", text, cure))
    if not 0.5 < ratio < 2.0:
        guess = next(text for min_ratio, text in _GUESSES.items() if ratio >= min_ratio)
        text = f"the logged steering is {ratio:.3g} times what the yaw rate needs: {guess}"
        cure = f"--steering-ratio {ratio * stated.ratio:.3g}"
        sentences.append(_make_finding("ratio", "steering", f"{text} ({cure} divides it)", cure))
    return sentences


def _describe_course(line: Any, turned: Array) -> list[LogFinding]:
    if len(turned) < _FEW or turned.std() < 0.02:
        return []
    related = line.rvalue if line else 0.0
    if abs(related) < MIN_CORRELATION:
        text = f"the course does not follow the gyro (correlation {related:.2f})"
        return [_make_finding("unrelated", "course", text)]
    if -FACTOR < line.slope < -1.0 / FACTOR:
        text = f"the course turns against the gyro (correlation {related:.2f}): {COMPASS}"
        return [_make_finding("sign", "course", text, "--map course_degnorth=COLUMN")]
    return _describe_contradiction(line, "the change of the course", "the integral of the gyro")


def find_contradictions(
    logs: Sequence[Log], car: Vehicle, stated: SignalCalibration = AS_LOGGED
) -> list[LogFinding]:
    """Find what does not fit together in a drive: findings that are not OK."""
    sentences: list[LogFinding] = []
    if what := find_swapped(logs):
        text, channel = f"columns seem to be swapped, {what}", what.split()[0]
        sentences.append(_make_finding("swapped", channel, text, "--map exchanges them"))
    for name, sensor in _LIMITED.items():
        if count := sum(find_saturated(log, name).sum() for log in logs):
            text, cure = f"{sensor} is at its limit in {count} rows", "a sensor of a wider range"
            sentences.append(_make_finding("saturation", name, text, cure))
    for name in _JUMPS:
        if count := sum(_find_jumps(log, name).sum() for log in logs if name in _get_columns(log)):
            text = f"{name} jumps as in no car, in {count} rows"
            sentences.append(_make_finding("jumps", name, text, "leave these rows empty"))
    judged = [log for log in logs if "beta" in log.truth] or logs
    turning, accel_y, slipping = smooth_columns(judged, "turning", "accel_y", "slipping")
    if len(turning) < _FEW or max(np.std(turning), np.std(accel_y)) < MIN_TURNING:
        return sentences
    zeros = [text for name in _ZEROS for text in _describe_zeros(logs, name)]
    sentences += zeros + _describe_fixes(logs)
    used = slipping.any() | (np.minimum(np.abs(turning), np.abs(accel_y)) < _MILD)
    accel = _fit_line(accel_y[used], turning[used], slipping[used])
    if np.std(turning) < MIN_TURNING and not (accel and abs(accel.rvalue) > 0.8):
        return sentences
    _, _, change, turned, slipped = compute_course_steps(logs, 1.0)
    course, wrong, unit = _fit_line(change, turned, slipped), [], accel.slope if accel else 1.0
    if accel and course and 0.67 < accel.slope / course.slope < 1.5:
        implied = "what accel_y and course imply"
        wrong = _describe_contradiction(accel, "the yaw rate", implied, True)
        unit = 1.0 if wrong else unit
    if not wrong:
        factor = FACTOR if slipping.any() else 3.0  # the faster the turns, the more they differ
        wrong = _describe_contradiction(accel, "accel_y", "speed x yaw rate", factor=factor)
        wrong += _describe_steering(logs, car, not wrong, stated)
        wrong += _describe_course(course, turned)
    sentences += wrong
    if not slipping.any():
        return sentences
    in_course = _fit_line(change, slipped, turned)
    if not accel or abs(accel.rvalue) < MIN_CORRELATION:
        implied = "what gyro and course imply"
        return sentences + _describe_contradiction(in_course, TRUTH, implied, True)
    line = _fit_line(accel_y / unit, slipping, turning)
    implied = "what gyro, accel_y and speed imply"
    sentences += _describe_contradiction(line, TRUTH, implied, True)
    if course and in_course and in_course.slope < 1.0 / FACTOR - _SURE * in_course.stderr:
        text = "the course shows no sideslip: is it the heading?"
        sentences += [] if sentences else [_make_finding("unrelated", "course", text)]
    return sentences


def sort_remarks(
    remarks: Sequence[str], logs: Sequence[Log], car: Vehicle
) -> tuple[list[str], list[str]]:
    """Sort a reader's remarks into warnings and all others, with those on the drives themselves.

    Args:
        remarks: Sentences of `read_parts`.
        logs: Parts of the log.
        car: The car that is assumed.
    """
    marked = [text for text in remarks if text.startswith(WARNING_PREFIX)]
    urgent = [text.removeprefix(WARNING_PREFIX).rstrip(".") for text in marked]
    others = [text for text in remarks if text not in marked]
    step = math.degrees(max(estimate_resolution(log.record.fast[:, FAST.gyro]) for log in logs))
    others += [f"The gyro's resolution is {step:.3g} deg/s."] if step > 0.1 else []
    return urgent + [finding.text for finding in find_contradictions(logs, car)], others
