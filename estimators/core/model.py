"""The linear model of a filter at the present speed: A, B and their exact discretisation.

Estimated tyres, factors on both axles' stiffness and the reciprocal of friction, are states behind
the dense ones. Every few ms each axle's force is expanded at the present state: its slope by slip
stands in `car` and makes the bicycle's matrices, its slopes by the states are columns beside them,
and the rest is a known push.
"""

from ...envs.numerics.functions import sincos
from ...envs.numerics.jit import jit, noinline
from ...envs.numerics.packed import allocate_scratch, load8, load_element, store8, store_element
from ...envs.numerics.primitives import Scalar, absolute, maximum, minimum
from ...envs.vehicle.linear import write_lateral, write_roll
from ...envs.vehicle.parameters import GRAVITY
from .covariance import multiply
from .memory import CAR, N_CORE, N_DRIVERS, N_INPUTS, N_SLOW, FilterMemory

BETA, GAMMA, PSI, Y_L = range(4)  # places of a bicycle's states
CURVATURE = 2  # place of the road's curvature among a bicycle's inputs; others have no third
MIN_SPEED = 1.5  # m/s: below it the model stays that of this speed
SPEED_TOLERANCE = 0.005  # fraction by which the speed moves until the model is built anew
# limits of the estimated factors on the stiffness and of the reciprocal of friction
_LOWEST, _HIGHEST = (0.2, 0.2, 0.0), (3.0, 3.0, 4.0)
_MIN_SLOPE = 0.02  # least slope by slip of a sliding tyre, as a fraction of its stiffness


@jit
def _build_lateral(f: FilterMemory, V: Scalar) -> None:
    """Build tie-vision (8), dakf-stability (5)-(11), a body that rolls and what a_y feels of it."""
    A, B, first = f.A, f.B, N_INPUTS - f.dense  # state j pushes by column first + j of B
    if f.model_speed > 0.0:
        f.beta_scale *= f.model_speed / V
    write_lateral(A, B, f.car, V, f.planar, f.inputs, f.preview)
    B[0, N_INPUTS] = f.push_rate + f.push_force / (f.car[CAR.m] * V)
    _write_body(f, V)
    _write_tyres(f, V)
    B[0, first + f.bank_state] = -GRAVITY / V  # the body does not roll by gravity
    B[Y_L, first + f.map_heading_state] = V
    acts = 1.0 if _is_steering_felt(V) else 0.0
    for i in range(f.dense):  # the input is the measured angle, with the offset in it
        B[i, first + f.steer_offset_state] = 0.0 - acts * B[i, 0]
    _write_accel(f, V)


@jit
def _is_steering_felt(V: Scalar) -> Scalar:
    """Return whether the steering offset acts: a standing car's wheels (V in m/s) turn in vain."""
    return V * (1.0 - 2.0 * SPEED_TOLERANCE) > MIN_SPEED  # by more than V moves without a new model


@jit
def _write_body(f: FilterMemory, V: Scalar) -> None:
    """Write phi, phi_rate and their effect on beta: double-layer-gps (1), (3), solved for phi''."""
    A, B, i = f.A, f.B, f.phi_state
    # phi'' enters F_y, hence phi'' itself: with S = M_s h_s all divides by 1 - S^2 / (M I_x)
    inverse = 1.0 / (1.0 - f.roll_arm * f.sway)
    lift, beta_per_roll = inverse * f.roll_arm, f.sway / V  # 1/m, s
    stiffness = inverse * (f.roll_stiffness - f.roll_arm * GRAVITY)
    write_roll(A, B, i, 0, stiffness, inverse * f.roll_damping, lift * V * B[0, 0])
    A[i + 1, BETA], A[i + 1, GAMMA] = lift * V * A[0, BETA], lift * V * (A[0, GAMMA] + 1.0)
    B[i + 1, N_INPUTS] = lift * V * B[0, N_INPUTS]  # the force that pushes beta
    A[0, i], A[0, i + 1] = 0.0, 0.0
    for j in (BETA, GAMMA, i, i + 1):
        A[0, j] += beta_per_roll * A[i + 1, j]
    B[0, 0] += beta_per_roll * B[i + 1, 0]
    B[0, N_INPUTS] += beta_per_roll * B[i + 1, N_INPUTS]


@jit
def _write_accel(f: FilterMemory, V: Scalar) -> None:
    """Write the specific force a_y = V (beta' + gamma) + g phi, with feed-through of steering."""
    row, first = f.C_fast[f.accel_row], N_INPUTS - f.dense
    for j in range(f.dense):
        row[j] = V * f.A[0, j] + f.felt[j]
    row[GAMMA] = V * (f.A[0, GAMMA] + 1.0)
    for j in range(f.dense, f.n):
        row[j] = V * f.B[0, first + j] + f.felt[j]
    row[f.bank_state] = 0.0  # gravity, which no accelerometer feels
    f.D_fast[f.accel_row, 0] = V * f.B[0, 0]


@jit
def _compute_rates(f: FilterMemory, V: Scalar, front: Scalar, rear: Scalar) -> tuple[Scalar, ...]:
    """Compute (beta', gamma', phi_rate') by forces of the axles in N."""
    beta = (front + rear) / (f.car[CAR.m] * V)
    gamma = (f.car[CAR.l_f] * front - f.car[CAR.l_r] * rear) / f.car[CAR.I]
    phi_rate = f.roll_arm / (1.0 - f.roll_arm * f.sway) * V * beta
    return beta + f.sway / V * phi_rate, gamma, phi_rate


@jit
def _write_tyres(f: FilterMemory, V: Scalar) -> None:
    """Write the estimated tyres' columns of B, besides their slope by slip, and f.push."""
    B, push, phi_rate = f.B, f.push, f.phi_state + 1
    for j in range(f.tyre_states):
        front = f.force_slopes[0, j // 2] if j != 1 else 0.0
        rear = f.force_slopes[1, j // 2] if j != 0 else 0.0
        k = N_INPUTS - f.dense + f.tyres + j
        B[0, k], B[1, k], B[phi_rate, k] = _compute_rates(f, V, front, rear)
    push[0], push[1], push[phi_rate] = _compute_rates(f, V, f.rest[0], f.rest[1])
    course = f.x[BETA] + f.x[PSI]  # y_l' = V sin(course)
    push[f.curved_state] = V * (sincos(course)[0] - course)
    f.rest_fast[f.accel_row] = V * push[0]


@jit
def _compute_axle_force(
    stiffness: Scalar, load: Scalar, alpha: Scalar, factor: Scalar, inverse_friction: Scalar
) -> tuple[Scalar, ...]:
    """Compute an axle's force (N) and its slopes by alpha, factor, 1/friction, by Fiala's law."""
    # F = C s alpha (1 - |z| + z^2 / 3), z = C s alpha / (3 friction F_z) within +-1.
    # stiffness: C (N/rad), load: F_z (N) of the axle. Source: Pacejka, Tire and Vehicle Dynamics, 3
    total_stiffness = stiffness * factor
    slip_ratio = total_stiffness * absolute(alpha) / (3.0 * load)
    z = minimum(slip_ratio * inverse_friction, 1.0)
    saturation = 1.0 - z + z * z * (1.0 / 3.0)
    if z >= 1.0:  # it slides: |F| = friction F_z
        limit = load / inverse_friction
        force = limit if alpha > 0.0 else 0.0 - limit
        return force, _MIN_SLOPE * total_stiffness, 0.0, 0.0 - force / inverse_friction
    slope = (1.0 - z) * (1.0 - z)
    friction_slope = total_stiffness * alpha * slip_ratio * (z * (2.0 / 3.0) - 1.0)
    return (
        total_stiffness * alpha * saturation,
        maximum(slope, _MIN_SLOPE) * total_stiffness,
        stiffness * alpha * slope,
        friction_slope,
    )


@jit
def linearise(f: FilterMemory, steer: Scalar) -> None:
    """Expand both axles' forces at the present state, and set the process noise that follows it."""
    x, V, tyre = f.x, maximum(f.model_speed, MIN_SPEED), f.tyre
    if _is_steering_felt(V):
        steer = steer - f.offset_share * x[f.steer_offset_state]
    beta, gamma = x[0], x[1]
    total_force, moves = 0.0, f.speed > MIN_SPEED
    for i in range(f.tyre_states):  # tyres walk while the car moves
        index = f.tyres + i
        tyre[i] = x[index] = minimum(maximum(x[index], _LOWEST[i]), _HIGHEST[i])
        walks = moves and f.P[index, index] < f.prior[index, index]
        f.Q[index, index] = f.q_tyres[i] if walks else 0.0
    # a map that is late errs by the road's turn in that time
    error, i = f.map_lag * V * f.u[CURVATURE], f.map_heading_state
    f.Q[i, i] = (1.0 - f.decay[i] * f.decay[i]) * (f.prior[i, i] + error * error)
    for i in range(2):
        arm = f.car[CAR.l_f] if i == 0 else 0.0 - f.car[CAR.l_r]
        alpha = (steer if i == 0 else 0.0) - beta - arm * gamma / V
        force, slope, per_factor, per_friction = _compute_axle_force(
            f.stiffness[i], f.load[i], alpha, tyre[i], tyre[2]
        )
        f.car[CAR.C_f + i] = 0.5 * slope  # of one tyre
        if not moves:  # the tyres are unobservable
            per_factor, per_friction = 0.0, 0.0
        f.force_slopes[i, 0], f.force_slopes[i, 1] = per_factor, per_friction
        f.rest[i] = force - slope * alpha - per_factor * tyre[i] - per_friction * tyre[2]
        total_force += absolute(force)
    if f.model_error > 0.0:
        force_error = f.model_error * total_force
        # the axles err independently: half a wheelbase is their mean arm
        moment_error = 0.5 * (f.car[CAR.l_f] + f.car[CAR.l_r]) * force_error
        f.Q[f.dense, f.dense] = f.q_nominal[0] + f.q_share[0] * force_error * force_error
        f.Q[f.dense + 1, f.dense + 1] = f.q_nominal[1] + f.q_share[1] * moment_error * moment_error


@jit
def build_tyres(f: FilterMemory, steer: Scalar) -> None:
    """Build the model of estimated tyres at the present state."""
    linearise(f, steer)
    f.felt[f.accel_scale_state] = 0.0
    build_model(f, f.model_speed, f.turning)
    i, row = f.accel_row, f.C_fast[f.accel_row]
    if f.speed > MIN_SPEED:  # the scale's column is what a_y predicts, 0 at standstill
        specific_force = f.rest_fast[i] + f.D_fast[i, 0] * f.u[0]
        for k in range(f.n):
            specific_force += row[k] * f.x[k]
        row[f.accel_scale_state] = f.felt[f.accel_scale_state] = specific_force


@jit
def discretise(f: FilterMemory) -> None:
    """Compute f.G and f.H of tie-vision (9): exact for inputs and disturbances held over the step.

    Phi = integral of e^(A t) over the step by its Taylor series, after halving the step until
    ||A h|| <= 1/2 and doubling back; G = I + A Phi. Accurate to rounding (relative 1e-14).
    """
    n, m = f.dense - f.delayed, N_INPUTS + f.n - f.dense
    E = allocate_scratch(f.A, N_CORE, N_DRIVERS)
    Phi = allocate_scratch(f.A, N_CORE, N_DRIVERS)
    T = allocate_scratch(f.A, N_CORE, N_DRIVERS)
    one = allocate_scratch(f.A, N_CORE, N_CORE)  # h I
    norm = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += absolute(load_element(f.A, i, j))
        norm = maximum(norm, total * f.step)
    h, doublings = f.step, 0
    while norm > 0.5:
        norm *= 0.5
        h *= 0.5
        doublings += 1
    for i in range(n):
        for j in range(0, n, 8):
            store8(one, 0.0, i, j)
        store_element(one, h, i, i)
        for j in range(0, n, 8):
            store8(Phi, load8(one, i, j), i, j)
    for order in range(15 if norm > 0.05 else 9, 1, -1):  # Horner: h (I + A h / 2 (I + ...))
        multiply(f.A, Phi, T, n, n)
        factor = h / order
        for i in range(n):
            for j in range(0, n, 8):
                store8(Phi, load8(T, i, j) * factor + load8(one, i, j), i, j)
    for _ in range(doublings):  # the integral over 2 h is (I + e^(A h)) times that over h
        multiply(f.A, Phi, E, n, n)
        for i in range(n):
            store_element(E, load_element(E, i, i) + 2.0, i, i)
        multiply(E, Phi, T, n, n)
        for i in range(n):
            for j in range(0, n, 8):
                store8(Phi, load8(T, i, j), i, j)
    multiply(f.A, Phi, E, n, n)
    multiply(Phi, f.B, T, n, m)
    for i in range(n):
        store_element(E, load_element(E, i, i) + 1.0, i, i)
        drift = 0.0
        for j in range(n):
            store_element(f.G, load_element(E, i, j), i, j)
            drift += load_element(Phi, i, j) * load_element(f.push, j)
        store_element(f.drift, drift, i)
        for j in range(f.inputs):
            store_element(f.H, load_element(T, i, j), i, j)
        for j in range(f.n - f.dense):
            store_element(f.G, load_element(T, i, N_INPUTS + j), i, f.dense + j)


@jit
def compute_row_variance(f: FilterMemory, s: int, i: int, V: Scalar) -> Scalar:
    """Compute the variance of a slow sensor's row at a speed."""
    scaled = f.noise_over_speed[s, i]
    return scaled / (V * V) if scaled > 0.0 else f.r[s, i]


@noinline
def build_model(f: FilterMemory, speed: Scalar, turning: Scalar) -> None:
    """Build the model at a speed, and the noise that grows with 1/V."""
    V = maximum(speed, MIN_SPEED)
    if f.planar > 0:
        _build_lateral(f, V)
    elif f.velocity > 0.0:  # v_x, v_y: double-layer-gps (4)-(5)
        f.A[0, 1], f.A[1, 0] = turning, -turning
    f.model_speed, f.turning = V, turning
    discretise(f)
    first = f.dense - f.delayed
    for i in range(f.delayed):  # they follow the camera's states: tie-vision (12), at each step
        for j in range(f.n):
            f.G[first + i, j] = 0.0
        f.G[first + i, PSI + i] = f.relax
        f.G[first + i, first + i] = 1.0 - f.relax
    for i in range(f.dense):
        for k in range(f.n):
            store_element(f.GT, load_element(f.G, i, k), k, i)
        for k in range(f.inputs):
            store_element(f.HT, load_element(f.H, i, k), k, i)
    for s in range(N_SLOW):
        for i in range(f.rows[s]):
            f.r[s, i] = compute_row_variance(f, s, i, V)


MAX_NUMBER = 1e15  # bound of the numbers that a filter takes: whole floats below are exact as int


@jit
def is_finite(value: float) -> Scalar:
    """Return whether a number can be calculated with: not NaN, infinite or beyond `MAX_NUMBER`.

    Args:
        value: Any number.
    """
    return absolute(value) < MAX_NUMBER
