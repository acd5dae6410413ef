"""The covariance and its gains in compiled code: `design.gains`'s equations on a filter's memory.

Only the first n of N = `total` states move; the others are clones. Rows are computed by eights of
columns, zero beyond N. Measurements come one scalar at a time, so that a gain is a division. The
memory of filters in lanes (`vector.lanes`) has the same fields, whose columns come one by one.
"""

from ...envs.numerics.jit import inline, jit
from ...envs.numerics.packed import (
    allocate_scratch,
    count_upper_rows,
    load8,
    load8_symmetric,
    load_element,
    mirror,
    store8,
    vector_width,
)
from ...envs.numerics.primitives import Scalar, Vector, absolute, any_lane, select, sqrt
from .memory import GAIN, N_CORE, N_TOTAL, FilterMemory


@jit
def has_covariance(f: FilterMemory) -> Scalar:
    """Return whether the filter carries P along, for its gains; others read them from a table."""
    return f.gain_rule <= GAIN.split


@jit
def dot(row: Vector, v: Vector, n: int) -> Scalar:
    """Compute the product of a row of C and a vector of states."""
    total = 0.0
    for k in range(n):
        total += row[k] * v[k]
    return total


@jit
def predict_measurement(f: FilterMemory, s: int, i: int) -> Scalar:
    """Predict a row of a slow sensor: C x and, over the ground, the road's heading."""
    value = dot(f.C[s, i], f.x, f.n)
    return value + f.road_turn if f.ground[s, i] == 1 else value


@inline
def _accumulate_rows(
    M: Vector, i: int, k: int, v: Scalar, sums: tuple[Scalar, ...]
) -> tuple[Scalar, ...]:
    a, b, c, d = sums
    a, b = a + load_element(M, i, k) * v, b + load_element(M, i + 1, k) * v
    return a, b, c + load_element(M, i + 2, k) * v, d + load_element(M, i + 3, k) * v


@inline
def _multiply_rows(
    M: Vector, i: int, V: Vector, n: int, j: int, sums: tuple[Scalar, ...]
) -> tuple[Scalar, ...]:
    """Add rows i to i + 3 of M (., n) times V to four sums, eight columns from j on."""
    for k in range(n):
        sums = _accumulate_rows(M, i, k, load8(V, k, j), sums)
    return sums


@inline
def _multiply_symmetric(M: Vector, i: int, P: Vector, n: int, j: int) -> tuple[Scalar, ...]:
    """Multiply rows i to i + 3 of M by a symmetric matrix P, see `_multiply_rows`."""
    sums = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        sums = _accumulate_rows(M, i, k, load8_symmetric(P, k, j), sums)
    return sums


@jit
def multiply(a: Vector, b: Vector, c: Vector, n: int, m: int) -> None:
    """Multiply c = a b, in the corners of larger arrays.

    Args:
        a: Matrix, shape (n, n) or larger.
        b: Matrix, shape (n, m) or larger.
        c: Output, shape (n, m) or larger.
        n: Rows of the product.
        m: Columns of the product.
    """
    for j in range(0, m, 8):
        for i in range(0, n, 4):
            first, second, third, fourth = _multiply_rows(a, i, b, n, j, (0.0, 0.0, 0.0, 0.0))
            store8(c, first, i, j)
            store8(c, second, i + 1, j)
            store8(c, third, i + 2, j)
            store8(c, fourth, i + 3, j)


@jit
def apply_transition(f: FilterMemory, v: Vector) -> None:
    """Predict v <- F v with F = diag(own_decay) + G."""
    n, new, step = f.n, allocate_scratch(f.P, 1, N_CORE), vector_width(f.P)
    for j in range(0, n, step):
        total = load8(f.own_decay, j) * load8(v, j)
        for k in range(n if j < f.dense else 0):  # the states behind decay by themselves
            total = total + load_element(v, k) * load8(f.GT, k, j)
        store8(new, total, 0, j)
    for j in range(0, n, step):
        store8(v, load8(new, 0, j), j)


@jit
def predict_covariance(f: FilterMemory) -> None:
    """Predict P <- F P F^T + Q with F = [[G, 0], [0, diag(decay)]] on the states, I on the clones.

    The rows of the dense states are computed by fours, what stands above the diagonal counts.
    """
    n, dense, N = f.n, f.dense, f.total
    P, Q, GT, keep, step = f.P, f.Q, f.GT, f.own_decay, vector_width(f.P)
    FP = allocate_scratch(P, N_CORE, N_TOTAL)
    states = (n + step - 1) // step * step  # columns with a state among them
    for j in range(0, N, step):
        for i in range(0, dense, 4):
            a, b, c, d = _multiply_symmetric(f.G, i, P, n, j)
            store8(FP, a, i, j)
            store8(FP, b, i + 1, j)
            store8(FP, c, i + 2, j)
            store8(FP, d, i + 3, j)
    for j in range(0, states, step):
        factor = load8(keep, j)
        for i in range(0, count_upper_rows(P, dense, j), 4):
            a = load8(Q, i, j) + load8(FP, i, j) * factor
            b = load8(Q, i + 1, j) + load8(FP, i + 1, j) * factor
            c = load8(Q, i + 2, j) + load8(FP, i + 2, j) * factor
            d = load8(Q, i + 3, j) + load8(FP, i + 3, j) * factor
            if j < dense:  # the columns behind have decays alone
                a, b, c, d = _multiply_rows(FP, i, GT, n, j, (a, b, c, d))
            store8(P, a, i, j)
            if i + 1 < dense:
                store8(P, b, i + 1, j)
            if i + 2 < dense:
                store8(P, c, i + 2, j)
            if i + 3 < dense:
                store8(P, d, i + 3, j)
        for i in range(dense, count_upper_rows(P, n, j)):
            store8(P, load_element(f.decay, i) * load8(P, i, j) * factor + load8(Q, i, j), i, j)
    for j in range(states, N, step):  # clones alone
        for i in range(dense):
            store8(P, load8(FP, i, j), i, j)
        for i in range(dense, n):
            store8(P, load_element(f.decay, i) * load8(P, i, j), i, j)
    for i in range(0, n, step):
        for j in range(i, N, step):
            mirror(P, i, j)


@jit
def correct_scalar(f: FilterMemory, variance: Scalar, residual: Scalar) -> None:
    """Correct by one residual whose covariance with the state is `f.PC`.

    P <- P - K s K^T with the residual's variance s, to which Joseph's form comes down for the
    optimal gain of a scalar. With products of two entries of P C^T it is symmetric to the last bit.
    """
    N, x, P, PC, gain, step = f.total, f.x, f.P, f.PC, f.gain, vector_width(f.P)
    inverse = 1.0 / variance
    if f.robust > 0.0:  # Huber: a larger residual's variance grows by deviations / robust
        deviations = absolute(residual) * sqrt(inverse)
        inverse = inverse * select(deviations > f.robust, f.robust / deviations, 1.0)
    for j in range(0, N, step):
        pc = load8(PC, j)
        store8(gain, pc * inverse, j)
        store8(x, load8(x, j) + pc * inverse * residual, j)
        for i in range(count_upper_rows(P, N, j)):
            store8(P, load8(P, i, j) - inverse * (load_element(PC, i) * pc), i, j)


@jit
def project(f: FilterMemory, row: Vector) -> Scalar:
    """Compute f.PC = P C^T of a measurement of the states."""
    n, N, P, PC = f.n, f.total, f.P, f.PC
    for j in range(0, N, vector_width(P)):
        total = 0.0
        for k in range(n):
            h = load_element(row, k)
            if any_lane(h != 0.0):
                total = total + h * load8_symmetric(P, k, j)
        store8(PC, total, j)
    variance = 0.0
    for k in range(n):
        h = load_element(row, k)
        if any_lane(h != 0.0):  # a zero would only lengthen the chain of sums
            variance = variance + h * load_element(PC, k)
    return variance


@jit
def project_row(f: FilterMemory, s: int, i: int, target: int) -> Scalar:
    """Compute f.PC = P C^T of a sensor's row."""
    if target < 0:
        return project(f, f.C[s, i])
    for j in range(f.total):
        f.PC[j] = f.P[target + i, j]
    return f.PC[target + i]
