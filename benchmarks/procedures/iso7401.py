"""ISO 7401: lateral transient response, by a step of the steering angle and by a swept sine.

Step: times count from where the steering angle passes half its end value; the response time is
that to 90 % of the steady state, the peak response time that to the peak, the overshoot the peak
over the steady state less one.

Swept sine: the frequency response is S_xy / S_xx of Welch's averaged periodograms (H1), with the
coherence and from it the standard deviation of the estimate, |H| sqrt((1 - c) / (2 c n)) over n
segments (Bendat and Piersol, Random Data, 9.2). It is held against the linear model's
C (j w I - A)^-1 B + D, where a_y = V (beta' + gamma).
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...envs.vehicle.linear import make_bicycle_model
from ...envs.vehicle.parameters import Vehicle
from .drive import DriveFunction, Fields, Series, TestCar

Complex = npt.NDArray[np.complex128]

ONSET = 1.0  # s
LOWEST, HIGHEST = 0.2, 2.0  # Hz
SEGMENT = 10.0  # s, of the averaged periodograms
OUTPUTS = ("gamma", "a_y")


@dataclass(frozen=True)
class StepResponse:
    """gain: steady state per rad of steering. response_time, peak_time: s. overshoot: a share."""

    gain: float
    response_time: float
    peak_time: float
    overshoot: float


@dataclass(frozen=True)
class FrequencyResponse:
    """(k,) each: frequency in Hz, H (per rad of steering), coherence, sd of H (one part of it)."""

    frequency: Array
    H: Complex
    coherence: Array
    sd: Array


def make_step(car: TestCar, steer: float, seconds: float = 4.0) -> Fields:
    """A step of the steering angle (rad) that is held."""
    return {
        "steering": "held-step",
        "amplitude": steer,
        "onset": ONSET,
        "speed": car.speed,
        "duration": ONSET + seconds,
    }


def make_sweep(car: TestCar, steer: float, seconds: float = 100.0) -> Fields:
    """A sine of an amplitude (rad) whose frequency rises from 0.05 to 2.5 Hz.

    It has passed half a segment when it comes to the lowest frequency of the standard.
    """
    return {
        "steering": "sweep",
        "amplitude": steer,
        "onset": ONSET,
        "frequency": 0.25 * LOWEST,
        "frequency_2": 1.25 * HIGHEST,
        "hold": seconds,
        "speed": car.speed,
        "duration": ONSET + seconds + 2.0,
    }


def compute_step_response(t: Array, steer: Array, output: Array) -> StepResponse:
    """The standard's numbers of a step that is held to the end; t, steer, output: (n,).

    The steady state is the mean of the last half second. Raises ValueError without a step.
    """
    end = float(steer[-1])
    if end == 0.0:
        raise ValueError("a step response needs a steering angle at its end, got 0")
    steady = float(np.mean(output[t >= t[-1] - 0.5]))
    share = output / steady
    start = _find_crossing(t, steer / end, 0.5)
    peak = int(np.argmax(share))
    return StepResponse(
        steady / end,
        _find_crossing(t, share, 0.9) - start,
        float(t[peak]) - start,
        max(0.0, float(share[peak]) - 1.0),
    )


def _find_crossing(t: Array, values: Array, level: float) -> float:
    """When the values first pass the level, on the line between two samples."""
    k = int(np.argmax(values >= level))
    if k == 0:
        return float(t[0]) if values[0] >= level else math.nan
    part = (level - values[k - 1]) / (values[k] - values[k - 1])
    return float(t[k - 1] + part * (t[k] - t[k - 1]))


def estimate_frequency_response(
    t: Array, steer: Array, output: Array, segment: float = SEGMENT
) -> FrequencyResponse:
    """The frequency response of output to steering between 0.2 and 2 Hz; t, steer, output: (n,)."""
    from scipy.signal import csd, welch

    rate = (len(t) - 1) / float(t[-1] - t[0])
    length = round(segment * rate)
    if length > len(t):
        raise ValueError(f"a segment of {segment} s is longer than the {t[-1] - t[0]:.1f} s driven")
    options = {"fs": rate, "nperseg": length, "detrend": False}
    frequency, S_xx = welch(steer, **options)
    S_yy, S_xy = welch(output, **options)[1], csd(steer, output, **options)[1]
    half = 0.5 / segment  # between two lines: rounding decides nothing
    in_range = (frequency > LOWEST - half) & (frequency < HIGHEST + half)
    H = (S_xy / S_xx)[in_range]
    coherence = (np.abs(S_xy) ** 2 / (S_xx * S_yy))[in_range]
    segments = 2 * len(t) // length - 1  # they overlap by half
    sd = np.abs(H) * np.sqrt((1.0 - coherence) / (2.0 * coherence * segments))
    return FrequencyResponse(frequency[in_range], H, coherence, sd)


def compute_linear_response(vehicle: Vehicle, speed: float, frequency: Array) -> dict[str, Complex]:
    """(k,) of the linear model's yaw rate and lateral acceleration to steering, by output."""
    model = make_bicycle_model(vehicle, speed)
    B = model.B[:, 0]
    turned = [np.linalg.solve(2j * np.pi * f * np.eye(2) - model.A, B) for f in frequency]
    beta, gamma = np.array(turned).T
    a_y = speed * (2j * np.pi * frequency * beta + gamma)
    return {"gamma": gamma, "a_y": a_y}


def compute_linear_step(vehicle: Vehicle, speed: float, series: Series) -> dict[str, StepResponse]:
    """The numbers of the linear model under the same steering, by output."""
    from scipy.signal import lsim

    model = make_bicycle_model(vehicle, speed)
    A, B = model.A, model.B[:, :1]
    C = np.vstack([[0.0, 1.0], speed * (A[0] + [0.0, 1.0])])
    D = np.array([[0.0], [speed * B[0, 0]]])
    outputs = lsim((A, B, C, D), series.steer, series.t)[1]
    return {
        name: compute_step_response(series.t, series.steer, outputs[:, i])
        for i, name in enumerate(OUTPUTS)
    }


def compute_responses(series: Series) -> dict[str, StepResponse]:
    """The numbers of yaw rate and lateral acceleration after a step."""
    return {
        name: compute_step_response(series.t, series.steer, getattr(series, name))
        for name in OUTPUTS
    }


def run_sweep(drive: DriveFunction, car: TestCar, steer: float) -> dict[str, FrequencyResponse]:
    """The frequency responses of yaw rate and lateral acceleration."""
    series = drive(make_sweep(car, steer))
    return {
        name: estimate_frequency_response(series.t, series.steer, getattr(series, name))
        for name in OUTPUTS
    }
