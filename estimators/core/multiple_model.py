"""A bank of filters side by side, and its mixture: the mean and covariance in layer 0.

Every half second the least likely member becomes a copy of the likeliest that forgets the tyres.
"""

from math import exp

from ...envs.numerics.jit import jit, noinline
from ...envs.numerics.primitives import Scalar, maximum
from ...envs.numerics.simd8 import load8, store8
from .innovation import inflate_covariance
from .record import FilterRecord, FilterRecords

MIN_LOG_WEIGHT = -60.0  # least weight of a member, a logarithm, relative to the likeliest


@jit
def _find_likeliest(layers: FilterRecords) -> int:
    best = 1
    for m in range(2, len(layers)):
        if layers[m].weight > layers[best].weight:
            best = m
    return best


@jit
def _set_level(f: FilterRecord, i: int, level: Scalar) -> None:
    """Set the variance of disturbance i to `level` times the configured one."""
    index, ratio = f.dense + i, level / f.level[i]
    f.level[i] = level
    f.q_known[i] *= ratio
    f.Q[index, index] *= ratio


@noinline
def replace_least_likely(layers: FilterRecords) -> None:
    """Replace the least likely member by the likeliest with tyres that may have changed.

    Its tyres walk until the next replacement, since the change may come later. Where members differ
    in the level of their disturbances, a place in the bank stays at its own.

    Args:
        layers: Memory of the bank, shape (layers,).
    """
    best = _find_likeliest(layers)
    peak, worst = layers[best].weight, 1
    for m in range(1, len(layers)):
        layers[m].weight, layers[m].fresh = maximum(layers[m].weight - peak, MIN_LOG_WEIGHT), 0.0
        if layers[m].weight <= layers[worst].weight and m != best:
            worst = m
    f = layers[worst]
    force, moment, odds, i = f.level[0], f.level[1], f.odds, f.dense
    first = f.prior[i, i], f.prior[i + 1, i + 1]
    layers[worst] = layers[best]
    f.odds = odds  # the initial weight belongs to the place, not to the copied member
    if f.forces == 1:
        _set_level(f, 0, force)
        _set_level(f, 1, moment)
        f.prior[i, i], f.prior[i + 1, i + 1] = first
    for i in range(2):
        inflate_covariance(f, f.tyres + i, f.spread)
    f.weight, f.fresh = f.hazard, f.alert


@jit
def _compute_likelihood(layers: FilterRecords, m: int, best: int) -> Scalar:
    return exp(maximum(layers[m].weight - layers[best].weight, MIN_LOG_WEIGHT))


@noinline
def compute_mixture(layers: FilterRecords) -> None:
    """Compute the mean and covariance of the mixture, in layer 0.

    Args:
        layers: Memory of the bank, shape (layers,).
    """
    best = _find_likeliest(layers)
    likeliest, mixture = layers[best], layers[0]
    total, n = 0.0, likeliest.n
    for m in range(1, len(layers)):
        total += _compute_likelihood(layers, m, best)
    for i in range(n):
        mixture.x[i] = 0.0
        for j in range(0, n, 8):
            store8(mixture.P, 0.0, i, j)
    for m in range(1, len(layers)):
        share = _compute_likelihood(layers, m, best) / total
        for i in range(n):
            mixture.x[i] += share * layers[m].x[i]
    for m in range(1, len(layers)):
        share, f = _compute_likelihood(layers, m, best) / total, layers[m]
        for j in range(0, n, 8):
            offset = load8(f.x, j) - load8(mixture.x, j)
            for i in range(n):
                moment = load8(f.P, i, j) + (f.x[i] - mixture.x[i]) * offset
                store8(mixture.P, load8(mixture.P, i, j) + share * moment, i, j)
    mixture.tick, mixture.speed, mixture.nis = likeliest.tick, likeliest.speed, layers[1].nis
    for i in range(len(mixture.counts)):
        mixture.counts[i] = layers[1].counts[i]
