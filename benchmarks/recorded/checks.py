"""What is wrong with a recorded drive: swapped columns, other units, a gyro at its limit."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label, uniform_filter1d

from ...envs.record import FAST, Array, Log
from ...envs.vehicle.vehicle import Vehicle
from .emulate import ground_speed

LEAST_RELATED = 0.5  # correlation, below which steering and yaw rate have nothing in common
FACTOR = 2.0  # by which steering may differ from what the yaw rate needs
_FAST_ENOUGH = 4.0  # m/s
_TURNING = 0.3  # m/s2 RMS, below which nothing is judged
_LONG = 5  # rows that a sensor stays at its largest value
_SMOOTH = 0.2  # s
_GUESSES = (  # a ratio of steering angles, and what it looks like from there on
    (300.0, "degrees of the steering wheel in a column of radians?"),
    (35.0, "degrees in a column of radians?"),
    (6.0, "the angle of the steering wheel?"),
    (0.05, "another unit or another car?"),
    (0.0, "radians in a column of degrees?"),
)


def moving(log: Log) -> npt.NDArray[np.bool_]:
    """The rows that are fast enough to judge."""
    return np.asarray(ground_speed(log) > _FAST_ENOUGH)


def _columns(logs: Sequence[Log], *names: str) -> list[Array]:
    """Smoothed columns of the rows that move, in all parts; "turning" is speed x yaw rate."""
    found: list[list[Array]] = [[] for _ in names]
    for log in logs:
        width = max(round(_SMOOTH / log.record.dt), 1)
        own = {name: log.record.fast[:, i] for name, i in FAST._asdict().items()}
        own |= {"speed": ground_speed(log), "turning": ground_speed(log) * own["gyro"]}
        for name, into in zip(names, found, strict=True):
            into.append(uniform_filter1d(own[name], width, mode="nearest")[moving(log)])
    return [np.concatenate(each) for each in found]


def _related(x: Array, y: Array) -> tuple[float, float]:
    """(slope of y by x through the means, correlation); zeros where one of them is constant."""
    x, y = x - x.mean(), y - y.mean()
    x2, y2, xy = float(x @ x), float(y @ y), float(x @ y)
    return (xy / x2, xy / math.sqrt(x2 * y2)) if x2 > 0.0 and y2 > 0.0 else (0.0, 0.0)


def steering_gain(logs: Sequence[Log], car: Vehicle) -> tuple[float, float]:
    """(gain, correlation): by how much the logged steering is to be multiplied to turn the car as
    its gyro shows, from steady turns of the linear car."""
    speed, gyro, steer = _columns(logs, "speed", "gyro", "steer")
    if len(speed) < 2:
        return 1.0, 0.0
    bend = car.rear_arm / car.front_stiffness - car.front_arm / car.rear_stiffness
    under = max(car.mass * bend / (2.0 * car.wheelbase), 0.0)
    return _related(steer, gyro * (car.wheelbase / speed + under * speed))


def saturated(log: Log) -> npt.NDArray[np.bool_]:
    """The rows in which the gyro stays at its largest value, of either sign."""
    gyro = log.record.fast[:, FAST.gyro]
    out = np.zeros(len(gyro), np.bool_)
    for limit in (gyro.max(), gyro.min()):
        runs, _ = label(gyro == limit)
        long = np.bincount(runs) >= _LONG
        long[0] = False
        out |= long[runs] & (abs(limit) > 0.05)
    return out


def swapped(logs: Sequence[Log]) -> str:
    """What columns seem to be swapped, "" for none that can be seen."""
    present = set.intersection(*(set(log.record.present) for log in logs))
    speed, turning, accel_y, accel_x, steer = _columns(
        logs, "speed", "turning", "accel_y", "accel_x", "steer"
    )
    if "accel_y" not in present or len(speed) < 2:
        return ""
    if max(np.std(turning), np.std(accel_y)) < _TURNING:
        return ""
    slope, fits = _related(turning, accel_y)
    instead, well = _related(speed * steer, accel_y)
    if not 0.5 < abs(slope) < 2.0 and 0.5 < abs(instead) < 2.0 and abs(well) > 0.8:
        return "steering and yaw rate: speed x steering is the lateral acceleration"
    across, well = _related(turning, accel_x)
    if "accel_x" in present and abs(fits) < 0.5 and abs(well) > 0.7 and 0.3 < abs(across) < 3.0:
        return "accel_x and accel_y: speed x yaw rate is in accel_x"
    return ""


def warnings_of(logs: Sequence[Log], car: Vehicle) -> list[str]:
    """What does not fit together in a drive, a sentence each."""
    found = [f"columns seem to be swapped, {what}"] if (what := swapped(logs)) else []
    if count := sum(int(np.count_nonzero(saturated(log))) for log in logs):
        found.append(f"the gyro is at its limit in {count} rows")
    turning, accel_y = _columns(logs, "turning", "accel_y")
    if len(turning) < 2 or float(np.std(turning)) < _TURNING:
        return found
    gain, related = steering_gain(logs, car)
    if abs(related) < LEAST_RELATED:
        return [*found, f"steering and yaw rate are unrelated (correlation {related:.2f})"]
    ratio = 1.0 / abs(gain)
    if gain < 0.0:
        found.append("steering and yaw rate differ in sign (--steering-sign -1 turns it)")
    if not 1.0 / FACTOR < ratio < FACTOR:
        guess = next(text for least, text in _GUESSES if ratio >= least)
        found.append(
            f"the logged steering is {ratio:.3g} times what the yaw rate needs: {guess} "
            f"(--steering-ratio {ratio:.3g} divides it)"
        )
    slope, fits = _related(turning, accel_y)
    if abs(fits) > 0.7 and not 1.0 / FACTOR < slope < FACTOR:
        found.append(f"accel_y is {slope:.3g} times speed x yaw rate: another unit or sign?")
    return found
