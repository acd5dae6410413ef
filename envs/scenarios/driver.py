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
    """Parameters of a driver who steers by preview."""

    preview: Any  # s, T
    gain: Any
    rest: Any  # what a tick leaves of a deviation from the wanted angle
    slew: Any  # rad a tick, at the wheels


@jit
def compute_lateral_error(motion: Any, path: Any, road: Any, preview: Any) -> Any:
    """Compute how far the previewed path lies to the left of the car's course.

    The road's own bend is the double integral of its curvature, exact on a clothoid too.

    Args:
        motion: `Motion` of the car.
        path: `TrackPath`.
        road: `RoadParams`.
        preview: Preview distance (m).

    Returns:
        Lateral error (m).
    """
    sin_r, cos_r = sincos(motion.psi - motion.theta)
    slope = (motion.v_x * sin_r + motion.v_y * cos_r) / maximum(motion.v_x, MIN_SPEED)
    bend = 0.5 * preview * preview * compute_curvature(road, motion.s + preview * (1.0 / 3.0))
    return compute_path_offset(path, motion.s + preview) + bend - motion.y - preview * slope


@jit
def compute_target_angle(
    motion: Any, path: Any, road: Any, target: Any, driver: Any, stop: Any
) -> Any:
    """Compute the steering angle that brings the car onto the path.

    Args:
        motion: `Motion` of the car.
        path: `TrackPath`.
        road: `RoadParams`.
        target: `ReferenceParams`, what the driver knows of the car.
        driver: `DriverParams`.
        stop: Largest angle (rad).

    Returns:
        Angle at the wheels (rad), within +-stop.
    """
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
    """Compute the driver's steering angle a tick later, at a Motion.

    Source: MacAdam, "Application of an optimal preview control for simulation of closed-loop
    automobile driving", IEEE Trans. SMC 11 (1981).

    Args:
        angle: Present angle at the wheels (rad).
        motion: `Motion` of the car.
        path: `TrackPath`.
        road: `RoadParams`.
        target: `ReferenceParams`, what the driver knows of the car.
        driver: `DriverParams`.
        stop: Largest angle (rad).

    Returns:
        The next angle (rad).
    """
    target_angle = compute_target_angle(motion, path, road, target, driver, stop)
    return limit_rate(angle, apply_lag(target_angle, angle, driver.rest), driver.slew)
