"""Estimators over a recorded drive, and how far they are from its truth.

A drive with truth and without a slow sensor gets a GPS course made of the truth and the gyro.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...envs.record import FAST, Array, Log
from ...envs.recordings.log_file import make_packet_rows
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import COURSE_SPEED
from ...envs.vehicle.parameters import Vehicle
from ...estimators.design.models import MEASUREMENTS
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, call_quietly
from ..harness.stats import Estimate, compute_honesty
from .motion import GYRO_ONLY, LoggedMotion

_BOTH, _GPS = ("gps", "camera"), ("gps",)
ESTIMATORS: dict[str, tuple[str, ...]] = {
    GYRO_ONLY: (), "single-rate-kf": _BOTH, "multirate-kf": _BOTH, "multirate-residual-kf": _BOTH,
    "course-kf": _GPS, "dakf": _GPS, "exact-kf": _BOTH, "joint": _BOTH,
}  # fmt: skip
"""The estimators of a replay and the slow sensors that serve them, the better one first."""
_OWN_NOISE = "joint"  # brings its levels along and finds the accelerometer's as it drives
_MIN_COURSE_NOISE = 0.01  # deg, of the course, the least that estimators assume
_MIN_GYRO_NOISE = 0.002  # rad/s; below, what the model lacks weighs more than the sensor's noise
_NOT_NEGATIVE = ("course_rate", "course_noise_deg", "delay", "q_beta", "q_gamma", "q_psi")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a drive is replayed; ValueError for a value out of range or an unknown estimator.

    Estimators assume the noise of the emulated course.
    """

    course_rate: float = 10.0  # Hz; a sample every so many whole rows of the log
    course_noise_deg: float = 0.5  # standard deviation of the course (deg)
    delay: float = 0.0  # of the course (s)
    bias_deg: float = 0.0  # constant error of the course (deg)
    gyro_bias_degps: float = 0.0  # of the gyro that estimators see, not of the emulated heading
    estimators: Sequence[str] | None = None  # in `ESTIMATORS`, None: all; gyro-only always runs
    q_beta: float = 1e-3  # process noise of sideslip (rad2/s)
    q_gamma: float = 0.1  # process noise of the yaw rate ((rad/s)2/s)
    q_psi: float = 0.0  # process noise of the heading (rad2/s)
    seeds: int = 5  # number of noises of the emulated course
    seed: int = 0  # the first of their seeds
    figures: bool = True
    emulated: bool = True  # whether a log with truth and no slow sensor gets a course
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # by estimator
    noise: Mapping[str, float] = field(default_factory=dict)  # deviations assumed, by option

    def __post_init__(self) -> None:
        unknown = [x for x in (*(self.estimators or ()), *self.options) if x not in ESTIMATORS]
        if unknown:
            names = ", ".join(unknown)
            raise ValueError(f"unknown estimator {names}; known here: {', '.join(ESTIMATORS)}")
        if self.seeds < 1 or self.seed < 0:
            raise ValueError(f"expected seeds >= 1 and seed >= 0, got {self.seeds}, {self.seed}")
        for name in (*_NOT_NEGATIVE, "bias_deg", "gyro_bias_degps"):
            value, rule = getattr(self, name), " and not negative" * (name in _NOT_NEGATIVE)
            if not math.isfinite(value) or (rule and value < 0.0):
                raise ValueError(f"{name} must be finite{rule}, got {value}")
        if self.course_rate == 0.0:
            raise ValueError(f"course_rate must be positive, got {self.course_rate} Hz")


def _emulate_course(log: Log, settings: Settings, seed: int) -> Log:
    """Add a GPS that measures the course alone to a log with truth.

    course = sideslip truth + integral of the logged yaw rate + bias + noise. Samples stand on
    ticks that are whole periods, none where the truth is unknown; quality is 0 below 1 m/s.
    """
    record, motion, beta = log.record, LoggedMotion(log), log.truth["beta"]
    if settings.course_rate * record.dt > 1.0 + 1e-6:
        raise ValueError(
            f"a course at {settings.course_rate:g} Hz needs a log at least as fast; "
            f"this one has {1.0 / record.dt:.4g} rows a second"
        )
    rows, late = round(1.0 / (settings.course_rate * record.dt)), round(settings.delay / record.dt)
    captured = np.arange(-record.first % rows, len(beta), rows)
    noise = np.random.default_rng(seed).standard_normal(len(captured))
    exact = (beta + motion.heading)[captured] + math.radians(settings.bias_deg)
    course = exact + math.radians(settings.course_noise_deg) * noise
    sent = np.isfinite(course) & (captured + late < len(beta))
    ticks = (record.first + captured[sent]).astype(np.float64)
    values = np.full((len(ticks), 4), np.nan)
    values[:, 0] = np.arctan2(np.sin(course[sent]), np.cos(course[sent]))
    quality = (motion.speed[captured][sent] >= COURSE_SPEED).astype(np.float64)
    packets = make_packet_rows("gps", ticks, ticks + late, values, quality)
    gps = SlowSensor(period=rows * record.dt, delays=(late * record.dt,))
    record = dataclasses.replace(record, packets=packets)
    return dataclasses.replace(log, record=record, slow={"gps": gps})


def make_drives(log: Log, settings: Settings) -> list[Log]:
    """Make a drive for each noise of the course, or the logged one, with the gyro's bias.

    Args:
        log: Recorded drive; ValueError if it is too short.
        settings: Settings of course and gyro.
    """
    duration = log.time[-1] - log.time[0]
    if duration < SETTLED:
        text = f"the drive lasts {duration:.3g} s, errors count from {SETTLED:g} s on"
        raise ValueError(f"{log.name}: {text}")
    drives, fast = [log], log.record.fast.copy()
    if settings.emulated and "beta" in log.truth and not log.slow:
        drives = [_emulate_course(log, settings, settings.seed + i) for i in range(settings.seeds)]
    fast[:, FAST.gyro] += math.radians(settings.gyro_bias_degps)
    records = [dataclasses.replace(drive.record, fast=fast) for drive in drives]
    pairs = zip(drives, records, strict=True)
    return [dataclasses.replace(drive, record=record) for drive, record in pairs]


@dataclass
class ReplayResult:
    """Errors of one vehicle's estimators on one drive, by estimator."""

    # by seed: mean squared error (rad2), NEES, fraction of errors in the 95 % interval, mean log
    # score, shape (seeds, 4); empty without truth
    scores: dict[str, Array] = field(default_factory=dict)
    nis: dict[str, float] = field(default_factory=dict)  # mean, a value of a packet; first seed
    traces: dict[str, Array] = field(default_factory=dict)  # sideslip of the first seed (rad)
    remarks: dict[str, str] = field(default_factory=dict)  # why it is left out, or what it misses

    @property
    def rmse(self) -> dict[str, Estimate]:
        """RMS errors over the seeds (rad), best first."""
        ranges = {name: compute_range(np.sqrt(x[:, 0])) for name, x in self.scores.items()}
        return dict(sorted(ranges.items(), key=lambda item: item[1].value))

    def compare(self, name: str, other: str = GYRO_ONLY) -> Estimate:
        """Compute the RMS error over another's, seed by seed.

        Args:
            name: Estimator.
            other: The other one.
        """
        return compute_range(np.sqrt(self.scores[name][:, 0] / self.scores[other][:, 0]))

    def rank_by_score(self) -> dict[str, float]:
        """Rank by the median log score, best first: medians of the share that intervals hold."""
        medians = {name: np.median(rows, axis=0) for name, rows in self.scores.items()}
        ranked = sorted(medians, key=lambda name: -float(medians[name][3]))
        return {name: float(medians[name][2]) for name in ranked}


def compute_range(values: Array) -> Estimate:
    """Compute median, smallest and largest.

    Args:
        values: Numbers of the noises, shape (n,).
    """
    return Estimate(*(float(function(values)) for function in (np.median, np.min, np.max)))


def run_estimators(drives: Sequence[Log], vehicle: Vehicle, settings: Settings) -> ReplayResult:
    """Run every wanted estimator that the drives' slow sensors serve over every drive.

    Args:
        drives: Drives of `make_drives`; ValueError where all of their truth is unknown.
        vehicle: Vehicle from which the estimators are designed.
        settings: Estimators and their noise.
    """
    log, result = drives[0], ReplayResult()
    counts = (log.time >= log.time[0] + SETTLED - 1e-9) & ~LoggedMotion(log).is_backward
    truth = log.truth.get("beta")
    if truth is not None and not (counts := counts & np.isfinite(truth)).any():
        text = f"the sideslip truth is unknown from {SETTLED:g} s on, driven forward"
        raise ValueError(f"{log.name}: {text}")
    for name, serves in ESTIMATORS.items():
        if settings.estimators is not None and name not in (GYRO_ONLY, *settings.estimators):
            continue
        slow = next((sensor for sensor in serves if sensor in log.slow), None)
        inertial = name == _OWN_NOISE and "accel_y" in log.record.present
        if serves and slow is None and not inertial:
            result.remarks[name] = f"left out: needs {' or '.join(serves)}"
            continue
        try:
            estimator = _make_estimator(name, slow, log, vehicle, settings)
        except ValueError as error:
            if name == GYRO_ONLY:
                raise
            result.remarks[name] = f"left out: {str(error).removeprefix(f'{name}: ')}"
            continue
        missing = [column for column in estimator.needs if column not in log.record.present]
        if missing and name != GYRO_ONLY:
            result.remarks[name] = f"left out: needs the column {', '.join(missing)}"
            continue
        if estimator.unobservable:
            result.remarks[name] = f"cannot see {'; '.join(estimator.unobservable)}"
        numbers = []
        for drive in drives:
            estimates = estimator.run(drive)
            place = estimates.names.index("beta")
            result.traces.setdefault(name, estimates.x[:, place])
            if slow is not None and np.isfinite(estimates.nis).any():
                values = len(MEASUREMENTS[slow].rows)  # of a packet, each of which adds 1
                result.nis.setdefault(name, float(np.nanmean(estimates.nis)) / values)
            if truth is not None:
                wrong = (estimates.x[:, place] - truth)[counts]
                honesty = compute_honesty(wrong, estimates.std[counts, place])
                numbers.append((np.mean(wrong**2), *honesty))
        if truth is not None:
            result.scores[name] = np.array(numbers)
    return result


def _make_estimator(
    name: str, slow: str | None, log: Log, vehicle: Vehicle, settings: Settings
) -> Any:
    sensors: dict[str, SlowSensor] = {} if slow is None else {slow: log.slow[slow]}
    options: dict[str, Any] = {} if slow is None else {"slow": slow}
    if name != _OWN_NOISE:
        options |= {"q_beta": settings.q_beta, "q_gamma": settings.q_gamma}
        options |= {} if slow is None else {"q_psi": settings.q_psi}
    if slow == "gps":
        emulated = math.radians(max(settings.course_noise_deg, _MIN_COURSE_NOISE))
        options["course_noise"] = settings.noise.get("course_noise", emulated)
    if "gyro_noise" in settings.noise and name != _OWN_NOISE:
        options["gyro_noise"] = max(settings.noise["gyro_noise"], _MIN_GYRO_NOISE)
    options |= settings.options.get(name, {})
    facts = {"sensors": sensors, "dt": log.record.dt, "present": log.record.present}
    # quietly: the result names what is unseen
    return call_quietly(make_estimator, name, vehicle=vehicle, **facts, **options)
