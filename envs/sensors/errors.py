"""Errors of the sensors that a `World` draws: what calibration leaves, and what is coloured."""

import math
from typing import NamedTuple

from ..numerics.functions import compute_sine
from ..numerics.jit import inline
from ..numerics.primitives import Scalar, Vector
from ..ticks import TICK
from ..vehicle.actuators import apply_lag
from ..vehicle.dynamics import Motion

CAMERA_HEIGHT = 1.3  # m above the road, behind the mirror
_VIBRATION_TIME = 0.03  # s, correlation time of a_y's vibration: 5 Hz
_VIBRATION_REST = math.exp(-TICK / _VIBRATION_TIME)  # what a tick leaves of it
_VIBRATION_GAIN = math.sqrt(1.0 - _VIBRATION_REST * _VIBRATION_REST)


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
