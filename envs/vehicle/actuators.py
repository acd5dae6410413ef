"""Torque distribution, added steering, and first-order lags solved exactly."""

import math
from typing import Any, NamedTuple

from ..backend.decorators import jit
from ..backend.primitives import absolute, anywhere, maximum, minimum, select
from .tyres import SLOW


class Lag(NamedTuple):
    """What is left of a deviation from the command within one tick; all zero without lag."""

    start: Any
    middle: Any
    end: Any
    mean: Any  # Simpson's mean over the tick, which the record carries


def lag_of(time_constant: float, tick: float) -> Lag:
    """The exact decay of a first-order lag at the start, middle and end of a tick (seconds)."""
    if time_constant == 0.0:
        return Lag(0.0, 0.0, 0.0, 0.0)
    half = math.exp(-0.5 * tick / time_constant)
    return Lag(1.0, half, half * half, (1.0 + 4.0 * half + half * half) / 6.0)


@jit
def lagged(command: Any, value: Any, rest: Any) -> Any:
    """The actuator's value once `rest` of its deviation from the command is left."""
    return command + (value - command) * rest


@jit
def torque_limit(v_x: Any, car: Any) -> Any:
    """N m that a motor can give at a speed, driving or braking: T_max, and P / |omega| of a wheel
    that rolls at v_x."""
    most = car.T_max
    if anywhere(car.P > 0.0):
        at_speed = car.P * car.r / maximum(absolute(v_x), SLOW)
        most = select(car.P > 0.0, minimum(most, at_speed), most)
    return most


@jit
def distribute(N_z: Any, a_x: Any, car: Any, yaw_first: Any, most: Any) -> Any:
    """(T_l, T_r) in N m for a yaw moment and an acceleration: tie-vision (3) in ISO axes.

    A positive yaw moment drives the right wheel. Where both together pass `most`, what a motor
    gives, the yaw moment keeps its share if `yaw_first` is 1, the acceleration if it is 0.
    """
    turn = minimum(maximum(car.r * N_z / car.d_r, 0.0 - most), most)
    drive = minimum(maximum(0.5 * car.m * car.r * a_x, 0.0 - most), most)
    room_drive = most - absolute(turn)
    room_turn = most - absolute(drive)
    drive_kept = minimum(maximum(drive, 0.0 - room_drive), room_drive)
    turn_kept = minimum(maximum(turn, 0.0 - room_turn), room_turn)
    drive = yaw_first * drive_kept + (1.0 - yaw_first) * drive
    turn = yaw_first * turn + (1.0 - yaw_first) * turn_kept
    return drive - turn, drive + turn  # tie-vision (3)


@jit
def slewed(value: Any, wanted: Any, most: Any) -> Any:
    """The value moved towards the wanted one by at most `most`."""
    return value + minimum(maximum(wanted - value, 0.0 - most), most)


@jit
def within_stop(added: Any, driver: Any, stop: Any) -> Any:
    """The part of an added steering angle (rad) that leaves the sum with the driver's in the stop.

    Where the driver's alone is beyond it, nothing is added to that side.
    """
    return minimum(maximum(added, minimum(0.0 - stop - driver, 0.0)), maximum(stop - driver, 0.0))


@jit
def yaw_moment(T_l: Any, T_r: Any, car: Any) -> Any:
    """N_z in N m that two motor torques produce."""
    return 0.5 * car.d_r / car.r * (T_r - T_l)
