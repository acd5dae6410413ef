"""From one step to the next: a fast row read, the prediction, the correction by fast sensors."""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.record import FAST
from ...envs.sensors.slow import GPS
from .covariance import measure_state, predict_covariance
from .delay import LARSEN, keep_promises
from .intersample import (
    PSEUDO,
    SPREAD,
    correct_between,
    expect,
    share_between,
    share_fast,
    spread_between,
)
from .memory import COUNTERS, SLOW
from .speed import cell_of, finite, measured_speed, moved
from .transition import GIVEN, KINEMATIC, VELOCITY_ROLL, build


@jit
def read(f: Any, row: Any, now: Any) -> None:
    """Take a fast row: its inputs (the last finite ones), measurements and speed.

    now: this sample of the speed, m/s. The model is built anew where it has to be.
    """
    f.r_before = f.r[GPS, 0]
    fine = True
    for i in range(f.inputs):
        value = f.u_factor[i, 0] * row[f.u_column[i, 0]] + f.u_factor[i, 1] * row[f.u_column[i, 1]]
        f.ph[i] = value
        fine = fine and finite(value)
    if fine:
        for i in range(f.inputs):
            f.u[i] = f.ph[i]
    else:
        f.counts[COUNTERS.invalid] += 1
    for i in range(f.fasts):
        f.y[i] = f.y_factor[i, 0] * row[f.y_column[i, 0]] + f.y_factor[i, 1] * row[f.y_column[i, 1]]
    turning = f.turning
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
def _predict(f: Any, v: Any) -> None:
    """v <- F v on the states."""
    n, dense, G, T = f.n, f.dense, f.G, f.work[0, 0]
    for i in range(dense):
        total = 0.0
        for k in range(n):
            total += G[i, k] * v[k]
        T[i] = total
    for i in range(dense):
        v[i] = T[i]
    for i in range(dense, n):
        v[i] *= f.decay[i]


@jit
def advance_state(f: Any, u: Any) -> None:
    """x <- F x + H u, and P or e with it."""
    _predict(f, f.x)
    for i in range(f.dense):
        for j in range(f.inputs):
            f.x[i] += f.H[i, j] * u[j]
    if f.kind == GIVEN:
        for i in range(f.n):
            f.x[i] += f.drift[i]
    if f.between == PSEUDO:
        _predict(f, f.e)
    if f.periodic == 0:
        predict_covariance(f)
        if f.late == LARSEN:
            for s in range(SLOW):
                if f.stamp[s, 0] >= 0:
                    for i in range(f.rows[s]):
                        _predict(f, f.promise[s, i])


@jit
def fast_residual(f: Any, i: int) -> Any:
    """Residual of the fast measurement i."""
    residual = f.y[i]
    for k in range(f.n):
        residual -= f.y_row[i, k] * f.x[k]
    for j in range(f.inputs):
        residual -= f.y_feed[i, j] * f.u[j]
    return residual


@jit
def _correct_joint(f: Any, gains: Any) -> None:
    """x += K residuals with residuals that are all taken before, in f.eps."""
    for i in range(f.fasts):
        K = gains[f.cell, 1 + f.at * f.fasts + i]
        for j in range(f.total):
            f.x[j] += K[j] * f.eps[i]


@jit
def correct_fast(f: Any, gains: Any) -> None:
    """Correct by the fast measurements in f.y; what is not finite is counted and skipped."""
    for i in range(f.fasts):
        if not finite(f.y[i]):
            f.counts[COUNTERS.invalid] += 1
    slow = 0 if f.period[0] > 0 else 1
    if f.between == PSEUDO:
        expect(f, slow)
    if f.joint == 1:
        for i in range(f.fasts):
            residual = fast_residual(f, i)
            f.eps[i] = residual if finite(residual) else 0.0
        if f.between == PSEUDO:
            correct_between(f, gains, slow)
        else:
            _correct_joint(f, gains)
        return
    for i in range(f.fasts):
        residual = fast_residual(f, i)
        if not finite(residual):
            f.eps[i] = 0.0
            continue
        if f.periodic == 1:
            K = gains[f.cell, 1 + f.at * f.fasts + i]
            for j in range(f.total):
                f.x[j] += K[j] * residual
            continue
        measure_state(f, f.y_row[i], f.r_fast[i], residual)
        for j in range(f.total):
            f.share[i, j] = f.gain[j]
        if f.between == PSEUDO:
            share_fast(f, i, residual)
        if f.late == LARSEN:
            keep_promises(f, f.y_row[i])
    if f.between == PSEUDO:
        share_between(f, slow)
    elif f.between == SPREAD:
        spread_between(f, gains, slow)
