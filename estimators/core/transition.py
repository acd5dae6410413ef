"""The model at a speed, compiled: A and B of each kind, discretised exactly."""

from typing import Any

from ...envs.backend.arrays import at, put
from ...envs.backend.decorators import apart, jit
from ...envs.backend.eights import eight, put_eight, scratch
from ...envs.backend.primitives import absolute, maximum
from ...envs.vehicle.linear import write_kinematic, write_lateral, write_roll
from ...envs.vehicle.vehicle import GRAVITY
from .covariance import times
from .memory import CAR, CORE, INPUTS, SLOW, WIDE, Memory, Row

LATERAL, ROLL, KINEMATIC, VELOCITY_ROLL, YAW, FORCES, LINEAR = range(7)
"""Kinds of models; LINEAR is any linear system, whose matrices are arguments."""
BETA, GAMMA, PSI, Y_L = range(4)
"""Places of a bicycle's states."""
CURVATURE = 2
"""Place of the road's curvature among a bicycle's inputs."""

SLOWEST = 1.5  # m/s: below it the model stays that of this speed


@jit
def _lateral(f: Memory, V: Any) -> None:
    """tie-vision (8), dakf-stability (5)-(11), a body that rolls and what a_y feels of it."""
    A, B = f.A, f.B
    rolling = 2 if f.rolling > 0 else 0
    write_lateral(A, B, f.car, V, f.dense - f.delayed - rolling, f.inputs, f.preview)
    if f.forces == 1:
        B[0, INPUTS], B[1, INPUTS + 1] = 1.0 / (f.car[CAR.mass] * V), B[1, 1]
    if rolling > 0:
        _write_body(f, V)
    if f.accel_row > 0:
        _write_accel(f, V)
    if f.tyres > 0:
        _write_tyres(f, V)
    if f.banked >= 0:  # gravity, which an accelerometer does not feel and the body does not roll by
        B[0, INPUTS + f.banked] = -GRAVITY / V


@jit
def _write_body(f: Memory, V: Any) -> None:
    """phi and phi_rate, and how they push beta: double-layer-gps (1), (3), solved for phi''."""
    A, B, i = f.A, f.B, f.rolling
    share = 1.0 / (1.0 - f.roll_arm * f.sway)
    lift, lag = share * f.roll_arm, f.sway / V
    stiffness = share * (f.roll_stiffness - f.roll_arm * GRAVITY)
    write_roll(A, B, i, 0, stiffness, share * f.roll_damping, lift * V * B[0, 0])
    A[i + 1, BETA], A[i + 1, GAMMA] = lift * V * A[0, BETA], lift * V * (A[0, GAMMA] + 1.0)
    B[i + 1, INPUTS] = lift * V * B[0, INPUTS]  # the force that pushes beta
    for j in range(f.dense):
        A[0, j] += lag * A[i + 1, j]
    B[0, 0] += lag * B[i + 1, 0]
    B[0, INPUTS] += lag * B[i + 1, INPUTS]


@jit
def _write_accel(f: Memory, V: Any) -> None:
    """The specific force a_y = V (beta' + gamma) + g phi, a row with feed-through of steering."""
    row = f.C_fast[f.accel_row]
    for j in range(f.dense):
        row[j] = V * f.A[0, j]
    row[GAMMA] = V * (f.A[0, GAMMA] + 1.0)
    if f.pushed[0] >= 0:  # what comes first behind is no bias
        row[f.dense] = V * f.B[0, INPUTS]
    if f.rolling > 0:
        row[f.rolling] += GRAVITY
    f.D_fast[f.accel_row, 0] = V * f.B[0, 0]


@jit
def _pushed(f: Memory, V: Any, front: Any, rear: Any) -> Any:
    """(beta', gamma', phi_rate') by forces of the axles in N."""
    beta = (front + rear) / (f.car[CAR.mass] * V)
    gamma = (f.car[CAR.front_arm] * front - f.car[CAR.rear_arm] * rear) / f.car[CAR.yaw_inertia]
    if f.rolling == 0:
        return beta, gamma, 0.0
    phi_rate = f.roll_arm / (1.0 - f.roll_arm * f.sway) * V * beta
    return beta + f.sway / V * phi_rate, gamma, phi_rate


@jit
def _write_tyres(f: Memory, V: Any) -> None:
    """What the estimated tyres do besides their slope by slip: columns of B, and f.push."""
    for j in range(3):  # both factors, then the grip
        if j < 2 or f.grip > 0:
            front = f.per_tyre[0, j // 2] if j != 1 else 0.0
            rear = f.per_tyre[1, j // 2] if j != 0 else 0.0
            column = (f.tyres + j if j < 2 else f.grip) - f.dense
            beta, gamma, phi_rate = _pushed(f, V, front, rear)
            f.B[0, INPUTS + column], f.B[1, INPUTS + column] = beta, gamma
            if f.rolling > 0:
                f.B[f.rolling + 1, INPUTS + column] = phi_rate
            if f.accel_row > 0:
                f.C_fast[f.accel_row, f.dense + column] = V * beta
    beta, gamma, phi_rate = _pushed(f, V, f.rest[0], f.rest[1])
    f.push[0], f.push[1] = beta, gamma
    if f.rolling > 0:
        f.push[f.rolling + 1] = phi_rate
    f.rest_fast[f.accel_row] = V * beta if f.accel_row > 0 else 0.0


@jit
def continuous(f: Memory, V: Any, turning: Any) -> None:
    """f.A and f.B = [inputs, disturbances] at a speed V in m/s and a yaw rate in rad/s."""
    A, B = f.A, f.B
    for i in range(f.dense):
        for j in range(0, CORE, 8):
            put_eight(A, 0.0, i, j)
        for j in range(0, WIDE, 8):
            put_eight(B, 0.0, i, j)
    if f.forces == 0:
        for j in range(f.n - f.dense):
            if f.pushed[j] >= 0:
                B[f.pushed[j], INPUTS + j] = 1.0
    if f.kind == LATERAL:
        _lateral(f, V)
    elif f.kind == ROLL or f.kind == VELOCITY_ROLL:
        i = 0 if f.kind == ROLL else 2
        write_roll(A, B, i, f.inputs - 1, f.roll_stiffness, f.roll_damping, f.roll_arm)
    if f.kind == KINEMATIC or f.kind == VELOCITY_ROLL:
        write_kinematic(A, B, turning)
        if f.kind == VELOCITY_ROLL:
            A[1, 2] = -GRAVITY  # double-layer-gps (5)
    if f.kind == YAW or f.kind == FORCES:
        I = f.car[CAR.yaw_inertia]  # noqa: E741  the papers' letter
        B[0, 0] = 1.0 / I
        B[0, INPUTS] = 1.0 / I
        if f.kind == FORCES:
            B[0, INPUTS], B[0, INPUTS + 1] = f.car[CAR.front_arm] / I, -f.car[CAR.rear_arm] / I


@jit
def _product(a: Row, b: Row, c: Row, n: int, m: int) -> None:
    """c = a b for a (n, n) and b (n, m), in the corners of larger arrays."""
    for j in range(0, m, 8):
        for i in range(0, n, 4):
            first, second, third, fourth = times(a, i, b, n, j, 0.0, 0.0, 0.0, 0.0)
            put_eight(c, first, i, j)
            put_eight(c, second, i + 1, j)
            put_eight(c, third, i + 2, j)
            put_eight(c, fourth, i + 3, j)


@jit
def discretise(f: Memory) -> None:
    """f.G and f.H of tie-vision (9): exact for inputs and disturbances held over the step.

    Phi = integral of e^(A t) over the step by its Taylor series, after halving the step until
    ||A h|| <= 1/2 and doubling back; G = I + A Phi. Accurate to rounding (relative 1e-14).
    """
    n, m = f.dense - f.delayed, INPUTS + f.n - f.dense
    E, Phi, T = scratch(f.A, CORE, WIDE), scratch(f.A, CORE, WIDE), scratch(f.A, CORE, WIDE)
    one = scratch(f.A, CORE, CORE)  # h I
    norm = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += absolute(at(f.A, i, j))
        norm = maximum(norm, total * f.step)
    h, doublings = f.step, 0
    while norm > 0.5:
        norm *= 0.5
        h *= 0.5
        doublings += 1
    for i in range(n):
        for j in range(0, n, 8):
            put_eight(one, 0.0, i, j)
        put(one, h, i, i)
        for j in range(0, n, 8):
            put_eight(Phi, eight(one, i, j), i, j)
    for order in range(15 if norm > 0.05 else 9, 1, -1):  # Horner: h (I + A h / 2 (I + ...))
        _product(f.A, Phi, T, n, n)
        share = h / order
        for i in range(n):
            for j in range(0, n, 8):
                put_eight(Phi, eight(T, i, j) * share + eight(one, i, j), i, j)
    for _ in range(doublings):  # the integral over 2 h is (I + e^(A h)) times that over h
        _product(f.A, Phi, E, n, n)
        for i in range(n):
            put(E, at(E, i, i) + 2.0, i, i)
        _product(E, Phi, T, n, n)
        for i in range(n):
            for j in range(0, n, 8):
                put_eight(Phi, eight(T, i, j), i, j)
    _product(f.A, Phi, E, n, n)
    _product(Phi, f.B, T, n, m)
    for i in range(n):
        put(E, at(E, i, i) + 1.0, i, i)
        drift = 0.0
        for j in range(n):
            put(f.G, at(E, i, j), i, j)
            drift += at(Phi, i, j) * at(f.push, j)
        put(f.drift, drift, i)
        for j in range(f.inputs):
            put(f.H, at(T, i, j), i, j)
        for j in range(f.n - f.dense):
            put(f.G, at(T, i, INPUTS + j), i, f.dense + j)


@jit
def _transpose(f: Memory) -> None:
    """f.GT and f.HT, by which states and covariance are predicted."""
    for i in range(f.dense):
        for k in range(f.n):
            put(f.GT, at(f.G, i, k), k, i)
        for k in range(f.inputs):
            put(f.HT, at(f.H, i, k), k, i)


@jit
def _lagging(f: Memory) -> None:
    """The delayed states follow what the camera sees: tie-vision (12), at every step."""
    first = f.dense - f.delayed
    for i in range(f.delayed):
        for j in range(f.n):
            f.G[first + i, j] = 0.0
        f.G[first + i, PSI + i] = f.relax
        f.G[first + i, first + i] = 1.0 - f.relax


@jit
def road_turned(V: Any, curvature: Any, step: Any) -> Any:
    """The angle in rad by which a road of a curvature in 1/m turns within a step of so many s."""
    return V * curvature * step


@jit
def variance(f: Memory, s: int, i: int, V: Any) -> Any:
    """The variance of row i of sensor s at a speed of the model in m/s."""
    over = f.noise_over_speed[s, i]
    return over / (V * V) if over > 0.0 else f.r[s, i]


@apart
def build(f: Memory, speed: Any, turning: Any) -> None:
    """The model at a speed in m/s and a yaw rate in rad/s, and the noise that goes with 1/V."""
    V = maximum(speed, SLOWEST)
    if f.kind == LATERAL and f.model_speed > 0.0:
        f.stretch *= f.model_speed / V
    f.model_speed, f.turning = V, turning
    if f.kind != LINEAR:
        continuous(f, V, turning)
        discretise(f)
        _lagging(f)
    _transpose(f)
    for s in range(SLOW):
        for i in range(f.rows[s]):
            f.r[s, i] = variance(f, s, i, V)
