"""Corrections: by a slow sensor's sample and by the fast sensors of a tick."""

import numpy as np

from ...envs.numerics.functions import wrap
from ...envs.numerics.jit import inline, jit, noinline
from ...envs.numerics.packed import load8, store8
from ...envs.numerics.primitives import Scalar, Vector, absolute, maximum, minimum
from ...envs.record import PACKET
from .covariance import correct_scalar, dot, has_covariance, project, project_row
from .innovation import check_sample, compute_sample_variance, note_surprise
from .intersample import (
    add_gain,
    correct_between,
    correct_by_sample,
    has_pseudo_residuals,
    locate_frame_row,
    locate_step_row,
    predict_between,
    split_sample_gain,
    start_shares,
)
from .late_samples import ASSUMED, PREDICTED, WEIGHED, correct_late, predict_sample, turn_heading
from .memory import COUNTERS, GAIN, FilterMemory, GainTables
from .model import MIN_SPEED, is_finite
from .predict import compute_residual

_MIN_SCALE, _MAX_SCALE = 0.05, 100.0  # limits of the adapted factor on R
_HEADING_TOLERANCE = 0.5  # rad, residual of the first heading fix above which it sets the heading


@jit
def _compute_residuals(f: FilterMemory, s: int, target: int) -> None:
    """Compute f.residual of every row, wrapped where it is an angle; a heading fix may set psi."""
    has_expected = has_pseudo_residuals(f) and target not in (PREDICTED, ASSUMED)
    for i in range(f.rows[s]):  # `expected`: before this tick's corrections
        prediction = f.expected[i] if has_expected else predict_sample(f, s, i, target)
        residual = f.sample[PACKET.value + i] - prediction
        f.residual[i] = wrap(residual) if f.angle[s, i] == 1 else residual
    if f.heading_fix[s] == 1 and f.first_fix < 0:
        f.first_fix = int(f.sample[PACKET.captured])
        if absolute(f.residual[0]) > _HEADING_TOLERANCE:
            turn_heading(f, s, f.residual[0])
            f.residual[0] = 0.0


@jit
def _reduce_residuals(f: FilterMemory, s: int, target: int, i: int, K: Vector) -> None:
    """Subtract row i's correction by the gain K (total,) from the residuals of the rows behind."""
    for j in range(i + 1, f.rows[s]):
        correction = K[target + j] if target >= 0 else dot(f.C[s, j], K, f.n)
        f.residual[j] -= correction * f.residual[i]


@jit
def _correct_periodic(f: FilterMemory, gains: GainTables, s: int, target: int) -> None:
    """Correct x by the gains of the table, one row after the other."""
    captured = int(f.sample[PACKET.captured])
    first_row = locate_frame_row(f, s, (captured - f.phase[s]) // f.period[s] % f.pattern)
    for i in range(f.rows[s]):
        add_gain(f, gains, first_row + i, f.residual[i])
        _reduce_residuals(f, s, target, i, gains[f.cell, first_row + i])


@jit
def _correct(f: FilterMemory, s: int, target: int) -> None:
    """Correct by the rows of a sample, one after the other, with the covariance."""
    for i in range(f.rows[s]):
        residual, r = f.residual[i], compute_sample_variance(f, s, i)
        if f.r_scale_weight > 0.0 and r > 0.0:  # R follows the mean of residual^2 - C P C^T
            projected = project_row(f, s, i, target)
            sample_scale = (residual * residual - projected) / r * f.scale[s, i]
            scale = f.scale[s, i] + f.r_scale_weight * (sample_scale - f.scale[s, i])
            f.scale[s, i] = minimum(maximum(scale, _MIN_SCALE), _MAX_SCALE)
        correct_scalar(f, project_row(f, s, i, target) + r, residual)
        _reduce_residuals(f, s, target, i, f.gain)
        correct_late(f, f.C[s, i])


@noinline
def update_filter(f: FilterMemory, gains: GainTables, s: int, target: int, is_gated: bool) -> bool:
    """Correct by a slow sensor's sound packet in f.sample; False if the gate refuses it."""
    if is_gated:
        f.nis = np.nan
    previous_fix = f.first_fix
    _compute_residuals(f, s, target)
    if f.gain_rule == GAIN.split:
        split_sample_gain(f, s, target)
    elif f.gain_rule == GAIN.pseudo:
        correct_by_sample(f, gains, s)
    elif f.gain_rule == GAIN.dual_rate:
        start_shares(f, gains, s)
    elif not has_covariance(f):
        _correct_periodic(f, gains, s, target)
    elif target == WEIGHED:  # x <- x + M K residual
        for i in range(f.rows[s]):
            for k in range(f.n):
                f.x[k] += f.larsen_gain[s, i, k] * f.residual[i]
    else:
        is_refused = is_gated and not check_sample(f, s, target)
        if is_gated and f.r_share > 0.0 and f.nis == f.nis:
            note_surprise(f, 1, f.nis / f.rows[s], _SAMPLE_WEIGHT)
        if is_refused:
            f.counts[COUNTERS.gated] += 1
            f.first_fix = previous_fix
            return False
        _correct(f, s, target)
    return True


_SAMPLE_WEIGHT = 1.0 / 12.0  # of a slow sample in the mean of the last ones
# mean surprises beyond which a filter is lost; a clean camera on a bend of a wrong map has 10
_MAX_FAST, _MAX_SLOW = 3.0, 15.0


@jit
def compute_excess(f: FilterMemory) -> Scalar:
    """Compute a filter's mean surprise over its limit, of fast rows or slow samples, the larger."""
    return maximum(f.surprise[0] * (1.0 / _MAX_FAST), f.surprise[1] * (1.0 / _MAX_SLOW))


@jit
def is_healthy(f: FilterMemory) -> Scalar:
    """Return whether a filter is neither lost nor reverses; it is True where noise is fixed."""
    is_forward = f.speed > 0.0 - MIN_SPEED or f.r_share == 0.0
    return is_forward and compute_excess(f) < 1.0


FIRST_VARIANCE = 100.0  # of a fast sensor over the configured one until its first block is over


@jit
def _find_variance(f: FilterMemory, i: int, residual: float, projected: Scalar) -> None:
    """Find the variance of fast row i from blocks' mean innovations; `projected` is C P C^T."""
    # The mean of n rows of white noise has r / n. Coloured noise, as vibration, has more: n times
    # that is the variance which a filter assumes of rows that it takes for independent.
    f.block_sum[i] += residual
    if f.block_rows + 1 < f.block:
        return
    sample, r = f.block_sum[i] * f.block_sum[i] / f.block - projected, f.r_fast[i]
    f.block_sum[i] = 0.0
    share = maximum(f.r_share, 1.0 / (f.blocks + 1.0))
    sample = minimum(maximum(sample, 0.0), 9.0 * r)  # more is an outlier's
    f.r_fast[i] = maximum(r + share * (sample - r), f.r_nominal[i])


@inline
def _correct_by_table(f: FilterMemory, gains: GainTables) -> None:
    """Correct x by fast measurements and the table, one after the other.

    Where a tick's residuals come at once, `correct_between` applies them.
    """
    is_joint = f.gain_rule <= GAIN.joint
    for i in range(f.fasts):
        residual = compute_residual(f, i)
        f.eps[i] = residual if is_finite(residual) else 0.0
        if not is_joint:
            add_gain(f, gains, locate_step_row(f) + i, f.eps[i])


@inline
def _correct_by_covariance(f: FilterMemory) -> None:
    """Correct x and P by fast measurements, one after the other."""
    for i in range(f.fasts):
        residual = compute_residual(f, i)
        if not is_finite(residual):
            f.eps[i] = 0.0
            for j in range(f.total):
                f.tick_gains[i, j] = 0.0
            continue
        projected = project(f, f.C_fast[i])
        if f.r_share > 0.0:
            _find_variance(f, i, residual, projected)
        variance = projected + f.r_fast[i]
        if f.r_share > 0.0:
            note_surprise(f, 0, residual * residual / variance, f.step / f.fasts)
        correct_scalar(f, variance, residual)
        f.eps[i] = residual
        for j in range(0, f.total, 8):  # the design of periodic gains reads them, too
            store8(f.tick_gains, load8(f.gain, j), i, j)
        correct_late(f, f.C_fast[i])
    if f.r_share > 0.0:
        f.block_rows += 1
        if f.block_rows == f.block:
            f.block_rows, f.blocks = 0, f.blocks + 1


@noinline
def correct_fast(f: FilterMemory, gains: GainTables) -> None:
    """Correct by the fast measurements in f.y; what is not finite is counted and skipped."""
    for i in range(f.fasts):
        if not is_finite(f.y[i]):
            f.counts[COUNTERS.invalid] += 1
    predict_between(f, f.first_slow)
    if has_covariance(f):
        _correct_by_covariance(f)
    else:
        _correct_by_table(f, gains)
    correct_between(f, gains, f.first_slow)
