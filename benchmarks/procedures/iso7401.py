"""ISO 7401: lateral transient response, by a step of the steering angle and by a swept sine.

A step's times count from where the steering angle passes half its end value. The sweep's frequency
response is S_xy / S_xx of Welch's averaged periodograms, whose standard deviation follows from the
coherence (Bendat and Piersol, Random Data, 9.2), beside the linear model's C (j w I - A)^-1 B + D.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...envs.vehicle.linear import make_bicycle_model
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from .drive import DriveFunction, Fields, Series, TestCar

_Complex = npt.NDArray[np.complex128]

ONSET = 1.0  # s
LOWEST, HIGHEST = 0.2, 2.0  # Hz
_SEGMENT = 10.0  # s, of the averaged periodograms
OUTPUTS = ("gamma", "a_y")
_STEP_AT = 0.2 * GRAVITY  # steady lateral acceleration of the step, in the linear range
_SWEEP_AT = 0.1 * GRAVITY  # of the sweep, where it is slow


@dataclass(frozen=True)
class StepResponse:
    """The numbers of a step of the steering angle."""

    gain: float  # steady state per rad of steering
    response_time: float  # s, to 90 % of the steady state
    peak_time: float  # s, to the peak
    overshoot: float  # fraction of the steady state


@dataclass(frozen=True)
class FrequencyResponse:
    """A frequency response, shape (k,) each."""

    frequency: Array  # Hz
    H: _Complex  # per rad of steering
    coherence: Array
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
    """Estimate the frequency response of output to steering from 0.2 to 2 Hz; arrays: (n,)."""
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
    return FrequencyResponse(frequency[in_range], H, coherence, sd)


def _compute_linear_response(
    vehicle: Vehicle, speed: float, frequency: Array
) -> dict[str, _Complex]:
    """Compute the linear model's response to steering by output, (k,); frequency in Hz."""
    model = make_bicycle_model(vehicle, speed)
    B = model.B[:, 0]
    turned = [np.linalg.solve(2j * np.pi * f * np.eye(2) - model.A, B) for f in frequency]
    beta, gamma = np.array(turned).T
    a_y = speed * (2j * np.pi * frequency * beta + gamma)
    return {"gamma": gamma, "a_y": a_y}


def _compute_linear_step(vehicle: Vehicle, speed: float, series: Series) -> dict[str, StepResponse]:
    """Compute the step's numbers of the linear model under the same steering by output."""
    from scipy.signal import lsim

    model = make_bicycle_model(vehicle, speed)
    A, B = model.A, model.B[:, :1]
    C = np.vstack([[0.0, 1.0], speed * (A[0] + [0.0, 1.0])])
    D = np.array([[0.0], [speed * B[0, 0]]])
    outputs = zip(OUTPUTS, lsim((A, B, C, D), series.steer, series.t)[1].T, strict=True)
    return {name: _compute_step_response(series.t, series.steer, y) for name, y in outputs}


def _compute_responses(series: Series) -> dict[str, StepResponse]:
    t, steer = series.t, series.steer
    return {name: _compute_step_response(t, steer, getattr(series, name)) for name in OUTPUTS}


def _run_sweep(drive: DriveFunction, car: TestCar, steer: float) -> dict[str, FrequencyResponse]:
    """Drive a sine from 0.05 to 2.5 Hz, and estimate the responses; steer: amplitude (rad)."""
    seconds = 100.0  # half a segment has passed when it comes to the standard's lowest frequency
    series = drive({
        "steering": "sweep", "amplitude": steer, "onset": ONSET, "frequency": 0.25 * LOWEST,
        "frequency_2": 1.25 * HIGHEST, "hold": seconds, "speed": car.speed,
        "duration": ONSET + seconds + 2.0,
    })  # fmt: skip
    t, steered = series.t, series.steer
    return {x: _estimate_frequency_response(t, steered, getattr(series, x)) for x in OUTPUTS}


@dataclass(frozen=True)
class Transient:
    """The responses of a car by output, measured and of the linear model."""

    step: dict[str, StepResponse]
    linear_step: dict[str, StepResponse]
    sweep: dict[str, FrequencyResponse]
    linear_sweep: dict[str, _Complex]


def run(drive: DriveFunction, car: TestCar) -> Transient:
    """Drive the step and the sweep.

    Args:
        drive: Function that drives the car through a scenario.
        car: Car under test, with speed and steering ratio.
    """
    vehicle, speed = car.vehicle, car.speed
    per = vehicle.wheelbase / speed**2 + car.understeer_gradient  # rad s2/m
    stepped = drive(_make_step(car, per * _STEP_AT))
    sweep = _run_sweep(drive, car, per * _SWEEP_AT)
    linear_step = _compute_linear_step(vehicle, speed, stepped)
    linear = _compute_linear_response(vehicle, speed, sweep[OUTPUTS[0]].frequency)
    return Transient(_compute_responses(stepped), linear_step, sweep, linear)
