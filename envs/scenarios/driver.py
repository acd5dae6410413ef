"""The driver's steering and speed, and the side wind; compiled.

A steering profile gives the angle at a tick from numbers that are drawn at reset. A driver who
steers by preview does it by MacAdam's optimal preview control (IEEE Trans. SMC 11, 1981) with one
preview point: the lateral acceleration that brings the car onto the path within the preview time T,
2 (y_path(t + T) - y - T y') / T^2; at gain 1 the loop has 1.41/T rad/s and damping 0.71. The angle
is the nominal car's for it in the steady state, behind a first-order lag and a rate limit.
"""

from typing import TYPE_CHECKING, NamedTuple

from ..numerics.functions import FOREVER, PI, TICK, exp, round_to_ticks, sincos, smoothstep
from ..numerics.jit import inline, jit
from ..numerics.packed import load_element
from ..numerics.primitives import Scalar, Vector, any_lane, floor, maximum, minimum, select, sqrt
from ..vehicle.actuators import apply_lag, limit_rate
from ..vehicle.dynamics import Motion, RoadParams, compute_curvature
from ..vehicle.tyres import MIN_SPEED
from .road import TrackPath, compute_path_offset
from .world import Draws

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
# places in a profile: a sine has amplitude, rad/s, phase, from, to, a step angle, from, rise
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
    """Compute the driver's steering command at a tick: the angle at the wheels (rad).

    The profile is an array: a tuple goes through memory in every call.
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
    """Interpolate a recorded trace at a tick, linearly: the angle at the wheels (rad).

    Args:
        tick: Tick since the start of the episode.
        trace: Ticks from sample to sample, the samples (rad), and the last one again.
    """
    position = minimum(tick / trace[0], len(trace) - 2.0)
    k = int(minimum(floor(position), len(trace) - 3.0))
    return trace[k + 1] + (position - k) * (trace[k + 2] - trace[k + 1])


@jit
def compute_wander_gains(amplitude: Scalar, hertz: Scalar, hold: Scalar) -> tuple[Scalar, Scalar]:
    """Compute decay, and noise gain (rad), of a wandering driver's angle over one hold.

    The next angle is decay times the last one plus noise gain times a standard normal number.

    Args:
        amplitude: Standard deviation of the angle (rad).
        hertz: Corner frequency (Hz).
        hold: Time from one angle to the next (s).
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
    """
    for i in range(STEERING_WIDTH):
        profile[i] = 0.0
    for i in range(STEPS):
        _write_step(profile, i, 0.0, 0.0, 1.0)
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
    """Write the gentle steering before a manoeuvre: two sines."""
    k, seconds, v = _LEAD_START, length * TICK, maximum(speed, 1.0)
    gain = maximum(1.0 + target.G * v * v, MIN_STEER_FACTOR) / (target.per_l * v * v)
    profile[k], profile[k + 3] = _LEAD_ACCELERATION * gain, length
    for i in range(2):
        waves = maximum(floor(_LEAD_FREQUENCIES[i] * seconds + 0.5), 1.0)
        profile[k + 1 + i] = 2.0 * PI * waves / length


_MIN_PREVIEW = 1.0  # wheelbases: a driver looks no nearer


class DriverParams(NamedTuple):
    """Parameters of a driver who steers by preview."""

    preview: Scalar  # s, T
    gain: Scalar
    rest: Scalar  # what a tick leaves of a deviation from the wanted angle
    slew: Scalar  # rad a tick, at the wheels


@jit
def compute_target_angle(
    motion: Motion, path: TrackPath, road: RoadParams, target: "ReferenceParams",
    driver: DriverParams, stop: Scalar,
) -> Scalar:  # fmt: skip
    """Compute the steering angle (rad) that brings the car onto the path, within +-stop."""
    v = motion.v_x
    distance = maximum(driver.preview * v, _MIN_PREVIEW / target.per_l)
    sin_r, cos_r = sincos(motion.psi - motion.theta)
    slope = (v * sin_r + motion.v_y * cos_r) / maximum(v, MIN_SPEED)
    # the double integral of the curvature, exact on a clothoid too
    bend = 0.5 * distance * distance * compute_curvature(road, motion.s + distance * (1.0 / 3.0))
    # how far the path lies to the left of the car's course at the preview distance
    error = compute_path_offset(path, motion.s + distance) + bend - motion.y - distance * slope
    curvature = driver.gain * 2.0 * error / (distance * distance)
    angle = curvature * maximum(1.0 + target.G * v * v, MIN_STEER_FACTOR) / target.per_l
    return minimum(maximum(angle, 0.0 - stop), stop)


@jit
def compute_driver_angle(
    angle: Scalar, motion: Motion, path: TrackPath, road: RoadParams, target: "ReferenceParams",
    driver: DriverParams, stop: Scalar,
) -> Scalar:  # fmt: skip
    """Compute the driver's steering angle (rad) a tick later."""
    target_angle = compute_target_angle(motion, path, road, target, driver, stop)
    return limit_rate(angle, apply_lag(target_angle, angle, driver.rest), driver.slew)


class SpeedProfile(NamedTuple):
    """The driver's speed, held or followed by PI control, or an acceleration."""

    speed: Scalar  # m/s, at the start and to hold
    hold: Scalar  # 1 hold the speed that `acceleration` and `surge` make of it; 0 apply them alone
    acceleration: Scalar  # m/s2, from start to end
    start: Scalar  # tick
    end: Scalar
    k_p: Scalar  # 1/s
    k_i: Scalar  # 1/s2
    surge: Scalar = 0.0  # m/s2, amplitude of a sine
    surge_rate: Scalar = 1.0  # rad/s


@inline
def compute_speed_reference(tick: Scalar, profile: SpeedProfile) -> tuple[Scalar, Scalar]:
    """Compute the speed (m/s) and the acceleration (m/s2) that the driver wants at a tick."""
    acceleration = select((tick >= profile.start) & (tick < profile.end), profile.acceleration, 0.0)
    elapsed = (minimum(maximum(tick, profile.start), profile.end) - profile.start) * TICK
    speed = profile.speed + profile.acceleration * elapsed
    if any_lane(profile.surge != 0.0):
        s, c = sincos(profile.surge_rate * (tick * TICK))
        acceleration = acceleration + profile.surge * s
        speed = speed + profile.surge / profile.surge_rate * (1.0 - c)
    return speed, acceleration


@inline
def compute_acceleration_command(
    tick: Scalar, v_x: Scalar, integral: Scalar, profile: SpeedProfile, limit: Scalar
) -> tuple[Scalar, Scalar]:
    """Compute the driver's acceleration command and its next integral part (m/s2): PI on the speed.

    The integral part is held at the limit. A profile that does not hold its speed gives the wanted
    acceleration alone.

    Args:
        tick: Tick since the start of the episode.
        v_x: Speed (m/s).
        integral: Integral part of the command (m/s2).
        profile: `SpeedProfile`.
        limit: Largest acceleration of the motors (m/s2).
    """
    speed, feedforward = compute_speed_reference(tick, profile)
    error = speed - v_x
    command = profile.k_p * error + integral + profile.hold * feedforward
    limited = minimum(maximum(command, 0.0 - limit), limit)
    next_integral = integral + profile.k_i * error * TICK
    integral = select(command == limited, next_integral, integral)
    return profile.hold * limited + (1.0 - profile.hold) * feedforward, integral


class Wind(NamedTuple):
    """A side wind between two ticks."""

    force: Scalar  # N, to the left
    arm: Scalar  # m, ahead of the centre of gravity
    start: Scalar
    end: Scalar
    height: Scalar = 0.0  # m, above the roll axis


@jit
def compute_wind(tick: Scalar, wind: Wind) -> tuple[Scalar, Scalar, Scalar]:
    """Compute force (N), yaw and roll moment (N m) of the wind from this tick to the next."""
    force = select((tick >= wind.start) & (tick < wind.end), wind.force, 0.0)
    return force, force * wind.arm, 0.0 - force * wind.height
