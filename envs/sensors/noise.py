"""Noise levels and biases of all sensors."""

from typing import Any, NamedTuple

import numpy as np


class Noise(NamedTuple):
    """Standard deviations and biases; the defaults are those of the project's simulations."""

    gyro: Any = 0.005  # rad/s
    gyro_bias: Any = 0.0
    accel: Any = 0.1  # m/s2, both axes
    accel_y_bias: Any = 0.0
    roll_rate: Any = 0.005  # rad/s
    wheel: Any = 0.02  # m/s
    camera_psi: Any = 3.5e-3  # rad
    camera_y: Any = 0.02  # m
    course: Any = 0.14 * np.pi / 180.0 * (60.0 / 3.6)  # rad m/s: 0.14 deg at 60 km/h, as 1 / V
    gps_speed: Any = 0.05  # m/s
    gps_position: Any = 0.5  # m
