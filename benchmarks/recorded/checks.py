"""The checks of `sideslip inspect`: whether a log is worth estimating from, channel by channel.

A check is a function of a drive that yields findings; `CHECKS` has them all. Limits are twice what
the filter `joint` allows for, or what an ordinary car of world v1 shows.
"""

import copy
import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...envs.record import FAST, MOVING_SPEED, PACKET, Array, Log
from ...envs.recordings.dialect import SENSORS, SLOW_QUANTITIES, TRUTH, find_sampling
from ...envs.recordings.log_file import MAX_HOLE, NEEDED
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ...estimators.filters import FILTERS
from ...estimators.wires import AS_LOGGED, SignalCalibration, apply_wires
from . import quality
from .quality import BLOCKER, FACTOR, MIN_TURNING, OK, WARNING, LogFinding
from .sensor_noise import COURSE, FixDifferences, estimate_slips

_ALLOWED = dict(FILTERS["joint"].options)  # standard deviations of what `joint` finds by itself
_DEGREES = 180.0 / math.pi
_COLUMNS = {"gyro": "yaw_rate", "accel_y": "accel_y", "steer": "steer", "wheel_left": "speed_x"}
_OUTAGE = 2.0  # s without a slow sample, in which the slip drifts by a gyro's bias alone
_STANDING, _REST = 0.3, 1.0  # m/s and s of a standstill
_LATE = 0.12  # s: receivers' stamps err by 0.05 s, rows and other tyres by as much again
_DRIFT = 0.1  # s from half to half, of which the same errors have no part
_TIMES = np.arange(-0.5, 1.0, 0.01)  # s, at which a late course is looked for
_STUCK, _MOVES = 1.0, 1.0  # s without change, in which others say m/s2, or m/s, of a change
_RESOLUTION = {  # SI, noise that filters assume at least, and the unit that people read
    "yaw_rate": (0.002, "deg/s"), "accel_y": (0.1, "m/s2"), "steer": (0.002, "deg"),
    "course": (_ALLOWED["course_noise"], "deg"), "speed_x": (0.3, "m/s"),
}  # fmt: skip
_SCALES = {  # ordinary: 1 % of a gyro and other tyres; 1.3 % and wear of a wheel; another roll
    "yaw_rate": 0.05, "speed_x": 0.04, "accel_y": 0.12,
}  # fmt: skip


@dataclass
class InspectedDrive:
    """A drive as checks see it; without logs where a needed channel is missing."""

    values: dict[str, Array]  # columns in SI units as they stand in the file
    kinds: Mapping[str, str]  # kinds of samples that names of columns tell
    logs: Sequence[Log]  # calibrated parts
    car: Vehicle
    wires: SignalCalibration = AS_LOGGED  # of the parts

    @functools.cached_property
    def contradictions(self) -> list[LogFinding]:
        """Findings of columns that do not fit together."""
        ratio = _divide_speeds(self.logs)
        logs, of_speed = self.logs, list[LogFinding]()
        if not 1.0 / FACTOR < ratio < FACTOR and not math.isnan(ratio):
            text, cure = f"{ratio:.3g} times gps_speed: another unit?", "--map speed_x_kmh=COLUMN"
            of_speed = [LogFinding("unit", BLOCKER, "speed_x", text, cure)]
            logs = [copy.deepcopy(log) for log in logs]
            for log in logs:
                log.record.fast[:, [FAST.wheel_left, FAST.wheel_right]] /= ratio
        findings = quality.find_contradictions(logs, self.car, self.wires) if logs else []
        late = self._find_lateness(logs) if any(map(_is_course, findings)) else 0.0
        if late:  # a late course does not follow the gyro, but later it does
            shifted = [apply_wires(log, SignalCalibration(latency={"gps": late})) for log in logs]
            aligned = quality.find_contradictions(shifted, self.car, self.wires)
            findings = findings if any(map(_is_course, aligned)) else aligned
        return of_speed + findings

    def _find_lateness(self, logs: Sequence[Log]) -> float:
        """Latency of the course (s) by the gyro alone, 0 where none is better than the others."""
        fixes = FixDifferences.from_logs(logs, COURSE, None, _TIMES)
        late = fixes.find_latency(0.0)[0] if fixes.blocks else 0.0
        return late if 0.0 < late < _TIMES[-2] else 0.0

    @functools.cached_property
    def judged(self) -> list[Log]:
        """Moving parts with the model's sideslip for truth; none where columns contradict."""
        if any(finding.level == BLOCKER for finding in self.contradictions):
            return []
        parts = [x for x in self.logs if x.is_moving.sum() * x.record.dt > 2.0]
        slips = estimate_slips(parts, self.car, AS_LOGGED) if parts else []
        pairs = zip(parts, slips, strict=True)
        return [replace(log, truth={"beta": slip}) for log, slip in pairs]


def _judge(check: str, channel: str, is_wrong: bool, text: str, cure: str) -> LogFinding:
    """A finding that is OK, and then without a cure, or not."""
    level, cure = (WARNING, cure) if is_wrong else (OK, "")
    return LogFinding(check, level, channel, text, cure)


def _is_course(finding: LogFinding) -> bool:
    """Whether it says that the course does not follow the gyro."""
    return finding.channel == "course" and finding.check in ("unrelated", "unit")


def _divide(y: Array, x: Array) -> tuple[float, float]:
    """Scale of y over x by their spread, which noise lowers less than a slope, and its error.

    Neighbours overlap: a fifth of the rows counts. NaN where the two are hardly related.
    """
    if len(x) < 20 or min(x.std(), y.std()) < 1e-6:
        return math.nan, math.nan
    related = float(np.corrcoef(x, y)[0, 1])
    error = 2.0 * math.sqrt((1.0 - min(related**2, 1.0)) / (len(x) / 5.0))
    return (float(y.std() / x.std()), error) if related > 0.9 else (math.nan, math.nan)


def _divide_speeds(logs: Sequence[Log]) -> float:
    """Median of speed over gps_speed, NaN without."""
    ratios = [np.zeros(0)]
    for log in (log for log in logs if "gps" in log.slow):
        fixes = log.record.select_packets("gps")
        rows = (fixes[:, PACKET.captured] - log.record.first).astype(int)
        inside = (rows >= 0) & (rows < len(log.time)) & (fixes[:, PACKET.value + 1] > MOVING_SPEED)
        ratios.append(log.speed[rows[inside]] / fixes[inside, PACKET.value + 1])
    merged = np.concatenate(ratios)
    return float(np.median(merged)) if len(merged) >= 20 else math.nan


def _check_missing(drive: InspectedDrive) -> Iterator[LogFinding]:
    for name in NEEDED:
        if name not in drive.values:
            cure = f"--map {name}_UNIT=COLUMN"
            yield LogFinding("missing", BLOCKER, name, "no such column", cure)
    slow = any(names[0] in drive.values for names in SENSORS.values())
    for name, is_there, cure in (
        ("accel_y", "accel_y" in drive.values, "log accel_y: it shows tyres that slide"),
        ("course", slow, "log a GPS's course: it alone shows the slip itself"),
    ):
        text = "logged" if is_there else "no such column"
        yield _judge("missing", name, not is_there, text, cure)


def _check_stamps(drive: InspectedDrive) -> Iterator[LogFinding]:
    steps = np.diff(drive.values.get("time", np.zeros(0)))
    back, same = int((steps < 0.0).sum()), int((steps == 0.0).sum())
    text = f"{back} stamps step back and {same} repeat, of {len(steps) + 1}"
    yield _judge("stamps", "time", back + same > 0, text, "such rows are left out; mend the logger")


def _check_gaps(drive: InspectedDrive) -> Iterator[LogFinding]:
    time = drive.values["time"]
    speed = drive.values.get("speed_x", np.full(len(time), np.inf))
    known_rows = np.where(~np.isnan(speed), np.arange(len(speed)), 0)
    speed = np.nan_to_num(speed[np.maximum.accumulate(known_rows)])  # that of the newest row
    clock, moving = time, np.broadcast_to(np.abs(speed) > _STANDING, time.shape)
    for name in ("time", *(name for name in drive.values if name != "time")):
        column = drive.values[name]
        known, slow = np.isfinite(column), name in SLOW_QUANTITIES
        if name in TRUTH or known.sum() < 3 or (slow and name not in ("course", "camera_psi")):
            continue
        ticks = np.cumsum(np.diff(clock, prepend=clock[0]) * moving) if slow else clock
        steps = np.diff(ticks[known])
        usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
        limit = _OUTAGE + usual if slow else max(MAX_HOLE, 1.9 * usual)
        count, longest = int((steps > limit).sum()), float(steps.max())
        text = f"{count} steps above {limit:.2g} s, the longest {longest:.3g} s"
        yield _judge("gaps", name, count > 0, text, "the filter begins anew, or goes without")
        if name == "time":  # others are judged beside its holes
            row = np.minimum(np.diff(time, prepend=time[0]), 1.5 * usual)
            clock = np.cumsum(np.maximum(row, 0.0))


def _check_sampling(drive: InspectedDrive) -> Iterator[LogFinding]:
    for name in ("speed_x", "yaw_rate", "accel_y", "steer", "course", "camera_psi"):
        column = drive.values.get(name, np.zeros(0))
        column, slow = column[np.isfinite(column)], name in SLOW_QUANTITIES
        if not len(column):
            continue
        kind, rows = find_sampling(column) if drive.kinds.get(name) != "fresh" else ("", 0.0)
        text = f"{kind or 'fresh'} between samples" + (f", one in {rows:.3g} rows" if rows else "")
        cure = f"--map {name}_UNIT_{kind}=COLUMN" if slow else "log samples alone, empty between"
        yield _judge(kind or "held", name, bool(kind), text, cure)


def _check_stuck(drive: InspectedDrive) -> Iterator[LogFinding]:
    for log in drive.logs:
        fast, speed, dt = log.record.fast, log.speed, log.record.dt
        turning, pulled = speed * fast[:, FAST.gyro], np.cumsum(fast[:, FAST.accel_x]) * dt
        others = {"gyro": fast[:, FAST.accel_y], "accel_y": turning, "steer": turning}
        width = max(round(0.2 / dt), 1)
        for name, other in {**others, "wheel_left": pulled}.items():
            x = fast[:, getattr(FAST, name)]
            if name not in log.record.present and name != "wheel_left":
                continue
            ends = np.flatnonzero(np.diff(x, prepend=math.nan, append=math.nan) != 0.0)
            start, stop = max(itertools.pairwise(ends), key=lambda x: x[1] - x[0])
            after = other[start + round(_STUCK / dt) : stop]  # a step of steering needs a second
            usable = len(after) > width and speed[start:stop].mean() > MOVING_SPEED
            smooth = np.convolve(after, np.ones(width) / width, "valid") if usable else np.zeros(1)
            moved, size = np.ptp(smooth), 0.0 if other is pulled else np.abs(smooth).max()
            text = f"no change for {(stop - start) * dt:.3g} s, while others show {moved:.2g} m/s2"
            stuck = bool(moved > max(_MOVES, 0.5 * size))
            yield _judge("stuck", _COLUMNS[name], stuck, text, "leave such rows empty")


def _check_scale(drive: InspectedDrive) -> Iterator[LogFinding]:
    if not drive.judged:
        return
    _, _, change, turned, slipped = quality.compute_course_steps(drive.judged, 1.0)
    names = ("turning", "accel_y", "slipping")
    turning, accel, slipping = quality.smooth_columns(drive.judged, *names)
    roll = drive.car.roll_moment_arm  # N m a m/s2, by which the body leans into gravity
    leaning = 1.0 + GRAVITY * roll / (drive.car.roll_stiffness - GRAVITY * roll)
    scales = {
        "yaw_rate": ("course", *_divide(turned + slipped, change)),
        "speed_x": ("gps_speed", _divide_speeds(drive.judged), 0.0),
        "accel_y": ("speed x yaw rate and roll", *_divide(accel, turning + slipping)),
    }
    product = 1.0 / leaning  # of accel_y with the errors of both others
    for name, (implied, scale, error) in scales.items():
        if name == "accel_y":
            scale *= product
        elif not math.isnan(scale):
            product *= scale
        wrong = abs(scale - 1.0) > _SCALES[name] + error
        text = f"{scale:.3f} times what {implied} implies"
        if not math.isnan(scale):
            yield _judge("scale", name, wrong, text, f"divide the column by {scale:.3f}")


def _check_bias(drive: InspectedDrive) -> Iterator[LogFinding]:
    rest = [np.zeros(0)]
    for log in drive.logs:
        still = np.abs(log.speed) < _STANDING
        rest.append(log.record.fast[still, FAST.gyro])
    gyro, bias, where = np.concatenate(rest), 0.0, "at rest"
    if drive.logs and len(gyro) * drive.logs[0].record.dt > _REST:
        bias = float(np.mean(gyro))
    else:
        lag, where = 4.0, "beside the course"
        _, _, change, turned, slipped = quality.compute_course_steps(drive.judged, lag)
        if len(change) >= 20:
            bias = float(np.median(turned + slipped - change)) / lag
    limit = 2.0 * _ALLOWED["bias_sd"]
    text = f"bias {bias * _DEGREES:.2f} deg/s {where}"
    yield _judge("bias", "yaw_rate", abs(bias) > limit, text, "subtract it from the column")
    if not drive.judged:
        return
    names = ("turning", "accel_y", "slipping", "speed", "steer")
    turning, accel, slipping, speed, steer = quality.smooth_columns(drive.judged, *names)
    if len(turning) < 20:
        return
    if accel.any():
        offset = float(np.mean(accel - turning - slipping + bias * speed))
        limit = 2.0 * _ALLOWED["accel_bias_sd"]
        text, cure = f"offset {offset:.2f} m/s2", "subtract it from the column"
        yield _judge("bias", "accel_y", abs(offset) > limit, text, cure)
    under = quality.compute_understeer(drive.car)
    needed = (turning / speed - bias) * (drive.car.wheelbase / speed + under * speed)
    offset, limit = float(np.median(steer - needed)), 2.0 * _ALLOWED["steer_offset_sd"]
    text = f"offset {offset * _DEGREES:.2f} deg at the wheels"
    cure = f"--steering-offset {(drive.wires.offset - offset) * _DEGREES:.2f}"
    yield _judge("bias", "steer", abs(offset) > limit, text, cure)


def _check_clocks(drive: InspectedDrive) -> Iterator[LogFinding]:
    slips = [log.truth["beta"] for log in drive.judged]
    fixes = FixDifferences.from_logs(drive.judged, COURSE, slips, _TIMES)
    if not fixes.blocks:
        return
    half = len(fixes.blocks) // 2
    late = fixes.find_latency(1.0)
    halves = fixes.blocks[:half], fixes.blocks[half:]
    first, last = (fixes._replace(blocks=blocks).find_latency(1.0) for blocks in halves)
    text = f"{late[0]:.2f} +- {late[1]:.2f} s later than the gyro"
    stated = drive.wires.latency.get("gps", 0.0)
    cure = f"--latency gps={stated + late[0]:.2f}" if stated + late[0] > 0.0 else "mend its stamps"
    yield _judge("late", "course", abs(late[0]) > max(_LATE, late[1]), text, cure)
    drift, margin = last[0] - first[0], 0.5 * math.hypot(first[1], last[1])
    text = f"its clock gains {drift:.2f} +- {margin:.2f} s from the first half to the second"
    wrong = abs(drift) > max(_DRIFT, margin)
    yield _judge("drift", "course", wrong, text, "log one clock for both")


def _check_resolution(drive: InspectedDrive) -> Iterator[LogFinding]:
    for name, (noise, unit) in _RESOLUTION.items():
        column = drive.values.get(name, np.zeros(0))
        column = column[np.isfinite(column)] * (abs(drive.wires.gain) if name == "steer" else 1.0)
        if len(column):
            step = quality.estimate_resolution(column)
            limit = math.sqrt(12.0) * noise  # steps whose rounding is noise of this size
            scale = _DEGREES if unit.startswith("deg") else 1.0
            text = f"steps of {scale * step:.2g} {unit}; {scale * limit:.2g} would do"
            yield _judge("resolution", name, step > limit, text, "log it finer, or unrounded")


def _check_excitation(drive: InspectedDrive) -> Iterator[LogFinding]:
    if drive.logs:
        turning = [(x.speed * x.record.fast[:, FAST.gyro])[x.is_moving] for x in drive.logs]
        merged = np.concatenate(turning)
        size = float(np.std(merged)) if len(merged) else 0.0
        text = f"speed x yaw rate has {size:.2g} m/s2 RMS above {MOVING_SPEED:g} m/s"
        cure = f"turn: {MIN_TURNING:g} m/s2 and more show tyres and signs"
        yield _judge("excitation", "yaw_rate", size < MIN_TURNING, text, cure)


CHECKS: Sequence[Callable[[InspectedDrive], Iterable[LogFinding]]] = (
    _check_missing, _check_stamps, _check_gaps, _check_sampling, _check_stuck,
    operator.attrgetter("contradictions"),  # swapped columns, signs, units, jumps, limits
    _check_scale, _check_bias, _check_clocks, _check_resolution, _check_excitation,
)  # fmt: skip
