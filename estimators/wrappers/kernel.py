"""An estimator's part of an observation, compiled: one call runs the filter and writes it."""

from functools import cache
from typing import Any

import numpy as np

from ...envs.numerics.functions import wrap
from ...envs.numerics.jit import jit, noinline
from ...envs.numerics.primitives import Matrix, Scalar, Vector, maximum, minimum
from ..core.filter import advance, compute_deviation, read_covariance
from ..core.record import FILTER, FilterRecord, GainTables
from ..estimator import compile_call
from ..learned.correction import EXAMPLE, apply_correction, filter_and_correct, remove_correction


@jit
def _clip_symmetric(value: Scalar, limit: Scalar) -> Scalar:
    """Clip the value to +-limit; NaN stays, so that a filter that failed is seen."""
    return value if value != value else minimum(maximum(value, 0.0 - limit), limit)


@jit
def _compute_nees(
    f: FilterRecord, gains: GainTables, i: int, j: int, beta: Scalar, gamma: Scalar
) -> Scalar:
    """Compute e' P_e^-1 e / len(e), the NEES per state; 0 without states or for a singular P_e.

    e is the error of the states i and j, estimates of the true beta and gamma; -1: there is none.
    """
    if i >= 0 and j >= 0:
        a, b = f.x[i] - beta, f.x[j] - gamma
        p, q = read_covariance(f, gains, i, i), read_covariance(f, gains, j, j)
        r = read_covariance(f, gains, i, j)
        det = p * q - r * r
        return 0.5 * (a * a * q - 2.0 * a * b * r + b * b * p) / det if det > 0.0 else 0.0
    k = maximum(i, j)
    if k < 0:
        return 0.0
    a = f.x[k] - (beta if i >= 0 else gamma)
    p = read_covariance(f, gains, k, k)
    return a * a / p if p > 0.0 else 0.0


@noinline
def observe(
    filters: Vector,
    gains: Matrix,
    fast: Matrix,
    rows: int,
    packets: Matrix,
    count: int,
    start: int,
    obs: Vector,
    inner: int,
    plan: Matrix,
    limits: Vector,
    beta: float,
    gamma: float,
    out: Vector,
    summary: Vector,
) -> int:
    """Advance the filter, then write the observation and the outputs.

    Args:
        filters: Memory of the filter, dtype `FILTER`, shape (layers,).
        gains: Tables of gains, shape (cells, rows, columns).
        fast: Fast rows, shape (k, FAST_WIDTH).
        rows: Number of fast rows to take.
        packets: Packets, shape (capacity, PACKET_WIDTH).
        count: Number of packets to take.
        start: Number of fast rows that are done already.
        obs: Observation of the env, float32, shape (at least inner,).
        inner: Number of entries of `obs` to copy.
        plan: Of each output the state's index, counted through the layers, 1 to wrap an angle, and
            its code in `outputs.TRUTHS`; shape (m, 3).
        limits: Bounds of the outputs in their units, shape (m,).
        beta: True sideslip angle (rad).
        gamma: True yaw rate (rad/s).
        out: Output, float32, shape (inner + m,), or (inner + 2 m,) with standard deviations.
        summary: Output, shape (3,): the filter's first state (beta where it has beta), its standard
            deviation, and the normalised estimation error squared of the outputs beta and gamma
            per state, e' P_e^-1 e / len(e), with expectation 1; 0 where P_e is singular.

    Returns:
        Number of fast rows done, as `advance` returns it.
    """
    no_states, no_nis = fast[:0], summary[:0]  # empty: `advance` writes no records
    done = advance(filters, gains, fast, rows, packets, count, start, no_states, no_states, no_nis)
    if done < rows:
        return done
    for i in range(inner):
        out[i] = obs[i]
    m, beta_at, gamma_at = len(plan), -1, -1
    for i in range(m):
        layer, state = 0, plan[i, 0]
        while state >= filters[layer].n:
            state -= filters[layer].n
            layer += 1
        f = filters[layer]
        value = f.x[state]
        if plan[i, 1] == 1:
            value = wrap(value)
        out[inner + i] = _clip_symmetric(value, limits[i])
        if len(out) > inner + m:
            out[inner + m + i] = _clip_symmetric(compute_deviation(f, gains, state), limits[i])
        if plan[i, 2] == 1:
            beta_at = state
        elif plan[i, 2] == 2:
            gamma_at = state
    f = filters[0]
    summary[0], summary[1] = f.x[0], compute_deviation(f, gains, 0)
    summary[2] = _compute_nees(f, gains, beta_at, gamma_at, beta, gamma)
    return done


@jit
def observe_corrected(
    filters: Vector, gains: Matrix, record: Any, m: Vector, net: Any, outputs: Any
) -> None:
    """Call `filter_and_correct`, and write the sums as `observe` does.

    Args:
        filters: Memory of the filter, dtype `FILTER`, shape (layers,).
        gains: Tables of gains, shape (cells, rows, columns).
        record: Arguments of `observe` from `fast` to `count`.
        m: Memory of the correction, shape (memory_size,).
        net: Network, as `learned.correction` packs it.
        outputs: Arguments of `observe` behind `start`.
    """
    fast, rows, packets, count = record
    filter_and_correct(filters, gains, fast, rows, packets, count, m, net)
    apply_correction(filters[0], m, net)
    observe(filters, gains, fast, 0, packets, 0, 0, *outputs)
    remove_correction(filters[0], m, net)


@cache
def compile_observe(corrected: bool = False) -> Any:
    """Return `observe`, or `observe_corrected`, as a plain call.

    Args:
        corrected: Whether it is `observe_corrected`.

    Returns:
        A callable with the same positional arguments.
    """
    small, wide, matrix = np.zeros(1, np.float32), np.zeros(1), np.zeros((1, 1))
    memory, record = (np.zeros(1, FILTER), np.zeros((1, 1, 1))), (matrix, 0, matrix, 0)
    outputs = small, 0, np.zeros((1, 3), np.int64), wide, 0.0, 0.0, small, wide
    if corrected:
        return compile_call(observe_corrected, *memory, record, wide, EXAMPLE, outputs)
    return compile_call(observe, *memory, *record, 0, *outputs)
