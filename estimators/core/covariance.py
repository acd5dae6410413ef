"""The covariance and its gains in compiled code: `design.kalman`'s equations on a filter's memory.

Only the first n of N = `total` states move; the others are clones. Measurements come one scalar at
a time, so that a gain is a division and not a matrix inverse.
"""

from math import log
from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, sqrt
from .memory import Memory, Row


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


@jit
def _plus(a: Any, g: Any, v: Row, j: int) -> Any:
    """a + g v[j : j + 8] of eight numbers a, at once: compiled, they stay in registers."""
    return (
        a[0] + g * v[j],
        a[1] + g * v[j + 1],
        a[2] + g * v[j + 2],
        a[3] + g * v[j + 3],
        a[4] + g * v[j + 4],
        a[5] + g * v[j + 5],
        a[6] + g * v[j + 6],
        a[7] + g * v[j + 7],
    )


@jit
def _predict_rows(f: Memory) -> None:
    """f.FP (CORE, WIDTH) = F P for the dense states, clones' columns included, by whole eights."""
    G, P, T = f.G, f.P, f.FP
    for i in range(f.dense):
        for j in range(0, f.total, 8):
            a = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            for k in range(f.n):
                a = _plus(a, G[i, k], P[k], j)
            for m in range(8):
                T[i, j + m] = a[m]


@jit
def predict_covariance(f: Memory) -> None:
    """P <- F P F^T + Q with F = [[G, 0], [0, diag(decay)]] on the states, I on the clones."""
    n, dense, N = f.n, f.dense, f.total
    G, P, Q, T, decay = f.G, f.P, f.Q, f.FP, f.decay
    _predict_rows(f)
    for i in range(dense):
        for j in range(i, dense):
            total = Q[i, j]
            for k in range(n):
                total += T[i, k] * G[j, k]
            P[i, j] = total
            P[j, i] = total
        for j in range(dense, n):
            value = T[i, j] * decay[j] + Q[i, j]
            P[i, j] = value
            P[j, i] = value
        for c in range(n, N):  # the clones' covariance with the states
            P[i, c] = T[i, c]
            P[c, i] = T[i, c]
    for i in range(dense, n):
        for j in range(i, n):
            value = decay[i] * P[i, j] * decay[j] + Q[i, j]
            P[i, j] = value
            P[j, i] = value
        for c in range(n, N):
            value = decay[i] * P[i, c]
            P[i, c] = value
            P[c, i] = value


@jit
def _condition(f: Memory, variance: Any, residual: Any) -> None:
    """Use one residual of the given variance whose covariance with the state is `f.PC`.

    P <- P - K s K^T, to which Joseph's form comes down for the optimal gain of a scalar. With
    products of two entries of P C^T it is symmetric to the last bit.
    """
    N, x, P, PC, gain = f.total, f.x, f.P, f.PC, f.gain
    per = 1.0 / variance
    if f.members > 0:
        f.weight -= 0.5 * (residual * residual * per + log(variance))
    if f.robust > 0.0:  # Huber's: the noise is what makes it `robust` deviations
        size = absolute(residual) * sqrt(per)
        if size > f.robust:
            per *= f.robust / size
    for i in range(N):
        gain[i] = PC[i] * per
        x[i] += gain[i] * residual
    for i in range(N):
        for j in range(N):
            P[i, j] -= per * (PC[i] * PC[j])


@jit
def project(f: Memory, row: Row) -> Any:
    """f.PC = P C^T of a measurement `row` (n,) of the states; returns C P C^T."""
    n, N, P, PC = f.n, f.total, f.P, f.PC
    for i in range(N):
        PC[i] = 0.0
    for k in range(n):
        h = row[k]
        if h != 0.0:
            for i in range(N):
                PC[i] += h * P[k, i]
    return dot(row, PC, n)


@jit
def project_clone(f: Memory, clone: int) -> Any:
    """f.PC = P C^T of a measurement of one clone; returns C P C^T."""
    for i in range(f.total):
        f.PC[i] = f.P[clone, i]
    return f.PC[clone]


@jit
def measure_state(f: Memory, row: Row, r: Any, residual: Any) -> None:
    """Use the residual of a measurement `row` (n,) of the states with noise variance r."""
    own = project(f, row)
    _condition(f, own + r, residual)


@jit
def measure_clone(f: Memory, clone: int, r: Any, residual: Any) -> None:
    """Use the residual of a measurement of one clone with noise variance r."""
    own = project_clone(f, clone)
    _condition(f, own + r, residual)


@jit
def clone_covariance(f: Memory, row: Row, clone: int) -> None:
    """Make a clone of the combination `row` of the states."""
    own = project(f, row)
    N, P, PC = f.total, f.P, f.PC
    for i in range(N):
        P[clone, i] = PC[i]
        P[i, clone] = PC[i]
    P[clone, clone] = own
