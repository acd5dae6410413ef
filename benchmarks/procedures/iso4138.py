"""ISO 4138: steady-state circular driving, constant steering angle with slowly rising speed.

The handling diagram is l gamma / v_x - delta_f over the lateral acceleration; its slope is minus
the understeer gradient K: delta_f = l / R + K a_y. Of the linear model it is l times the stability
factor G of dakf-stability (24).
"""

from dataclasses import dataclass

import numpy as np

from ...envs.record import Array
from ...envs.task import make_reference_params
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from .drive import DriveFunction, Fields, Series, TestCar

SETTLE = 3.0  # s, at the first speed
LINEAR_FROM, LINEAR_TO = 0.05 * GRAVITY, 0.25 * GRAVITY  # the range of the slope


@dataclass(frozen=True)
class Handling:
    """The diagram, (n,) each: a_y in m/s2 and angle in rad; K in rad s2/m; theory: K's."""

    a_y: Array
    angle: Array
    K: float
    theory: float


def compute_understeer_gradient(vehicle: Vehicle) -> float:
    """K in rad s2/m of the linear model."""
    return float(make_reference_params(vehicle).G) * vehicle.wheelbase


def make_circle(car: TestCar, steer: float, first: float, last: float, seconds: float) -> Fields:
    """A constant steering angle (rad) while the speed rises from the first to the last (m/s)."""
    return {
        "steering": "held-step",
        "amplitude": steer,
        "onset": 0.0,
        "speed": first,
        "speed_change": last - first,
        "change_start": SETTLE,
        "change_length": seconds,
        "duration": SETTLE + seconds,
    }


def compute_handling(series: Series, vehicle: Vehicle) -> Handling:
    """The handling diagram of a circle, and the slope in its linear range.

    Raises ValueError where the car does not reach the linear range's end.
    """
    settled = series.t >= SETTLE
    side = np.sign(np.mean(series.gamma[settled]))
    a_y = side * (series.v_x * series.gamma)[settled]  # quasi-steady: v_y' is left out
    path = vehicle.wheelbase * side * (series.gamma / series.v_x)[settled]
    angle = path - side * series.steer[settled]
    linear = (a_y >= LINEAR_FROM) & (a_y <= LINEAR_TO)
    if a_y.max() < LINEAR_TO or linear.sum() < 2:
        raise ValueError(f"the circle reached {a_y.max():.2f} m/s2, not {LINEAR_TO:.2f}")
    slope = float(np.polyfit(a_y[linear], angle[linear], 1)[0])
    return Handling(a_y, angle, -slope, compute_understeer_gradient(vehicle))


def run(
    drive: DriveFunction,
    car: TestCar,
    max_acceleration: float = 0.5 * GRAVITY,
    seconds: float = 60.0,
) -> Handling:
    """Drive a circle on which the linear car would reach `max_acceleration` (m/s2) at the car's
    own speed."""
    v, K = car.speed, compute_understeer_gradient(car.vehicle)
    steer = (car.vehicle.wheelbase / v**2 + K) * max_acceleration
    return compute_handling(drive(make_circle(car, steer, 0.2 * v, v, seconds)), car.vehicle)
