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
from ..vehicle.actuators import apply_lag, limit_rate
from ..vehicle.dynamics import compute_curvature
from ..vehicle.tyres import MIN_SPEED
from .tracks import compute_path_offset

MIN_PREVIEW = 1.0  # wheelbases: a driver looks no nearer


class DriverParams(NamedTuple):
    """How a driver steers."""

    preview: Any  # s, T
    gain: Any
    rest: Any  # what a tick leaves of a deviation from the wanted angle
    slew: Any  # rad a tick, at the wheels


@jit
def compute_lateral_error(motion: Any, path: Any, road: Any, preview: Any) -> Any:
    """How far in m the path, `preview` m on, lies to the left of where the car is going.

    The road's own bend is the double integral of its curvature, exact on a clothoid too.
    """
    sin_r, cos_r = sincos(motion.psi - motion.theta)
    slope = (motion.v_x * sin_r + motion.v_y * cos_r) / maximum(motion.v_x, MIN_SPEED)
    bend = 0.5 * preview * preview * compute_curvature(road, motion.s + preview * (1.0 / 3.0))
    return compute_path_offset(path, motion.s + preview) + bend - motion.y - preview * slope


@jit
def compute_target_angle(
    motion: Any, path: Any, road: Any, target: Any, driver: Any, stop: Any
) -> Any:
    """The steering angle in rad, within +-stop, that brings the car onto the path."""
    v = motion.v_x
    preview = maximum(driver.preview * v, MIN_PREVIEW / target.per_l)
    error = compute_lateral_error(motion, path, road, preview)
    curvature = driver.gain * 2.0 * error / (preview * preview)
    angle = curvature * maximum(1.0 + target.G * v * v, 0.2) / target.per_l  # dakf-stability (23)
    return minimum(maximum(angle, 0.0 - stop), stop)


@jit
def compute_driver_angle(
    angle: Any, motion: Any, path: Any, road: Any, target: Any, driver: Any, stop: Any
) -> Any:
    """The driver's steering angle in rad a tick after `angle`, at a Motion.

    path: a `tracks.TrackPath`. road: a `dynamics.Road`. target: a `reference.Target`, what the
    driver knows of the car. stop: rad. Source: MacAdam, "Application of an optimal preview control
    for simulation of closed-loop automobile driving", IEEE Trans. SMC 11 (1981).
    """
    target_angle = compute_target_angle(motion, path, road, target, driver, stop)
    return limit_rate(angle, apply_lag(target_angle, angle, driver.rest), driver.slew)
