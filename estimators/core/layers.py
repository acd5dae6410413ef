"""Estimators of several records: the second layer of double-layer-gps, or a bank and its mixture.

The second layer has velocities and roll, measured by the GPS and the first layer.

A bank: a filter that has settled on its tyres takes seconds to believe that they changed. Every
half second the least likely member becomes a copy of the likeliest that has forgotten the tyres, at
the odds of such a change, and whose tyres walk until the next one begins, since the change may come
later; what is measured makes one or the other likelier. Members that would be twins of others at
the start come with next to no weight, so that they begin anew first. Where members differ in the
level of their disturbances, a place in the bank stays at its own. Layer 0 of an estimator
with a bank is the mixture's mean and covariance, which nothing measures; its members follow.

Or its four members interact, an interacting multiple model (Blom, Bar-Shalom 1988) of a Markov
chain: nothing happens; a gust blows, whose force and moment walk; the tyres have just changed, and
walk; they settle. Every fifth of a second each one is merged, mean and covariance, with what
comes from the others at the chain's odds: a gust that begins adds its variance to the forces, one
that ends leaves them as they are without it, tyres that change are forgotten. What a gust does is
seen only after some tenths of a second: until then merging lets the hypothesis live.
"""

from math import exp, log
from typing import Any

from ...envs.backend.decorators import apart, copied, jit
from ...envs.backend.eights import eight, put_eight
from ...envs.backend.elementary import sincos
from ...envs.backend.primitives import maximum
from ...envs.record import PACKET
from .innovation import dilution, loosen
from .memory import COUNTERS, WINDOW, Filters, Gains, Memory, Row
from .packets import receive, receive_sample
from .speed import finite
from .transition import BETA

LEAST = -60.0  # of a member's weight, below the likeliest
CALM, GUSTY, CHANGED, SETTLING = range(1, 5)
"""Layers of the members that interact."""
GUSTS, LULLS = 0.03, 0.3  # 1/s, of gusts that begin and end
CHANGES, SETTLES, TRUSTS = 0.1, 2.0, 0.3  # 1/s, of tyres: into CHANGED, SETTLING, CALM


@jit
def pass_on(first: Memory, second: Memory, gains: Gains, packet: Row) -> None:
    """Correct the second layer by a packet (PACKET_WIDTH,) that the first has used, as a velocity:
    v_x = V cos(beta), v_y = V sin(beta).

    double-layer-gps (8)-(9), with the first layer's sideslip angle as it was predicted for the
    captured tick. The noise along is the speed's, after the table of HDOP; the one across is that
    of the angle, (V sigma_beta)^2, and of the speed, (sigma_V sin(beta))^2.
    """
    s, captured = int(packet[PACKET.sensor]), int(packet[PACKET.captured])
    beta = first.x[BETA]
    if captured >= maximum(first.start, first.tick - WINDOW + 1) and captured < first.tick:
        beta = first.predicted[captured % WINDOW, BETA]
    sine, cosine = sincos(beta)
    V = packet[first.speed_column[s]]
    if not finite(V):
        first.counts[COUNTERS.invalid] += 1
        return
    velocity = second.sample
    copied(packet, velocity)
    velocity[PACKET.value] = V * cosine
    velocity[PACKET.value + 1] = V * sine
    factor = dilution(first, s, packet)
    along = second.r_speed * factor * factor
    second.r[s, 0] = along
    second.r[s, 1] = V * V * first.P[BETA, BETA] + along * sine * sine
    receive_sample(second, gains)


@jit
def own(layers: Filters) -> int:
    """The first layer that measures: 1 where there is a bank, else 0."""
    return 1 if layers[0].members > 0 else 0


@jit
def receive_beside(layers: Filters, gains: Gains, packet: Row) -> None:
    """`receive` a packet by every member behind the first one."""
    for m in range(2, len(layers)):
        receive(layers[m], gains, packet)


@jit
def _likeliest(layers: Filters) -> int:
    best = 1
    for m in range(2, len(layers)):
        if layers[m].weight > layers[best].weight:
            best = m
    return best


@jit
def _set_level(f: Memory, i: int, level: Any) -> None:
    """Disturbance i comes with `level` of its configured variance."""
    at, more = f.dense + i, level / f.level[i]
    f.level[i] = level
    f.q_known[i] *= more
    f.Q[at, at] *= more


@apart
def respawn(layers: Filters) -> None:
    """The least likely member becomes the likeliest, but for tyres that may be others now."""
    best = _likeliest(layers)
    top, worst = layers[best].weight, 1
    for m in range(1, len(layers)):
        layers[m].weight, layers[m].fresh = maximum(layers[m].weight - top, LEAST), 0.0
        if layers[m].weight <= layers[worst].weight and m != best:
            worst = m
    f = layers[worst]
    force, moment, odds, i = f.level[0], f.level[1], f.odds, f.dense
    first = f.prior[i, i], f.prior[i + 1, i + 1]
    layers[worst] = layers[best]
    f.odds = odds  # with which the place, not the member, begins
    if f.forces == 1:
        _set_level(f, 0, force)
        _set_level(f, 1, moment)
        f.prior[i, i], f.prior[i + 1, i + 1] = first
    for i in range(2):
        loosen(f, f.tyres + i, f.spread)
    f.weight, f.fresh = f.hazard, f.alert


@jit
def _copy_moments(source: Memory, target: Memory) -> None:
    """Mean and covariance of states and clones."""
    for j in range(0, source.total, 8):
        put_eight(target.x, eight(source.x, j), j)
        for i in range(source.total):
            put_eight(target.P, eight(source.P, i, j), i, j)


@jit
def _give(source: Memory, share: Any) -> Any:
    """The probability (a member's `weight`, here) that leaves it."""
    left = share * source.weight
    source.weight -= left
    return left


@jit
def _merge(source: Memory, probability: Any, target: Memory) -> Any:
    """Mean and covariance of a member with what comes from a source; the source's share."""
    target.weight += probability
    share = probability / target.weight
    both = share * (1.0 - share)
    for j in range(0, target.total, 8):
        off = eight(source.x, j) - eight(target.x, j)
        for i in range(target.total):
            own, more = eight(target.P, i, j), (source.x[i] - target.x[i]) * off * both
            put_eight(target.P, own + (eight(source.P, i, j) - own) * share + more, i, j)
    for i in range(target.total):
        target.x[i] += share * (source.x[i] - target.x[i])
    return share


@jit
def _calm_down(f: Memory) -> None:
    """Force and moment are what they are without a gust, whatever they were."""
    for i in range(2):
        at = f.dense + i
        f.x[at] = 0.0
        for j in range(f.total):
            f.P[at, j] = 0.0
            f.P[j, at] = 0.0
        f.P[at, at] = f.q_known[i] / f.q_share


@apart
def interact(layers: Filters) -> None:
    """The members' moments and weights after a step of the chain; layer 0 is its scratch."""
    best, aside = _likeliest(layers), layers[0]
    calm, gusty, changed = layers[CALM], layers[GUSTY], layers[CHANGED]
    settling, top, time = layers[SETTLING], layers[best].weight, calm.respawn * calm.step
    for m in range(1, len(layers)):
        layers[m].weight = exp(maximum(layers[m].weight - top, LEAST))
    _copy_moments(gusty, aside)
    _calm_down(aside)
    lulled = _give(gusty, LULLS * time)
    share = _merge(calm, _give(calm, GUSTS * time), gusty)
    for i in range(2):
        loosen(gusty, gusty.dense + i, share * gusty.burst[i])
    _merge(aside, lulled, calm)
    _copy_moments(calm, aside)
    forgotten = _give(calm, CHANGES * time)
    _merge(settling, _give(settling, TRUSTS * time), calm)
    _merge(changed, _give(changed, SETTLES * time), settling)
    share = _merge(aside, forgotten, changed)
    for i in range(2):
        loosen(changed, changed.tyres + i, share * changed.spread)
    for m in range(1, len(layers)):
        layers[m].weight = log(layers[m].weight)


@jit
def renew(layers: Filters) -> None:
    """The bank's own step, now and then."""
    if layers[0].burst[0] > 0.0:
        interact(layers)
    else:
        respawn(layers)


@jit
def _share(layers: Filters, m: int, best: int) -> Any:
    return exp(maximum(layers[m].weight - layers[best].weight, LEAST))


@apart
def mix(layers: Filters) -> None:
    """The mean and covariance of the mixture into layer 0."""
    best = _likeliest(layers)
    out, front = layers[best], layers[0]
    total, n = 0.0, out.n
    for m in range(1, len(layers)):
        total += _share(layers, m, best)
    for i in range(n):
        front.x[i] = 0.0
        for j in range(0, n, 8):
            put_eight(front.P, 0.0, i, j)
    for m in range(1, len(layers)):
        share = _share(layers, m, best) / total
        for i in range(n):
            front.x[i] += share * layers[m].x[i]
    for m in range(1, len(layers)):
        share, f = _share(layers, m, best) / total, layers[m]
        for j in range(0, n, 8):
            off = eight(f.x, j) - eight(front.x, j)
            for i in range(n):
                spread = eight(f.P, i, j) + (f.x[i] - front.x[i]) * off
                put_eight(front.P, eight(front.P, i, j) + share * spread, i, j)
    front.tick, front.speed, front.nis = out.tick, out.speed, layers[1].nis
    for i in range(len(front.counts)):
        front.counts[i] = layers[1].counts[i]
