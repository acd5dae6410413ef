"""Steps through time of the plant's equations.

Forces depend on the velocities and the roll alone, so only these go through the stages of a
Runge-Kutta rule; place and heading follow once a step. Scalar functions over tuples, without
branches on values, as in `dynamics`.
"""

from typing import Any

from ..backend.decorators import inlined, jit
from ..backend.elementary import sincos
from ..backend.primitives import anywhere
from .dynamics import Motion, Velocity, course, curvature_at, gravity_felt, rates


@jit
def _after(now: Any, h: Any, rate: Any) -> Any:
    """now + h rate, written out so that it compiles for every number type."""
    return Velocity(
        now.v_x + h * rate.v_x,
        now.v_y + h * rate.v_y,
        now.gamma + h * rate.gamma,
        now.phi + h * rate.phi,
        now.phi_dot + h * rate.phi_dot,
    )


@jit
def _mean(first: Any, middle: Any, last: Any) -> Any:
    """Simpson's rule."""
    return (first + 4.0 * middle + last) * (1.0 / 6.0)


@jit
def _means(a: Any, b: Any, c: Any) -> Any:
    """Simpson's rule for each number of three Velocities."""
    return Velocity(
        _mean(a.v_x, b.v_x, c.v_x),
        _mean(a.v_y, b.v_y, c.v_y),
        _mean(a.gamma, b.gamma, c.gamma),
        _mean(a.phi, b.phi, c.phi),
        _mean(a.phi_dot, b.phi_dot, c.phi_dot),
    )


@jit
def _halfway(a: Any, b: Any) -> Any:
    """The mean of two Velocities."""
    return Velocity(
        0.5 * (a.v_x + b.v_x),
        0.5 * (a.v_y + b.v_y),
        0.5 * (a.gamma + b.gamma),
        0.5 * (a.phi + b.phi),
        0.5 * (a.phi_dot + b.phi_dot),
    )


@inlined
def _gravity_between(motion: Any, road: Any, h: Any, small_angle: int) -> Any:
    """`gravity_felt` in the middle of a step of h seconds, where the car will be by its start's
    speed: it stands for the whole step, in which the car turns by h gamma."""
    ahead = motion.s + 0.5 * h * motion.v_x
    if not anywhere((road.across != 0.0) | (road.along != 0.0)):
        return 0.0, 0.0
    if small_angle:
        return gravity_felt(road, ahead, 0.0, 1.0)
    turning = motion.gamma - motion.v_x * curvature_at(road, ahead) - road.turn
    sin_r, cos_r = sincos(motion.psi - motion.theta + 0.5 * h * turning)
    return gravity_felt(road, ahead, sin_r, cos_r)


@inlined
def _moved(
    motion: Any, middle: Any, now: Any, mean: Any, road: Any, h: Any, small_angle: int
) -> Any:
    """The Motion after h seconds whose velocities were `middle` halfway, `now` at the end and
    `mean` in the mean.

    No force within a step depends on place and heading, so these follow at once. The mean of the
    turning velocity is the mean velocity in the mean direction, but for its length, 1 - r^2 / 24 of
    it after a turn by r, and r / 12 of its change to the side: an error of h^5 a step. A road that
    turns is taken where the car is halfway by the start's velocity: h^3 v^2 / 8 times its change of
    curvature, below 1e-7 m a second at 1 ms.
    """
    half, turned = 0.5 * h, h * mean.gamma
    shorter, aside = 1.0 - turned * turned * (1.0 / 24.0), turned * (1.0 / 12.0)
    v_x = shorter * mean.v_x - aside * (now.v_y - motion.v_y)
    v_y = shorter * mean.v_y + aside * (now.v_x - motion.v_x)
    psi = motion.psi + h * (motion.gamma + 2.0 * middle.gamma) * (1.0 / 6.0)  # in the mean
    s, y, theta = motion.s, motion.y, motion.theta
    if anywhere(road.curvature != 0.0) or anywhere(road.turn != 0.0):
        _, _, ds, dy, turns = course(motion, motion.v_x, motion.v_y, road, small_angle)
        s, y, theta = s + half * ds, y + half * dy, theta + half * turns
    between = Motion(
        v_x, v_y, mean.gamma, psi, motion.X, motion.Y, s, y, theta, now.phi, now.phi_dot
    )
    dX, dY, ds, dy, turns = course(between, v_x, v_y, road, small_angle)
    return Motion(
        now.v_x,
        now.v_y,
        now.gamma,
        motion.psi + turned,
        motion.X + h * dX,
        motion.Y + h * dY,
        motion.s + h * ds,
        motion.y + h * dy,
        motion.theta + h * turns,
        now.phi,
        now.phi_dot,
    )


@inlined
def kutta3(
    motion: Any,
    load: tuple[Any, Any, Any],
    push: Any,
    car: Any,
    road: Any,
    h: Any,
    small_angle: int,
    law: int,
    roll: int = 0,
) -> Any:
    """A step of h seconds by Kutta's third-order rule: the plant's, of a millisecond.

    load: the Load at the start, the middle and the end of the step. Three stages at 1 ms err by
    less than what the plant's kinks cost any rule (docs/physics.md has the table).
    """
    gravity = _gravity_between(motion, road, h, small_angle)
    start = Velocity(motion.v_x, motion.v_y, motion.gamma, motion.phi, motion.phi_dot)
    a = rates(start, load[0], push, car, gravity, small_angle, law, roll)
    middle = _after(start, 0.5 * h, a)
    b = rates(middle, load[1], push, car, gravity, small_angle, law, roll)
    end = _after(_after(start, 0.0 - h, a), 2.0 * h, b)
    c = rates(end, load[2], push, car, gravity, small_angle, law, roll)
    mean = _means(start, middle, end)
    return _moved(motion, middle, _after(start, h, _means(a, b, c)), mean, road, h, small_angle)


@inlined
def rk4(
    motion: Any,
    load: tuple[Any, Any, Any],
    push: Any,
    car: Any,
    road: Any,
    h: Any,
    small_angle: int,
    law: int,
    roll: int = 0,
) -> Any:
    """The same by the classical Runge-Kutta method: the plans', whose steps are longer."""
    gravity = _gravity_between(motion, road, h, small_angle)
    start = Velocity(motion.v_x, motion.v_y, motion.gamma, motion.phi, motion.phi_dot)
    a = rates(start, load[0], push, car, gravity, small_angle, law, roll)
    first = _after(start, 0.5 * h, a)
    b = rates(first, load[1], push, car, gravity, small_angle, law, roll)
    second = _after(start, 0.5 * h, b)
    c = rates(second, load[1], push, car, gravity, small_angle, law, roll)
    end = _after(start, h, c)
    d = rates(end, load[2], push, car, gravity, small_angle, law, roll)
    middle, between = _halfway(first, second), _halfway(b, c)
    mean = _means(start, middle, end)
    now = _after(start, h, _means(a, between, d))
    return _moved(motion, middle, now, mean, road, h, small_angle)
