"""What an estimator adds to an observation, compiled: one call takes the step and writes it."""

from functools import cache
from typing import Any

import numpy as np

from ..envs.backend import jit, maximum, minimum
from ..envs.elementary import wrap
from .compiled import entry
from .core import advance, covariance_of, deviation
from .memory import FILTER


@jit
def _clipped(value: Any, limit: Any) -> Any:
    return minimum(maximum(value, 0.0 - limit), limit)


@jit
def _nees(f: Any, gains: Any, beta: Any, gamma: Any, both: Any, first: int) -> Any:
    """e^T P^-1 e of beta and gamma, or of the state `first` of them, per state; 0 if P is singular.

    beta, gamma: the true ones.
    """
    a, b = f.x[0] - beta, f.x[1] - gamma
    p, q = covariance_of(f, gains, 0, 0), covariance_of(f, gains, 1, 1)
    if both:
        r = covariance_of(f, gains, 0, 1)
        det = p * q - r * r
        return 0.5 * (a * a * q - 2.0 * a * b * r + b * b * p) / det if det > 0.0 else 0.0
    if first == 1:
        a, p = b, q
    return a * a / p if p > 0.0 else 0.0


@jit
def observe(
    filters: Any,
    gains: Any,
    fast: Any,
    rows: int,
    packets: Any,
    count: int,
    start: int,
    obs: Any,
    kept: int,
    plan: Any,
    limits: Any,
    beta: float,
    gamma: float,
    out: Any,
    said: Any,
) -> int:
    """`advance`, then the first `kept` entries of obs and the outputs into out.

    plan: (m, 3), each output's state, whether it is wrapped and whether its truth is known.
    limits: (m,). out: kept + m entries, or kept + 2 m with standard deviations. said: beta, its
    standard deviation and the nees. Returns the rows done, as `advance` does.
    """
    f = filters[0]
    done = advance(filters, gains, fast, rows, packets, count, start, fast[:0], fast[:0], said[:0])
    if done < rows:
        return done
    for i in range(kept):
        out[i] = obs[i]
    m, judged, first = len(plan), 0, 0
    for i in range(m):
        state = plan[i, 0]
        value = f.x[state]
        if plan[i, 1] == 1:
            value = wrap(value)
        out[kept + i] = _clipped(value, limits[i])
        if len(out) > kept + m:
            out[kept + m + i] = _clipped(deviation(f, gains, state), limits[i])
        if plan[i, 2] == 1:
            judged, first = judged + 1, state
    said[0], said[1] = f.x[0], deviation(f, gains, 0)
    said[2] = _nees(f, gains, beta, gamma, judged == 2, first) if judged > 0 else 0.0
    return done


@cache
def observe_entry() -> Any:
    """`observe` as a plain call."""
    small, wide, matrix = np.zeros(1, np.float32), np.zeros(1), np.zeros((1, 1))
    return entry(
        observe,
        np.zeros(1, FILTER),
        np.zeros((1, 1, 1)),
        matrix,
        0,
        matrix,
        0,
        0,
        small,
        0,
        np.zeros((1, 3), np.int64),
        wide,
        0.0,
        0.0,
        small,
        wide,
    )
