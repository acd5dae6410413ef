"""The actuators: torque distribution, added steering, and first-order lags solved exactly."""

import math
from typing import TYPE_CHECKING, NamedTuple

from ..numerics.jit import jit
from ..numerics.primitives import Scalar, absolute, any_lane, maximum, minimum, select
from .tyres import MIN_SPEED

if TYPE_CHECKING:
    from .dynamics import CarParams


class Lag(NamedTuple):
    """Remaining fractions of a deviation from the command within a tick; all zero without lag."""

    start: Scalar  # 1, at the tick's start
    middle: Scalar
    end: Scalar
    mean: Scalar  # mean over the tick by Simpson's rule; the record has the inputs of this mean


def make_lag(time_constant: float, tick: float) -> Lag:
    """Compute a first-order lag's exact decay at start, middle and end of a tick, and its mean.

    Args:
        time_constant: Time constant of the lag (s); 0 for none.
        tick: Length of the tick (s).
    """
    if time_constant == 0.0:
        return Lag(0.0, 0.0, 0.0, 0.0)
    half = math.exp(-0.5 * tick / time_constant)
    return Lag(1.0, half, half * half, (1.0 + 4.0 * half + half * half) / 6.0)


@jit
def apply_lag(command: Scalar, value: Scalar, rest: Scalar) -> Scalar:
    """Compute the actuator's value from what remains of its deviation from the command.

    Args:
        command: Commanded value.
        value: Value at the start of the tick, in the command's unit.
        rest: Fraction of the deviation that remains.
    """
    return command + (value - command) * rest


@jit
def compute_torque_limit(v_x: Scalar, car: "CarParams") -> Scalar:
    """Compute a motor's torque limit (N m), driving or braking: T_max, or P / |omega| if less."""
    max_torque = car.T_max
    if any_lane(car.P > 0.0):
        at_speed = car.P * car.r / maximum(absolute(v_x), MIN_SPEED)
        max_torque = select(car.P > 0.0, minimum(max_torque, at_speed), max_torque)
    return max_torque


@jit
def allocate_torques(
    N_z: Scalar, a_x: Scalar, car: "CarParams", yaw_first: Scalar, max_torque: Scalar
) -> tuple[Scalar, Scalar]:
    """Compute torques (T_l, T_r) (N m) of yaw moment and acceleration: tie-vision (3) in ISO axes.

    A positive yaw moment drives the right wheel.

    Args:
        N_z: Yaw moment (N m).
        a_x: Longitudinal acceleration (m/s2).
        car: `CarParams`.
        yaw_first: Where both pass the limit, 1 keeps the yaw moment and 0 the acceleration.
        max_torque: Torque limit of one motor (N m).
    """
    turn = minimum(maximum(car.r * N_z / car.d_r, 0.0 - max_torque), max_torque)
    drive = minimum(maximum(0.5 * car.m * car.r * a_x, 0.0 - max_torque), max_torque)
    drive_margin, turn_margin = max_torque - absolute(turn), max_torque - absolute(drive)
    limited_drive = minimum(maximum(drive, 0.0 - drive_margin), drive_margin)
    limited_turn = minimum(maximum(turn, 0.0 - turn_margin), turn_margin)
    drive = yaw_first * limited_drive + (1.0 - yaw_first) * drive
    turn = yaw_first * turn + (1.0 - yaw_first) * limited_turn
    return drive - turn, drive + turn  # tie-vision (3)


@jit
def limit_rate(value: Scalar, command: Scalar, max_change: Scalar) -> Scalar:
    """Move a value towards a command by at most `max_change`.

    Args:
        value: Present value.
        command: Wanted value.
        max_change: Largest change, in the unit of both.
    """
    return value + minimum(maximum(command - value, 0.0 - max_change), max_change)


@jit
def limit_angle(added: Scalar, driver: Scalar, stop: Scalar) -> Scalar:
    """Limit an added steering angle (rad) so that the sum with the driver's stays within the stop.

    Where the driver's angle alone is beyond the stop, nothing is added to that side.

    Args:
        added: Added steering angle (rad).
        driver: The driver's angle (rad).
        stop: Largest angle of the sum (rad).
    """
    return minimum(maximum(added, minimum(0.0 - stop - driver, 0.0)), maximum(stop - driver, 0.0))


@jit
def compute_yaw_moment(T_l: Scalar, T_r: Scalar, car: "CarParams") -> Scalar:
    """Compute the yaw moment N_z (N m) of two motor torques."""
    return 0.5 * car.d_r / car.r * (car.k_r * T_r - car.k_l * T_l)
