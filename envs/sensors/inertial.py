"""The fast sensors (gyro, accelerometers, roll rate, wheels), and noise and errors of all sensors.

Errors are what calibration leaves, and what is coloured; a `World` draws them.
"""

import math
from typing import NamedTuple

import numpy as np

from ..numerics.functions import TICK, compute_sine
from ..numerics.jit import inline
from ..numerics.primitives import Scalar, Vector, any_lane, select
from ..vehicle.actuators import apply_lag
from ..vehicle.dynamics import Motion, RoadParams, compute_gravity
from ..vehicle.parameters import GRAVITY

CAMERA_HEIGHT = 1.3  # m above the road, behind the mirror
_VIBRATION_TIME = 0.03  # s, correlation time of a_y's vibration: 5 Hz
_VIBRATION_REST = math.exp(-TICK / _VIBRATION_TIME)  # what a tick leaves of it
_VIBRATION_GAIN = math.sqrt(1.0 - _VIBRATION_REST * _VIBRATION_REST)


class Noise(NamedTuple):
    """Standard deviations and biases; the defaults are those of the project's simulations."""

    gyro: Scalar = 0.005  # rad/s
    gyro_bias: Scalar = 0.0
    accel: Scalar = 0.1  # m/s2, both axes
    accel_y_bias: Scalar = 0.0
    roll_rate: Scalar = 0.005  # rad/s
    wheel: Scalar = 0.02  # m/s
    camera_psi: Scalar = 3.5e-3  # rad
    camera_y: Scalar = 0.02  # m
    course: Scalar = 0.14 * np.pi / 180.0 * (60.0 / 3.6)  # rad m/s: 0.14 deg at 60 km/h, as 1 / V
    gps_speed: Scalar = 0.05  # m/s
    gps_position: Scalar = 0.5  # m


class NormalDraws(NamedTuple):
    """Random numbers of a tick, four standard normal ones each."""

    inertial: Vector  # gyro, accel_y, accel_x, roll rate
    wheels: Vector  # left and right wheel speed; lateral force and yaw moment that disturb
    vibration: Scalar  # of a_y


@inline
def compute_specific_force(
    before: Motion, after: Motion, road: RoadParams, small_angle: int, roll: int
) -> tuple[Scalar, Scalar]:
    """Compute the mean specific force (a_x, a_y) (m/s2) over a tick: v', turning axes, gravity.

    Args:
        before: `Motion` at the start of the tick.
        after: `Motion` at its end.
        road: `RoadParams`.
        small_angle: 1 for the small-angle plant, else 0.
        roll: 1 if the body rolls, else 0.
    """
    turn_x = 0.5 * (before.gamma * before.v_y + after.gamma * after.v_y)
    turn_y = 0.5 * (before.gamma * before.v_x + after.gamma * after.v_x)
    turns_x = (small_angle == 0) | (roll == 1)  # tie-vision holds v_x; double-layer-gps (4)
    a_x = (after.v_x - before.v_x) * (1.0 / TICK) - select(turns_x, turn_x, 0.0)
    a_y = (after.v_y - before.v_y) * (1.0 / TICK) + turn_y
    if roll:
        a_y = a_y + 0.5 * GRAVITY * (before.phi + after.phi)  # double-layer-gps (5)
    if any_lane((road.longitudinal != 0.0) | (road.lateral != 0.0) | (road.wave != 0.0)):
        first = compute_gravity(before, road, small_angle, 0.0)
        last = compute_gravity(after, road, small_angle, 0.0)
        a_x, a_y = a_x + 0.5 * (first[0] + last[0]), a_y + 0.5 * (first[1] + last[1])
    return a_x, a_y


@inline
def compute_fast_row(
    motion: Motion, accel: Vector, applied: Vector, d_f: Scalar, noise: Noise, draws: NormalDraws
) -> tuple[Scalar, ...]:
    """Compute the fast sensors' samples at a tick, columns as in `Fast`.

    Args:
        motion: `Motion` of the car.
        accel: Specific force (a_x, a_y) (m/s2).
        applied: Applied inputs and commands, in the order of `Fast` from `steer` on.
        d_f: Front track (m).
        noise: `Noise`.
        draws: `NormalDraws` of the tick.
    """
    n, wheels = draws.inertial, draws.wheels
    half = 0.5 * d_f * motion.gamma
    return (
        motion.gamma + noise.gyro_bias + noise.gyro * n[0],
        accel[1] + noise.accel_y_bias + noise.accel * n[1],
        accel[0] + noise.accel * n[2],
        motion.phi_dot + noise.roll_rate * n[3],
        motion.v_x - half + noise.wheel * wheels[0],
        motion.v_x + half + noise.wheel * wheels[1],
        applied[0], applied[1], applied[2], applied[3], applied[4], applied[5],
    )  # fmt: skip


class SensorErrors(NamedTuple):
    """Errors of one episode's sensors; those of an ideal one are 0, and 1 for scales."""

    camera_yaw: Scalar  # rad, to the left
    camera_pitch: Scalar  # rad, downwards
    camera_height: Scalar  # told over true, minus 1
    steer_offset: Scalar  # rad
    steer_scale: Scalar
    wheel_left: Scalar  # measured over true speed
    wheel_right: Scalar
    gyro_scale: Scalar
    gyro_drift: Scalar  # rad/s a tick
    accel_scale: Scalar
    accel_ahead: Scalar  # m, ahead of the centre of gravity
    vibration: Scalar  # m/s2, standard deviation
    course_error: Scalar  # rad m/s, amplitude
    course_rate: Scalar  # rad a tick
    course_phase: Scalar  # rad
    map_error: Scalar  # 1/m, amplitude
    map_rate: Scalar  # rad/m
    map_phase: Scalar  # rad
    map_rest: Scalar  # what a tick leaves of the curvature's lag


IDEAL_SENSORS = SensorErrors._make([0.0] * 4 + [1.0] * 4 + [0.0, 1.0] + [0.0] * 9)
"""No errors."""


class ErrorState(NamedTuple):
    """What errors carry from tick to tick."""

    vibration: Scalar  # m/s2, of a_y
    curvature: Scalar  # 1/m, as it is measured
    gyro: Scalar  # rad/s, drift of the gyro


@inline
def advance_errors(
    state: ErrorState, errors: SensorErrors, curvature: Scalar, s: Scalar, normal: Scalar
) -> ErrorState:
    """Advance the errors by a tick.

    Args:
        state: `ErrorState` of the tick before.
        errors: `SensorErrors`.
        curvature: True curvature of the road (1/m).
        s: Distance along the road (m).
        normal: Standard normal number.
    """
    wave = compute_sine(errors.map_rate * s + errors.map_phase)
    return ErrorState(
        _VIBRATION_REST * state.vibration + _VIBRATION_GAIN * errors.vibration * normal,
        apply_lag(curvature + errors.map_error * wave, state.curvature, errors.map_rest),
        state.gyro + errors.gyro_drift,
    )


@inline
def apply_sensor_errors(
    row: Vector, motion: Motion, accel: Vector, state: ErrorState, errors: SensorErrors
) -> tuple[Scalar, ...]:
    """Distort an ideal fast row.

    Torques stay: a motor's controller reports what it commands. The steering angle and the driver's
    are of one sensor.

    Args:
        row: Fast row, columns as in `Fast`.
        motion: True `Motion`.
        accel: True specific force (a_x, a_y) at the accelerometer (m/s2).
        state: `ErrorState` of the tick.
        errors: `SensorErrors`.
    """
    scale, offset, excess = errors.steer_scale, errors.steer_offset, errors.accel_scale - 1.0
    return (
        row[0] + (errors.gyro_scale - 1.0) * motion.gamma + state.gyro,
        row[1] + excess * accel[1] + state.vibration,
        row[2] + excess * accel[0],
        row[3], errors.wheel_left * row[4], errors.wheel_right * row[5],
        scale * row[6] + offset, row[7], row[8],
        scale * row[9] + offset, row[10], state.curvature,
    )  # fmt: skip
