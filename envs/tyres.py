"""Tyres: what the driver and the motors ask of them, and what they give.

Scalar functions over tuples, without branches on values, as in `dynamics`.
"""

from typing import Any, NamedTuple

from .backend import absolute, inlined, jit, maximum, minimum, sqrt
from .elementary import atan, sincos
from .vehicle import GRAVITY

LINEAR, FIALA = 0, 1
SLOW = 0.5  # m/s: below it slip is computed as at this speed, and beta is zero


class Inputs(NamedTuple):
    """What the actuators do at one instant."""

    delta_f: Any  # rad, front steering angle
    T_l: Any  # N m, left motor
    T_r: Any  # N m, right motor


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
    rear_l: Any  # N, capacity of the left and the right rear tyre in all directions, standing
    rear_r: Any
    F_l: Any  # N, what the left and the right motor ask for
    F_r: Any


@jit
def _capacity(limit: Any, drive: Any) -> Any:
    """Lateral capacity of a tyre in N that also drives: the friction circle, never below 5 %."""
    return sqrt(maximum(limit * limit - drive * drive, 0.0025 * limit * limit))


@jit
def load_of(inputs: Any, car: Any, small_angle: int) -> Any:
    """The Load of the Inputs of one instant.

    The road may grip less on one side: each rear tyre has its own, which its motor feels; the
    front tyres share the mean.
    """
    weight = car.m * GRAVITY / (2.0 * (car.l_f + car.l_r))
    front = 0.5 * (car.mu + car.mu_r) * weight * car.l_r
    rear_l, rear_r = car.mu * weight * car.l_f, car.mu_r * weight * car.l_f
    asked_l, asked_r = inputs.T_l * (1.0 / car.r), inputs.T_r * (1.0 / car.r)
    F_l, F_r = asked_l, asked_r
    s, c = sincos(inputs.delta_f)
    left, right = rear_l, rear_r
    if not small_angle:
        F_l = minimum(maximum(F_l, 0.0 - rear_l), rear_l)
        F_r = minimum(maximum(F_r, 0.0 - rear_r), rear_r)
        left, right = _capacity(rear_l, F_l), _capacity(rear_r, F_r)
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
        rear_l,
        rear_r,
        asked_l,
        asked_r,
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


@inlined
def load_transfer(motion: Any, car: Any, g_y: Any) -> Any:
    """The share of its standing load by which the left wheels of (front, rear) are relieved.

    The right wheels get as much. The suspension passes K_x phi + C_x phi_dot on to the wheels; the
    rest of the moment of the car's own height, (M h - M_s h_s) a_y, acts at once and is taken at
    a_y = v_x gamma and gravity. Each axle bears it in proportion to its standing load. No
    wheel leaves the ground: shares end at 0.9.
    """
    direct = (car.m * car.h - car.S) * (motion.v_x * motion.gamma + g_y)
    moment = car.K_x * motion.phi + car.C_x * motion.phi_dot + direct
    half_weight = 0.5 * car.m * GRAVITY
    front = moment * (1.0 / (half_weight * car.d_f))
    rear = moment * (1.0 / (half_weight * car.d_r))
    return minimum(maximum(front, -0.9), 0.9), minimum(maximum(rear, -0.9), 0.9)


@inlined
def tyre_forces(
    motion: Any, load: Any, car: Any, g_y: Any, small_angle: int, law: int, roll: int
) -> Any:
    """(F_yf, F_yr, F_x, N_z): lateral forces of the axles, drive force, moment of the motors.

    g_y: m/s2, what the car feels of the road's bank. Roll moves load from side to side, which
    matters to Fiala tyres only, and is left out of the small-angle plant.
    """
    t_f, t_r = slips(motion, load, car, small_angle, law)
    if roll and law == FIALA and not small_angle:
        e_f, e_r = load_transfer(motion, car, g_y)
        narrow, wide = 1.0 - e_f, 1.0 + e_f
        per = load.slope_f / (narrow * wide)
        F_yf = lateral_force(t_f, load.limit_f * narrow, per * wide, law) + lateral_force(
            t_f, load.limit_f * wide, per * narrow, law
        )
        rear_l, rear_r = load.rear_l * (1.0 - e_r), load.rear_r * (1.0 + e_r)
        F_l = minimum(maximum(load.F_l, 0.0 - rear_l), rear_l)
        F_r = minimum(maximum(load.F_r, 0.0 - rear_r), rear_r)
        left, right = _capacity(rear_l, F_l), _capacity(rear_r, F_r)
        per = car.C_r / (3.0 * left * right)
        F_yr = lateral_force(t_r, left, per * right, law) + lateral_force(
            t_r, right, per * left, law
        )
        return F_yf, F_yr, F_l + F_r, 0.5 * car.d_r * (F_r - F_l)
    F_yf = 2.0 * lateral_force(t_f, load.limit_f, load.slope_f, law)
    F_yr = lateral_force(t_r, load.limit_l, load.slope_l, law) + lateral_force(
        t_r, load.limit_r, load.slope_r, law
    )
    return F_yf, F_yr, load.F_x, load.N_z
