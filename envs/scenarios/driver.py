"""A driver who keeps to a path by preview.

MacAdam's optimal preview control (1981) for a single preview point and a car that goes where it
is steered: the lateral acceleration that brings the car onto the path within the preview time T,
2 (y_path(t + T) - y - T y') / T^2. At gain 1 that closes the loop at 1.41/T rad/s with damping
0.71. The steering angle is the one at which the nominal car turns so in the steady state; the arms
follow as a first-order lag within a largest rate.
"""

from typing import Any, NamedTuple

from ..backend.decorators import jit
from ..backend.elementary import sincos
from ..backend.primitives import maximum, minimum
from ..vehicle.actuators import lagged, slewed
from ..vehicle.dynamics import curvature_at
from ..vehicle.tyres import SLOW
from .tracks import path_offset

NEAR = 1.0  # wheelbases: a driver looks no nearer


class Driver(NamedTuple):
    """How a driver steers."""

    preview: Any  # s, T
    gain: Any
    rest: Any  # what a tick leaves of a deviation from the wanted angle
    slew: Any  # rad a tick, at the wheels


@jit
def lateral_error(motion: Any, path: Any, road: Any, ahead: Any) -> Any:
    """How far in m the path, `ahead` m on, lies to the left of where the car is going.

    The road's own bend is the double integral of its curvature, exact on a clothoid too.
    """
    sin_r, cos_r = sincos(motion.psi - motion.theta)
    slope = (motion.v_x * sin_r + motion.v_y * cos_r) / maximum(motion.v_x, SLOW)
    bend = 0.5 * ahead * ahead * curvature_at(road, motion.s + ahead * (1.0 / 3.0))
    return path_offset(path, motion.s + ahead) + bend - motion.y - ahead * slope


@jit
def wanted_angle(motion: Any, path: Any, road: Any, target: Any, driver: Any, stop: Any) -> Any:
    """The steering angle in rad, within +-stop, that brings the car onto the path."""
    v = motion.v_x
    ahead = maximum(driver.preview * v, NEAR / target.per_l)
    error = lateral_error(motion, path, road, ahead)
    curvature = driver.gain * 2.0 * error / (ahead * ahead)
    angle = curvature * maximum(1.0 + target.G * v * v, 0.2) / target.per_l  # dakf-stability (23)
    return minimum(maximum(angle, 0.0 - stop), stop)


@jit
def steered(
    angle: Any, motion: Any, path: Any, road: Any, target: Any, driver: Any, stop: Any
) -> Any:
    """The driver's steering angle in rad a tick after `angle`, at a Motion.

    path: a `tracks.Path`. road: a `dynamics.Road`. target: a `reference.Target`, what the driver
    knows of the car. stop: rad. Source: MacAdam, "Application of an optimal preview control for
    simulation of closed-loop automobile driving", IEEE Trans. SMC 11 (1981).
    """
    wanted = wanted_angle(motion, path, road, target, driver, stop)
    return slewed(angle, lagged(wanted, angle, driver.rest), driver.slew)
