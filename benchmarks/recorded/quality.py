"""Quality of a recorded drive: columns that contradict one another, noise, and a late GPS.

Intervals are jackknives over blocks of the log.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label, median_filter, uniform_filter1d
from scipy.stats import linregress

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ..harness.stats import margin_of_error
from .emulate import compute_course_steps, compute_ground_speed, compute_heading, find_backward
from .emulate import find_moving as find_moving

MIN_CORRELATION = 0.5  # correlation, below which steering and yaw rate have nothing in common
TRUTH = "the sideslip truth"  # how a warning begins that puts the score in doubt
COMPASS = "degrees from north, clockwise? --map course_degnorth=COLUMN reads it"
FACTOR = 1.8  # by which a column may differ from what the others imply
_SURE = 3.0  # standard errors beyond it
_TURNING = 0.3  # m/s2 RMS, below which nothing is judged
_MILD = 5.0  # m/s2, up to which tyres are linear
_FEW = 10  # samples, below which nothing is judged
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
_GUESSES = {  # a ratio of steering angles, and what it looks like from there on
    300.0: "degrees of the steering wheel in a column of radians?",
    35.0: "degrees in a column of radians?",
    6.0: "the angle of the steering wheel?",
    0.05: "another unit or another car?",
    0.0: "radians in a column of degrees?",
}


def _get_columns(log: Log) -> dict[str, Array]:
    """Columns of a log by name, shape (rows,) each."""
    names = {"gyro", "accel_y", "accel_x", "steer"} & set(log.record.present)
    columns = {name: log.record.fast[:, getattr(FAST, name)] for name in names}
    columns |= {TRUTH: log.truth["beta"]} if "beta" in log.truth else {}
    return {"speed": compute_ground_speed(log), **columns}


def _find_jumps(log: Log, name: str) -> npt.NDArray[np.bool_]:
    """Mask of a column's rows beside a jump that no car makes, or between two."""
    x = _get_columns(log)[name]
    known = np.isfinite(x) & (find_moving(log) | (name == "speed")) & ~find_backward(log)
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


def _smooth_columns(logs: Sequence[Log], *names: str) -> list[Array]:
    """Smoothed columns of undisturbed rows; also speed x yaw rate, change of speed x truth."""
    columns: list[list[Array]] = [[] for _ in names]
    for log in logs:
        dt, raw = log.record.dt, _get_columns(log)
        width, none = max(round(_SMOOTH / dt), 1), np.zeros(len(log.time))
        bad = ~find_moving(log) | find_backward(log)
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


def _describe_contradiction(
    line: Any, column: str, implied: str, inverse: bool = False, factor: float = FACTOR
) -> list[str]:
    """A sentence if a line's slope, or its inverse, is surely not within a factor of 1."""
    margin = _SURE * line.stderr if line else math.inf
    if not line or 1.0 / factor - margin < line.slope < factor + margin:
        return []
    if abs(line.rvalue) < MIN_CORRELATION:
        return [f"{column} and {implied} are unrelated (correlation {line.rvalue:.2f})"]
    factor = 1.0 / line.slope if inverse else line.slope
    guess = "its sign?" if factor < 0.0 else "another unit?"
    guess = next((text for x, text in _UNITS.items() if 0.8 < x / factor < 1.25), guess)
    return [f"{column} is {factor:.3g} times {implied}: {guess}"]


def _fit_steering(logs: Sequence[Log], car: Vehicle, steady: bool, tyres: float = 1.0) -> Any:
    """Line of the linear car's steering for its yaw rate over the logged one; tyres 0: neutral."""
    speed, gyro, steer, accel_y = _smooth_columns(logs, "speed", "gyro", "steer", "accel_y")
    bend = car.rear_arm / car.front_stiffness - car.front_arm / car.rear_stiffness
    under = tyres * max(car.mass * bend / (2.0 * car.wheelbase), 0.0)
    slides = np.abs(accel_y - speed * gyro) > (1.0 if accel_y.any() else math.inf)
    used = (np.abs(speed * gyro) < _MILD) & ~slides
    used |= (used.sum() < _FEW) | (not steady)
    return _fit_line((gyro * (car.wheelbase / speed + under * speed))[used], steer[used])


def estimate_steering_gain(logs: Sequence[Log], car: Vehicle) -> tuple[float, float]:
    """Estimate gain and correlation of the logged steering, from the linear car's yaw rate."""
    line = _fit_steering(logs, car, steady=False)
    return (float(line.slope), float(line.rvalue)) if line else (1.0, 0.0)


def estimate_resolution(log: Log) -> float:
    """Estimate the step between the values of the gyro (rad/s), 0 for one too fine to be seen."""
    steps = np.diff(np.unique(log.record.fast[:, FAST.gyro]))
    step = float(np.median(steps)) if 2 <= len(steps) < len(log.time) / 3 else math.inf
    even = np.abs(steps / step - np.rint(steps / step)).max(initial=0.0) < 0.1
    return step if even and math.isfinite(step) and steps.min() > 0.5 * step else 0.0


def find_saturated(log: Log) -> npt.NDArray[np.bool_]:
    """Mark rows in which the gyro stays at its limit: long, and many steps of its resolution."""
    gyro = log.record.fast[:, FAST.gyro]
    runs = np.cumsum(np.diff(gyro, prepend=gyro[0]) != 0.0)
    length = np.bincount(runs)
    long = (length >= _LONG * np.percentile(length, 95))[runs]
    is_large = np.abs(gyro) > max(0.05, _STEPS * estimate_resolution(log))
    return np.asarray(long & is_large & ((gyro == gyro.max()) | (gyro == gyro.min())))


def find_swapped(logs: Sequence[Log]) -> str:
    """Find what columns seem to be swapped, "" for none that can be seen."""
    present = set.intersection(*(set(log.record.present) for log in logs))
    names = ("speed", "turning", "accel_y", "accel_x", "steer")
    speed, turning, accel_y, accel_x, steer = _smooth_columns(logs, *names)
    turn, instead = _fit_line(accel_y, turning), _fit_line(accel_y, speed * steer)
    across = _fit_line(accel_x, turning)
    if "accel_y" not in present or not turn or max(turning.std(), accel_y.std()) < _TURNING:
        return ""
    fits = instead and 0.5 < abs(instead.slope) < 2.0 and abs(instead.rvalue) > 0.8
    if fits and not 0.5 < abs(turn.slope) < 2.0 and abs(instead.rvalue) > abs(turn.rvalue):
        return "steering and yaw rate: speed x steering is the lateral acceleration"
    fits = across and 0.3 < abs(across.slope) < 3.0 and abs(across.rvalue) > 0.7
    if fits and abs(turn.rvalue) < 0.5:
        return "accel_x and accel_y: speed x yaw rate is in accel_x"
    return ""


def _describe_zeros(logs: Sequence[Log], name: str) -> list[str]:
    """A sentence if a column is filled with zeros where the car turns."""
    x, moves = [np.zeros(0)], sum(find_moving(log).sum() for log in logs)
    for log in (log for log in logs if name in _get_columns(log)):
        columns = _get_columns(log)
        turns = np.hypot(columns["speed"] * columns["gyro"], columns.get("accel_y", 0.0)) > 1.0
        x.append(columns[name][turns & find_moving(log)])
    values, counts = np.unique(np.concatenate(x), return_counts=True)
    zeros, others = counts[values == 0.0].sum(), counts[values != 0.0]
    if zeros <= max(_ZEROS[name] * moves, 5 * others.max(initial=1)):
        return []
    return [f"{name} is 0 in {zeros} of {counts.sum()} rows in which the car turns"]


def _describe_fixes(logs: Sequence[Log]) -> list[str]:
    """Sentences on a course that is held while the gyro turns, or jumps for a fix or two."""
    before, after, change, turned, _ = compute_course_steps(logs, 0.0)
    runs, _ = label(change == 0.0)
    held = (runs > 0) & (np.bincount(runs, np.abs(turned), 1) > 0.1)[runs]
    if held.any():
        return [f"the course stands still in {held.sum()} fixes while the gyro turns"]
    beside = np.angle(np.exp(1j * (change - turned)))
    for min_angle, few in _BESIDE.items():
        out = np.abs(beside) > min_angle
        values, counts = np.unique((before[out], after[out]), return_counts=True)
        back = abs(beside[out].sum()) < 0.2 * np.abs(beside[out]).sum()
        if back and counts.max() >= max(few, 0.8 * np.count_nonzero(out)):
            value = math.degrees(values[counts.argmax()])
            return [f"the course jumps to {value:.3g} deg and back: where it is not known?"]
    return []


def _describe_steering(logs: Sequence[Log], car: Vehicle, steady: bool) -> list[str]:
    """Sentences on the steering, by steady turns and all rows, by these and other tyres."""
    line, *lines = (_fit_steering(logs, car, *how) for how in ((steady,), (False,), (False, 0.0)))
    sentences = _describe_contradiction(line, "steering", "yaw rate")
    if not all(_describe_contradiction(candidate, "", "") for candidate in lines):
        return []
    if not sentences or abs(line.rvalue) < MIN_CORRELATION:
        return sentences
    ratio, sentences = 1.0 / abs(line.slope), []
    if line.slope < 0.0:
        sentences.append("steering and yaw rate differ in sign (--steering-sign -1 turns it)")
    if not 0.5 < ratio < 2.0:
        guess = next(text for min_ratio, text in _GUESSES.items() if ratio >= min_ratio)
        text = f"the logged steering is {ratio:.3g} times what the yaw rate needs: {guess}"
        sentences.append(f"{text} (--steering-ratio {ratio:.3g} divides it)")
    return sentences


def _describe_course(line: Any, turned: Array) -> list[str]:
    """Sentences on the course, by its change over the integral of the gyro."""
    if len(turned) < _FEW or turned.std() < 0.02:
        return []
    related = line.rvalue if line else 0.0
    if abs(related) < MIN_CORRELATION:
        return [f"the course does not follow the gyro (correlation {related:.2f})"]
    if -FACTOR < line.slope < -1.0 / FACTOR:
        return [f"the course turns against the gyro (correlation {related:.2f}): {COMPASS}"]
    return _describe_contradiction(line, "the change of the course", "the integral of the gyro")


def make_remarks(logs: Sequence[Log]) -> list[str]:
    """Make remarks on what is no fault of a drive, but good to know: a gyro of coarse steps."""
    step = math.degrees(max(map(estimate_resolution, logs)))
    return [f"The gyro's resolution is {step:.3g} deg/s."] if step > 0.1 else []


def make_warnings(logs: Sequence[Log], car: Vehicle) -> list[str]:
    """Make warnings of what does not fit together in a drive, a sentence each."""
    sentences = [f"columns seem to be swapped, {what}"] if (what := find_swapped(logs)) else []
    if count := sum(find_saturated(log).sum() for log in logs):
        sentences.append(f"the gyro is at its limit in {count} rows")
    for name in _JUMPS:
        if count := sum(_find_jumps(log, name).sum() for log in logs if name in _get_columns(log)):
            sentences.append(f"{name} jumps as in no car, in {count} rows")
    judged = [log for log in logs if "beta" in log.truth] or logs
    turning, accel_y, slipping = _smooth_columns(judged, "turning", "accel_y", "slipping")
    if len(turning) < _FEW or max(np.std(turning), np.std(accel_y)) < _TURNING:
        return sentences
    zeros = [text for name in _ZEROS for text in _describe_zeros(logs, name)]
    sentences += zeros + _describe_fixes(logs)
    used = slipping.any() | (np.abs(turning) < _MILD)
    accel = _fit_line(accel_y[used], turning[used], slipping[used])
    if np.std(turning) < _TURNING and not (accel and abs(accel.rvalue) > 0.8):
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
        wrong += _describe_steering(logs, car, steady=not wrong) + _describe_course(course, turned)
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
        sentences += [] if sentences else ["the course shows no sideslip: is it the heading?"]
    return sentences


WIDE = "its interval is too wide"
BLOCKS = 20  # of a log, which the intervals take for independent
_ALIKE = (0.0, 0.1, 0.25, 0.5, 1.0)  # s, for which rows of a residual may be alike
LATE = (-0.2, 1.2)  # s, of the GPS
_COURSE, _SPEED = range(2)  # places in its values
LATE_WITHIN = 0.05  # s, half of the widest interval of a latency
_FAST = {"gyro": "rad/s", "accel_y": "m/s2", "roll_rate": "rad/s", "wheel_left": "m/s"}
NOISES = {name: f"{name.removesuffix('_left')}_noise" for name in (*_FAST, "course", "gps_speed")}
"""The estimators' options for a standard deviation, by what it is of."""


class Finding(NamedTuple):
    """A number with half of its 95 % interval, and whether the log determines it."""

    name: str
    stated: float
    value: float = math.nan
    half: float = math.inf
    unit: str = ""
    is_determined: bool = False
    remark: str = ""


def jackknife(blocks: Array, statistic: Callable[[Array], float]) -> tuple[float, float]:
    """Compute a statistic of the sum of blocks, (count, ...), and half of its 95 % interval."""
    total, count = blocks.sum(axis=0), len(blocks)
    without = np.array([statistic(total - block) for block in blocks])
    return statistic(total), margin_of_error((count - 1.0) * without)


def estimate_white_noise(parts: Sequence[Array]) -> tuple[float, float]:
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


def estimate_noise_levels(left: Array, dt: float) -> Array:
    """Estimate deviations of independent rows that tell as much as a residual's, (channels,).

    Rows of a residual are alike for a while: means over up to 1 s, by the root of their rows.
    """
    levels = [np.full(left.shape[1], 1e-9)]
    shown = np.maximum(np.mean(left != 0.0, axis=(0, 2)), 1e-9)
    for seconds in _ALIKE:
        rows = max(round(seconds / dt), 1)
        trimmed = left[:, :, : left.shape[2] // rows * rows]
        means = trimmed.reshape(*left.shape[:2], -1, rows).mean(axis=3)
        levels.append(np.sqrt(rows * np.mean(means**2, axis=(0, 2)) / shown))
    return np.asarray(np.max(levels, axis=0))


def _collect_fixes(log: Log, value: int, signal: Array, part: Array, times: Array) -> list[Array]:
    """Blocks of sums of d^2, d p, p^2 and 1, shape (4, times) each."""
    # d: differences of two fixes' values less the signal's so much earlier; p: those of `part`
    packets = log.record.select_packets("gps")
    packets = packets[packets[:, PACKET.quality] > 0.0]
    rows, place = packets[:, PACKET.captured] - log.record.first, np.arange(float(len(signal)))
    earlier = rows[:, None] - times / log.record.dt
    d = np.diff(packets[:, PACKET.value + value, None] - np.interp(earlier, place, signal), axis=0)
    if value == _COURSE:
        d = (d + math.pi) % (2.0 * math.pi) - math.pi  # within a turn
    p = np.diff(np.interp(earlier, place, part), axis=0)
    usual = np.diff(rows) <= 1.5 * np.median(np.diff(rows))
    inside = (earlier[1:].min(axis=1) > 0.0) & (earlier[1:].max(axis=1) < place[-1])
    used = usual & inside & np.isfinite(d).all(axis=1)
    if np.count_nonzero(used) < BLOCKS:
        return []
    d, p = d[used] - np.median(d[used], axis=0), p[used]  # the median is a gyro's bias
    sums = np.stack([d * d, d * p, p * p, np.ones_like(d)])
    return [block.sum(axis=1) for block in np.array_split(sums, BLOCKS, axis=1)]


def _compute_remainder(sums: Array, share: float | None = None) -> Array:
    """Mean squares that a fraction of the part leaves, None: the best one; shape (times,)."""
    square, product, part_square, count = sums
    shares = product / np.maximum(part_square, 1e-12) if share is None else share
    return np.asarray((square - 2.0 * shares * product + shares**2 * part_square) / count)


def _find_minimum(times: Array, sums: Array, share: float | None = None) -> float:
    """Time of the smallest remainder (s), between the samples by a parabola."""
    lefts = _compute_remainder(sums, share)
    i = int(np.clip(np.argmin(lefts), 1, len(times) - 2))
    left, middle, right = lefts[i - 1 : i + 2]
    bend = left - 2.0 * middle + right
    beside = 0.5 * (left - right) / bend if bend > 0.0 else 0.0
    return float(times[i] + beside * (times[1] - times[0]))


def make_sensor_findings(
    logs: Sequence[Log], slips: Sequence[Array]
) -> tuple[list[Finding], dict[str, float], dict[str, float]]:
    """Make findings of the sensors, noise by the estimators' options, and latency by sensor (s).

    slips: Sideslip angle (rad) of each log, shape (rows,), by which the course is predicted.
    """
    findings: list[Finding] = []
    noise: dict[str, float] = {}
    for channel, unit in _FAST.items():
        if all(channel in log.record.present for log in logs):
            column = getattr(FAST, channel)
            sd, half = estimate_white_noise([log.record.fast[:, column] for log in logs])
            is_determined = half < 0.3 * sd
            remark = "" if is_determined else WIDE if sd > 0.0 else "none is seen"
            row = Finding(f"noise of {channel}", math.nan, sd, half, unit, is_determined, remark)
            findings.append(row)
            noise |= {NOISES[channel]: sd} if is_determined else {}
    times = np.arange(*LATE, max(logs[0].record.dt, 0.01))
    pairs = [pair for pair in zip(logs, slips, strict=True) if "gps" in pair[0].slow]
    courses, speeds = list[Array](), list[Array]()
    for log, slip in pairs:
        courses += _collect_fixes(log, _COURSE, compute_heading(log), slip, times)
        speed, none = compute_ground_speed(log), 0.0 * log.time
        speeds += _collect_fixes(log, _SPEED, speed, none, times)
    if not courses:
        return findings, noise, {}
    late, half = jackknife(np.array(courses), lambda sums: _find_minimum(times, sums))
    with_slip = _find_minimum(times, np.sum(courses, axis=0), 1.0)  # had the slip its size
    half = math.hypot(half, late - with_slip)
    is_determined = half < LATE_WITHIN
    pays = is_determined and late > half
    remark = ("applied" if pays else "within its interval of 0") if is_determined else WIDE
    findings.append(Finding("latency of gps", 0.0, late, half, "s", is_determined, remark))
    at = int(np.argmin(np.abs(times - late)))
    for name, unit, scale, blocks in (
        ("course", "deg", math.degrees(1.0), courses), ("gps_speed", "m/s", 1.0, speeds)
    ):  # fmt: skip
        if blocks:  # a difference has twice the variance
            sd, half = jackknife(
                np.array(blocks), lambda sums: math.sqrt(0.5 * _compute_remainder(sums)[at])
            )
            row = Finding(f"noise of {name}", math.nan, scale * sd, scale * half, unit, True)
            findings, noise = [*findings, row], noise | {NOISES[name]: sd}
    return findings, noise, {"gps": late} if pays else {}
