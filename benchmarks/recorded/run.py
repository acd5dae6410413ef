"""Estimators over one recorded drive: their settings, and how far they are from the truth."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...envs.record import Array, Log
from ...envs.sensors.link import SlowSensor
from ...envs.vehicle.vehicle import Vehicle
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, call_quietly
from .emulate import Emulation, find_backward

GYRO_ONLY = "bicycle-kf"
ESTIMATORS: dict[str, tuple[str, ...]] = {
    GYRO_ONLY: (),
    "single-rate-kf": ("gps", "camera"),
    "multirate-kf": ("gps", "camera"),
    "multirate-residual-kf": ("gps", "camera"),
    "course-kf": ("gps",),
    "dakf": ("gps",),
    "exact-kf": ("gps", "camera"),
    "joint": ("gps", "camera"),
    "joint-robust": ("gps", "camera"),
}
"""The estimators of a replay and the slow sensors that serve them, the better one first."""

OWN_NOISE = "joint-robust"  # brings its levels along and finds the accelerometer's as it drives
MIN_COURSE_NOISE = 0.01  # deg, of the course, the least that estimators assume
MIN_GYRO_NOISE = 0.002  # rad/s; below, what the model lacks weighs more than the sensor's noise
_MOTION = ("beta", "gamma", "psi", "y_l", "course", "phi", "phi_rate", "F_d", "N_d")


@dataclass(frozen=True, kw_only=True)
class Settings(Emulation):
    """How a drive is replayed, on top of `Emulation`.

    estimators: names in `ESTIMATORS`; None: all. The gyro-only one always runs along.
    q_beta, q_gamma, q_psi: process noise of every estimator in rad2/s, (rad/s)2/s, rad2/s; the
    course noise they assume is `course_noise_deg`. seeds: how many noises of the emulated course,
    from `seed` on. options: more options of estimators, by name. noise: standard deviations by
    option, which estimators assume. stiffness_factor: of both tyre stiffnesses of the estimators.
    figures: whether to draw. emulated: whether a log with truth and no slow sensor gets a course.

    Raises ValueError for a value out of range and an unknown estimator.
    """

    estimators: Sequence[str] | None = None
    q_beta: float = 1e-3
    q_gamma: float = 0.1
    q_psi: float = 0.0
    seeds: int = 5
    seed: int = 0
    stiffness_factor: float = 1.0
    figures: bool = True
    emulated: bool = True
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        requested = (*(self.estimators or ()), *self.options)
        unknown = [name for name in requested if name not in ESTIMATORS]
        if unknown:
            raise ValueError(
                f"unknown estimator {', '.join(unknown)}; known here: {', '.join(ESTIMATORS)}"
            )
        if self.seeds < 1 or self.seed < 0:
            raise ValueError(f"expected seeds >= 1 and seed >= 0, got {self.seeds}, {self.seed}")
        for name in ("q_beta", "q_gamma", "q_psi"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be finite and not negative, got {value}")

    def as_dict(self) -> dict[str, Any]:
        """JSON types: everything that moves a number."""
        plain = dataclasses.asdict(self)
        del plain["figures"], plain["emulated"]
        plain["estimators"] = list(self.estimators or ESTIMATORS)
        return plain


@dataclass
class ReplayResult:
    """Errors of one vehicle's estimators on one drive.

    squares: by estimator, mean squared error in rad2 of each seed (empty without truth). cost: CPU
    us per row. traces: sideslip of the first seed in rad, (rows,). found: by estimator, its states
    that are no motion at the end: (name, value, standard deviation). remarks: by estimator, why it
    was left out or what it cannot see.
    """

    squares: dict[str, Array] = field(default_factory=dict)
    cost: dict[str, float] = field(default_factory=dict)
    traces: dict[str, Array] = field(default_factory=dict)
    outcomes: dict[str, list[tuple[str, float, float]]] = field(default_factory=dict)
    remarks: dict[str, str] = field(default_factory=dict)

    def rmse(self, name: str) -> tuple[float, float, float]:
        """Median, least and most over the seeds, in rad."""
        return _summarise_range(np.sqrt(self.squares[name]))

    def ratio(self, name: str, other: str = GYRO_ONLY) -> tuple[float, float, float]:
        """RMSE over another's, seed by seed: median, least and most."""
        return _summarise_range(np.sqrt(self.squares[name] / self.squares[other]))


def _summarise_range(values: Array) -> tuple[float, float, float]:
    return float(np.median(values)), float(np.min(values)), float(np.max(values))


def make_drives(log: Log, settings: Settings) -> list[Log]:
    """What the estimators see: a drive for each noise of the course, or the one that was logged.

    Raises ValueError for a log that is over before errors count.
    """
    duration = log.time[-1] - log.time[0]
    if duration < SETTLED:
        raise ValueError(
            f"{log.name}: the drive lasts {duration:.3g} s, errors count from {SETTLED:g} s on"
        )
    if log.slow or "beta" not in log.truth or not settings.emulated:
        return [settings.add_gyro_bias(log)]
    return [settings.add_course(log, settings.seed + i) for i in range(settings.seeds)]


def run_estimators(drives: Sequence[Log], vehicle: Vehicle, settings: Settings) -> ReplayResult:
    """Every wanted estimator that the drives' slow sensors serve, over every drive."""
    log, result = drives[0], ReplayResult()
    counts = (log.time >= log.time[0] + SETTLED - 1e-9) & ~find_backward(log)
    truth = log.truth.get("beta")
    if truth is not None and not (counts := counts & np.isfinite(truth)).any():
        raise ValueError(
            f"{log.name}: the sideslip truth is unknown from {SETTLED:g} s on, driven forward"
        )
    for name, serves in ESTIMATORS.items():
        if settings.estimators is not None and name not in (GYRO_ONLY, *settings.estimators):
            continue
        slow = next((sensor for sensor in serves if sensor in log.slow), None)
        if serves and slow is None and name != OWN_NOISE:  # which inertial sensors serve too
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
        squares = []
        for drive in (log, *drives):  # the first run designs the gains
            start = time.process_time()
            estimates = estimator.run(drive)
            spent = (time.process_time() - start) / len(counts) * 1e6
            result.cost[name] = min(spent, result.cost.get(name, math.inf))
            beta = estimates.x[:, estimates.names.index("beta")]
            result.traces.setdefault(name, beta)
            ends = zip(estimates.names, estimates.x[-1], estimates.std[-1], strict=True)
            result.outcomes[name] = [
                (state, float(x), float(sd)) for state, x, sd in ends if state not in _MOTION
            ]
            if truth is not None:
                squares.append(np.mean((beta - truth)[counts] ** 2))
        if truth is not None:
            result.squares[name] = np.array(squares[1:])
    return result


def _make_estimator(
    name: str, slow: str | None, log: Log, vehicle: Vehicle, settings: Settings
) -> Any:
    sensors: dict[str, SlowSensor] = {} if slow is None else {slow: log.slow[slow]}
    options: dict[str, Any] = {"q_beta": settings.q_beta, "q_gamma": settings.q_gamma}
    if slow is not None:
        options |= {"slow": slow, "q_psi": settings.q_psi}
    if name == OWN_NOISE:
        options = {"slow": slow} if slow is not None else {}
    if slow == "gps":
        options["course_noise"] = math.radians(max(settings.course_noise_deg, MIN_COURSE_NOISE))
        options |= {key: settings.noise[key] for key in ("course_noise",) if key in settings.noise}
    if "gyro_noise" in settings.noise and name != OWN_NOISE:
        options["gyro_noise"] = max(settings.noise["gyro_noise"], MIN_GYRO_NOISE)
    options |= settings.options.get(name, {})
    facts = {"vehicle": vehicle, "sensors": sensors, "dt": log.record.dt}
    return call_quietly(make_estimator, name, **facts, **options)  # the result names what is unseen
