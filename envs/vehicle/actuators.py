"""Torque distribution, added steering, and first-order lags solved exactly."""

import math
from typing import Any, NamedTuple

from ..backend.decorators import jit
from ..backend.primitives import absolute, any_lane, maximum, minimum, select
from .tyres import MIN_SPEED


class Lag(NamedTuple):
    """What is left of a deviation from the command within one tick; all zero without lag."""

    start: Any
    middle: Any
    end: Any
    mean: Any  # Simpson's mean over the tick, which the record carries


def make_lag(time_constant: float, tick: float) -> Lag:
    """The exact decay of a first-order lag at the start, middle and end of a tick (seconds)."""
    if time_constant == 0.0:
        return Lag(0.0, 0.0, 0.0, 0.0)
    half = math.exp(-0.5 * tick / time_constant)
    return Lag(1.0, half, half * half, (1.0 + 4.0 * half + half * half) / 6.0)


@jit
def apply_lag(command: Any, value: Any, rest: Any) -> Any:
    """The actuator's value once `rest` of its deviation from the command is left."""
    return command + (value - command) * rest


@jit
def compute_torque_limit(v_x: Any, car: Any) -> Any:
    """N m that a motor can give at a speed, driving or braking: T_max, and P / |omega| of a wheel
    that rolls at v_x."""
    max_torque = car.T_max
    if any_lane(car.P > 0.0):
        at_speed = car.P * car.r / maximum(absolute(v_x), MIN_SPEED)
        max_torque = select(car.P > 0.0, minimum(max_torque, at_speed), max_torque)
    return max_torque


@jit
def allocate_torques(N_z: Any, a_x: Any, car: Any, yaw_first: Any, max_torque: Any) -> Any:
    """(T_l, T_r) in N m for a yaw moment and an acceleration: tie-vision (3) in ISO axes.

    A positive yaw moment drives the right wheel. Where both together pass `max_torque`, what a
    motor gives, the yaw moment keeps its share if `yaw_first` is 1, the acceleration if it is 0.
    """
    turn = minimum(maximum(car.r * N_z / car.d_r, 0.0 - max_torque), max_torque)
    drive = minimum(maximum(0.5 * car.m * car.r * a_x, 0.0 - max_torque), max_torque)
    drive_margin = max_torque - absolute(turn)
    turn_margin = max_torque - absolute(drive)
    limited_drive = minimum(maximum(drive, 0.0 - drive_margin), drive_margin)
    limited_turn = minimum(maximum(turn, 0.0 - turn_margin), turn_margin)
    drive = yaw_first * limited_drive + (1.0 - yaw_first) * drive
    turn = yaw_first * turn + (1.0 - yaw_first) * limited_turn
    return drive - turn, drive + turn  # tie-vision (3)


@jit
def limit_rate(value: Any, command: Any, max_change: Any) -> Any:
    """The value moved towards the wanted one by at most `max_change`."""
    return value + minimum(maximum(command - value, 0.0 - max_change), max_change)


@jit
def limit_angle(added: Any, driver: Any, stop: Any) -> Any:
    """The part of an added steering angle (rad) that leaves the sum with the driver's in the stop.

    Where the driver's alone is beyond it, nothing is added to that side.
    """
    return minimum(maximum(added, minimum(0.0 - stop - driver, 0.0)), maximum(stop - driver, 0.0))


@jit
def compute_yaw_moment(T_l: Any, T_r: Any, car: Any) -> Any:
    """N_z in N m that two motor torques produce."""
    return 0.5 * car.d_r / car.r * (T_r - T_l)
