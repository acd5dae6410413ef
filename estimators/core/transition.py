"""The model at a speed, compiled: A and B of each kind, discretised exactly."""

from typing import Any

from ...envs.backend.decorators import apart, jit
from ...envs.backend.primitives import absolute, maximum
from ...envs.sensors.slow import GPS
from ...envs.vehicle.linear import write_kinematic, write_lateral, write_roll
from ...envs.vehicle.vehicle import GRAVITY
from .memory import CORE, INPUTS

LATERAL, ROLL, KINEMATIC, VELOCITY_ROLL, YAW, FORCES, GIVEN = range(7)
"""Kinds of models; GIVEN has its matrices from the user."""

SLOWEST = 1.5  # m/s: below it the model stays that of this speed


@jit
def _lateral(f: Any, V: Any) -> None:
    """tie-vision (8), dakf-stability (5)-(11); a_y = V (beta' + gamma) is an output."""
    A, B = f.A, f.B
    write_lateral(A, B, f.car, V, f.dense - f.delayed, f.preview)
    if f.forces == 1:
        B[0, INPUTS], B[1, INPUTS + 1] = 1.0 / (f.car[0] * V), B[1, 1]
    if f.fasts > 1:
        f.y_row[1, 0], f.y_row[1, 1] = V * A[0, 0], V * (A[0, 1] + 1.0)
        f.y_feed[1, 0] = V * B[0, 0]


@jit
def continuous(f: Any, V: Any, turning: Any) -> None:
    """A and B = [inputs, disturbances] at the speed V and the yaw rate `turning`."""
    A, B = f.A, f.B
    for i in range(CORE):
        for j in range(CORE):
            A[i, j] = 0.0
        for j in range(INPUTS + CORE):
            B[i, j] = 0.0
    if f.forces == 0:
        for j in range(f.n - f.dense):
            B[f.pushed[j], INPUTS + j] = 1.0
    if f.kind == LATERAL:
        _lateral(f, V)
    elif f.kind == ROLL or f.kind == VELOCITY_ROLL:
        i = 0 if f.kind == ROLL else 2
        write_roll(A, B, i, f.inputs - 1, f.roll[0], f.roll[1], f.roll[2])
    if f.kind == KINEMATIC or f.kind == VELOCITY_ROLL:
        write_kinematic(A, B, turning)
        if f.kind == VELOCITY_ROLL:
            A[1, 2] = -GRAVITY  # double-layer-gps (5)
    if f.kind == YAW or f.kind == FORCES:
        B[0, 0] = 1.0 / f.car[1]
        B[0, INPUTS] = 1.0 / f.car[1]
        if f.kind == FORCES:
            B[0, INPUTS], B[0, INPUTS + 1] = f.car[2] / f.car[1], -f.car[3] / f.car[1]


@jit
def _product(a: Any, b: Any, c: Any, n: int, m: int) -> None:
    """c = a b for a (n, n) and b (n, m)."""
    for i in range(n):
        for j in range(m):
            c[i, j] = 0.0
        for k in range(n):
            for j in range(m):
                c[i, j] += a[i, k] * b[k, j]


@jit
def discretise(f: Any) -> None:
    """G and H of tie-vision (9): exact for inputs and disturbances held over the step.

    Phi = integral of e^(A t) over the step by its Taylor series, after halving the step until
    ||A h|| <= 1/2 and doubling back; G = I + A Phi. Accurate to rounding (relative 1e-14).
    """
    n, m = f.dense - f.delayed, INPUTS + f.n - f.dense
    E, Phi, T = f.work[0], f.work[1], f.work[2]
    norm = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += absolute(f.A[i, j])
        norm = maximum(norm, total * f.step)
    h, doublings = f.step, 0
    while norm > 0.5:
        norm *= 0.5
        h *= 0.5
        doublings += 1
    for i in range(n):
        for j in range(n):
            Phi[i, j] = 0.0
        Phi[i, i] = h
    for order in range(15 if norm > 0.05 else 9, 1, -1):  # Horner: h (I + A h / 2 (I + ...))
        _product(f.A, Phi, T, n, n)
        for i in range(n):
            for j in range(n):
                Phi[i, j] = T[i, j] * (h / order)
            Phi[i, i] += h
    for _ in range(doublings):  # the integral over 2 h is (I + e^(A h)) times that over h
        _product(f.A, Phi, E, n, n)
        for i in range(n):
            E[i, i] += 2.0
        _product(E, Phi, T, n, n)
        for i in range(n):
            for j in range(n):
                Phi[i, j] = T[i, j]
    _product(f.A, Phi, E, n, n)
    _product(Phi, f.B, T, n, m)
    for i in range(n):
        E[i, i] += 1.0
        for j in range(n):
            f.G[i, j] = E[i, j]
        for j in range(f.inputs):
            f.H[i, j] = T[i, j]
        for j in range(f.n - f.dense):
            f.G[i, f.dense + j] = T[i, INPUTS + j]


@jit
def _lagging(f: Any) -> None:
    """The delayed states follow what the camera sees: tie-vision (12), at every step."""
    first = f.dense - f.delayed
    for i in range(f.delayed):
        for j in range(f.n):
            f.G[first + i, j] = 0.0
        f.G[first + i, 2 + i] = f.relax
        f.G[first + i, first + i] = 1.0 - f.relax


@apart
def build(f: Any, speed: Any, turning: Any) -> None:
    """The model at a speed in m/s and a yaw rate in rad/s, and the course's variance there."""
    V = maximum(speed, SLOWEST)
    f.model_speed, f.turning = V, turning
    if f.kind != GIVEN:
        continuous(f, V, turning)
        discretise(f)
        _lagging(f)
    if f.r_course > 0.0:
        f.r[GPS, 0] = f.r_course / (V * V)
