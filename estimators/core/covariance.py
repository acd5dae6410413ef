"""The covariance and its gains in compiled code: `design.kalman`'s equations on a filter's memory.

Only the first n of N = `total` states move; the others are clones. Rows are computed by eights of
their columns: beyond N all is zero and stays so. Measurements come one scalar at
a time, so that a gain is a division and not a matrix inverse.

One filter's memory is a record of numbers; that of several filters in lanes has fields of the same
names (`vector.lanes`), whose columns come one by one.
"""

from math import log
from typing import Any

from ...envs.backend.arrays import at
from ...envs.backend.decorators import inlined, jit
from ...envs.backend.eights import across, eight, mirror, put_eight, rows_of, scratch, span
from ...envs.backend.primitives import absolute, anywhere, select, sqrt
from .memory import CORE, WIDTH, Memory, Row


@jit
def dot(row: Row, v: Row, n: int) -> Any:
    """The product of a row of C and a vector of states, n entries of each."""
    total = 0.0
    for k in range(n):
        total += row[k] * v[k]
    return total


@jit
def expected(f: Memory, s: int, i: int) -> Any:
    """What row i of sensor s would measure now: C x and, over the ground, the road's heading."""
    value = dot(f.C[s, i], f.x, f.n)
    return value + f.road_turn if f.ground[s, i] == 1 else value


@inlined
def _more(M: Row, i: int, k: int, v: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    a, b = a + at(M, i, k) * v, b + at(M, i + 1, k) * v
    return a, b, c + at(M, i + 2, k) * v, d + at(M, i + 3, k) * v


@inlined
def times(M: Row, i: int, V: Row, n: int, j: int, a: Any, b: Any, c: Any, d: Any) -> Any:
    """a, b, c, d and rows i to i + 3 of M (., n) times V (n, .), eight columns from j on."""
    for k in range(n):
        a, b, c, d = _more(M, i, k, eight(V, k, j), a, b, c, d)
    return a, b, c, d


@inlined
def _along_symmetric(M: Row, i: int, P: Row, n: int, j: int) -> Any:
    """The same from zero on for a symmetric matrix P."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        a, b, c, d = _more(M, i, k, across(P, k, j), a, b, c, d)
    return a, b, c, d


@jit
def predict_covariance(f: Memory) -> None:
    """P <- F P F^T + Q with F = [[G, 0], [0, diag(decay)]] on the states, I on the clones.

    The rows of the dense states are computed by fours, what stands above the diagonal counts.
    """
    n, dense, N = f.n, f.dense, f.total
    P, Q, GT, keep, step = f.P, f.Q, f.GT, f.keep, span(f.P)
    FP = scratch(P, CORE, WIDTH)
    states = (n + step - 1) // step * step  # columns with a state among them
    for j in range(0, N, step):
        for i in range(0, dense, 4):
            a, b, c, d = _along_symmetric(f.G, i, P, n, j)
            put_eight(FP, a, i, j)
            put_eight(FP, b, i + 1, j)
            put_eight(FP, c, i + 2, j)
            put_eight(FP, d, i + 3, j)
    for j in range(0, states, step):
        own = eight(keep, j)
        for i in range(0, rows_of(P, dense, j), 4):
            a = eight(Q, i, j) + eight(FP, i, j) * own
            b = eight(Q, i + 1, j) + eight(FP, i + 1, j) * own
            c = eight(Q, i + 2, j) + eight(FP, i + 2, j) * own
            d = eight(Q, i + 3, j) + eight(FP, i + 3, j) * own
            a, b, c, d = times(FP, i, GT, n, j, a, b, c, d)
            put_eight(P, a, i, j)
            if i + 1 < dense:
                put_eight(P, b, i + 1, j)
            if i + 2 < dense:
                put_eight(P, c, i + 2, j)
            if i + 3 < dense:
                put_eight(P, d, i + 3, j)
        for i in range(dense, rows_of(P, n, j)):
            put_eight(P, at(f.decay, i) * eight(P, i, j) * own + eight(Q, i, j), i, j)
    for j in range(states, N, step):  # clones alone
        for i in range(dense):
            put_eight(P, eight(FP, i, j), i, j)
        for i in range(dense, n):
            put_eight(P, at(f.decay, i) * eight(P, i, j), i, j)
    for i in range(0, n, step):
        for j in range(i, N, step):
            mirror(P, i, j)


@jit
def condition(f: Memory, variance: Any, residual: Any) -> None:
    """Use one residual of the given variance whose covariance with the state is `f.PC`.

    P <- P - K s K^T, to which Joseph's form comes down for the optimal gain of a scalar. With
    products of two entries of P C^T it is symmetric to the last bit.
    """
    N, x, P, PC, gain, step = f.total, f.x, f.P, f.PC, f.gain, span(f.P)
    per = 1.0 / variance
    if f.robust > 0.0:  # Huber's: the noise is what makes it `robust` deviations
        size = absolute(residual) * sqrt(per)
        per = per * select(size > f.robust, f.robust / size, 1.0)
    for j in range(0, N, step):
        own = eight(PC, j)
        put_eight(gain, own * per, j)
        put_eight(x, eight(x, j) + own * per * residual, j)
        for i in range(rows_of(P, N, j)):
            put_eight(P, eight(P, i, j) - per * (at(PC, i) * own), i, j)


@jit
def _weigh(f: Memory, variance: Any, residual: Any) -> None:
    """What a residual of the given variance says of a member of a bank."""
    if f.members > 0:
        f.weight -= 0.5 * (residual * residual * (1.0 / variance) + log(variance))


@jit
def project(f: Memory, row: Row) -> Any:
    """f.PC = P C^T of a measurement `row` (n,) of the states; returns C P C^T."""
    n, N, P, PC = f.n, f.total, f.P, f.PC
    for j in range(0, N, span(P)):
        total = 0.0
        for k in range(n):
            h = at(row, k)
            if anywhere(h != 0.0):
                total = total + h * across(P, k, j)
        put_eight(PC, total, j)
    own = 0.0
    for k in range(n):
        h = at(row, k)
        if anywhere(h != 0.0):  # no sum waits for nothing
            own = own + h * at(PC, k)
    return own


@jit
def project_clone(f: Memory, clone: int) -> Any:
    """f.PC = P C^T of a measurement of one clone; returns C P C^T."""
    for i in range(f.total):
        f.PC[i] = f.P[clone, i]
    return f.PC[clone]


@jit
def measure_state(f: Memory, row: Row, r: Any, residual: Any) -> None:
    """Use the residual of a measurement `row` (n,) of the states with noise variance r."""
    variance = project(f, row) + r
    _weigh(f, variance, residual)
    condition(f, variance, residual)


@jit
def measure_clone(f: Memory, clone: int, r: Any, residual: Any) -> None:
    """Use the residual of a measurement of one clone with noise variance r."""
    variance = project_clone(f, clone) + r
    _weigh(f, variance, residual)
    condition(f, variance, residual)


@jit
def clone_covariance(f: Memory, row: Row, clone: int) -> None:
    """Make a clone of the combination `row` of the states."""
    own = project(f, row)
    N, P, PC = f.total, f.P, f.PC
    for i in range(N):
        P[clone, i] = PC[i]
        P[i, clone] = PC[i]
    P[clone, clone] = own
