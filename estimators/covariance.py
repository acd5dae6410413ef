"""The covariance and its gains in compiled code: `kalman.py`'s equations on a filter's record.

Only the first n of N = `total` states move; the others are clones. Measurements come one scalar at
a time, so that a gain is a division and not a matrix inverse.
"""

from typing import Any

from ..envs.backend import jit


@jit
def predict_covariance(f: Any) -> None:
    """P <- F P F^T + Q with F = [[G, 0], [0, diag(decay)]] on the states, I on the clones."""
    n, dense, N = f.n, f.dense, f.total
    G, P, T, decay = f.G, f.P, f.work[0], f.decay
    for i in range(dense):  # T = F P on the states
        for j in range(n):
            T[i, j] = 0.0
        for k in range(n):
            g = G[i, k]
            for j in range(n):
                T[i, j] += g * P[k, j]
    for i in range(dense):  # P = T F^T + Q
        for j in range(i, dense):
            total = f.Q[i, j]
            for k in range(n):
                total += T[i, k] * G[j, k]
            P[i, j] = total
            P[j, i] = total
        for j in range(dense, n):
            value = T[i, j] * decay[j] + f.Q[i, j]
            P[i, j] = value
            P[j, i] = value
    for i in range(dense, n):
        for j in range(i, n):
            value = decay[i] * P[i, j] * decay[j] + f.Q[i, j]
            P[i, j] = value
            P[j, i] = value
    for c in range(n, N):  # the clones' covariance with the states
        for i in range(dense):
            total = 0.0
            for k in range(n):
                total += G[i, k] * P[k, c]
            f.ph[i] = total
        for i in range(dense, n):
            f.ph[i] = decay[i] * P[i, c]
        for i in range(n):
            P[i, c] = f.ph[i]
            P[c, i] = f.ph[i]


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
