"""The plant: equations of motion of a single-track car whose body rolls, and their integration.

ISO 8855 axes (x forward, y left, z up; yaw to the left and roll with the left side up positive), SI
units. v_y is the roll axis's: M (v_y' + v_x gamma) - M_s h_s phi'' = F_y. Accelerometers measure
a_y = v_y' + v_x gamma + g phi, and a road banked by b adds g sin b. The functions have no branches
on values; the integers `small_angle`, `law` and `roll` choose the text that is compiled.
"""

from typing import NamedTuple

from ..numerics.functions import atan2, compute_sine, sincos
from ..numerics.jit import inline, jit
from ..numerics.primitives import Scalar, any_lane, maximum, minimum, select
from .parameters import GRAVITY
from .tyres import (
    MAGIC_FORMULA,
    MIN_SPEED,
    TyreLoad,
    Variant,
    compute_slip_rates,
    compute_tyre_forces,
)


class CarParams(NamedTuple):
    """The true vehicle of an episode in SI units; letters as in the papers, stiffness per tyre."""

    m: Scalar  # kg
    I: Scalar  # noqa: E741  kg m2, yaw inertia; the papers' letter
    l_f: Scalar  # m, from the centre of gravity to the front axle
    l_r: Scalar  # m, to the rear axle
    C_f: Scalar  # N/rad, cornering stiffness of a front tyre
    C_r: Scalar  # N/rad, of a rear tyre
    d_f: Scalar  # m, front track
    d_r: Scalar  # m, rear track
    r: Scalar  # m, wheel radius
    T_max: Scalar  # N m, of one motor
    mu: Scalar  # friction under the left wheels
    l_pre: Scalar  # m, preview distance of the camera
    S: Scalar  # kg m, M_s h_s: sprung mass times its arm to the roll axis
    I_x: Scalar  # kg m2, roll inertia
    K_x: Scalar  # N m/rad, roll stiffness
    C_x: Scalar  # N m s/rad, roll damping
    h: Scalar  # m, height of the centre of gravity
    forward: Scalar  # m, the GPS antenna ahead of the centre of gravity
    left: Scalar  # m, the GPS antenna left of the centre of gravity
    mu_r: Scalar  # friction under the right wheels
    P: Scalar  # W, power limit of one motor; 0: no limit
    h_x: Scalar  # m, height by which drive force moves load between the axles
    k_l: Scalar  # left motor's torque over the commanded
    k_r: Scalar  # right motor's
    relaxation: Scalar = 0.0  # m, relaxation length of the Magic Formula's tyres; 0: none


class Motion(NamedTuple):
    """The integrated state of the plant: velocities, heading, place, roll, slip of the tyres."""

    v_x: Scalar  # m/s
    v_y: Scalar  # m/s
    gamma: Scalar  # rad/s
    psi: Scalar  # rad, from the ground's x axis
    X: Scalar  # m, on the ground
    Y: Scalar  # m
    s: Scalar  # m, along the road
    y: Scalar  # m, left of the road's centre line
    theta: Scalar  # rad, the road's direction at the car
    phi: Scalar = 0.0  # rad, roll of the body against the road
    phi_dot: Scalar = 0.0  # rad/s
    slip_f: Scalar = 0.0  # tangent of slip that acts in front, 0 where tyres do not relax
    slip_r: Scalar = 0.0  # at the rear


class RoadParams(NamedTuple):
    """A road that is straight and flat up to `start` and changes over `ramp` metres from there."""

    curvature: Scalar  # 1/m, left positive
    start: Scalar  # m
    ramp: Scalar  # m, positive
    lateral: Scalar = 0.0  # m/s2, g sin(bank), left side up positive
    longitudinal: Scalar = 0.0  # m/s2, g sin(grade), uphill positive
    turn: Scalar = 0.0  # rad/s, turning rate of its direction where it is laid tick by tick
    wave: Scalar = 0.0  # m/s2, g sin(amplitude) of a bank that varies along it
    wave_rate: Scalar = 0.0  # rad/m
    wave_phase: Scalar = 0.0  # rad


@jit
def _compute_ramp(road: RoadParams, s: Scalar) -> Scalar:
    """Compute the fraction of curvature, bank and grade that is reached at s (m)."""
    return minimum(maximum((s - road.start) * (1.0 / road.ramp), 0.0), 1.0)


@jit
def compute_curvature(road: RoadParams, s: Scalar) -> Scalar:
    """Compute the curvature of the road at a distance along it (1/m), positive to the left."""
    return road.curvature * _compute_ramp(road, s)


@jit
def compute_car_curvature(motion: Motion, road: RoadParams) -> Scalar:
    """Compute the road's curvature at the car (1/m, left positive), with a turning road's part."""
    kappa = compute_curvature(road, motion.s)
    if any_lane(road.turn != 0.0):
        kappa = kappa + road.turn / maximum(motion.v_x, 1.0)
    return kappa


@inline
def _rotate_gravity(
    road: RoadParams, s: Scalar, sin_r: Scalar, cos_r: Scalar
) -> tuple[Scalar, Scalar]:
    """(x, y) of the gravity that a car without roll measures (m/s2), by its heading on the road."""
    ramp = _compute_ramp(road, s)
    g_s, g_n = road.longitudinal * ramp, road.lateral * ramp  # along the road, to its left
    if any_lane(road.wave != 0.0):
        g_n = g_n + road.wave * compute_sine(road.wave_rate * s + road.wave_phase)
    return g_s * cos_r + g_n * sin_r, g_n * cos_r - g_s * sin_r


@jit
def compute_gravity(
    motion: Motion, road: RoadParams, small_angle: int, ahead: Scalar = 0.0
) -> tuple[Scalar, Scalar]:
    """Compute the gravity (x, y) in car axes (m/s2) that accelerometers measure without roll.

    Args:
        motion: `Motion` of the car.
        road: `RoadParams`.
        small_angle: 1 for the small-angle plant, else 0.
        ahead: Time (s) by which place and heading are extrapolated.
    """
    s = motion.s + ahead * motion.v_x
    if small_angle:
        return _rotate_gravity(road, s, 0.0, 1.0)
    turn_rate = motion.gamma - motion.v_x * compute_curvature(road, s) - road.turn
    sin_r, cos_r = sincos(motion.psi - motion.theta + ahead * turn_rate)
    return _rotate_gravity(road, s, sin_r, cos_r)


class DisturbanceForces(NamedTuple):
    """Force and moments that disturb the car during a tick."""

    F_d: Scalar  # N, lateral force at the centre of gravity
    N_d: Scalar  # N m, yaw moment
    N_x: Scalar = 0.0  # N m, roll moment on the body


class Velocity(NamedTuple):
    """The part of a Motion that forces change and depend on, with a Motion's units."""

    v_x: Scalar
    v_y: Scalar
    gamma: Scalar
    phi: Scalar
    phi_dot: Scalar
    slip_f: Scalar
    slip_r: Scalar


@inline
def _compute_rates(
    motion: Motion | Velocity, load: TyreLoad, disturbance: DisturbanceForces, car: CarParams,
    gravity: tuple[Scalar, Scalar], variant: Variant,
) -> Velocity:  # fmt: skip
    """Compute the time derivative of a `Velocity`; gravity (x, y) in m/s2."""
    small_angle, roll = variant.small_angle, variant.roll
    per_m, per_I = 1.0 / car.m, 1.0 / car.I
    v_x, v_y, gamma = motion.v_x, motion.v_y, motion.gamma
    g_x, g_y = gravity
    F_yf, F_yr, F_x, N_z = compute_tyre_forces(motion, load, car, g_y, variant)
    F_yc = F_yf if small_angle else F_yf * load.cos_d
    F_y = F_yc + F_yr + disturbance.F_d
    phi_dot, phi_ddot = 0.0, 0.0
    if roll:
        phi_dot = motion.phi_dot
        # double-layer-gps (1) and (3), in which gravity's pull cancels from F_y
        body_moment = disturbance.N_x - car.C_x * phi_dot - car.K_x * motion.phi
        lever = car.S * (F_y * per_m + GRAVITY * motion.phi)
        phi_ddot = (lever + body_moment) * (1.0 / (car.I_x - car.S * car.S * per_m))
        F_y = F_y + car.S * phi_ddot  # double-layer-gps (1)
    if not small_angle:
        F_x = F_x - F_yf * load.sin_d
    dv_x = F_x * per_m - g_x
    if roll or not small_angle:
        dv_x = dv_x + v_y * gamma  # double-layer-gps (4)
    dv_y = F_y * per_m - v_x * gamma - g_y  # tie-vision (1)
    dgamma = (car.l_f * F_yc - car.l_r * F_yr + N_z + disturbance.N_d) * per_I  # tie-vision (2)
    dslip_f, dslip_r = 0.0, 0.0
    if variant.law == MAGIC_FORMULA:
        dslip_f, dslip_r = compute_slip_rates(motion, load, car, small_angle)
    return Velocity(dv_x, dv_y, dgamma, phi_dot, phi_ddot, dslip_f, dslip_r)


@inline
def _compute_course_rates(
    motion: Motion, v_x: Scalar, v_y: Scalar, road: RoadParams, small_angle: int
) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar]:
    """(dX, dY, ds, dy, dtheta)/dt (m/s, rad/s) at a Motion's place and heading."""
    kappa = compute_curvature(road, motion.s)
    if small_angle:
        dY = v_x * motion.psi + v_y  # tie-vision (5), V_x (psi + beta)
        dy = v_x * (motion.psi - motion.theta) + v_y
        return v_x, dY, v_x, dy, v_x * kappa + road.turn
    sin_t, cos_t = sincos(motion.theta)
    sin_r, cos_r = sincos(motion.psi - motion.theta)
    v_along = v_x * cos_r - v_y * sin_r  # in road axes
    v_across = v_x * sin_r + v_y * cos_r
    ds = v_along
    if any_lane(road.curvature != 0.0):
        ds = v_along / maximum(1.0 - kappa * motion.y, 0.1)
    dX, dY = v_along * cos_t - v_across * sin_t, v_along * sin_t + v_across * cos_t
    return dX, dY, ds, v_across, ds * kappa + road.turn


@inline
def derivative(
    motion: Motion, load: TyreLoad, disturbance: DisturbanceForces, car: CarParams,
    road: RoadParams, variant: Variant,
) -> Motion:  # fmt: skip
    """Compute the time derivative of a Motion."""
    gravity = compute_gravity(motion, road, variant.small_angle, 0.0)
    rate = _compute_rates(motion, load, disturbance, car, gravity, variant)
    course = _compute_course_rates(motion, motion.v_x, motion.v_y, road, variant.small_angle)
    return Motion(*(rate[:3] + (motion.gamma,) + course + rate[3:]))  # noqa: RUF005


@inline
def compute_sideslip_angle(v_x: Scalar, v_y: Scalar, small_angle: int) -> Scalar:
    """Compute the sideslip angle (rad): atan2(v_y, v_x), small v_y / v_x; 0 below 0.5 m/s."""
    if small_angle:
        return select(v_x > MIN_SPEED, v_y / maximum(v_x, MIN_SPEED), 0.0)
    is_moving = v_x * v_x + v_y * v_y > MIN_SPEED * MIN_SPEED
    return select(is_moving, atan2(v_y, v_x), 0.0)


@jit
def _take_velocity(motion: Motion) -> Velocity:
    """Velocity part of a Motion."""
    m = motion
    return Velocity(m.v_x, m.v_y, m.gamma, m.phi, m.phi_dot, m.slip_f, m.slip_r)


@jit
def _step_euler(start: Velocity, h: Scalar, rate: Velocity) -> Velocity:
    """Velocity start + h rate, written out so that it compiles for every number type."""
    return Velocity(
        start.v_x + h * rate.v_x, start.v_y + h * rate.v_y, start.gamma + h * rate.gamma,
        start.phi + h * rate.phi, start.phi_dot + h * rate.phi_dot, start.slip_f + h * rate.slip_f,
        start.slip_r + h * rate.slip_r,
    )  # fmt: skip


@jit
def _average(first: Scalar, middle: Scalar, last: Scalar) -> Scalar:
    """Mean of a number by Simpson's rule."""
    return (first + 4.0 * middle + last) * (1.0 / 6.0)


@jit
def _average_velocities(a: Velocity, b: Velocity, c: Velocity) -> Velocity:
    """Mean of three Velocities by Simpson's rule."""
    return Velocity(
        _average(a.v_x, b.v_x, c.v_x), _average(a.v_y, b.v_y, c.v_y),
        _average(a.gamma, b.gamma, c.gamma), _average(a.phi, b.phi, c.phi),
        _average(a.phi_dot, b.phi_dot, c.phi_dot), _average(a.slip_f, b.slip_f, c.slip_f),
        _average(a.slip_r, b.slip_r, c.slip_r),
    )  # fmt: skip


@jit
def _average_two(a: Velocity, b: Velocity) -> Velocity:
    """Mean of two Velocities."""
    return Velocity(
        0.5 * (a.v_x + b.v_x), 0.5 * (a.v_y + b.v_y), 0.5 * (a.gamma + b.gamma),
        0.5 * (a.phi + b.phi), 0.5 * (a.phi_dot + b.phi_dot), 0.5 * (a.slip_f + b.slip_f),
        0.5 * (a.slip_r + b.slip_r),
    )  # fmt: skip


@inline
def _compute_mid_gravity(
    motion: Motion, road: RoadParams, h: Scalar, small_angle: int
) -> tuple[Scalar, Scalar]:
    """Measured gravity (m/s2) in the middle of a step of h seconds, extrapolated from its start."""
    if not any_lane((road.lateral != 0.0) | (road.longitudinal != 0.0) | (road.wave != 0.0)):
        return 0.0, 0.0
    return compute_gravity(motion, road, small_angle, 0.5 * h)


@inline
def _integrate_motion(
    motion: Motion, middle: Velocity, end: Velocity, mean: Velocity, road: RoadParams, h: Scalar,
    small_angle: int,
) -> Motion:  # fmt: skip
    """Motion after h seconds from the velocities halfway, at the end and in the mean."""
    # Forces do not depend on place and heading, which follow here once a step. The mean of the
    # turning velocity is the mean velocity in the mean direction, but for its length, 1 - r^2 / 24
    # after a turn by r, and r / 12 of its change to the side: an error of h^5 a step. The road's
    # direction is taken halfway by the start's velocity: below 1e-7 m a second at 1 ms.
    half, angle = 0.5 * h, h * mean.gamma
    shrink, side_gain = 1.0 - angle * angle * (1.0 / 24.0), angle * (1.0 / 12.0)
    v_x = shrink * mean.v_x - side_gain * (end.v_y - motion.v_y)
    v_y = shrink * mean.v_y + side_gain * (end.v_x - motion.v_x)
    psi = motion.psi + h * (motion.gamma + 2.0 * middle.gamma) * (1.0 / 6.0)  # mean heading
    s, y, theta = motion.s, motion.y, motion.theta
    if any_lane(road.curvature != 0.0) or any_lane(road.turn != 0.0):
        course = _compute_course_rates(motion, motion.v_x, motion.v_y, road, small_angle)
        _, _, ds, dy, dtheta = course
        s, y, theta = s + half * ds, y + half * dy, theta + half * dtheta
    mid_motion = Motion(
        v_x, v_y, mean.gamma, psi, motion.X, motion.Y, s, y, theta, end.phi, end.phi_dot,
        end.slip_f, end.slip_r,
    )  # fmt: skip
    dX, dY, ds, dy, dtheta = _compute_course_rates(mid_motion, v_x, v_y, road, small_angle)
    return Motion(
        end.v_x, end.v_y, end.gamma, motion.psi + angle, motion.X + h * dX, motion.Y + h * dY,
        motion.s + h * ds, motion.y + h * dy, motion.theta + h * dtheta, end.phi, end.phi_dot,
        end.slip_f, end.slip_r,
    )  # fmt: skip


@inline
def kutta3(
    motion: Motion, load: tuple[TyreLoad, TyreLoad, TyreLoad], disturbance: DisturbanceForces,
    car: CarParams, road: RoadParams, h: Scalar, variant: Variant,
) -> Motion:  # fmt: skip
    """Integrate the plant over h seconds by Kutta's third-order rule."""
    gravity = _compute_mid_gravity(motion, road, h, variant.small_angle)
    start = _take_velocity(motion)
    a = _compute_rates(start, load[0], disturbance, car, gravity, variant)
    middle = _step_euler(start, 0.5 * h, a)
    b = _compute_rates(middle, load[1], disturbance, car, gravity, variant)
    trial = _step_euler(_step_euler(start, 0.0 - h, a), 2.0 * h, b)
    c = _compute_rates(trial, load[2], disturbance, car, gravity, variant)
    mean = _average_velocities(start, middle, trial)
    end = _step_euler(start, h, _average_velocities(a, b, c))
    return _integrate_motion(motion, middle, end, mean, road, h, variant.small_angle)


@inline
def rk4(
    motion: Motion, load: tuple[TyreLoad, TyreLoad, TyreLoad], disturbance: DisturbanceForces,
    car: CarParams, road: RoadParams, h: Scalar, variant: Variant,
) -> Motion:  # fmt: skip
    """Integrate the plant over h seconds, longer in plans, by the classical Runge-Kutta method."""
    gravity = _compute_mid_gravity(motion, road, h, variant.small_angle)
    start = _take_velocity(motion)
    a = _compute_rates(start, load[0], disturbance, car, gravity, variant)
    first = _step_euler(start, 0.5 * h, a)
    b = _compute_rates(first, load[1], disturbance, car, gravity, variant)
    second = _step_euler(start, 0.5 * h, b)
    c = _compute_rates(second, load[1], disturbance, car, gravity, variant)
    end = _step_euler(start, h, c)
    d = _compute_rates(end, load[2], disturbance, car, gravity, variant)
    middle, mid_rate = _average_two(first, second), _average_two(b, c)
    mean = _average_velocities(start, middle, end)
    last = _step_euler(start, h, _average_velocities(a, mid_rate, d))
    return _integrate_motion(motion, middle, last, mean, road, h, variant.small_angle)
