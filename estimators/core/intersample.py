"""Between slow samples: what stands in for the measurement that is not there.

predict: nothing. pseudo-residual: tie-vision (19)-(22), which uneven-delay (20)-(22), double-layer
(28)-(29), dual-rate (31) and Oh's (35) repeat: the propagated estimate of the error. The fast
sensors' residuals are always the real ones. One constant gain K serves every tick, its columns in
the order fast rows, slow rows; where gains are not precomputed, the share of the last sample's.
dual-rate: that paper's rules, whose corrections after a sample are a table of shares of its
innovation (`design.dual_rate`). single-rate: a filter that listens only at the sensor's rate.
"""

from typing import Any

from ...envs.backend.decorators import jit
from .covariance import dot, expected, measure_clone, measure_state
from .innovation import noise_of
from .memory import Gains, Memory, Row
from .speed import frame_row

NONE, PSEUDO, DUAL_RATE = range(3)
"""Codes of the field `between`."""


@jit
def _measured(f: Memory, s: int, i: int, v: Row) -> Any:
    """Row i of sensor s applied to a vector of states and clones (total,): its clone, if it has."""
    return v[f.first_clone[s] + i] if f.frames[s] > 0 else dot(f.C[s, i], v, f.n)


@jit
def expect(f: Memory, s: int) -> None:
    """What the slow rows are expected to be, and their pseudo-residuals: tie-vision (22)."""
    for i in range(f.rows[s]):
        cloned = f.frames[s] > 0
        f.expected[i] = f.x[f.first_clone[s] + i] if cloned else expected(f, s, i)
        f.eps[f.fasts + i] = _measured(f, s, i, f.e)  # C G e


@jit
def correct_between(f: Memory, gains: Gains, s: int) -> None:
    """Correct x and e, both predicted, by the fast residuals in f.eps and the pseudo-residuals.

    gains: in the present table, rows of K^T and then of the inverse's transpose stand behind those
    of the steps and frames.
    """
    x, e, N, m = f.x, f.e, f.total, f.fasts
    first = frame_row(f, s, f.pattern)
    for i in range(m):
        f.e_seen[i] = dot(f.C_fast[i], e, f.n)
    for i in range(m):
        K = gains[f.cell, first + i]
        for j in range(N):
            x[j] += K[j] * f.eps[i]
            e[j] -= K[j] * f.e_seen[i]  # (21): (I - K C) G e
    for i in range(m, m + f.rows[s]):
        K = gains[f.cell, first + i]
        for j in range(N):
            x[j] += K[j] * f.eps[i]
            e[j] -= K[j] * f.eps[i]


@jit
def correct_sample(f: Memory, gains: Gains, s: int) -> None:
    """A sample has come in this tick: its residuals replace the pseudo ones, and e starts anew."""
    m, N, rows = f.fasts, f.total, f.rows[s]
    first = frame_row(f, s, f.pattern)
    for i in range(rows):
        K, real = gains[f.cell, first + m + i], f.residual[i]  # tie-vision (19)
        for j in range(N):
            f.x[j] += K[j] * (real - f.eps[m + i])
        f.eps[m + i] = real
    for j in range(N):  # (20): e = (C^+ - K) eps
        total = 0.0
        for i in range(m + rows):
            pinv, K = gains[f.cell, first + m + rows + i, j], gains[f.cell, first + i, j]
            total += (pinv - K) * f.eps[i]
        f.e[j] = total


@jit
def share_fast(f: Memory, i: int, residual: float) -> None:
    """A fast row's gain f.share[i] was used on x: the same for e."""
    ahead = dot(f.C_fast[i], f.e, f.n)
    f.eps[i] = residual
    for j in range(f.total):
        f.e[j] -= f.share[i, j] * ahead


@jit
def share_between(f: Memory, s: int) -> None:
    """Correct x and e by the pseudo-residuals with the share of the last sample's gain."""
    for i in range(f.fasts, f.fasts + f.rows[s]):
        for j in range(f.total):
            f.x[j] += f.share[i, j] * f.eps[i]
            f.e[j] -= f.share[i, j] * f.eps[i]


@jit
def share_sample(f: Memory, s: int, first: int, packet: Row) -> None:
    """`correct_sample` with the covariance's gain of this packet (PACKET_WIDTH,), in even shares
    over a period."""
    m, N, rows = f.fasts, f.total, f.rows[s]
    steps = f.period[s] // f.stride
    for i in range(rows):
        for j in range(N):
            f.x[j] -= f.share[m + i, j] * f.eps[m + i]
    for i in range(rows):
        r = noise_of(f, s, i, packet)
        if first >= 0:
            measure_clone(f, first + i, r, 0.0)
        else:
            measure_state(f, f.C[s, i], r, 0.0)
        for k in range(i):  # the rows before it correct what it measures
            moved = _measured(f, s, i, f.share[m + k])
            for j in range(N):
                f.share[m + k, j] -= f.gain[j] * moved
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
def _use_share(f: Memory, gains: Gains, s: int) -> None:
    """x += the share of the last innovation that is due now."""
    first = frame_row(f, s, f.pattern) + f.since * f.rows[s]
    for i in range(f.rows[s]):
        K = gains[f.cell, first + i]
        for j in range(f.total):
            f.x[j] += K[j] * f.innovation[i]


@jit
def begin_shares(f: Memory, gains: Gains, s: int) -> None:
    """A sample has come: store its innovation and use its first share."""
    for i in range(f.rows[s]):
        f.innovation[i] = f.residual[i]
    f.since = 0
    _use_share(f, gains, s)


@jit
def next_share(f: Memory, gains: Gains, s: int) -> None:
    """The next share, as long as there is one."""
    if f.since >= 0:
        f.since += 1
        if f.since < f.cycle:
            _use_share(f, gains, s)
