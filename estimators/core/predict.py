"""From one step to the next: a fast row is read, and states and covariance are predicted."""

import numpy as np

from ...envs.numerics.jit import jit, noinline
from ...envs.numerics.packed import load8, load_element, store8, vector_width
from ...envs.numerics.primitives import Scalar, Vector, absolute, maximum, minimum
from ...envs.record import FAST
from .covariance import apply_transition, has_covariance, predict_covariance
from .innovation import MAX_SURPRISE, note_surprise
from .intersample import has_pseudo_residuals
from .late_samples import predict_late
from .memory import COUNTERS, N_SLOW, FilterMemory
from .model import BETA, MIN_SPEED, SPEED_TOLERANCE, build_model, build_tyres, is_finite

_MAX_STEER = 1.0  # rad: no wheels turn further, an angle in degrees soon reads more


@jit
def compute_signal(fast_row: Vector, column: Vector, factor: Vector) -> Scalar:
    """Compute a signal of a fast row: the sum of two of its columns times their factors.

    Args:
        fast_row: Fast row, shape (FAST_WIDTH,).
        column: Indices of the columns, shape (2,).
        factor: Their factors, shape (2,).
    """
    return load_element(factor, 0) * load_element(fast_row, load_element(column, 0)) + load_element(
        factor, 1
    ) * load_element(fast_row, load_element(column, 1))


@jit
def is_speed_changed(speed: Scalar, model_speed: Scalar) -> Scalar:
    """Return whether a speed is further from the model's than `SPEED_TOLERANCE`."""
    return absolute(maximum(speed, MIN_SPEED) - model_speed) > SPEED_TOLERANCE * model_speed


@jit
def _filter_speed(f: FilterMemory, fast_row: Vector) -> Scalar:
    """Compute the low-passed mean of the front wheels' speeds (m/s); a bad sample is skipped."""
    sample = 0.5 * (fast_row[FAST.wheel_left] + fast_row[FAST.wheel_right])
    if not is_finite(sample):
        return f.speed
    if f.model_speed == 0.0:  # no sample yet
        return sample
    return f.speed + f.smoothing * (sample - f.speed)


@jit
def _find_cell(f: FilterMemory, speed: float) -> int:
    """Find the table of gains nearest to a speed (m/s)."""
    if f.spacing == 0.0:
        return 0
    V = minimum(maximum(speed, f.low), f.high)
    return int((V - f.low) / f.spacing + 0.5)


@jit
def find_next_cell(f: FilterMemory, fast_row: Vector) -> Scalar:
    """Find the index of the table of gains that the next row will use."""
    speed = _filter_speed(f, fast_row)
    return _find_cell(f, speed) if is_speed_changed(speed, f.model_speed) else f.cell


@jit
def read_fast_row(f: FilterMemory, fast_row: Vector) -> None:
    """Read a fast row: inputs (the last finite ones), measurements, speed, perhaps a new model."""
    is_sound = True
    for i in range(f.inputs):
        f.u_new[i] = compute_signal(fast_row, f.u_column[i], f.u_factor[i])
    if f.steer_jump > 0.0:  # a steering angle (the first input) that jumps waits for the next row
        steer = f.u_new[0]
        if absolute(steer - f.steer_before) > f.steer_jump or absolute(steer) > _MAX_STEER:
            f.u_new[0] = np.nan
        f.steer_before = steer if is_finite(steer) else f.steer_before
    for i in range(f.inputs):
        is_sound = is_sound and is_finite(f.u_new[i])
    if is_sound:
        for i in range(f.inputs):
            f.u[i] = f.u_new[i]
    else:
        f.counts[COUNTERS.invalid] += 1
        if f.r_share > 0.0:
            note_surprise(f, 0, MAX_SURPRISE, f.step)
    for i in range(f.fasts):
        f.y[i] = compute_signal(fast_row, f.y_column[i], f.y_factor[i])
    turning, f.speed_before = f.turning, f.model_speed
    if is_finite(fast_row[FAST.gyro]):
        turning = f.velocity * fast_row[FAST.gyro]
    is_outdated, speed = turning != f.turning, f.model_speed
    f.speed = _filter_speed(f, fast_row)
    if is_speed_changed(f.speed, f.model_speed):
        is_outdated, speed = True, f.speed
        f.cell = _find_cell(f, f.speed)
    if is_outdated:
        build_model(f, speed, turning)


@jit
def propagate(f: FilterMemory, u: Vector) -> None:
    """Predict x <- F x + H u + drift and, without tables, P; of a block of lanes, too."""
    step = vector_width(f.P)
    apply_transition(f, f.x)
    for j in range(0, f.dense, step):
        total = load8(f.x, j)
        for k in range(f.inputs):
            total = total + load_element(u, k) * load8(f.HT, k, j)
        store8(f.x, total + load8(f.drift, j), j)
    if has_covariance(f):
        predict_covariance(f)


@jit
def _scale_beta(f: FilterMemory) -> None:
    """Scale beta = v_y / V to the model's new speed V, since v_y is what stays."""
    f.x[BETA] *= f.beta_scale
    f.e[BETA] *= f.beta_scale
    for i in range(f.total):
        f.P[BETA, i] *= f.beta_scale
        f.P[i, BETA] *= f.beta_scale
    for s in range(N_SLOW):
        for i in range(f.rows[s]):
            f.larsen_gain[s, i, BETA] *= f.beta_scale
    f.beta_scale = 1.0


@noinline
def advance_state(f: FilterMemory, u: Vector) -> None:
    """Predict by the present model, and what else is carried along."""
    if f.beta_scale != 1.0:
        _scale_beta(f)
    if f.tyre_states > 0 and f.tick % f.linearise_every == 0:
        build_tyres(f, u[0])
    propagate(f, u)
    if has_pseudo_residuals(f):
        apply_transition(f, f.e)
    predict_late(f)


@jit
def compute_residual(f: FilterMemory, i: int) -> Scalar:
    """Compute the residual of a fast measurement; of a block of lanes, too."""
    residual = load_element(f.y, i) - load_element(f.rest_fast, i)
    for k in range(f.n):
        residual = residual - load_element(f.C_fast, i, k) * load_element(f.x, k)
    for j in range(f.inputs):
        residual = residual - load_element(f.D_fast, i, j) * load_element(f.u, j)
    return residual
