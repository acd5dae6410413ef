"""ISO 4138: steady-state circular driving, constant steering angle with slowly rising speed.

The handling diagram is l gamma / v_x - delta_f over a_y; its slope is minus the understeer gradient
K: delta_f = l / R + K a_y. The linear model's is l times G of dakf-stability (24).
"""

from dataclasses import dataclass

import numpy as np

from ...envs.record import Array
from ...envs.vehicle.parameters import GRAVITY
from .drive import DriveFunction, Series, TestCar

_SETTLE = 3.0  # s, at the first speed
LINEAR_FROM, LINEAR_TO = 0.05 * GRAVITY, 0.25 * GRAVITY  # the range of the slope


@dataclass(frozen=True)
class Handling:
    """The handling diagram, shape (n,) each, and its slope."""

    a_y: Array  # m/s2
    angle: Array  # rad
    K: float  # understeer gradient, rad s2/m
    theory: float  # K of the linear model


def _compute_handling(series: Series, car: TestCar) -> Handling:
    """Compute a circle's handling diagram and slope; ValueError where it stays below 0.25 g."""
    settled = series.t >= _SETTLE
    side = np.sign(np.mean(series.gamma[settled]))
    a_y = side * (series.v_x * series.gamma)[settled]  # quasi-steady: v_y' is left out
    path = car.vehicle.wheelbase * side * (series.gamma / series.v_x)[settled]
    angle = path - side * series.steer[settled]
    linear = (a_y >= LINEAR_FROM) & (a_y <= LINEAR_TO)
    if a_y.max() < LINEAR_TO or linear.sum() < 2:
        raise ValueError(f"the circle reached {a_y.max():.2f} m/s2, not {LINEAR_TO:.2f}")
    slope = float(np.polyfit(a_y[linear], angle[linear], 1)[0])
    return Handling(a_y, angle, -slope, car.understeer_gradient)


def run(drive: DriveFunction, car: TestCar, seconds: float = 60.0) -> Handling:
    """Drive a circle on which the linear car would reach 0.5 g at its full speed.

    Args:
        drive: Function that drives the car through a scenario.
        car: Car under test, with speed and steering ratio.
        seconds: Time in which the speed rises (s).

    Returns:
        The handling diagram.
    """
    v = car.speed
    steer = (car.vehicle.wheelbase / v**2 + car.understeer_gradient) * (0.5 * GRAVITY)
    first = 0.2 * v
    circle = {
        "steering": "held-step", "amplitude": steer, "onset": 0.0, "speed": first,
        "speed_change": v - first, "change_start": _SETTLE, "change_length": seconds,
        "duration": _SETTLE + seconds,
    }  # fmt: skip
    return _compute_handling(drive(circle), car)
