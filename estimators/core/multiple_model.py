"""A bank of filters side by side, and its mixture: the mean and covariance in layer 0.

Every half second the least likely member becomes a copy of the likeliest that forgets the tyres.
Or four members interact, an interacting multiple model (Blom, Bar-Shalom 1988): nothing happens,
a gust blows, the tyres have just changed, they settle.
"""

from math import exp, log

from ...envs.numerics.jit import jit, noinline
from ...envs.numerics.primitives import Scalar, maximum
from ...envs.numerics.simd8 import load8, store8
from .innovation import inflate_covariance
from .record import FilterRecord, FilterRecords

MIN_LOG_WEIGHT = -60.0  # least weight of a member, a logarithm, relative to the likeliest
CALM, GUSTY, CHANGED, _SETTLING = range(1, 5)
"""Layers of the members that interact."""
_GUST_RATE, _LULL_RATE = 0.03, 0.3  # 1/s, rates at which gusts begin and end
# 1/s, rates of the transitions into CHANGED, _SETTLING and CALM
_CHANGE_RATE, _SETTLE_RATE, _TRUST_RATE = 0.1, 2.0, 0.3


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
def _copy_moments(source: FilterRecord, target: FilterRecord) -> None:
    """Copy mean and covariance of states and clones."""
    for j in range(0, source.total, 8):
        store8(target.x, load8(source.x, j), j)
        for i in range(source.total):
            store8(target.P, load8(source.P, i, j), i, j)


@jit
def _split_weight(source: FilterRecord, share: Scalar) -> Scalar:
    """Split off and return a fraction of a member's probability, which its `weight` is here."""
    moved = share * source.weight
    source.weight -= moved
    return moved


@jit
def _merge(source: FilterRecord, probability: Scalar, target: FilterRecord) -> Scalar:
    """Merge a source's moments into a member's as a mixture's; return the source's fraction."""
    target.weight += probability
    share = probability / target.weight
    product = share * (1.0 - share)
    for j in range(0, target.total, 8):
        offset = load8(source.x, j) - load8(target.x, j)
        for i in range(target.total):
            entry, between = load8(target.P, i, j), (source.x[i] - target.x[i]) * offset * product
            store8(target.P, entry + (load8(source.P, i, j) - entry) * share + between, i, j)
    for i in range(target.total):
        target.x[i] += share * (source.x[i] - target.x[i])
    return share


@jit
def _remove_gust(f: FilterRecord) -> None:
    """Set force and moment to what they are without a gust, whatever they were."""
    for i in range(2):
        index = f.dense + i
        f.x[index] = 0.0
        for j in range(f.total):
            f.P[index, j] = 0.0
            f.P[j, index] = 0.0
        f.P[index, index] = f.q_known[i] / f.q_share[i]  # the stationary variance


@noinline
def run_imm_step(layers: FilterRecords) -> None:
    """Run a step of the Markov chain on the members' moments and weights; layer 0 is its scratch.

    A gust that begins adds its variance to the forces, one that ends leaves them as they are
    without it, tyres that change are forgotten.

    Args:
        layers: Memory of the bank, shape (1 + 4,).
    """
    best, calmed = _find_likeliest(layers), layers[0]
    calm, gusty, changed = layers[CALM], layers[GUSTY], layers[CHANGED]
    settling, max_weight, time = layers[_SETTLING], layers[best].weight, calm.respawn * calm.step
    for m in range(1, len(layers)):
        layers[m].weight = exp(maximum(layers[m].weight - max_weight, MIN_LOG_WEIGHT))
    _copy_moments(gusty, calmed)
    _remove_gust(calmed)
    calm_probability = _split_weight(gusty, _LULL_RATE * time)
    share = _merge(calm, _split_weight(calm, _GUST_RATE * time), gusty)
    for i in range(2):
        inflate_covariance(gusty, gusty.dense + i, share * gusty.burst[i])
    _merge(calmed, calm_probability, calm)
    _copy_moments(calm, calmed)
    change_probability = _split_weight(calm, _CHANGE_RATE * time)
    _merge(settling, _split_weight(settling, _TRUST_RATE * time), calm)
    _merge(changed, _split_weight(changed, _SETTLE_RATE * time), settling)
    share = _merge(calmed, change_probability, changed)
    for i in range(2):
        inflate_covariance(changed, changed.tyres + i, share * changed.spread)
    for m in range(1, len(layers)):
        layers[m].weight = log(layers[m].weight)


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
