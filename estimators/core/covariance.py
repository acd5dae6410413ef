"""The covariance and its gains in compiled code: `kalman.py`'s equations on a filter's record.

Only the first n of N = `total` states move; the others are clones. Measurements come one scalar at
a time, so that a gain is a division and not a matrix inverse.
"""

from typing import Any

from ...envs.backend.decorators import jit


@jit
def _plus(a: Any, g: Any, v: Any, j: int) -> Any:
    """a + g v[j : j + 8], eight sums at once: compiled, they stay in registers."""
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
def _predict_rows(f: Any) -> None:
    """f.FP = F P for the dense states, clones' columns included (and zeros up to a full eight)."""
    G, P, T = f.G, f.P, f.FP
    for i in range(f.dense):
        for j in range(0, f.total, 8):
            a = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            for k in range(f.n):
                a = _plus(a, G[i, k], P[k], j)
            for m in range(8):
                T[i, j + m] = a[m]


@jit
def predict_covariance(f: Any) -> None:
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
def _condition(f: Any, variance: Any, residual: Any) -> None:
    """Use one residual of the given variance whose covariance with the state is `f.ph`.

    P <- P - K s K^T, to which Joseph's form comes down for the optimal gain of a scalar. With
    products of two entries of P C^T it is symmetric to the last bit.
    """
    N, x, P, ph, gain = f.total, f.x, f.P, f.ph, f.gain
    per = 1.0 / variance
    for i in range(N):
        gain[i] = ph[i] * per
        x[i] += gain[i] * residual
    for i in range(N):
        for j in range(N):
            P[i, j] -= per * (ph[i] * ph[j])


@jit
def project(f: Any, row: Any) -> Any:
    """f.ph = P C^T of a measurement `row` (n,) of the states; returns C P C^T."""
    n, N, P, ph = f.n, f.total, f.P, f.ph
    for i in range(N):
        ph[i] = 0.0
    for k in range(n):
        h = row[k]
        if h != 0.0:
            for i in range(N):
                ph[i] += h * P[k, i]
    own = 0.0
    for k in range(n):
        own += row[k] * ph[k]
    return own


@jit
def project_clone(f: Any, clone: int) -> Any:
    """The same for a measurement of one clone."""
    for i in range(f.total):
        f.ph[i] = f.P[clone, i]
    return f.ph[clone]


@jit
def measure_state(f: Any, row: Any, r: Any, residual: Any) -> None:
    """Use the residual of a measurement `row` (n,) of the states with noise variance r."""
    own = project(f, row)
    _condition(f, own + r, residual)


@jit
def measure_clone(f: Any, clone: int, r: Any, residual: Any) -> None:
    """Use the residual of a measurement of one clone with noise variance r."""
    own = project_clone(f, clone)
    _condition(f, own + r, residual)


@jit
def clone_covariance(f: Any, row: Any, clone: int) -> None:
    """Make a clone of the combination `row` of the states."""
    own = project(f, row)
    N, P, ph = f.total, f.P, f.ph
    for i in range(N):
        P[clone, i] = ph[i]
        P[i, clone] = ph[i]
    P[clone, clone] = own
