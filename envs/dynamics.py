"""The plant's equations, written once.

A single-track model with two driven rear wheels, in ISO 8855 axes (x forward, y left, yaw to the
left), SI units. The functions are scalar, over tuples, without branches on values; `small_angle`
and `tyre_law` are integers that choose the text, not the values.
"""

from typing import Any, NamedTuple

from .backend import absolute, jit, maximum, minimum, select, sqrt
from .elementary import atan, atan2, sincos
from .vehicle import GRAVITY

LINEAR, FIALA = 0, 1
SLOW = 0.5  # m/s: below it slip is computed as at this speed, and beta is zero


class Car(NamedTuple):
    """The true vehicle of an episode; letters as in the papers, stiffness per tyre."""

    m: Any
    I: Any  # noqa: E741  the papers' letter
    l_f: Any
    l_r: Any
    C_f: Any
    C_r: Any
    d_f: Any
    d_r: Any
    r: Any
    T_max: Any
    mu: Any
    l_pre: Any


class Motion(NamedTuple):
    """What the plant integrates: velocities, heading, place on the ground and on the road."""

    v_x: Any  # m/s
    v_y: Any  # m/s
    gamma: Any  # rad/s
    psi: Any  # rad, from the ground's x axis
    X: Any  # m, on the ground
    Y: Any  # m
    s: Any  # m, along the road
    y: Any  # m, left of the road's centre line
    theta: Any  # rad, the road's direction at the car


class Inputs(NamedTuple):
    """What the actuators do at one instant."""

    delta_f: Any  # rad, front steering angle
    T_l: Any  # N m, left motor
    T_r: Any  # N m, right motor


class Road(NamedTuple):
    """A road that is straight up to `start` and bends to `curvature` over `ramp` metres."""

    curvature: Any  # 1/m, left positive
    start: Any  # m
    ramp: Any  # m, positive


@jit
def curvature_at(road: Any, s: Any) -> Any:
    """Curvature of the road in 1/m at the distance s."""
    return road.curvature * minimum(maximum((s - road.start) * (1.0 / road.ramp), 0.0), 1.0)


class Push(NamedTuple):
    """What disturbs the car during a tick."""

    F_d: Any  # N, lateral force at the centre of gravity
    N_d: Any  # N m, yaw moment


class Load(NamedTuple):
    """What one instant's inputs mean for the tyres; computed once, used by several stages."""

    sin_d: Any  # of the front steering angle
    cos_d: Any
    steer: Any  # rad
    F_x: Any  # N, drive force
    N_z: Any  # N m, yaw moment of the motors
    limit_f: Any  # N, lateral capacity of one front tyre, of the left and of the right rear tyre
    limit_l: Any
    limit_r: Any
    slope_f: Any  # C / 3 F_max of the same tyres, 1/tan
    slope_l: Any
    slope_r: Any


class Frame(NamedTuple):
    """The headings at the start of a tick; within the tick they turn by a small angle."""

    psi: Any
    theta: Any
    sin_t: Any  # of the road's direction
    cos_t: Any
    sin_r: Any  # of the heading relative to the road
    cos_r: Any


@jit
def frame_of(motion: Any) -> Any:
    """The Frame of a Motion."""
    sin_t, cos_t = sincos(motion.theta)
    sin_r, cos_r = sincos(motion.psi - motion.theta)
    return Frame(motion.psi, motion.theta, sin_t, cos_t, sin_r, cos_r)


@jit
def _capacity(limit: Any, drive: Any) -> Any:
    """Lateral capacity of a tyre in N that also drives: the friction circle, never below 5 %."""
    return sqrt(maximum(limit * limit - drive * drive, 0.0025 * limit * limit))


@jit
def load_of(inputs: Any, car: Any, small_angle: int) -> Any:
    """The Load of the Inputs of one instant."""
    weight = car.m * GRAVITY / (2.0 * (car.l_f + car.l_r))
    front, rear = car.mu * weight * car.l_r, car.mu * weight * car.l_f
    F_l, F_r = inputs.T_l * (1.0 / car.r), inputs.T_r * (1.0 / car.r)
    s, c = sincos(inputs.delta_f)
    left, right = rear, rear
    if not small_angle:
        F_l = minimum(maximum(F_l, 0.0 - rear), rear)
        F_r = minimum(maximum(F_r, 0.0 - rear), rear)
        left, right = _capacity(rear, F_l), _capacity(rear, F_r)
    return Load(
        s,
        c,
        inputs.delta_f,
        F_l + F_r,
        0.5 * car.d_r * (F_r - F_l),
        front,
        left,
        right,
        car.C_f / (3.0 * front),
        car.C_r / (3.0 * left),
        car.C_r / (3.0 * right),
    )


@jit
def lateral_force(tangent: Any, limit: Any, slope: Any, law: int) -> Any:
    """Lateral force of one tyre in N from the tangent of its slip angle (linear: the angle).

    Fiala: z = clip(C t / 3 F_max, -1, 1), F_y = F_max z (3 - 3 |z| + z^2), which needs neither
    branch nor arctangent.
    """
    z = slope * tangent
    if law == LINEAR:
        return 3.0 * limit * z
    z = minimum(maximum(z, -1.0), 1.0)
    return limit * z * (3.0 - 3.0 * absolute(z) + z * z)


@jit
def slips(motion: Any, load: Any, car: Any, small_angle: int, law: int) -> Any:
    """Tangents of the front and rear slip angle (the angles themselves for linear tyres)."""
    front = motion.v_y + car.l_f * motion.gamma
    rear = motion.v_y - car.l_r * motion.gamma
    if small_angle:
        v = maximum(motion.v_x, SLOW)
        # delta_f - beta - l_f gamma / V_x and l_r gamma / V_x - beta of tie-vision (1)
        return (motion.v_x * load.steer - front) / v, (0.0 - rear) / v
    along = maximum(absolute(motion.v_x * load.cos_d + front * load.sin_d), SLOW)
    t_f = (motion.v_x * load.sin_d - front * load.cos_d) / along
    t_r = (0.0 - rear) / maximum(absolute(motion.v_x), SLOW)
    if law == LINEAR:
        return atan(t_f), atan(t_r)
    return t_f, t_r


@jit
def _turned(sine: Any, cosine: Any, angle: Any) -> Any:
    """(sin, cos) after a further turn by a small angle; error below 1e-13 for 0.02 rad."""
    z = angle * angle
    s = angle * (1.0 - z * (1.0 / 6.0 - z * (1.0 / 120.0)))
    c = 1.0 - z * (0.5 - z * (1.0 / 24.0 - z * (1.0 / 720.0)))
    return sine * c + cosine * s, cosine * c - sine * s


@jit
def derivative(
    motion: Any,
    load: Any,
    push: Any,
    car: Any,
    road: Any,
    frame: Any,
    small_angle: int,
    law: int,
) -> Any:
    """d(motion)/dt as a Motion; `frame` is that of the tick's start (`frame_of`)."""
    per_m, per_I = 1.0 / car.m, 1.0 / car.I
    v_x, v_y, gamma = motion.v_x, motion.v_y, motion.gamma
    t_f, t_r = slips(motion, load, car, small_angle, law)
    F_yf = 2.0 * lateral_force(t_f, load.limit_f, load.slope_f, law)
    F_yr = lateral_force(t_r, load.limit_l, load.slope_l, law) + lateral_force(
        t_r, load.limit_r, load.slope_r, law
    )
    kappa = curvature_at(road, motion.s)
    if small_angle:
        dv_x = load.F_x * per_m
        dv_y = (F_yf + F_yr + push.F_d) * per_m - v_x * gamma  # tie-vision (1)
        dgamma = (car.l_f * F_yf - car.l_r * F_yr + load.N_z + push.N_d) * per_I  # (2)
        dY = v_x * motion.psi + v_y  # tie-vision (5), V_x (psi + beta)
        dy = v_x * (motion.psi - motion.theta) + v_y
        return Motion(dv_x, dv_y, dgamma, gamma, v_x, dY, v_x, dy, v_x * kappa)
    F_yc = F_yf * load.cos_d
    dv_x = (load.F_x - F_yf * load.sin_d) * per_m + v_y * gamma
    dv_y = (F_yc + F_yr + push.F_d) * per_m - v_x * gamma
    dgamma = (car.l_f * F_yc - car.l_r * F_yr + load.N_z + push.N_d) * per_I
    turn = motion.theta - frame.theta
    s_r, c_r = _turned(frame.sin_r, frame.cos_r, motion.psi - frame.psi - turn)
    s_t, c_t = _turned(frame.sin_t, frame.cos_t, turn)
    along = v_x * c_r - v_y * s_r  # in road axes
    across = v_x * s_r + v_y * c_r
    ds = along / maximum(1.0 - kappa * motion.y, 0.1)
    dX = along * c_t - across * s_t
    dY = along * s_t + across * c_t
    return Motion(dv_x, dv_y, dgamma, gamma, dX, dY, ds, across, ds * kappa)


@jit
def _ahead(motion: Any, h: Any, d: Any) -> Any:
    """motion + h d, written out so that it compiles for every number type."""
    return Motion(
        motion.v_x + h * d.v_x,
        motion.v_y + h * d.v_y,
        motion.gamma + h * d.gamma,
        motion.psi + h * d.psi,
        motion.X + h * d.X,
        motion.Y + h * d.Y,
        motion.s + h * d.s,
        motion.y + h * d.y,
        motion.theta + h * d.theta,
    )


@jit
def _weighted(a: Any, b: Any, c: Any, d: Any) -> Any:
    return (a + 2.0 * (b + c) + d) * (1.0 / 6.0)


@jit
def rk4(
    motion: Any,
    load: tuple[Any, Any, Any],
    push: Any,
    car: Any,
    road: Any,
    h: Any,
    small_angle: int,
    law: int,
) -> Any:
    """One step of h seconds of the classical Runge-Kutta method.

    load: the Load at the start, the middle and the end of the step.
    """
    frame = frame_of(motion)
    a = derivative(motion, load[0], push, car, road, frame, small_angle, law)
    b = derivative(_ahead(motion, 0.5 * h, a), load[1], push, car, road, frame, small_angle, law)
    c = derivative(_ahead(motion, 0.5 * h, b), load[1], push, car, road, frame, small_angle, law)
    d = derivative(_ahead(motion, h, c), load[2], push, car, road, frame, small_angle, law)
    slope = Motion(
        _weighted(a.v_x, b.v_x, c.v_x, d.v_x),
        _weighted(a.v_y, b.v_y, c.v_y, d.v_y),
        _weighted(a.gamma, b.gamma, c.gamma, d.gamma),
        _weighted(a.psi, b.psi, c.psi, d.psi),
        _weighted(a.X, b.X, c.X, d.X),
        _weighted(a.Y, b.Y, c.Y, d.Y),
        _weighted(a.s, b.s, c.s, d.s),
        _weighted(a.y, b.y, c.y, d.y),
        _weighted(a.theta, b.theta, c.theta, d.theta),
    )
    return _ahead(motion, h, slope)


@jit
def sideslip_angle(v_x: Any, v_y: Any, small_angle: int) -> Any:
    """beta in rad: atan2(v_y, v_x) above 0.5 m/s, else 0 (the ratio on the small-angle plant)."""
    if small_angle:
        return select(v_x > SLOW, v_y / maximum(v_x, SLOW), 0.0)
    moving = v_x * v_x + v_y * v_y > SLOW * SLOW
    return select(moving, atan2(v_y, v_x), 0.0)
