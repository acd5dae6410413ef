"""Between slow samples: pseudo-residuals stand in for the measurement that is not there.

tie-vision (19)-(22), which uneven-delay (20)-(22), dual-rate (31) and Oh's (35) repeat. One
constant gain K serves every tick, its columns in the order gyro, slow rows. The gyro's residual is
always the real one; the slow rows' is the propagated estimate of the error until a sample comes.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from ..envs.backend import jit
from ..envs.elementary import wrap
from .kalman import gain

Array = npt.NDArray[np.float64]

RULES = ("predict", "pseudo-residual", "single-rate")
INVERSES = ("moore-penrose", "p-weighted", "tikhonov")
RIDGE = 1e-3  # lambda of Tikhonov's inverse, in SI units squared


def inverse(kind: str, C: Array, P: Array) -> Array:
    """The generalised inverse of C (p, n) that (20) needs; (n, p).

    C has full row rank only, so C^T C of the printed (20) is singular; the Moore-Penrose inverse is
    C^T (C C^T)^-1. "p-weighted" weighs by the covariance P (n, n), "tikhonov" is regularised.
    """
    I, zero = np.eye(C.shape[1]), np.zeros((len(C), len(C)))  # noqa: E741
    if kind == "moore-penrose":
        return gain(I, C, zero)
    if kind == "p-weighted":
        return gain(P, C, zero)
    return gain(I, C, RIDGE * np.eye(len(C)))


def constant_gain(K_fast: Array, K_slow: Array, steps: int) -> Array:
    """One gain for every tick from the multirate filter's gains over a period, (N, 1 + p).

    K_fast: (steps, N) gyro gains. K_slow: (p, N), gains of the slow rows at a sample. Every
    tick of the frame corrects by a pseudo-residual, so each takes its even share of the gain that
    the multirate filter applies at once.
    """
    return np.column_stack([K_fast.mean(0), K_slow.T / steps])


@jit
def _slow_row(f: Any, s: int, i: int, v: Any) -> Any:
    """The slow row i of sensor s applied to a vector of states and clones: its clone, if held."""
    if f.frames[s] > 0:
        return v[f.home[s] + i]
    total = 0.0
    for k in range(f.n):
        total += f.row[s, i, k] * v[k]
    return total


@jit
def correct_between(f: Any, gains: Any, s: int, residual: Any) -> None:
    """Correct x and e, both already predicted, by the gyro's and the pseudo-residuals.

    gains: in the present table, rows of K^T and then of the inverse's transpose stand behind those
    of the steps and frames.
    """
    x, e, N, cell = f.x, f.e, f.total, f.cell
    first, rows = 1 + f.cycle + f.rows[s] * f.pattern, f.rows[s]
    f.eps[0] = residual
    ahead = 0.0
    for k in range(f.n):
        ahead += f.gyro[k] * e[k]
    for i in range(rows):
        f.expected[i] = _slow_row(f, s, i, x)
        f.eps[1 + i] = _slow_row(f, s, i, e)  # tie-vision (22): C G e
    for j in range(N):
        K = gains[cell, first, j]
        x[j] += K * residual
        e[j] -= K * ahead  # (21): (I - K C) G e
    for i in range(rows):
        eps = f.eps[1 + i]
        for j in range(N):
            K = gains[cell, first + 1 + i, j]
            x[j] += K * eps
            e[j] -= K * eps


@jit
def correct_sample(f: Any, gains: Any, s: int, values: Any) -> None:
    """A sample has come in this tick: real residuals replace the pseudo ones, and e starts anew."""
    N, rows, cell = f.total, f.rows[s], f.cell
    first = 1 + f.cycle + rows * f.pattern
    for i in range(rows):
        real = values[i] - f.expected[i]  # tie-vision (19)
        if f.angle[s, i] == 1:
            real = wrap(real)
        for j in range(N):
            f.x[j] += gains[cell, first + 1 + i, j] * (real - f.eps[1 + i])
        f.eps[1 + i] = real
    for j in range(N):  # (20): e = (C^+ - K) eps
        total = 0.0
        for i in range(1 + rows):
            inverse, K = gains[cell, first + 1 + rows + i, j], gains[cell, first + i, j]
            total += (inverse - K) * f.eps[i]
        f.e[j] = total
