"""FMVSS 126: electronic stability control, sine with dwell (49 CFR 571.126, S5.2, S7.6, S7.9).

Slowly increasing steer gives A, the steering wheel angle at 0.3 g; then one period of a sine with a
dwell after its third quarter, coasting, to both sides, from 1.5 A on. The peak of the yaw rate is
that between reversal and completion of steer: a car that spins has no later one.

Args:
    A: Reference angle (rad at the steering wheel).
    multiples: Amplitudes (of A); None: the standard's series.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...envs.record import Array
from ...envs.vehicle.parameters import GRAVITY
from .drive import DriveFunction, Fields, Series, TestCar

FREQUENCY, DWELL = 0.7, 0.5  # Hz, s
ONSET = 0.5  # s, straight ahead before
_AFTER = 2.0  # s, recorded after completion of steer
_RAMP_RATE = math.radians(13.5)  # rad/s at the steering wheel
A_AT, A_FROM, A_TO = 0.3 * GRAVITY, 0.1 * GRAVITY, 0.375 * GRAVITY  # m/s2: at A, the line's ends
FIRST, STEP, LAST = 1.5, 0.5, 6.5  # of A
MIN_AMPLITUDE, MAX_AMPLITUDE = math.radians(270.0), math.radians(300.0)  # at the steering wheel
# s after completion of steer, share of the peak: S5.2.1, S5.2.2
RATIOS = ((1.0, 0.35), (1.75, 0.20))
_RESPONSIVE = 5.0  # of A
SIDEWAYS, SIDEWAYS_AT = 1.83, 1.07  # m, s after the beginning of steer: S5.2.3

REVERSAL = ONSET + 0.5 / FREQUENCY
COMPLETION = ONSET + 1.0 / FREQUENCY + DWELL


@dataclass(frozen=True)
class SineDwellRun:
    """A sine with dwell and its measures, which are NaN from where the car's drive ended."""

    multiple: float  # of A
    ratio_1: float  # yaw rate over its peak at the first time of `RATIOS`
    ratio_2: float
    sideways: float  # m

    @property
    def stable(self) -> bool:
        """Whether S5.2.1 and S5.2.2 are met; False for NaN."""
        return self.ratio_1 <= RATIOS[0][1] and self.ratio_2 <= RATIOS[1][1]

    @property
    def passed(self) -> bool:
        """Whether S5.2.3 is met too, from 5 A on."""
        return self.stable and (self.multiple < _RESPONSIVE or self.sideways >= SIDEWAYS)


def _make_slow_steer(car: TestCar, side: float) -> Fields:
    """Make the slowly rising steer; its first quarter is driven, enough to pass 0.375 g."""
    seconds = 30.0
    return {
        "steering": "ramp", "onset": ONSET, "amplitude": side * _RAMP_RATE / car.ratio * seconds,
        "hold": seconds, "speed": car.speed, "duration": ONSET + seconds * 0.25,
    }  # fmt: skip


def _fit_reference_angle(series: Series, ratio: float) -> float:
    """Fit |A| (rad): where a line through 0.1 to 0.375 g crosses 0.3 g; ValueError below these."""
    a_y = np.abs(series.a_y)
    past_range = np.flatnonzero(a_y > A_TO)
    if not len(past_range):
        raise ValueError(f"slowly increasing steer reached {a_y.max():.2f} m/s2, not {A_TO:.2f}")
    in_range = np.flatnonzero(a_y[: past_range[0]] >= A_FROM)
    slope, start = np.polyfit(a_y[in_range], ratio * np.abs(series.steer[in_range]), 1)
    return float(start + slope * A_AT)


def _list_amplitudes(A: float) -> Array:
    """List the steering wheel angles (rad) of a series, from 1.5 A on."""
    last = MAX_AMPLITUDE if LAST * A > MAX_AMPLITUDE else max(LAST * A, MIN_AMPLITUDE)
    count = math.ceil(round((last / A - FIRST) / STEP, 9))
    return np.append(A * (FIRST + STEP * np.arange(count)), last)


def _make_sine_with_dwell(car: TestCar, amplitude: float) -> Fields:
    """Make a sine with dwell; amplitude: rad at the steering wheel, signed as its first half."""
    return {
        "steering": "sine-with-dwell", "onset": ONSET, "amplitude": amplitude / car.ratio,
        "frequency": FREQUENCY, "hold": DWELL, "speed": car.speed, "acceleration": 0.0,
        "duration": COMPLETION + _AFTER,
    }  # fmt: skip


def _evaluate_run(series: Series, amplitude: float, A: float) -> SineDwellRun:
    """Evaluate a run; amplitude and A are in rad at the steering wheel."""
    towards = -math.copysign(1.0, amplitude)
    steered = (series.t >= REVERSAL) & (series.t <= COMPLETION)
    peak = float(np.max(towards * series.gamma[steered], initial=0.0))

    def interpolate(name: str, time: float) -> float:  # NaN after the end
        return float(np.interp(time, series.t, getattr(series, name), right=np.nan))

    later = [abs(interpolate("gamma", COMPLETION + time)) for time, _ in RATIOS]
    ratio_1, ratio_2 = (rate / peak if peak > 0.0 else math.nan for rate in later)
    multiple = round(abs(amplitude) / A, 6)  # 5 A is no less than 5 A
    start = {name: interpolate(name, ONSET) for name in ("X", "Y", "psi")}
    dX, dY = (interpolate(name, ONSET + SIDEWAYS_AT) - start[name] for name in ("X", "Y"))
    # across the heading at the beginning of steer
    sideways = abs(dY * math.cos(start["psi"]) - dX * math.sin(start["psi"]))
    return SineDwellRun(multiple, ratio_1, ratio_2, sideways)


@dataclass(frozen=True)
class SineDwellResult:
    """The runs of a car."""

    A: float  # rad at the steering wheel, the mean of both sides'
    runs: tuple[SineDwellRun, ...]  # as they were driven

    @property
    def passed(self) -> bool:
        """Whether every run passes."""
        return all(run.passed for run in self.runs)

    @property
    def highest(self) -> float:
        """The amplitude in A up to which every run passes, on both sides; 0 if none does."""
        failed = min((run.multiple for run in self.runs if not run.passed), default=math.inf)
        return max((run.multiple for run in self.runs if run.multiple < failed), default=0.0)


def measure_reference_angle(drive: DriveFunction, car: TestCar) -> float:
    """Measure A (rad at the steering wheel), mean of both sides; ValueError short of 0.375 g."""
    turns = [drive(_make_slow_steer(car, side)) for side in (1.0, -1.0)]
    return float(np.mean([_fit_reference_angle(turn, car.ratio) for turn in turns]))


def run(
    drive: DriveFunction, car: TestCar, A: float, multiples: Sequence[float] | None = None
) -> SineDwellResult:
    """Run the procedure, to both sides with each amplitude."""
    angles = _list_amplitudes(A) if multiples is None else A * np.asarray(multiples)
    signed = [side * angle for angle in angles.tolist() for side in (1.0, -1.0)]
    runs = [_evaluate_run(drive(_make_sine_with_dwell(car, angle)), angle, A) for angle in signed]
    return SineDwellResult(A, tuple(runs))
