"""Corrections between samples of a slow sensor, and by a sample, where a rule shares them out.

The rules are `memory.GainRules`. joint: an observer's, of all fast residuals of a tick at once.
pseudo-residual: tie-vision (19)-(22), which uneven-delay (20)-(22), double-layer-gps (28)-(29),
dual-rate (31) and Oh's (35) repeat: the propagated estimate of the error, by a constant gain K
(columns: fast rows, slow rows) or a fraction of the last sample's gain. dual-rate: fractions of the
last innovation from a table. In a table of gains the rows K^T between samples begin at
`locate_frame_row(f, s, f.pattern)`; behind them stand as many of C^+ transposed.
"""

from ...envs.numerics.jit import copy_into, inline, jit
from ...envs.numerics.packed import load_element, store_element
from ...envs.numerics.primitives import Scalar, Vector, maximum
from .covariance import correct_scalar, dot, predict_measurement, project_row
from .innovation import compute_sample_variance
from .memory import GAIN, FilterMemory, GainTables


@jit
def has_pseudo_residuals(f: FilterMemory) -> Scalar:
    """Return whether the filter corrects by pseudo-residuals between samples."""
    return f.gain_rule == GAIN.split or f.gain_rule == GAIN.pseudo


@jit
def _apply_row(f: FilterMemory, s: int, i: int, v: Vector) -> Scalar:
    """Apply row i of sensor s to a vector of states and clones (total,): its clone, if it has."""
    return v[f.first_clone[s] + i] if f.frames[s] > 0 else dot(f.C[s, i], v, f.n)


@jit
def locate_step_row(f: FilterMemory) -> Scalar:
    """Locate the gain of the first fast measurement in this step."""
    return 1 + f.at * maximum(f.fasts, 1)


@jit
def locate_frame_row(f: FilterMemory, s: int, frame: int) -> Scalar:
    """Locate the gain of a sensor's first row for a frame."""
    return 1 + f.cycle * maximum(f.fasts, 1) + frame * f.rows[s]


@jit
def add_gain(f: FilterMemory, gains: GainTables, k: int, residual: float) -> None:
    """Correct x by row k of the table of gains."""
    for j in range(f.total):
        store_element(f.x, load_element(f.x, j) + load_element(gains, f.cell, k, j) * residual, j)


@jit
def start_shares(f: FilterMemory, gains: GainTables, s: int) -> None:
    """Correct by the first fraction of a sample's innovation, which is stored for the others."""
    copy_into(f.residual, f.innovation)
    f.since = 0
    _apply_share(f, gains, s)


@jit
def _apply_share(f: FilterMemory, gains: GainTables, s: int) -> None:
    """Add the fraction of the last innovation that is due now to x."""
    first_row = locate_frame_row(f, s, f.pattern) + f.since * f.rows[s]
    for i in range(f.rows[s]):
        add_gain(f, gains, first_row + i, f.innovation[i])


@inline
def predict_between(f: FilterMemory, s: int) -> None:
    """Predict what a sample would read now, and its pseudo-residual."""
    if has_pseudo_residuals(f):
        for i in range(f.rows[s]):
            is_cloned = f.frames[s] > 0
            f.expected[i] = f.x[f.first_clone[s] + i] if is_cloned else predict_measurement(f, s, i)
            f.eps[f.fasts + i] = _apply_row(f, s, i, f.e)  # pseudo-residual C G e, tie-vision (22)


@jit
def _correct_x_and_e(f: FilterMemory, gains: GainTables, s: int) -> None:
    """Correct x and e, both predicted, by the fast residuals in f.eps and the pseudo-residuals."""
    x, e, N, m = f.x, f.e, f.total, f.fasts
    first_row = locate_frame_row(f, s, f.pattern)
    for i in range(m):
        f.e_seen[i] = dot(f.C_fast[i], e, f.n)
    for i in range(m + f.rows[s]):
        K, projected = gains[f.cell, first_row + i], f.e_seen[i] if i < m else f.eps[i]
        for j in range(N):
            x[j] += K[j] * f.eps[i]
            e[j] -= K[j] * projected  # tie-vision (21): (I - K C) G e


@jit
def _correct_by_split_gains(f: FilterMemory, s: int) -> None:
    """Correct e as fast rows did x, then both by the even fraction of the last sample's gain."""
    for i in range(f.fasts):
        projected = dot(f.C_fast[i], f.e, f.n)
        for j in range(f.total):
            f.e[j] -= f.tick_gains[i, j] * projected
    for i in range(f.fasts, f.fasts + f.rows[s]):
        for j in range(f.total):
            f.x[j] += f.tick_gains[i, j] * f.eps[i]
            f.e[j] -= f.tick_gains[i, j] * f.eps[i]


@inline
def correct_between(f: FilterMemory, gains: GainTables, s: int) -> None:
    """Correct by pseudo-residuals, a fraction of an innovation, or all fast residuals at once."""
    if f.gain_rule == GAIN.pseudo:
        _correct_x_and_e(f, gains, s)
    elif f.gain_rule == GAIN.split:
        _correct_by_split_gains(f, s)
    elif f.gain_rule == GAIN.dual_rate and f.since >= 0:
        f.since += 1
        if f.since < f.cycle:
            _apply_share(f, gains, s)
    elif f.gain_rule == GAIN.joint:
        for i in range(f.fasts):
            add_gain(f, gains, locate_step_row(f) + i, f.eps[i])


@jit
def correct_by_sample(f: FilterMemory, gains: GainTables, s: int) -> None:
    """Correct by a sample of this tick: its residuals replace the pseudo ones; e starts anew."""
    m, N, rows = f.fasts, f.total, f.rows[s]
    first_row = locate_frame_row(f, s, f.pattern)
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
def split_sample_gain(f: FilterMemory, s: int, target: int) -> None:
    """Correct as `correct_by_sample`, with this sample's gain, split evenly over a period."""
    m, N, rows, steps = f.fasts, f.total, f.rows[s], f.period[s] // f.stride
    for i in range(rows):
        for j in range(N):
            f.x[j] -= f.tick_gains[m + i, j] * f.eps[m + i]
    for i in range(rows):
        r = compute_sample_variance(f, s, i)
        correct_scalar(f, project_row(f, s, i, target) + r, 0.0)
        for k in range(i):  # the rows before it correct what it measures
            correction = _apply_row(f, s, i, f.tick_gains[m + k])
            for j in range(N):
                f.tick_gains[m + k, j] -= f.gain[j] * correction
        for j in range(N):
            f.tick_gains[m + i, j] = f.gain[j] / steps
        f.eps[m + i] = f.residual[i]
    for j in range(N):
        f.e[j] = 0.0
        for i in range(m, m + rows):
            f.x[j] += f.tick_gains[i, j] * f.eps[i]
        for i in range(m + rows):
            f.e[j] += (f.inverse[i, j] - f.tick_gains[i, j]) * f.eps[i]
