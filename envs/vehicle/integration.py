"""Steps through time of the plant's equations.

Forces depend on the velocities and the roll alone, so only these go through the stages of a
Runge-Kutta rule; place and heading follow once a step. Scalar functions over tuples, without
branches on values, as in `dynamics`.
"""

from typing import Any

from ..backend.decorators import inline, jit
from ..backend.elementary import sincos
from ..backend.primitives import any_lane
from .dynamics import (
    Motion,
    Velocity,
    compute_course_rates,
    compute_curvature,
    compute_rates,
    rotate_gravity,
)


@jit
def _step_euler(start: Any, h: Any, rate: Any) -> Any:
    """Compute start + h rate, written out so that it compiles for every number type."""
    return Velocity(
        start.v_x + h * rate.v_x,
        start.v_y + h * rate.v_y,
        start.gamma + h * rate.gamma,
        start.phi + h * rate.phi,
        start.phi_dot + h * rate.phi_dot,
    )


@jit
def _average(first: Any, middle: Any, last: Any) -> Any:
    """Simpson's rule."""
    return (first + 4.0 * middle + last) * (1.0 / 6.0)


@jit
def _average_velocities(a: Any, b: Any, c: Any) -> Any:
    """Simpson's rule for each number of three Velocities."""
    return Velocity(
        _average(a.v_x, b.v_x, c.v_x),
        _average(a.v_y, b.v_y, c.v_y),
        _average(a.gamma, b.gamma, c.gamma),
        _average(a.phi, b.phi, c.phi),
        _average(a.phi_dot, b.phi_dot, c.phi_dot),
    )


@jit
def _average_two(a: Any, b: Any) -> Any:
    """The mean of two Velocities."""
    return Velocity(
        0.5 * (a.v_x + b.v_x),
        0.5 * (a.v_y + b.v_y),
        0.5 * (a.gamma + b.gamma),
        0.5 * (a.phi + b.phi),
        0.5 * (a.phi_dot + b.phi_dot),
    )


@inline
def _compute_mid_gravity(motion: Any, road: Any, h: Any, small_angle: int) -> Any:
    """Compute `rotate_gravity` in the middle of a step of h seconds, for the whole step.

    The car's place is extrapolated by its speed at the start; in the step it turns by h gamma.
    """
    s_mid = motion.s + 0.5 * h * motion.v_x
    if not any_lane((road.lateral != 0.0) | (road.longitudinal != 0.0)):
        return 0.0, 0.0
    if small_angle:
        return rotate_gravity(road, s_mid, 0.0, 1.0)
    mid_turn_rate = motion.gamma - motion.v_x * compute_curvature(road, s_mid) - road.turn
    sin_r, cos_r = sincos(motion.psi - motion.theta + 0.5 * h * mid_turn_rate)
    return rotate_gravity(road, s_mid, sin_r, cos_r)


@inline
def _integrate_motion(
    motion: Any, middle: Any, end: Any, mean: Any, road: Any, h: Any, small_angle: int
) -> Any:
    """Compute the Motion after h seconds from its velocities halfway, at the end and in the mean.

    No force within a step depends on place and heading, so these follow at once. The mean of the
    turning velocity is the mean velocity in the mean direction, but for its length, 1 - r^2 / 24 of
    it after a turn by r, and r / 12 of its change to the side: an error of h^5 a step. A road that
    turns is taken where the car is halfway by the start's velocity: h^3 v^2 / 8 times its change of
    curvature, below 1e-7 m a second at 1 ms.
    """
    half, angle = 0.5 * h, h * mean.gamma
    shrink, side_gain = 1.0 - angle * angle * (1.0 / 24.0), angle * (1.0 / 12.0)
    v_x = shrink * mean.v_x - side_gain * (end.v_y - motion.v_y)
    v_y = shrink * mean.v_y + side_gain * (end.v_x - motion.v_x)
    psi = motion.psi + h * (motion.gamma + 2.0 * middle.gamma) * (1.0 / 6.0)  # in the mean
    s, y, theta = motion.s, motion.y, motion.theta
    if any_lane(road.curvature != 0.0) or any_lane(road.turn != 0.0):
        _, _, ds, dy, dtheta = compute_course_rates(
            motion, motion.v_x, motion.v_y, road, small_angle
        )
        s, y, theta = s + half * ds, y + half * dy, theta + half * dtheta
    mid_motion = Motion(
        v_x, v_y, mean.gamma, psi, motion.X, motion.Y, s, y, theta, end.phi, end.phi_dot
    )
    dX, dY, ds, dy, dtheta = compute_course_rates(mid_motion, v_x, v_y, road, small_angle)
    return Motion(
        end.v_x,
        end.v_y,
        end.gamma,
        motion.psi + angle,
        motion.X + h * dX,
        motion.Y + h * dY,
        motion.s + h * ds,
        motion.y + h * dy,
        motion.theta + h * dtheta,
        end.phi,
        end.phi_dot,
    )


@inline
def kutta3(
    motion: Any,
    load: tuple[Any, Any, Any],
    disturbance: Any,
    car: Any,
    road: Any,
    h: Any,
    small_angle: int,
    law: int,
    roll: int = 0,
) -> Any:
    """Integrate the plant over h seconds by Kutta's third-order rule.

    Three stages at 1 ms err by less than what the plant's kinks cost any rule (docs/physics.md has
    the table).

    Args:
        motion: `Motion` at the start.
        load: `TyreLoad` at the start, the middle and the end of the step.
        disturbance: `DisturbanceForces` of the whole step.
        car: `CarParams`.
        road: `RoadParams`.
        h: Length of the step (s).
        small_angle: 1 for the small-angle plant, else 0.
        law: Code of the tyre law, its place in `TYRE_LAWS`.
        roll: 1 if the body rolls, else 0.

    Returns:
        The `Motion` at the end.
    """
    gravity = _compute_mid_gravity(motion, road, h, small_angle)
    start = Velocity(motion.v_x, motion.v_y, motion.gamma, motion.phi, motion.phi_dot)
    a = compute_rates(start, load[0], disturbance, car, gravity, small_angle, law, roll)
    middle = _step_euler(start, 0.5 * h, a)
    b = compute_rates(middle, load[1], disturbance, car, gravity, small_angle, law, roll)
    end = _step_euler(_step_euler(start, 0.0 - h, a), 2.0 * h, b)
    c = compute_rates(end, load[2], disturbance, car, gravity, small_angle, law, roll)
    mean = _average_velocities(start, middle, end)
    return _integrate_motion(
        motion,
        middle,
        _step_euler(start, h, _average_velocities(a, b, c)),
        mean,
        road,
        h,
        small_angle,
    )


@inline
def rk4(
    motion: Any,
    load: tuple[Any, Any, Any],
    disturbance: Any,
    car: Any,
    road: Any,
    h: Any,
    small_angle: int,
    law: int,
    roll: int = 0,
) -> Any:
    """Integrate the plant over h seconds by the classical Runge-Kutta method.

    It serves plans, whose steps are longer than the plant's.

    Args:
        motion: `Motion` at the start.
        load: `TyreLoad` at the start, the middle and the end of the step.
        disturbance: `DisturbanceForces` of the whole step.
        car: `CarParams`.
        road: `RoadParams`.
        h: Length of the step (s).
        small_angle: 1 for the small-angle plant, else 0.
        law: Code of the tyre law, its place in `TYRE_LAWS`.
        roll: 1 if the body rolls, else 0.

    Returns:
        The `Motion` at the end.
    """
    gravity = _compute_mid_gravity(motion, road, h, small_angle)
    start = Velocity(motion.v_x, motion.v_y, motion.gamma, motion.phi, motion.phi_dot)
    a = compute_rates(start, load[0], disturbance, car, gravity, small_angle, law, roll)
    first = _step_euler(start, 0.5 * h, a)
    b = compute_rates(first, load[1], disturbance, car, gravity, small_angle, law, roll)
    second = _step_euler(start, 0.5 * h, b)
    c = compute_rates(second, load[1], disturbance, car, gravity, small_angle, law, roll)
    end = _step_euler(start, h, c)
    d = compute_rates(end, load[2], disturbance, car, gravity, small_angle, law, roll)
    middle, mid_rate = _average_two(first, second), _average_two(b, c)
    mean = _average_velocities(start, middle, end)
    last = _step_euler(start, h, _average_velocities(a, mid_rate, d))
    return _integrate_motion(motion, middle, last, mean, road, h, small_angle)
