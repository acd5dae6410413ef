"""Corrections: by the fast sensors, by a sample, and between samples of a slow sensor.

Rules between samples: pseudo-residual: tie-vision (19)-(22), which uneven-delay (20)-(22),
double-layer-gps (28)-(29), dual-rate (31) and Oh's (35) repeat: the propagated estimate of the
error, by a constant gain K (columns: fast rows, slow rows) or a fraction of the last sample's gain.
dual-rate: fractions of the last innovation from a table.
"""

import numpy as np

from ...envs.numerics.functions import wrap
from ...envs.numerics.jit import jit, noinline
from ...envs.numerics.packed import load_element, store_element
from ...envs.numerics.primitives import Scalar, Vector, absolute, maximum, minimum
from ...envs.numerics.simd8 import load8, store8
from ...envs.record import PACKET
from .covariance import correct_scalar, dot, predict_measurement, project, project_row
from .innovation import (
    BUFFER,
    CONSTANT,
    DUAL_RATE,
    LARSEN,
    NONE,
    PSEUDO,
    STORED_ONE,
    check_sample,
    compute_sample_variance,
    note_surprise,
    propagate_larsen_gains,
)
from .model import MIN_SPEED, PSI, is_finite
from .predict import compute_residual
from .record import COUNTERS, N_SNAPSHOTS, WINDOW, FilterRecord, GainTables


@jit
def _apply_row(f: FilterRecord, s: int, i: int, v: Vector) -> Scalar:
    """Apply row i of sensor s to a vector of states and clones (total,): its clone, if it has."""
    return v[f.first_clone[s] + i] if f.frames[s] > 0 else dot(f.C[s, i], v, f.n)


@jit
def _locate_step_row(f: FilterRecord) -> Scalar:
    """Locate the gain of the first fast measurement in this step."""
    return 1 + f.at * maximum(f.fasts, 1)


@jit
def _locate_frame_row(f: FilterRecord, s: int, frame: int) -> Scalar:
    """Locate the gain of sensor s's first row for a frame, or, at f.pattern, between samples."""
    return 1 + f.cycle * maximum(f.fasts, 1) + frame * f.rows[s]


@jit
def _add_gain(f: FilterRecord, gains: GainTables, row: int, residual: float) -> None:
    """Correct x by a row of the table of gains."""
    for j in range(f.total):
        store_element(f.x, load_element(f.x, j) + load_element(gains, f.cell, row, j) * residual, j)


@jit
def _correct_between(f: FilterRecord, gains: GainTables, s: int) -> None:
    """Correct x and e, both predicted, by the fast residuals in f.eps and the pseudo-residuals."""
    x, e, N, m = f.x, f.e, f.total, f.fasts
    first_row = _locate_frame_row(f, s, f.pattern)
    for i in range(m):
        f.e_seen[i] = dot(f.C_fast[i], e, f.n)
    for i in range(m + f.rows[s]):
        K, projected = gains[f.cell, first_row + i], f.e_seen[i] if i < m else f.eps[i]
        for j in range(N):
            x[j] += K[j] * f.eps[i]
            e[j] -= K[j] * projected  # tie-vision (21): (I - K C) G e


@jit
def _correct_sample(f: FilterRecord, gains: GainTables, s: int) -> None:
    """Correct by a sample of this tick: its residuals replace the pseudo ones; e starts anew."""
    m, N, rows = f.fasts, f.total, f.rows[s]
    first_row = _locate_frame_row(f, s, f.pattern)
    for i in range(rows):
        K, residual = gains[f.cell, first_row + m + i], f.residual[i]  # tie-vision (19)
        for j in range(N):
            f.x[j] += K[j] * (residual - f.eps[m + i])
        f.eps[m + i] = residual
    for j in range(N):  # tie-vision (20): e = (C^+ - K) eps
        total = 0.0
        for i in range(m + rows):
            pinv, K = gains[f.cell, first_row + m + rows + i, j], gains[f.cell, first_row + i, j]
            total += (pinv - K) * f.eps[i]
        f.e[j] = total


@jit
def _split_sample_gain(f: FilterRecord, s: int, first: int) -> None:
    """Correct as `_correct_sample`, with this sample's gain, split evenly over a period."""
    m, N, rows = f.fasts, f.total, f.rows[s]
    steps = f.period[s] // f.stride
    for i in range(rows):
        for j in range(N):
            f.x[j] -= f.share[m + i, j] * f.eps[m + i]
    for i in range(rows):
        r = compute_sample_variance(f, s, i)
        correct_scalar(f, project_row(f, s, i, first) + r, 0.0)
        for k in range(i):  # the rows before it correct what it measures
            correction = _apply_row(f, s, i, f.share[m + k])
            for j in range(N):
                f.share[m + k, j] -= f.gain[j] * correction
        for j in range(N):
            f.share[m + i, j] = f.gain[j] / steps
        f.eps[m + i] = f.residual[i]
    for j in range(N):
        f.e[j] = 0.0
        for i in range(m, m + rows):
            f.x[j] += f.share[i, j] * f.eps[i]
        for i in range(m + rows):
            f.e[j] += (f.inverse[i, j] - f.share[i, j]) * f.eps[i]


@jit
def _apply_share(f: FilterRecord, gains: GainTables, s: int) -> None:
    """Add the fraction of the last innovation that is due now to x."""
    first_row = _locate_frame_row(f, s, f.pattern) + f.since * f.rows[s]
    for i in range(f.rows[s]):
        _add_gain(f, gains, first_row + i, f.innovation[i])


_MIN_SCALE, _MAX_SCALE = 0.05, 100.0  # limits of the adapted factor on R
_HEADING_TOLERANCE = 0.5  # rad, residual of the first heading fix above which it sets the heading


@jit
def _predict_row(f: FilterRecord, s: int, i: int, first: int, captured: int) -> Scalar:
    """Predict row i of a sample."""
    if first == STORED_ONE and f.delay_rule == LARSEN:
        return f.larsen_expected[s, i]
    if first == STORED_ONE:
        stored = maximum(f.tick - f.assumed, f.start) if f.delay_rule == CONSTANT else captured
        stored_prediction = dot(f.C[s, i], f.predicted[stored % WINDOW], f.n)  # uneven-delay (15)
        turn = f.past_road_turn[stored % WINDOW]
        return stored_prediction + turn if f.ground[s, i] == 1 else stored_prediction
    if f.intersample_rule == PSEUDO:
        return f.expected[i]  # before this tick's corrections
    if first >= 0:
        return f.x[first + i]
    return predict_measurement(f, s, i)


@jit
def _align_heading(f: FilterRecord, s: int, turn: float) -> None:
    """Turn the heading onto sensor s's first fix, now and in what it has captured; turn: rad."""
    f.x[PSI] += turn
    f.expected[0] += turn
    if f.first_clone[s] > 0:
        for slot in range(f.frames[s]):
            f.x[f.first_clone[s] + slot * f.rows[s]] += turn
    f.larsen_expected[s, 0] += turn
    if f.delay_rule == BUFFER:
        for i in range(N_SNAPSHOTS + 1):
            f.snapshot_x[i, PSI] += turn


@jit
def _compute_residuals(f: FilterRecord, s: int, first: int) -> None:
    """Compute f.residual of every row, wrapped where it is an angle; a heading fix may set psi."""
    captured = int(f.sample[PACKET.captured])
    for i in range(f.rows[s]):
        residual = f.sample[PACKET.value + i] - _predict_row(f, s, i, first, captured)
        f.residual[i] = wrap(residual) if f.angle[s, i] == 1 else residual
    if f.heading_fix[s] == 1 and f.first_fix < 0:
        f.first_fix = captured
        if absolute(f.residual[0]) > _HEADING_TOLERANCE:
            _align_heading(f, s, f.residual[0])
            f.residual[0] = 0.0


@jit
def _reduce_residuals(f: FilterRecord, s: int, first: int, i: int, K: Vector) -> None:
    """Subtract row i's correction by the gain K (total,) from the residuals of the rows behind."""
    for j in range(i + 1, f.rows[s]):
        correction = K[first + j] if first >= 0 else dot(f.C[s, j], K, f.n)
        f.residual[j] -= correction * f.residual[i]


@jit
def _correct_periodic(f: FilterRecord, gains: GainTables, s: int, first: int) -> None:
    """Correct x by the gains of the table, one row after the other."""
    captured = int(f.sample[PACKET.captured])
    first_row = _locate_frame_row(f, s, (captured - f.phase[s]) // f.period[s] % f.pattern)
    for i in range(f.rows[s]):
        _add_gain(f, gains, first_row + i, f.residual[i])
        _reduce_residuals(f, s, first, i, gains[f.cell, first_row + i])


@jit
def _correct(f: FilterRecord, s: int, first: int) -> None:
    """Correct by the rows of a sample, one after the other, with the covariance."""
    for i in range(f.rows[s]):
        residual, r = f.residual[i], compute_sample_variance(f, s, i)
        if f.r_scale_weight > 0.0 and r > 0.0:  # R follows the mean of residual^2 - C P C^T
            projected = project_row(f, s, i, first)
            sample_scale = (residual * residual - projected) / r * f.scale[s, i]
            scale = f.scale[s, i] + f.r_scale_weight * (sample_scale - f.scale[s, i])
            f.scale[s, i] = minimum(maximum(scale, _MIN_SCALE), _MAX_SCALE)
        correct_scalar(f, project_row(f, s, i, first) + r, residual)
        _reduce_residuals(f, s, first, i, f.gain)
        if f.delay_rule == LARSEN:
            propagate_larsen_gains(f, f.C[s, i])


@noinline
def update_filter(f: FilterRecord, gains: GainTables, s: int, first: int, is_gated: bool) -> bool:
    """Correct by a slow sensor's sound packet in f.sample; False if the gate refuses it.

    Args:
        f: Memory of the filter.
        gains: Tables of gains, shape (cells, rows, columns).
        s: Index of the slow sensor.
        first: Clone of the sample's first row, or negative, as of `find_clone`.
        is_gated: Whether the gate judges it and its NIS is taken: not once more when rewound.
    """
    if is_gated:
        f.nis = np.nan
    previous_fix = f.first_fix
    _compute_residuals(f, s, first)
    if f.intersample_rule == PSEUDO and f.periodic == 1:
        _correct_sample(f, gains, s)
    elif f.intersample_rule == PSEUDO:
        _split_sample_gain(f, s, first)
    elif f.intersample_rule != NONE:
        for i in range(f.rows[s]):
            f.innovation[i] = f.residual[i]
        f.since = 0
        _apply_share(f, gains, s)
    elif f.periodic == 1:
        _correct_periodic(f, gains, s, first)
    elif first == STORED_ONE and f.delay_rule == LARSEN:  # x <- x + M K residual
        for i in range(f.rows[s]):
            for k in range(f.n):
                f.x[k] += f.larsen_gain[s, i, k] * f.residual[i]
    else:
        is_refused = is_gated and not check_sample(f, s, first)
        if is_gated and f.r_share > 0.0 and f.nis == f.nis:
            note_surprise(f, 1, f.nis / f.rows[s], _SAMPLE_WEIGHT)
        if is_refused:
            f.counts[COUNTERS.gated] += 1
            f.first_fix = previous_fix
            return False
        _correct(f, s, first)
    return True


_SAMPLE_WEIGHT = 1.0 / 12.0  # of a slow sample in the mean of the last ones
# mean surprises beyond which a filter is lost; a clean camera on a bend of a wrong map has 10
_MAX_FAST, _MAX_SLOW = 3.0, 15.0


@jit
def compute_excess(f: FilterRecord) -> Scalar:
    """Compute a filter's mean surprise over its limit, of fast rows or slow samples, the larger.

    Args:
        f: Memory of the filter.
    """
    return maximum(f.surprise[0] * (1.0 / _MAX_FAST), f.surprise[1] * (1.0 / _MAX_SLOW))


@jit
def is_healthy(f: FilterRecord) -> Scalar:
    """Return whether a filter is neither lost nor reverses; it is True where noise is fixed.

    Args:
        f: Memory of the filter.
    """
    is_known = f.speed > 0.0 - MIN_SPEED or f.r_share == 0.0
    return is_known and compute_excess(f) < 1.0


FIRST_VARIANCE = 100.0  # of a fast sensor over the configured one until its first block is over


@jit
def _find_variance(f: FilterRecord, i: int, residual: float, projected: Scalar) -> None:
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


@noinline
def correct_fast(f: FilterRecord, gains: GainTables) -> None:
    """Correct by the fast measurements in f.y; what is not finite is counted and skipped.

    Args:
        f: Memory of the filter.
        gains: Tables of gains, shape (cells, rows, columns).
    """
    s = f.first_slow
    for i in range(f.fasts):
        if not is_finite(f.y[i]):
            f.counts[COUNTERS.invalid] += 1
    if f.intersample_rule == PSEUDO:
        for i in range(f.rows[s]):
            is_cloned = f.frames[s] > 0
            f.expected[i] = f.x[f.first_clone[s] + i] if is_cloned else predict_measurement(f, s, i)
            f.eps[f.fasts + i] = _apply_row(f, s, i, f.e)  # pseudo-residual C G e, tie-vision (22)
    if f.joint == 1:  # all residuals are taken before the first correction
        for i in range(f.fasts):
            residual = compute_residual(f, i)
            f.eps[i] = residual if is_finite(residual) else 0.0
        if f.intersample_rule == PSEUDO:
            _correct_between(f, gains, s)
            return
        for i in range(f.fasts):
            _add_gain(f, gains, _locate_step_row(f) + i, f.eps[i])
        return
    for i in range(f.fasts):
        residual = compute_residual(f, i)
        if not is_finite(residual):
            f.eps[i] = 0.0
            continue
        if f.periodic == 1:
            _add_gain(f, gains, _locate_step_row(f) + i, residual)
            continue
        projected = project(f, f.C_fast[i])
        if f.r_share > 0.0:
            _find_variance(f, i, residual, projected)
        variance = projected + f.r_fast[i]
        if f.r_share > 0.0:
            note_surprise(f, 0, residual * residual / variance, f.step / f.fasts)
        correct_scalar(f, variance, residual)
        for j in range(0, f.total, 8):  # the design of periodic gains reads them, too
            store8(f.share, load8(f.gain, j), i, j)
        if f.intersample_rule == PSEUDO:
            projected = dot(f.C_fast[i], f.e, f.n)
            f.eps[i] = residual
            for j in range(f.total):
                f.e[j] -= f.share[i, j] * projected
        if f.delay_rule == LARSEN:
            propagate_larsen_gains(f, f.C_fast[i])
    if f.r_share > 0.0:
        f.block_rows += 1
        if f.block_rows == f.block:
            f.block_rows, f.blocks = 0, f.blocks + 1
    if f.intersample_rule == PSEUDO:  # the even fraction of the last sample's gain
        for i in range(f.fasts, f.fasts + f.rows[s]):
            for j in range(f.total):
                f.x[j] += f.share[i, j] * f.eps[i]
                f.e[j] -= f.share[i, j] * f.eps[i]
    elif f.intersample_rule == DUAL_RATE and f.since >= 0:
        f.since += 1
        if f.since < f.cycle:
            _apply_share(f, gains, s)
