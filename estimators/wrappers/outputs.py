"""States of an estimator as entries of an observation: names, units, bounds, and their values.

One compiled call runs a filter and writes them; those of a user's own are written by NumPy.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ...envs.numerics.functions import wrap
from ...envs.numerics.jit import as_python, compile_call, jit, noinline
from ...envs.numerics.primitives import ARRAYS, Matrix, Scalar, Vector, maximum, minimum
from ...envs.task import ObservationEntry
from ..core.filter import FilterOutputs, StepRecord, advance, compute_deviation, read_covariance
from ..core.record import FILTER, FilterRecord, GainTables
from ..core.update import compute_excess, is_healthy
from ..protocol import EstimatorLike, compute_std

BETA, STD, NEES, HEALTHY = range(4)  # places in the summary of a step
_wrap = as_python(wrap, ARRAYS)


class OutputTable(NamedTuple):
    """What `observe` writes behind an observation."""

    inner: int  # entries of the env's observation to copy
    # a row for each output, shape (m, 3): its state's index over all layers; 1 if it is an angle to
    # wrap; whose truth the NEES takes (1 beta, 2 gamma, 0 none)
    plan: Matrix
    limits: Vector  # bounds of the outputs in their units, shape (m,)


class Observed(NamedTuple):
    """What an observation is made of, and where it is written.

    Of N cars, all but `table` have them as the first axis.
    """

    obs: Vector  # observation of the env, float32, shape (at least inner,)
    table: OutputTable
    beta: Scalar  # true sideslip angle (rad)
    gamma: Scalar  # true yaw rate (rad/s)
    out: Vector  # float32, filled, shape (inner + m,), or (inner + 2 m,) with standard deviations
    # filled, shape (4,): beta (the first state where there is no beta), its standard deviation, and
    # the normalised estimation error squared of the outputs beta and gamma per state,
    # e' P_e^-1 e / len(e), with expectation 1; 0 where P_e is singular; 0 for a filter that is lost
    summary: Vector


@dataclass(frozen=True)
class Outputs:
    """The entries of a wrapped observation."""

    title: str  # of the estimator, for pictures
    layout: tuple[ObservationEntry, ...]
    table: OutputTable
    keys: tuple[tuple[str, int], ...]  # keys of `info`, with their places in the summary


def write_outputs(estimator: EstimatorLike, observed: Observed) -> None:
    """Write a user's estimates as `observe` writes those of a compiled filter.

    Raises what `ForeignEstimator.x` raises.

    Args:
        estimator: The user's estimator.
        observed: Observation and outputs.
    """
    obs, (inner, plan, limits), beta, gamma, out, summary = observed
    x, P = np.asarray(estimator.x), np.asarray(estimator.P)
    std, states, m = compute_std(P), plan[:, 0], len(plan)
    out[:inner] = obs[:inner]
    with np.errstate(invalid="ignore"):
        values = np.where(plan[:, 1] == 1, _wrap(x[states]), x[states])
    out[inner : inner + m] = np.clip(values, -limits, limits)
    if len(out) > inner + m:
        out[inner + m :] = np.clip(std[states], -limits, limits)
    first = estimator.names.index("beta") if "beta" in estimator.names else 0
    truth_plan = plan[plan[:, 2] > 0]
    e = x[truth_plan[:, 0]] - np.where(truth_plan[:, 2] == 1, beta, gamma)
    P_e = P[np.ix_(truth_plan[:, 0], truth_plan[:, 0])]
    nees = e @ np.linalg.solve(P_e, e) / len(e) if len(e) and np.linalg.det(P_e) > 0.0 else 0.0
    summary[:] = x[first], std[first], nees, float(getattr(estimator, "is_healthy", True))


@jit
def _clip_symmetric(value: Scalar, limit: Scalar) -> Scalar:
    """Clip the value to +-limit; NaN stays, so that a filter that failed is seen."""
    return value if value != value else minimum(maximum(value, 0.0 - limit), limit)


@jit
def _compute_nees(
    f: FilterRecord, gains: GainTables, i: int, j: int, beta: Scalar, gamma: Scalar
) -> Scalar:
    """Compute e' P_e^-1 e / len(e) of the states i (beta) and j (gamma; -1: none), or 0."""
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
    filters: Vector, gains: Matrix, record: StepRecord, start: int, observed: Observed
) -> int:
    """Advance the filter and write the observation; return the rows done as `advance` does.

    Args:
        filters: Memory of the filter, dtype `FILTER`, shape (layers,).
        gains: Tables of gains, shape (cells, rows, columns).
        record: Record to process.
        start: Number of fast rows that are done already.
        observed: Observation and outputs.
    """
    obs, (inner, plan, limits), beta, gamma, out, summary = observed
    nothing = FilterOutputs(record.fast[:0], record.fast[:0], summary[:0])
    done = advance(filters, gains, record, start, nothing)
    if done < record.rows:
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
    nees = _compute_nees(f, gains, beta_at, gamma_at, beta, gamma)
    summary[2] = nees / maximum(compute_excess(f), 1.0)  # lost, it is less sure
    summary[3] = 1.0 if is_healthy(f) else 0.0
    return done


@cache
def compile_observe() -> Any:
    """Return `observe` as a plain call with the same positional arguments."""
    small, wide, matrix = np.zeros(1, np.float32), np.zeros(1), np.zeros((1, 1))
    memory, record = (np.zeros(1, FILTER), np.zeros((1, 1, 1))), StepRecord(matrix, 0, matrix, 0)
    table = OutputTable(0, np.zeros((1, 3), np.int64), wide)
    observed = Observed(small, table, 0.0, 0.0, small, wide)
    return compile_call(observe, *memory, record, 0, observed)
