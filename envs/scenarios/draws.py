"""Random draws of an episode: ranges, numbers drawn from them, and redraws of unstable cars."""

from typing import NamedTuple

from ..numerics.functions import CHANNELS, draw_uniforms
from ..numerics.jit import jit
from ..numerics.packed import make_offsets, read
from ..numerics.primitives import Scalar, Vector, select
from ..vehicle.dynamics import CarParams

_ATTEMPTS = 64


class Draws(NamedTuple):
    """The quantities that a scenario gives as a number or a range."""

    speed: Scalar  # m/s
    friction: Scalar
    front_stiffness: Scalar  # factor on the vehicle's
    rear_stiffness: Scalar
    onset: Scalar  # s
    amplitude: Scalar  # rad
    amplitude_2: Scalar  # rad, of the second pair of a random steering
    frequency: Scalar  # Hz
    frequency_2: Scalar
    frequency_3: Scalar
    frequency_4: Scalar
    hold: Scalar  # s, of a step, a dwell, a ramp, a sweep; from one lane change to the next
    wind_force: Scalar  # N
    wind_arm: Scalar  # m, ahead of the centre of gravity
    wind_start: Scalar  # s
    wind_length: Scalar  # s
    side: Scalar  # uniform in (0, 1): below a half the steering is mirrored
    wind_side: Scalar
    curvature: Scalar  # 1/m, of the road
    path_speed: Scalar  # m/s at which a track has its standard's lengths; 0 always
    friction_right: Scalar  # 0 as on the left
    tyre_change_time: Scalar  # s; 0 never
    front_change: Scalar  # factors on the stiffness from then on
    rear_change: Scalar
    gyro_bias: Scalar  # rad/s
    accel_y_bias: Scalar  # m/s2
    gps_latency: Scalar  # s, on top of the GPS's delays
    bank: Scalar  # rad
    initial_beta: Scalar  # rad, where the episode begins
    initial_gamma: Scalar  # rad/s
    # from here on the ranges of a `World`, in its order
    camera_yaw: Scalar  # rad
    camera_pitch: Scalar  # rad
    camera_height: Scalar
    steer_offset: Scalar  # rad
    steer_scale: Scalar
    wheel_scale: Scalar
    wheel_left: Scalar
    torque_scale: Scalar
    torque_left: Scalar
    torque_rate: Scalar  # 1/s
    gyro_scale: Scalar
    gyro_drift: Scalar  # rad/s2
    accel_scale: Scalar
    accel_roll: Scalar  # rad
    accel_ahead: Scalar  # m
    vibration: Scalar  # m/s2
    course_error: Scalar  # rad m/s
    course_period: Scalar  # s
    gps_stamp: Scalar  # s
    map_error: Scalar  # 1/m
    map_length: Scalar  # m
    map_lag: Scalar  # s
    load: Scalar
    inertia: Scalar
    gravity_shift: Scalar
    bank_wave: Scalar  # rad
    bank_length: Scalar  # m
    gust: Scalar  # m/s2
    friction_wave: Scalar
    friction_length: Scalar  # m
    friction_across: Scalar
    relaxation: Scalar
    phase: Scalar  # uniform in (0, 1): where the waves of a world begin
    friction_change: Scalar  # factor on the friction from the tyres' change on
    critical_speed: Scalar  # least critical speed of a drawn car, over its speed


DRAWS, DRAWS_WIDTH = make_offsets(Draws)


@jit
def _draw_numbers(
    low: Vector, high: Vector, key_low: int, key_high: int, attempt: int, out: Vector
) -> None:
    """Draw uniform numbers in [low, high] into out (len(Draws),); equal ends keep their bits."""
    u = draw_uniforms(key_low, key_high, attempt, CHANNELS.scenario, 0)
    for i in range(len(out)):
        if i % 4 == 0:
            u = draw_uniforms(key_low, key_high, attempt, CHANNELS.scenario, i // 4)
        out[i] = low[i] + (high[i] - low[i]) * u[i % 4]


@jit
def draw_car(d: Draws, car: CarParams) -> CarParams:
    """Load a car and draw its tyres.

    Args:
        d: `Draws`.
        car: `CarParams` of the vehicle.

    Returns:
        `CarParams` with the load, which rolls with the body, and the drawn stiffness.
    """
    laden, shift = 1.0 + d.load, d.gravity_shift * (car.l_f + car.l_r)
    drawn = (
        car.m * laden, car.I * laden * d.inertia, car.l_f + shift, car.l_r - shift,
        car.C_f * d.front_stiffness, car.C_r * d.rear_stiffness,
    )  # fmt: skip
    body = (car.S * laden, car.I_x * laden)  # fields 12 and 13
    return CarParams(*(drawn + car[6:12] + body + car[14:]))


@jit
def _is_stable(d: Draws, car: CarParams) -> Scalar:
    """Check whether the drawn car is stable, before its tyres change and after."""
    drawn = draw_car(d, car)
    has_change = d.tyre_change_time > 0.0
    later_f = drawn.C_f * select(has_change, d.front_change, 1.0)
    later_r = drawn.C_r * select(has_change, d.rear_change, 1.0)
    speed = d.critical_speed * d.speed
    is_stable_later = _is_below_critical(later_f, later_r, speed, drawn)
    return _is_below_critical(drawn.C_f, drawn.C_r, speed, drawn) & is_stable_later


@jit
def _is_below_critical(C_f: Scalar, C_r: Scalar, speed: Scalar, car: CarParams) -> Scalar:
    """Check whether a speed (m/s) is below the critical speed of linear tyres."""
    excess = C_f * car.l_f - C_r * car.l_r
    l, v = car.l_f + car.l_r, speed  # noqa: E741
    return car.m * v * v * excess < 2.0 * C_f * C_r * l * l


@jit
def draw_stable(
    low: Vector, high: Vector, key_low: int, key_high: int, car: CarParams, out: Vector
) -> tuple[Draws, int]:
    """Draw until the vehicle is stable, at most 64 times.

    Args:
        low: Lower ends, shape (len(Draws),).
        high: Upper ends, shape (len(Draws),).
        key_low: Lower 32 bits of the episode's key.
        key_high: Upper 32 bits of the episode's key.
        car: `CarParams`.
        out: Array for the draws, shape (len(Draws),).

    Returns:
        The `Draws`, and the number of draws that were rejected.
    """
    attempt = 0
    _draw_numbers(low, high, key_low, key_high, attempt, out)
    while attempt + 1 < _ATTEMPTS and not _is_stable(read(out, DRAWS), car):
        attempt += 1
        _draw_numbers(low, high, key_low, key_high, attempt, out)
    return read(out, DRAWS), attempt


Range = float | tuple[float, float]
"""A number, or the (low, high) that the seed draws from uniformly."""

KMH = 1.0 / 3.6


def get_range(value: Range | None) -> tuple[float, float]:
    """Get the ends of a drawn quantity; zeros for None.

    Args:
        value: A number, a range or None.

    Returns:
        (low, high), equal for a number.
    """
    low, high = value if isinstance(value, tuple) else (value or 0.0, value or 0.0)
    return float(low), float(high)
