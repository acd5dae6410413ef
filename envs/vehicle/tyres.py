"""The tyres: normal load, friction circle, slip and lateral force.

As in `dynamics`, no function branches on values, except by `any_lane`. A law of the lateral force
has its name in `TYRE_LAWS` and its equation in `compute_lateral_forces`. `estimators.core.model`
has Fiala's once more, with slopes; a test holds both equal.

The Magic Formula's numbers are published: Pacejka, Tyre and Vehicle Dynamics, 2nd ed. (2006), Table
A3.1, 205/60R15 91V at 2.2 bar, without camber, ply steer and conicity: shape, and what F_z changes.
Nominal is the axle's standing load, with the car's stiffness and friction: it scales to small cars.
"""

from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..numerics.functions import atan, compute_arctan_gap, sincos
from ..numerics.jit import as_python, inline, jit
from ..numerics.primitives import ARRAYS, Scalar, absolute, any_lane, maximum, minimum, select, sqrt
from .parameters import GRAVITY, Vehicle

Car: TypeAlias = Any  # `CarParams` of `dynamics`, which imports this file
State: TypeAlias = Any  # its `Motion` or `Velocity`
Axles: TypeAlias = tuple[Scalar, Scalar]  # a number of the front axle, one of the rear
Variant: TypeAlias = Any  # a `PlantVariant`, or the engine's `StepVariant`, which has its fields

TYRE_LAWS = ("linear", "fiala", "dugoff", "magic-formula")
"""The laws by the names that `Scenario.tyres` takes; a law's code is its place."""
LINEAR, FIALA, DUGOFF, MAGIC_FORMULA = range(len(TYRE_LAWS))

MIN_SPEED = 0.5  # m/s: below it slip is computed as at this speed, and beta is zero

_P_CY1 = 1.193  # shape factor C
_P_DY2 = 0.145 / -0.990  # pDy2 / pDy1: change of friction with load
_P_EY1, _P_EY2 = -1.003, -0.537  # curvature factor E, and its change with load
_P_KY2 = 2.130  # load of the largest cornering stiffness
_MAX_LOAD = 2.0  # largest load by drive that these numbers take, over the standing load


class PlantVariant(NamedTuple):
    """Integers that choose the plant's equations."""

    small_angle: int  # 1: the small-angle plant
    law: int  # place in `TYRE_LAWS`
    roll: int = 0  # 1: the body rolls


class TyreInputs(NamedTuple):
    """Steering angle and motor torques at one instant."""

    delta_f: Scalar  # rad, front steering angle
    T_l: Scalar  # N m, left motor
    T_r: Scalar  # N m, right motor


class TyreLoad(NamedTuple):
    """What steering and torques make of the tyres at one instant; "load" is not F_z here."""

    sin_d: Scalar  # sine of the front steering angle
    cos_d: Scalar  # its cosine
    steer: Scalar  # rad, the angle itself
    F_x: Scalar  # N, drive force
    N_z: Scalar  # N m, yaw moment of the motors
    limit_f: Scalar  # N, lateral capacity F_max of one front tyre
    limit_l: Scalar  # N, of the left rear tyre
    limit_r: Scalar  # N, of the right rear tyre
    slope_f: Scalar  # 1/rad, C / (3 F_max) of a front tyre
    slope_l: Scalar  # 1/rad, of the left rear tyre
    slope_r: Scalar  # 1/rad, of the right rear tyre
    rear_l: Scalar  # N, friction of the left and right rear tyre in all directions, without roll
    rear_r: Scalar
    F_l: Scalar  # N, drive force that the left motor commands
    F_r: Scalar  # N, that of the right motor
    load_f: Scalar  # F_z of a front and a rear tyre over its standing load, without roll
    load_r: Scalar


@inline
def _compute_squared_capacity(limit: Scalar, drive: Scalar) -> Scalar:
    """Squared lateral capacity (N2) of a tyre that drives: friction circle, at least (5 %)^2."""
    return maximum(limit * limit - drive * drive, 0.0025 * limit * limit)


@jit
def _has_moving_limits(variant: Variant) -> bool:
    """Whether the tyres' limits depend on loads that the motion shifts, or on F_z itself."""
    is_limited = variant.law == MAGIC_FORMULA or (variant.law != LINEAR and variant.roll == 1)
    return bool(variant.small_angle == 0 and is_limited)


@inline
def compute_tyre_load(inputs: Any, car: Car, variant: Variant) -> TyreLoad:
    """Compute the tyres' load, forces and capacities, under the inputs of one instant.

    The front tyres have the mean friction of both sides. Each rear tyre's friction limits its
    motor's force, and drive force moves load between the axles, but not on the small-angle plant.
    Where the motion shifts load, friction does not limit the drive force here, and the rear tyres'
    limits are mu F_z.

    Args:
        inputs: Steering and torques: `TyreInputs`, or the actuators' state.
        car: Parameters, `CarParams`.
        variant: `PlantVariant` or `StepVariant` of the plant.
    """
    small_angle = variant.small_angle
    weight = car.m * GRAVITY / (2.0 * (car.l_f + car.l_r))
    front = 0.5 * (car.mu + car.mu_r) * weight * car.l_r
    rear_l, rear_r = car.mu * weight * car.l_f, car.mu_r * weight * car.l_f
    command_l, command_r = inputs.T_l * (car.k_l / car.r), inputs.T_r * (car.k_r / car.r)
    F_l, F_r, load_f, load_r = command_l, command_r, 1.0, 1.0
    if not small_angle and any_lane(car.h_x > 0.0):
        # F_x h_x / (2 l) moves from each front wheel to the rear one behind it. F_x is within the
        # tyres' standing capacity, so that it does not depend on its own effect. At most nine
        # tenths of an axle's standing load move.
        F_x = minimum(maximum(F_l, 0.0 - rear_l), rear_l)
        F_x = F_x + minimum(maximum(F_r, 0.0 - rear_r), rear_r)
        shift = F_x * car.h_x * (0.5 / (car.l_f + car.l_r))
        shift = minimum(maximum(shift, -0.9 * weight * car.l_f), 0.9 * weight * car.l_r)
        front = front - 0.5 * (car.mu + car.mu_r) * shift
        rear_l, rear_r = rear_l + car.mu * shift, rear_r + car.mu_r * shift
        load_f = minimum(1.0 - shift / (weight * car.l_r), _MAX_LOAD)
        load_r = minimum(1.0 + shift / (weight * car.l_f), _MAX_LOAD)
    s, c = sincos(inputs.delta_f)
    left, right = rear_l, rear_r
    if not small_angle and not _has_moving_limits(variant):
        F_l = minimum(maximum(F_l, 0.0 - rear_l), rear_l)
        F_r = minimum(maximum(F_r, 0.0 - rear_r), rear_r)
        left = sqrt(_compute_squared_capacity(rear_l, F_l))
        right = sqrt(_compute_squared_capacity(rear_r, F_r))
    return TyreLoad(
        s, c, inputs.delta_f, F_l + F_r, 0.5 * car.d_r * (F_r - F_l), front, left, right,
        car.C_f / (3.0 * front), car.C_r / (3.0 * left), car.C_r / (3.0 * right),
        rear_l, rear_r, command_l, command_r, load_f, load_r,
    )  # fmt: skip


class Tyre(NamedTuple):
    """One tyre at one instant."""

    # t, tangent of its slip angle, or on the small-angle plant the angle; where load moves, its
    # lateral speed (m/s), and `slope` is over the forward speed: the product counts
    tangent: Scalar
    limit: Scalar  # N, F_max: what the drive force leaves of mu F_z on the friction circle
    slope: Scalar  # C / (3 F_max)
    load: Scalar = 1.0  # F_z over the standing load; the Magic Formula alone reads it


@jit
def _linear(tyre: Tyre, small_angle: int) -> Scalar:
    """Lateral force (N) F_y = C atan t, without a limit."""
    angle = tyre.tangent if small_angle else atan(tyre.tangent)
    return 3.0 * tyre.limit * (tyre.slope * angle)


@jit
def _fiala(tyre: Tyre) -> Scalar:
    """Lateral force (N) F_max z (3 - 3 |z| + z^2), z = clip(C t / (3 F_max), -1, 1)."""
    # Pacejka, Tire and Vehicle Dynamics, 3
    z = minimum(maximum(tyre.slope * tyre.tangent, -1.0), 1.0)
    return tyre.limit * z * (3.0 - 3.0 * absolute(z) + z * z)


@jit
def _dugoff(tyre: Tyre) -> Scalar:
    """Lateral force (N) C t q (2 - q), q = min(1, F_max / (2 C |t|))."""
    # Dugoff, Fancher, Segel, SAE 700377, 1970. With u = C t / F_max it is F_max u up to |u| = 1/2
    # and F_max (1 - 1 / (4 |u|)) from there on, always below the limit.
    u = 3.0 * (tyre.slope * tyre.tangent)
    size = absolute(u)
    max_ratio = minimum(size, 0.5) + (0.5 - 0.25 / maximum(size, 0.5))
    return tyre.limit * minimum(maximum(u, 0.0 - max_ratio), max_ratio)


@jit
def _apply_magic_formula(tyre: Tyre) -> Scalar:
    """Lateral force (N) F_max sin(C atan(B t - E (B t - atan B t))), B C F_max = slope at zero."""
    # Pacejka (2006), (4.E19)-(4.E26)
    x = tyre.slope * ((3.0 / _P_CY1) * tyre.tangent)
    E = (_P_EY1 - _P_EY2) + _P_EY2 * tyre.load
    y = x - (E * x) * compute_arctan_gap(x)
    z = 1.0 + y * y
    s = sqrt(z)
    # a rational fit of sin(C atan y) / y for C = _P_CY1 alone, to 2e-12: faster than both functions
    above = (0.95439677509688102 * z + 1.8352163560088414) * z + 0.042236923574876198
    above = above + s * (2.3193336981700569 * z + 0.52958079101713026)
    below = (2.0569790286145251 * z + 0.31982684439427181) * z - 0.00010492429988359089
    below = below + s * ((z + 1.3669130170659188) * z + 0.018133346771509709)
    return tyre.limit * y * (above / below)


@inline
def compute_lateral_forces(a: Tyre, b: Tyre, c: Tyre, d: Tyre, law: int, small_angle: int) -> Any:
    """Compute the four tyres' lateral forces (N), a to d; the law is chosen once for all of them.

    Args:
        a: `Tyre` front left.
        b: `Tyre` front right.
        c: `Tyre` rear left.
        d: `Tyre` rear right.
        law: Code of the tyre law, its place in `TYRE_LAWS`.
        small_angle: 1 for the small-angle plant, else 0.
    """
    if law == LINEAR:
        s = small_angle
        return _linear(a, s), _linear(b, s), _linear(c, s), _linear(d, s)
    if law == DUGOFF:
        return _dugoff(a), _dugoff(b), _dugoff(c), _dugoff(d)
    if law == MAGIC_FORMULA:
        a_b = _apply_magic_formula(a), _apply_magic_formula(b)
        return *a_b, _apply_magic_formula(c), _apply_magic_formula(d)
    return _fiala(a), _fiala(b), _fiala(c), _fiala(d)


@jit
def _split_slip_tangents(
    motion: State, load: TyreLoad, car: Car, small_angle: int
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Split the tangents of both slip angles into numerator and denominator (m/s)."""
    front, rear = motion.v_y + car.l_f * motion.gamma, motion.v_y - car.l_r * motion.gamma
    if small_angle:
        v = maximum(motion.v_x, MIN_SPEED)
        # delta_f - beta - l_f gamma / V_x and l_r gamma / V_x - beta of tie-vision (1)
        return motion.v_x * load.steer - front, v, 0.0 - rear, v
    v_along = maximum(absolute(motion.v_x * load.cos_d + front * load.sin_d), MIN_SPEED)
    v_across = motion.v_x * load.sin_d - front * load.cos_d
    return v_across, v_along, 0.0 - rear, maximum(absolute(motion.v_x), MIN_SPEED)


@jit
def _compute_slips(motion: State, load: TyreLoad, car: Car, small_angle: int) -> Axles:
    """Compute the tangents (front, rear) of the slip angles, positive for a force to the left."""
    across_f, along_f, across_r, along_r = _split_slip_tangents(motion, load, car, small_angle)
    return across_f / along_f, across_r / along_r


@jit
def compute_slip_rates(motion: State, load: TyreLoad, car: Car, small_angle: int) -> Axles:
    """Compute the rates (1/s) at which the slip of relaxing tyres follows, of (front, rear).

    sigma dt'/dt = |v_along| (t - t'): Pacejka (2006), (7.7). Without a length both are zero.
    """
    across_f, along_f, across_r, along_r = _split_slip_tangents(motion, load, car, small_angle)
    is_relaxing = car.relaxation > 0.0
    per_length = select(is_relaxing, 1.0 / select(is_relaxing, car.relaxation, 1.0), 0.0)
    front = (across_f - along_f * motion.slip_f) * per_length
    return front, (across_r - along_r * motion.slip_r) * per_length


@jit
def _compute_relaxed_slips(motion: State, load: TyreLoad, car: Car, small_angle: int) -> Axles:
    """Compute the tangents (front, rear) that act: the states, or without a length the slips."""
    t_f, t_r = motion.slip_f, motion.slip_r
    is_rigid = car.relaxation == 0.0
    if any_lane(is_rigid):
        direct_f, direct_r = _compute_slips(motion, load, car, small_angle)
        t_f, t_r = select(is_rigid, direct_f, t_f), select(is_rigid, direct_r, t_r)
    return t_f, t_r


@inline
def _compute_load_transfer(motion: State, car: Car, g_y: Scalar) -> Axles:
    """Fractions (-0.9 to 0.9) of its load that the front and the rear left wheel give to the right.

    The suspension transmits K_x phi + C_x phi_dot; the moment of the rest of the car's height,
    (M h - M_s h_s) a_y, acts at once, with a_y = v_x gamma and gravity. Each axle bears it in
    proportion to its standing load.
    """
    direct = (car.m * car.h - car.S) * (motion.v_x * motion.gamma + g_y)
    moment = car.K_x * motion.phi + car.C_x * motion.phi_dot + direct
    half_weight = 0.5 * car.m * GRAVITY
    front, rear = moment * (1.0 / (half_weight * car.d_f)), moment * (1.0 / (half_weight * car.d_r))
    return minimum(maximum(front, -0.9), 0.9), minimum(maximum(rear, -0.9), 0.9)


@inline
def compute_tyre_forces(
    motion: State, load: TyreLoad, car: Car, g_y: Scalar, variant: Variant
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Compute (F_yf, F_yr, F_x, N_z): the axles' lateral forces, drive force (N), moment (N m)."""
    a, b, c, d, F_x, N_z = compute_tyres(motion, load, car, g_y, variant)
    F_fl, F_fr, F_rl, F_rr = compute_lateral_forces(a, b, c, d, variant.law, variant.small_angle)
    return F_fl + F_fr, F_rl + F_rr, F_x, N_z


@inline
def compute_tyres(
    motion: State, load: TyreLoad, car: Car, g_y: Scalar, variant: Variant
) -> tuple[Tyre, Tyre, Tyre, Tyre, Scalar, Scalar]:
    """Compute four `Tyre` (front, then rear; left first), drive force (N) and yaw moment (N m)."""
    if variant.law == MAGIC_FORMULA and not variant.small_angle:
        return _compute_magic_tyres(motion, load, car, g_y, variant)
    if _has_moving_limits(variant):
        return _compute_shifted_tyres(motion, load, car, g_y)
    if variant.law == MAGIC_FORMULA:
        t_f, t_r = _compute_relaxed_slips(motion, load, car, variant.small_angle)
    else:
        t_f, t_r = _compute_slips(motion, load, car, variant.small_angle)
    front = Tyre(t_f, load.limit_f, load.slope_f, load.load_f)
    left = Tyre(t_r, load.limit_l, load.slope_l, load.load_r)
    right = Tyre(t_r, load.limit_r, load.slope_r, load.load_r)
    return front, front, left, right, load.F_x, load.N_z


@inline
def _compute_shifted_tyres(
    motion: State, load: TyreLoad, car: Car, g_y: Scalar
) -> tuple[Tyre, Tyre, Tyre, Tyre, Scalar, Scalar]:
    """`compute_tyres` where roll moves load from side to side; all quotients come from one."""
    across_f, along_f, across_r, along_r = _split_slip_tangents(motion, load, car, 0)
    e_f, e_r = _compute_load_transfer(motion, car, g_y)
    relieved, burdened = 1.0 - e_f, 1.0 + e_f
    rear_l, rear_r = load.rear_l * (1.0 - e_r), load.rear_r * (1.0 + e_r)
    F_l = minimum(maximum(load.F_l, 0.0 - rear_l), rear_l)
    F_r = minimum(maximum(load.F_r, 0.0 - rear_r), rear_r)
    square_l = _compute_squared_capacity(rear_l, load.F_l)
    square_r = _compute_squared_capacity(rear_r, load.F_r)
    left, right = sqrt(square_l), sqrt(square_r)
    sides, squares = relieved * burdened, square_l * square_r
    inv_product = 1.0 / (along_f * along_r * (sides * squares))
    front = load.slope_f * (along_r * squares * inv_product)  # C_f / (3 F_max), standing
    rear = car.C_r * (1.0 / 3.0) * (along_f * sides * inv_product)
    return (
        Tyre(across_f, load.limit_f * relieved, front * burdened, load.load_f * relieved),
        Tyre(across_f, load.limit_f * burdened, front * relieved, load.load_f * burdened),
        Tyre(across_r, left, rear * square_r * left, load.load_r * (1.0 - e_r)),
        Tyre(across_r, right, rear * square_l * right, load.load_r * (1.0 + e_r)),
        F_l + F_r,
        0.5 * car.d_r * (F_r - F_l),
    )


@inline
def _compute_magic_tyres(
    motion: State, load: TyreLoad, car: Car, g_y: Scalar, variant: Variant
) -> tuple[Tyre, Tyre, Tyre, Tyre, Scalar, Scalar]:
    """`compute_tyres` of the Magic Formula: with f = F_z over the standing load, p = pKy2, friction
    is mu (1 + (f - 1) pDy2 / pDy1), stiffness C f (p^2 + 1) / (p^2 + f^2); all quotients from one.
    """
    t_f, t_r = _compute_relaxed_slips(motion, load, car, 0)
    e_f, e_r = 0.0, 0.0
    if variant.roll:
        e_f, e_r = _compute_load_transfer(motion, car, g_y)
    a, b = load.load_f * (1.0 - e_f), load.load_f * (1.0 + e_f)
    c, d = load.load_r * (1.0 - e_r), load.load_r * (1.0 + e_r)
    mu_a, mu_b = (1.0 - _P_DY2) + _P_DY2 * a, (1.0 - _P_DY2) + _P_DY2 * b
    mu_c, mu_d = (1.0 - _P_DY2) + _P_DY2 * c, (1.0 - _P_DY2) + _P_DY2 * d
    rear_l, rear_r = load.rear_l * (1.0 - e_r) * mu_c, load.rear_r * (1.0 + e_r) * mu_d
    F_l = minimum(maximum(load.F_l, 0.0 - rear_l), rear_l)
    F_r = minimum(maximum(load.F_r, 0.0 - rear_r), rear_r)
    square_l = _compute_squared_capacity(rear_l, load.F_l)
    square_r = _compute_squared_capacity(rear_r, load.F_r)
    left, right = sqrt(square_l), sqrt(square_r)
    p2 = _P_KY2 * _P_KY2
    per_a, per_b = mu_a * (p2 + a * a), mu_b * (p2 + b * b)
    per_c, per_d = square_l * (p2 + c * c), square_r * (p2 + d * d)
    fronts, rears = per_a * per_b, per_c * per_d
    inv_product = (p2 + 1.0) / (fronts * rears)
    front, rear = rears * inv_product, fronts * inv_product
    C_f, C_r = load.slope_f * load.load_f, car.C_r * (1.0 / 3.0)  # thirds of stiffnesses, scaled
    return (
        Tyre(t_f, load.limit_f * (1.0 - e_f) * mu_a, C_f * per_b * front, a),
        Tyre(t_f, load.limit_f * (1.0 + e_f) * mu_b, C_f * per_a * front, b),
        Tyre(t_r, left, C_r * per_d * c * left * rear, c),
        Tyre(t_r, right, C_r * per_c * d * right * rear, d),
        F_l + F_r,
        0.5 * car.d_r * (F_r - F_l),
    )


def fit_fiala(vehicle: Vehicle) -> Vehicle:
    """Fit Fiala's law to a car of the Magic Formula, for filters and planners without it.

    Least squares of the forces at the standing load, over slips from zero to the peak's with equal
    weights. As fractions of mu F_z, over C t / (mu F_z), both axles have one curve: so one pair of
    factors, on stiffness and friction, fits both.
    """
    from scipy.optimize import curve_fit

    u = np.linspace(0.0, 6.0, 601)
    force = as_python(_apply_magic_formula, ARRAYS)(Tyre(u, 1.0, 1.0 / 3.0))
    n, fiala = int(force.argmax()) + 1, as_python(_fiala, ARRAYS)
    (C, mu), _ = curve_fit(
        lambda u, C, mu: fiala(Tyre(u, mu, C / (3.0 * mu))), u[:n], force[:n], (1.0, 1.0)
    )
    return vehicle.scale_stiffness(float(C)).replace(friction=vehicle.friction * float(mu))
