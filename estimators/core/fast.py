"""From one step to the next: a fast row read, the prediction, the correction by fast sensors."""

from typing import Any

import numpy as np

from ...envs.backend.arrays import at, put
from ...envs.backend.decorators import apart, jit
from ...envs.backend.eights import eight, put_eight, scratch, span
from ...envs.backend.primitives import absolute, maximum, minimum
from ...envs.record import FAST
from .covariance import measure_state, predict_covariance
from .delay import BUFFER, LARSEN, carry_gains
from .intersample import (
    DUAL_RATE,
    PSEUDO,
    correct_between,
    expect,
    next_share,
    share_between,
    share_fast,
)
from .memory import CORE, COUNTERS, SLOW, Gains, Memory, Row
from .speed import cell_of, finite, measured_speed, moved, step_row
from .transition import BETA, KINEMATIC, LINEAR, SLOWEST, VELOCITY_ROLL, build
from .tyres import linearise


@jit
def signal(row: Row, column: Row, factor: Row) -> Any:
    """A signal of a fast row (FAST_WIDTH,): the sum of two of its columns times their factors."""
    return at(factor, 0) * at(row, at(column, 0)) + at(factor, 1) * at(row, at(column, 1))


@jit
def _measure_noise(f: Memory, now: float) -> None:
    """The variance of a_y from its second differences, which a car's motion hardly has.

    White noise of variance r gives them 6 r; what is far beyond counts as 9 times what is expected.
    """
    second = now - 2.0 * f.y_past[0] + f.y_past[1]
    if finite(second):
        r = f.r_fast[f.accel_row]
        seen = minimum(second * second * (1.0 / 6.0), 9.0 * r)
        f.r_fast[f.accel_row] = maximum(r + f.r_share * (seen - r), f.r_told)
    f.y_past[1], f.y_past[0] = f.y_past[0], now


@jit
def _scale(f: Memory) -> None:
    """The accelerometer's row has what it should measure now in the column of its scale's error;
    at a standstill nothing of the scale is seen."""
    row = f.C_fast[f.accel_row]
    row[f.scaled] = 0.0
    if f.speed <= SLOWEST:
        return
    felt = f.rest_fast[f.accel_row] + f.D_fast[f.accel_row, 0] * f.u[0]
    for k in range(f.n):
        felt += row[k] * f.x[k]
    row[f.scaled] = felt


@jit
def _check_steering(f: Memory) -> None:
    """A steering angle (the first input) that jumps is none until the next row confirms it."""
    steer = f.u_new[0]
    if absolute(steer - f.steer_before) > f.steer_jump:
        f.u_new[0] = np.nan
    f.steer_before = steer


@jit
def read(f: Memory, row: Row, now: float) -> None:
    """Take a fast row (FAST_WIDTH,): its inputs (the last finite ones), measurements and speed.

    now: this sample of the speed, m/s. The model is built anew where it has to be.
    """
    fine = True
    for i in range(f.inputs):
        f.u_new[i] = signal(row, f.u_column[i], f.u_factor[i])
    if f.steer_jump > 0.0:
        _check_steering(f)
    for i in range(f.inputs):
        fine = fine and finite(f.u_new[i])
    if fine:
        for i in range(f.inputs):
            f.u[i] = f.u_new[i]
    else:
        f.counts[COUNTERS.invalid] += 1
    for i in range(f.fasts):
        f.y[i] = signal(row, f.y_column[i], f.y_factor[i])
    if f.r_share > 0.0:
        _measure_noise(f, f.y[f.accel_row])
    turning, f.speed_before = f.turning, f.model_speed
    if (f.kind == KINEMATIC or f.kind == VELOCITY_ROLL) and finite(row[FAST.gyro]):
        turning = row[FAST.gyro]
    renew = turning != f.turning
    if f.measured == 1:
        f.speed = measured_speed(f, now)
        if moved(f, f.speed):
            renew = True
            f.cell = cell_of(f, f.speed)
    if renew:
        build(f, f.speed if f.measured == 0 or moved(f, f.speed) else f.model_speed, turning)


@jit
def _predict(f: Memory, v: Row) -> None:
    """v <- F v on the states of a vector (n,) or longer."""
    n, new, step = f.n, scratch(f.P, 1, CORE), span(f.P)
    for j in range(0, n, step):
        total = eight(f.keep, j) * eight(v, j)
        for k in range(n):
            total = total + at(v, k) * eight(f.GT, k, j)
        put_eight(new, total, 0, j)
    for j in range(0, n, step):
        put_eight(v, eight(new, 0, j), j)


@jit
def propagate(f: Memory, u: Row) -> None:
    """x <- F x + H u for the inputs u (INPUTS,), and P with it."""
    step = span(f.P)
    _predict(f, f.x)
    for j in range(0, f.dense, step):
        total = eight(f.x, j)
        for k in range(f.inputs):
            total = total + at(u, k) * eight(f.HT, k, j)
        put_eight(f.x, total, j)
    if f.kind == LINEAR or f.tyres > 0:
        for j in range(0, f.n, step):
            put_eight(f.x, eight(f.x, j) + eight(f.drift, j), j)
    if f.periodic == 0:
        predict_covariance(f)


@jit
def _change_speed(f: Memory) -> None:
    """beta = v_y / V at the model's new speed V, since v_y is what stays."""
    f.x[BETA] *= f.stretch
    f.e[BETA] *= f.stretch
    if f.periodic == 0:
        for i in range(f.total):
            f.P[BETA, i] *= f.stretch
        for i in range(f.total):
            f.P[i, BETA] *= f.stretch
        for s in range(SLOW):
            for i in range(f.rows[s]):
                f.larsen_gain[s, i, BETA] *= f.stretch
    f.stretch = 1.0


@apart
def advance_state(f: Memory, u: Row) -> None:
    """`propagate` with the model of now, and what else is carried along."""
    if f.stretch != 1.0:
        _change_speed(f)
    if f.tyres > 0 and (f.tick % f.again == 0 or f.late == BUFFER):
        linearise(f, u[0])
        build(f, f.model_speed, f.turning)
        if f.scaled > 0:
            _scale(f)
    propagate(f, u)
    if f.between == PSEUDO:
        _predict(f, f.e)
    if f.periodic == 0 and f.late == LARSEN:
        for s in range(SLOW):
            if f.stamp[s, 0] >= 0:
                for i in range(f.rows[s]):
                    _predict(f, f.larsen_gain[s, i])


@jit
def residual_of(f: Memory, i: int) -> Any:
    """The residual of the fast measurement i."""
    residual = at(f.y, i) - at(f.rest_fast, i)
    for k in range(f.n):
        residual = residual - at(f.C_fast, i, k) * at(f.x, k)
    for j in range(f.inputs):
        residual = residual - at(f.D_fast, i, j) * at(f.u, j)
    return residual


@jit
def _correct_joint(f: Memory, gains: Gains) -> None:
    """x += K residuals with residuals that are all taken before, in f.eps."""
    for i in range(f.fasts):
        K = gains[f.cell, step_row(f) + i]
        for j in range(f.total):
            f.x[j] += K[j] * f.eps[i]


@apart
def correct_fast(f: Memory, gains: Gains) -> None:
    """Correct by the fast measurements in f.y; what is not finite is counted and skipped."""
    for i in range(f.fasts):
        if not finite(f.y[i]):
            f.counts[COUNTERS.invalid] += 1
    if f.between == PSEUDO:
        expect(f, f.first_slow)
    if f.joint == 1:
        for i in range(f.fasts):
            residual = residual_of(f, i)
            f.eps[i] = residual if finite(residual) else 0.0
        if f.between == PSEUDO:
            correct_between(f, gains, f.first_slow)
        else:
            _correct_joint(f, gains)
        return
    for i in range(f.fasts):
        residual = residual_of(f, i)
        if not finite(residual):
            f.eps[i] = 0.0
            continue
        if f.periodic == 1:
            step = step_row(f) + i
            for j in range(f.total):
                put(f.x, at(f.x, j) + at(gains, f.cell, step, j) * residual, j)
            continue
        measure_state(f, f.C_fast[i], f.r_fast[i], residual)
        for j in range(0, f.total, 8):  # the design of periodic gains reads them, too
            put_eight(f.share, eight(f.gain, j), i, j)
        if f.between == PSEUDO:
            share_fast(f, i, residual)
        if f.late == LARSEN:
            carry_gains(f, f.C_fast[i])
    if f.between == PSEUDO:
        share_between(f, f.first_slow)
    elif f.between == DUAL_RATE:
        next_share(f, gains, f.first_slow)
