"""ISO 3888, 4138 and 7401: lane changes between cones, steady circles, transient responses.

ISO 3888: double lane change (part 1, at a held speed) and obstacle avoidance (part 2, coasting).
The highest clean speed is that of car and drivers together, below what test drivers do. A slower
car's tracks are shortened by its speed over the standards' 80 km/h, but for the lanes' widths.

Args:
    track: One of `TRACKS`.
    speed: Speed (m/s).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...envs.scenarios.road import Section, make_sections
from ...envs.vehicle.linear import make_bicycle_model
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from .drive import DriveFunction, Fields, Series, TestCar

_Complex = npt.NDArray[np.complex128]

ONSET = 1.0  # s, straight ahead before the first lane, the step and the sweep

TRACKS = ("iso-3888-1", "iso-3888-2")
_STANDARD_SPEED = 80.0 / 3.6  # m/s
RUN_OUT = 10.0  # m, after the last lane
DRIVERS: tuple[Fields, ...] = tuple(
    {"driver_preview": preview, "driver_gain": gain, "driver_lag": 0.05}
    for preview, gain in ((0.3, 0.6), (0.4, 0.8), (0.5, 1.0), (0.6, 1.0), (0.6, 1.2))
)


@dataclass(frozen=True)
class TrackRun:
    """One run through a track."""

    speed: float  # m/s
    lanes: tuple[Section, ...]  # where the car drives them
    margins: tuple[float, ...]  # m, by lane, to its edge; below 0 a cone falls, NaN: not driven
    series: Series

    @property
    def min_margin(self) -> float:
        """The smallest margin (m); minus infinity where the track was not driven to its end."""
        is_complete = not self.series.failed and all(margin == margin for margin in self.margins)
        return min(self.margins) if is_complete else -math.inf

    @property
    def passed(self) -> bool:
        """Whether no cone falls and the car does not fail."""
        return self.min_margin >= 0.0


def _compute_corners(series: Series, car: TestCar) -> Array:
    """Compute the body's corners on the ground (m), going round it: (n, 4, 2)."""
    front = car.vehicle.front_arm + car.front_overhang
    half = 0.5 * car.vehicle.width
    rear = front - car.length
    body = np.array([[front, half], [front, -half], [rear, -half], [rear, half]])
    sine, cosine = np.sin(series.psi), np.cos(series.psi)
    turned = np.array([[cosine, -sine], [sine, cosine]])
    place = np.stack([series.X, series.Y], axis=1)
    return np.asarray(place[:, None, :] + np.einsum("ijn,kj->nki", turned, body))


def _compute_margin(body: Array, lane: Section) -> float:
    """Compute the smallest distance (m) of a body (n, 4, 2) to the edges of a lane that it crosses.

    The body's sides are cut where the lane begins and ends: a side may touch the first or the
    last cone with all corners outside. NaN where the body does not reach the lane's end.
    """
    start, end = lane.start, lane.start + lane.length
    if body[:, :, 0].max() < end:
        return float("nan")
    corner, next_corner = body, np.roll(body, -1, axis=1)
    dx = next_corner[..., 0] - corner[..., 0]
    safe = np.where(dx == 0.0, 1.0, dx)
    cuts = np.sort([(start - corner[..., 0]) / safe, (end - corner[..., 0]) / safe], axis=0)
    inside = (corner[..., 0] >= start) & (corner[..., 0] <= end)
    first = np.where(dx == 0.0, np.where(inside, 0.0, 2.0), np.maximum(cuts[0], 0.0))
    last = np.where(dx == 0.0, np.where(inside, 1.0, -1.0), np.minimum(cuts[1], 1.0))
    dy = next_corner[..., 1] - corner[..., 1]
    max_offset = -np.inf
    for part in (first, last):
        y = corner[..., 1] + part * dy - lane.offset
        max_offset = max(max_offset, float(np.max(np.abs(y), where=first <= last, initial=-np.inf)))
    return 0.5 * lane.width - max_offset


def _make_lanes(car: TestCar, track: str, speed: float) -> tuple[Section, ...]:
    """Make the lanes where the car drives them, in their order."""
    return make_sections(track, car.vehicle.width, speed * ONSET, _compute_length_share(car))


def _compute_length_share(car: TestCar) -> float:
    """Compute the fraction of the standards' lengths that the car drives."""
    return min(1.0, car.speed / _STANDARD_SPEED)


def _make_lane_change(car: TestCar, track: str, speed: float) -> Fields:
    """Make a run through a track at a speed (m/s)."""
    last = _make_lanes(car, track, 0.0)[-1]
    way = last.start + last.length + RUN_OUT
    return {
        "steering": "driver", "path": track, "path_speed": speed / _compute_length_share(car),
        "onset": ONSET, "speed": speed, "acceleration": None if track == TRACKS[0] else 0.0,
        "duration": ONSET + 1.3 * way / speed,  # a coasting car is slower
    }  # fmt: skip


def _evaluate_run(series: Series, car: TestCar, track: str, speed: float) -> TrackRun:
    body, lanes = _compute_corners(series, car), _make_lanes(car, track, speed)
    return TrackRun(speed, lanes, tuple(_compute_margin(body, lane) for lane in lanes), series)


def run_track(drive: DriveFunction, car: TestCar, track: str, speed: float) -> TrackRun:
    """Drive with each driver until a run is clean, and return that or the closest run."""
    runs, fields = list[TrackRun](), _make_lane_change(car, track, speed)
    for driver in DRIVERS:
        runs.append(_evaluate_run(drive({**fields, **driver}), car, track, speed))
        if runs[-1].passed:
            break
    return max(runs, key=lambda track_run: track_run.min_margin)


_SETTLE = 3.0  # s, at the first speed
LINEAR_FROM, LINEAR_TO = 0.05 * GRAVITY, 0.25 * GRAVITY  # the range of the slope


def _fit_understeer(series: Series, car: TestCar) -> tuple[float, float]:
    """Fit delta_f = l / R + K a_y + b on a circle: K (rad s2/m) and b (rad), of the linear car 0.

    By ISO 4138's handling diagram, l gamma / v_x - delta_f over a_y; ValueError where the circle
    stays below 0.25 g.
    """
    settled = series.t >= _SETTLE
    side = np.sign(np.mean(series.gamma[settled]))
    a_y = side * (series.v_x * series.gamma)[settled]  # quasi-steady: v_y' is left out
    path = car.vehicle.wheelbase * side * (series.gamma / series.v_x)[settled]
    angle = path - side * series.steer[settled]
    linear = (a_y >= LINEAR_FROM) & (a_y <= LINEAR_TO)
    if a_y.max() < LINEAR_TO or linear.sum() < 2:
        raise ValueError(f"the circle reached {a_y.max():.2f} m/s2, not {LINEAR_TO:.2f}")
    slope, offset = np.polyfit(a_y[linear], angle[linear], 1)
    return -float(slope), -float(offset)


def run_circle(drive: DriveFunction, car: TestCar, seconds: float = 60.0) -> float:
    """Measure K (rad s2/m) on a circle where the linear car reaches 0.5 g at full speed.

    Args:
        drive: Function that drives the car through a scenario.
        car: Car under test, with speed and steering ratio.
        seconds: Time in which the speed rises (s).
    """
    v = car.speed
    steer = (car.vehicle.wheelbase / v**2 + car.understeer_gradient) * (0.5 * GRAVITY)
    first = 0.2 * v
    circle = {
        "steering": "held-step", "amplitude": steer, "onset": 0.0, "speed": first,
        "speed_change": v - first, "change_start": _SETTLE, "change_length": seconds,
        "duration": _SETTLE + seconds,
    }  # fmt: skip
    return _fit_understeer(drive(circle), car)[0]


LOWEST, HIGHEST = 0.2, 2.0  # Hz
_SEGMENT = 10.0  # s, of the averaged periodograms
OUTPUTS = ("gamma", "a_y")
_STEP_ACCELERATION = 0.2 * GRAVITY  # steady lateral acceleration of the step, in the linear range
_SWEEP_ACCELERATION = 0.1 * GRAVITY  # of the sweep, where it is slow


@dataclass(frozen=True)
class StepResponse:
    """ISO 7401's numbers of a step; times count from where the steering passes half its end."""

    gain: float  # steady state per rad of steering
    response_time: float  # s, to 90 % of the steady state
    peak_time: float  # s, to the peak
    overshoot: float  # fraction of the steady state


@dataclass(frozen=True)
class FrequencyResponse:
    """A frequency response, shape (k,) each."""

    frequency: Array  # Hz
    H: _Complex  # per rad of steering
    sd: Array  # of the real or the imaginary part of H


def _make_step(car: TestCar, steer: float) -> Fields:
    """Make a step of the steering angle (rad) that is held for 4 s."""
    steering = {"steering": "held-step", "amplitude": steer, "onset": ONSET}
    return steering | {"speed": car.speed, "duration": ONSET + 4.0}


def _compute_step_response(t: Array, steer: Array, output: Array) -> StepResponse:
    """Compute the numbers of a step that is held to the end, (n,) each; ValueError without one."""
    end = float(steer[-1])
    if end == 0.0:
        raise ValueError("a step response needs a steering angle at its end, got 0")
    steady = float(np.mean(output[t >= t[-1] - 0.5]))
    share = output / steady
    start = _find_crossing(t, steer / end, 0.5)
    peak = int(np.argmax(share))
    response_time, peak_time = _find_crossing(t, share, 0.9) - start, float(t[peak]) - start
    return StepResponse(steady / end, response_time, peak_time, max(0.0, float(share[peak]) - 1.0))


def _find_crossing(t: Array, values: Array, level: float) -> float:
    """Find when the values first pass the level, on the line between two samples."""
    k = int(np.argmax(values >= level))
    if k == 0:
        return float(t[0]) if values[0] >= level else math.nan
    part = (level - values[k - 1]) / (values[k] - values[k - 1])
    return float(t[k - 1] + part * (t[k] - t[k - 1]))


def _estimate_frequency_response(t: Array, steer: Array, output: Array) -> FrequencyResponse:
    """Estimate the frequency response of output to steering from 0.2 to 2 Hz; arrays: (n,).

    S_xy / S_xx by Welch; its deviation by the coherence (Bendat and Piersol, Random Data, 9.2).
    """
    from scipy.signal import csd, welch

    duration = float(t[-1] - t[0])
    rate = (len(t) - 1) / duration
    length = round(_SEGMENT * rate)
    if length > len(t):
        raise ValueError(f"a segment of {_SEGMENT} s is longer than the {duration:.1f} s driven")
    options = {"fs": rate, "nperseg": length, "detrend": False}
    frequency, S_xx = welch(steer, **options)
    S_yy, S_xy = welch(output, **options)[1], csd(steer, output, **options)[1]
    half = 0.5 / _SEGMENT  # between two lines: rounding decides nothing
    in_range = (frequency > LOWEST - half) & (frequency < HIGHEST + half)
    H = (S_xy / S_xx)[in_range]
    coherence = (np.abs(S_xy) ** 2 / (S_xx * S_yy))[in_range]
    segments = 2 * len(t) // length - 1  # they overlap by half
    sd = np.abs(H) * np.sqrt((1.0 - coherence) / (2.0 * coherence * segments))
    return FrequencyResponse(frequency[in_range], H, sd)


def _compute_linear_response(
    vehicle: Vehicle, speed: float, frequency: Array
) -> dict[str, _Complex]:
    """Compute the linear model's response to steering by output, (k,); frequency in Hz."""
    model = make_bicycle_model(vehicle, speed)
    B = model.B[:, 0]
    turned = [np.linalg.solve(2j * np.pi * f * np.eye(2) - model.A, B) for f in frequency]
    beta, gamma = np.array(turned).T
    return {"gamma": gamma, "a_y": speed * (2j * np.pi * frequency * beta + gamma)}


def _compute_linear_step(vehicle: Vehicle, speed: float, series: Series) -> dict[str, StepResponse]:
    """Compute the step's numbers of the linear model under the same steering by output."""
    from scipy.signal import lsim

    model = make_bicycle_model(vehicle, speed)
    A, B = model.A, model.B[:, :1]
    C = np.vstack([[0.0, 1.0], speed * (A[0] + [0.0, 1.0])])
    D = np.array([[0.0], [speed * B[0, 0]]])
    outputs = zip(OUTPUTS, lsim((A, B, C, D), series.steer, series.t)[1].T, strict=True)
    return {name: _compute_step_response(series.t, series.steer, y) for name, y in outputs}


def _make_sweep(car: TestCar, steer: float) -> Fields:
    """Make a sine of the steering angle (rad) from 0.05 to 2.5 Hz."""
    seconds = 100.0  # half a segment has passed when it comes to the standard's lowest frequency
    return {
        "steering": "sweep", "amplitude": steer, "onset": ONSET, "frequency": 0.25 * LOWEST,
        "frequency_2": 1.25 * HIGHEST, "hold": seconds, "speed": car.speed,
        "duration": ONSET + seconds + 2.0,
    }  # fmt: skip


class Transient(NamedTuple):
    """The responses of an output, measured and of the linear model."""

    step: StepResponse
    linear_step: StepResponse
    sweep: FrequencyResponse
    linear_sweep: _Complex


def run_transient(drive: DriveFunction, car: TestCar) -> dict[str, Transient]:
    """Drive the step and the sweep; the responses by output."""
    vehicle, speed = car.vehicle, car.speed
    per = vehicle.wheelbase / speed**2 + car.understeer_gradient  # rad s2/m
    stepped = drive(_make_step(car, per * _STEP_ACCELERATION))
    swept = drive(_make_sweep(car, per * _SWEEP_ACCELERATION))
    linear_step, responses = _compute_linear_step(vehicle, speed, stepped), {}
    for name in OUTPUTS:
        step = _compute_step_response(stepped.t, stepped.steer, getattr(stepped, name))
        sweep = _estimate_frequency_response(swept.t, swept.steer, getattr(swept, name))
        linear = _compute_linear_response(vehicle, speed, sweep.frequency)[name]
        responses[name] = Transient(step, linear_step[name], sweep, linear)
    return responses
