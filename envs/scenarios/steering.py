"""Steering profiles: the driver's angle at a tick, from numbers drawn at reset; compiled."""

from typing import TYPE_CHECKING

from ..numerics.functions import PI, exp, sincos, smoothstep
from ..numerics.jit import jit
from ..numerics.packed import load_element
from ..numerics.primitives import Scalar, Vector, any_lane, floor, maximum, minimum, select, sqrt
from ..ticks import FOREVER, TICK, round_to_ticks
from .draws import Draws

if TYPE_CHECKING:
    from ..task import ReferenceParams

(
    STRAIGHT, SINE, SLALOM, LANE_CHANGE, STEP, RANDOM, DOUBLE_LANE_CHANGE, SINE_WITH_DWELL, RAMP,
    SWEEP, HELD_STEP, DRIVER, TRACE, WANDER,
) = range(14)  # fmt: skip
STEERING_KINDS = (
    "straight", "sine", "slalom", "lane-change", "step", "random", "double-lane-change",
    "sine-with-dwell", "ramp", "sweep", "held-step", "driver", "trace", "wander",
)  # fmt: skip
SINES, STEPS = 4, 3
_RAMP_START = 5 * SINES + 3 * STEPS
_SWEEP_START = _RAMP_START + 3
WANDER_START = _SWEEP_START + 5
_LEAD_START = WANDER_START + 3
STEERING_WIDTH = _LEAD_START + 4
_RISE = 0.2  # s, of a step
MIN_STEER_FACTOR = 0.2  # of 1 + G v^2, dakf-stability (23): at an oversteering car's limit it is 0


@jit
def compute_steering(tick: Scalar, profile: Vector) -> Scalar:
    """Compute the driver's steering command at a tick.

    The profile is an array: a tuple goes through memory in every call.

    Args:
        tick: Tick since the start of the episode.
        profile: Array that begins with the STEERING_WIDTH numbers of `write_steering`.

    Returns:
        Angle at the wheels (rad).
    """
    angle = 0.0
    for i in range(SINES):
        start = load_element(profile, 5 * i + 3)
        turned = load_element(profile, 5 * i + 1) * ((tick - start) * TICK)
        s, _ = sincos(turned + load_element(profile, 5 * i + 2))
        is_active = (tick >= start) & (tick < load_element(profile, 5 * i + 4))
        angle = angle + select(is_active, load_element(profile, 5 * i) * s, 0.0)
    for i in range(STEPS):
        k = 5 * SINES + 3 * i
        progress = (tick - load_element(profile, k + 1)) / load_element(profile, k + 2)
        angle = angle + load_element(profile, k) * smoothstep(progress)
    k = _RAMP_START
    is_used = load_element(profile, k) != 0.0
    if any_lane(is_used):
        rise = select(is_used, load_element(profile, k + 2), 1.0)
        share = (tick - load_element(profile, k + 1)) / rise
        angle = angle + load_element(profile, k) * minimum(maximum(share, 0.0), 1.0)
    k = _SWEEP_START
    is_used = load_element(profile, k) != 0.0
    if any_lane(is_used):
        t = maximum(tick - load_element(profile, k + 3), 0.0) * TICK
        sweep_time = minimum(t, load_element(profile, k + 4))
        length = select(is_used, load_element(profile, k + 4), 1.0)
        chirp = 0.5 * sweep_time * sweep_time / length + (t - sweep_time)
        phase = load_element(profile, k + 1) * t + load_element(profile, k + 2) * chirp
        angle = angle + load_element(profile, k) * sincos(phase)[0]
    k = _LEAD_START
    if any_lane(load_element(profile, k) != 0.0):
        first, _ = sincos(load_element(profile, k + 1) * tick)
        second, _ = sincos(load_element(profile, k + 2) * tick)
        lead = load_element(profile, k) * (first + second)
        angle = angle + select(tick < load_element(profile, k + 3), lead, 0.0)
    return angle


@jit
def interpolate_trace(tick: Scalar, trace: Vector) -> Scalar:
    """Interpolate a recorded trace at a tick, linearly between its samples.

    Args:
        tick: Tick since the start of the episode.
        trace: Ticks from sample to sample, the samples (rad), and the last one again.

    Returns:
        Angle at the wheels (rad).
    """
    position = minimum(tick / trace[0], len(trace) - 2.0)
    k = int(minimum(floor(position), len(trace) - 3.0))
    return trace[k + 1] + (position - k) * (trace[k + 2] - trace[k + 1])


@jit
def compute_wander_gains(amplitude: Scalar, hertz: Scalar, hold: Scalar) -> tuple[Scalar, Scalar]:
    """Compute decay and noise gain of a wandering driver's angle over one hold.

    The next angle is decay times the last one plus noise gain times a standard normal number.

    Args:
        amplitude: Standard deviation of the angle (rad).
        hertz: Corner frequency (Hz).
        hold: Time from one angle to the next (s).

    Returns:
        Decay, and noise gain (rad).
    """
    decay = exp(maximum(-2.0 * PI * hertz * hold, -7.5))  # where `exp` ends
    return decay, amplitude * sqrt(1.0 - decay * decay)


@jit
def _write_sine(
    profile: Vector, i: int, amplitude: Scalar, hertz: Scalar, start: Scalar, end: Scalar
) -> None:
    """Write sine i (rad) between two ticks, with phase 0 at its start."""
    k = 5 * i
    profile[k], profile[k + 1], profile[k + 2] = amplitude, 2.0 * PI * hertz, 0.0
    profile[k + 3], profile[k + 4] = start, end


@jit
def _write_step(profile: Vector, i: int, amplitude: Scalar, start: Scalar, rise: Scalar) -> None:
    """Write smooth step i (rad), which rises for some ticks from its start."""
    k = 5 * SINES + 3 * i
    profile[k], profile[k + 1], profile[k + 2] = amplitude, start, rise


@jit
def _write_dwell(profile: Vector, a: Scalar, hertz: Scalar, start: Scalar, dwell: Scalar) -> None:
    """Write three quarters of a sine, its peak held for some ticks, and the last quarter."""
    peak, last = start + round_to_ticks(0.75 / hertz), start + round_to_ticks(1.0 / hertz)
    _write_sine(profile, 0, a, hertz, start, peak)
    _write_sine(profile, 1, -a, 0.0, peak, peak + dwell)
    profile[5 + 2] = 0.5 * PI
    _write_sine(profile, 2, a, hertz, peak + dwell, last + dwell)
    profile[10 + 2] = 2.0 * PI * hertz * ((peak - start) * TICK)


@jit
def write_steering(kind: int, d: Draws, profile: Vector) -> None:
    """Write the steering profile of a kind from drawn numbers.

    A driver's and a trace's is empty; a wandering driver's has `compute_wander_gains`. The slalom,
    lane changes, step and random steering keep the heading: the slalom starts with half a wave of
    half the amplitude, the step is followed by its mirror image, and random sines come in pairs
    whose heading angles cancel. The sine with dwell stays at its second peak for `hold`
    (FMVSS 126). The ramp rises within `hold`, the held step within 0.2 s, and both stay. The sweep
    goes from `frequency` to `frequency_2` within `hold`, evenly in Hz, and stays there.

    Args:
        kind: Index of the kind in `STEERING_KINDS`.
        d: `Draws`.
        profile: Array for the profile, at least STEERING_WIDTH long.
    """
    for i in range(SINES):
        _write_sine(profile, i, 0.0, 0.0, 0.0, 0.0)
    for i in range(STEPS):
        _write_step(profile, i, 0.0, 0.0, 1.0)
    for i in range(_RAMP_START, STEERING_WIDTH):
        profile[i] = 0.0
    a = select(d.side < 0.5, -d.amplitude, d.amplitude)
    start = round_to_ticks(d.onset)
    if kind == SINE:
        _write_sine(profile, 0, a, d.frequency, start, FOREVER)
    elif kind == LANE_CHANGE:
        _write_sine(profile, 0, a, d.frequency, start, start + round_to_ticks(1.0 / d.frequency))
    elif kind == DOUBLE_LANE_CHANGE:
        return_start, period = start + round_to_ticks(d.hold), round_to_ticks(1.0 / d.frequency)
        _write_sine(profile, 0, a, d.frequency, start, start + period)
        _write_sine(profile, 1, -a, d.frequency, return_start, return_start + period)
    elif kind == SLALOM:
        half = start + round_to_ticks(0.5 / d.frequency)
        _write_sine(profile, 0, 0.5 * a, d.frequency, start, half)
        _write_sine(profile, 1, -a, d.frequency, half, FOREVER)
    elif kind == STEP:
        length, rise = round_to_ticks(d.hold), round_to_ticks(_RISE)
        _write_step(profile, 0, a, start, rise)
        _write_step(profile, 1, -2.0 * a, start + length, rise)
        _write_step(profile, 2, a, start + 2.0 * length, rise)
    elif kind == RANDOM:
        second = select(d.side < 0.5, -d.amplitude_2, d.amplitude_2)
        _write_sine(profile, 0, a, d.frequency, start, FOREVER)
        fourth = -second * (d.frequency_4 / d.frequency_3)
        _write_sine(profile, 1, -a * (d.frequency_2 / d.frequency), d.frequency_2, start, FOREVER)
        _write_sine(profile, 2, second, d.frequency_3, start, FOREVER)
        _write_sine(profile, 3, fourth, d.frequency_4, start, FOREVER)
    elif kind == SINE_WITH_DWELL:
        _write_dwell(profile, a, d.frequency, start, round_to_ticks(d.hold))
    elif kind == RAMP:
        k = _RAMP_START
        profile[k], profile[k + 1], profile[k + 2] = a, start, round_to_ticks(d.hold)
    elif kind == SWEEP:
        k = _SWEEP_START
        profile[k], profile[k + 1] = a, 2.0 * PI * d.frequency
        profile[k + 2] = 2.0 * PI * (d.frequency_2 - d.frequency)
        profile[k + 3], profile[k + 4] = start, d.hold
    elif kind == HELD_STEP:
        _write_step(profile, 0, a, start, round_to_ticks(_RISE))
    elif kind == WANDER:
        decay, noise_gain = compute_wander_gains(d.amplitude, d.frequency, d.hold)
        k = WANDER_START
        profile[k], profile[k + 1], profile[k + 2] = decay, noise_gain, round_to_ticks(d.hold)


_LEAD_ACCELERATION = 0.5  # m/s2, about, of either sine
_LEAD_FREQUENCIES = 0.2, 0.35  # Hz, about: whole waves, so that heading and angle come back to zero


@jit
def write_gentle_steering(
    length: Scalar, speed: Scalar, target: "ReferenceParams", profile: Vector
) -> None:
    """Write the gentle steering before a manoeuvre: two sines.

    Args:
        length: Its length (ticks), positive.
        speed: Speed of the car (m/s).
        target: `ReferenceParams` of the nominal car.
        profile: Array of the profile, at least STEERING_WIDTH long.
    """
    k, seconds, v = _LEAD_START, length * TICK, maximum(speed, 1.0)
    gain = maximum(1.0 + target.G * v * v, MIN_STEER_FACTOR) / (target.per_l * v * v)
    profile[k], profile[k + 3] = _LEAD_ACCELERATION * gain, length
    for i in range(2):
        waves = maximum(floor(_LEAD_FREQUENCIES[i] * seconds + 0.5), 1.0)
        profile[k + 1 + i] = 2.0 * PI * waves / length
