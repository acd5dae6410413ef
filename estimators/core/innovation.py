"""A sample's innovation: its variance, whether it is possible at all, and what it tells of R.

A gate alone starves a filter that has lost itself. Gated samples in a row whose residuals agree
show that it is the filter which is wrong, or that what is measured has jumped, as a heading does by
the half turn of a flipped antenna: then the state that only this sensor measures is forgotten by as
much as the residual, and the sensor is believed again. A state that another sensor measures, which
was believed meanwhile, is not forgotten.
"""

from math import log
from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.elementary import wrap
from ...envs.backend.primitives import maximum, minimum, sqrt
from ...envs.record import PACKET
from .covariance import dot, project, project_clone
from .delay import BUFFER, CLONE
from .memory import SLOW, SNAPSHOTS, Memory, Row
from .transition import variance

_ALIKE = 4.0  # standard deviations
_LEAST, _MOST = 0.05, 100.0  # of the scale of R


@jit
def dilution(f: Memory, s: int, packet: Row) -> Any:
    """The factor on sensor s's standard deviations at the HDOP of its packet (PACKET_WIDTH,).

    The filter's table, linear between its knots; 1 without a table or an HDOP.
    """
    if f.knots == 0 or f.hdop_column[s] == 0:
        return 1.0
    hdop, last = packet[f.hdop_column[s]], f.knots - 1
    if hdop - hdop != 0.0:
        return 1.0
    if hdop <= f.hdop[0]:
        return f.hdop_factor[0]
    for i in range(last):
        if hdop <= f.hdop[i + 1]:
            share = (hdop - f.hdop[i]) / (f.hdop[i + 1] - f.hdop[i])
            return f.hdop_factor[i] + share * (f.hdop_factor[i + 1] - f.hdop_factor[i])
    return f.hdop_factor[last]


@jit
def _at_capture(f: Memory, s: int, i: int, packet: Row) -> Any:
    """The variance of row i of a packet at the speed at which it was captured."""
    captured = int(packet[PACKET.captured])
    if f.late == CLONE and f.noise_over_speed[s, i] > 0.0 and captured < f.tick:
        slot = (captured - f.phase[s]) // f.period[s] % f.frames[s]
        return variance(f, s, i, f.speed_captured[s, slot])
    return f.r[s, i]


@jit
def noise_of(f: Memory, s: int, i: int, packet: Row) -> Any:
    """The variance of row i of a packet (PACKET_WIDTH,) of sensor s."""
    factor = dilution(f, s, packet)
    return _at_capture(f, s, i, packet) * f.scale[s, i] * factor * factor


@jit
def project_row(f: Memory, s: int, i: int, first: int) -> Any:
    """f.PC = P C^T of row i, of the states (first < 0) or of a clone; returns C P C^T."""
    return project_clone(f, first + i) if first >= 0 else project(f, f.C[s, i])


@jit
def _covariance(f: Memory, s: int, first: int, packet: Row) -> None:
    """f.S = C P C^T + R of the sample, its lower half."""
    for i in range(f.rows[s]):
        own = project_row(f, s, i, first)
        f.S[i, i] = own + noise_of(f, s, i, packet)
        for j in range(i + 1, f.rows[s]):
            f.S[j, i] = f.PC[first + j] if first >= 0 else dot(f.C[s, j], f.PC, f.n)


@jit
def innovate(f: Memory, s: int, first: int, packet: Row) -> bool:
    """f.nis = residual^T S^-1 residual (f.residual); whether the gate lets the sample pass.

    first: the clone of its first row, negative where it measures the states.
    """
    p, S = f.rows[s], f.S
    _covariance(f, s, first, packet)
    nis = 0.0
    for i in range(p):  # Cholesky and forward substitution in one go
        rest = f.residual[i]
        for j in range(i):
            rest -= S[i, j] * f.white[j]
        for j in range(i):
            S[i, i] -= S[i, j] * S[i, j]
        S[i, i] = sqrt(S[i, i])
        for k in range(i + 1, p):
            for j in range(i):
                S[k, i] -= S[k, j] * S[i, j]
            S[k, i] /= S[i, i]
        f.white[i] = rest / S[i, i]
        nis += f.white[i] * f.white[i]
    f.nis = nis
    return not (f.gate[p] > 0.0 and nis > f.gate[p])


@jit
def _agrees(f: Memory, s: int) -> bool:
    """Whether every residual is the last gated one, within `_ALIKE` deviations of a difference."""
    for i in range(f.rows[s]):
        off, own = f.residual[i] - f.doubt[s, i], 0.0
        if f.angle[s, i] == 1:
            off = wrap(off)
        for j in range(i + 1):
            own += f.S[i, j] * f.S[i, j]  # Cholesky's factor
        if off * off > 2.0 * _ALIKE * _ALIKE * own:
            return False
    return True


@jit
def _measured_by_others(f: Memory, s: int, state: int) -> bool:
    """Whether another sensor that measures a state was believed since s was doubted."""
    for other in range(SLOW):
        if other != s and f.rows[other] > 0 and f.believed[other] >= f.doubted[s]:
            for i in range(f.rows[other]):
                if f.C[other, i, state] != 0.0:
                    return True
    return False


@jit
def loosen(f: Memory, state: int, variance: Any) -> None:
    """Add a variance to a state, now and in what was captured of it."""
    v = f.PC
    for i in range(f.total):
        v[i] = 0.0
    v[state] = 1.0
    if f.late == CLONE:
        for s in range(SLOW):
            for k in range(f.frames[s] * f.rows[s]):
                v[f.first_clone[s] + k] = f.C[s, k % f.rows[s], state]
    for i in range(f.total):
        for j in range(f.total):
            f.P[i, j] += variance * (v[i] * v[j])
    if f.late == BUFFER:
        for i in range(SNAPSHOTS + 1):
            f.snapshot_P[i, state, state] += variance


@jit
def _begin_anew(f: Memory, s: int) -> bool:
    """Forget what only sensor s measures, of each row the last state; False if there is nothing."""
    forgot = False
    for i in range(f.rows[s]):
        state = 0
        for k in range(f.n):
            if f.C[s, i, k] != 0.0:
                state = k
        if not _measured_by_others(f, s, state):
            loosen(f, state, f.residual[i] * f.residual[i])
            forgot = True
    return forgot


@jit
def believe(f: Memory, s: int, first: int, packet: Row) -> bool:
    """Whether to use a sample: the gate lets it pass, or the filter begins anew with the sensor."""
    passed = innovate(f, s, first, packet)
    if f.wary == 0:
        return passed
    if not passed and f.believed[s] >= 0:
        if f.members > 0:  # as unlikely as the gate is high, or a member gains by refusing
            f.weight -= 0.5 * f.gate[f.rows[s]]
            for i in range(f.rows[s]):
                f.weight -= log(f.S[i, i])
        if f.doubts[s] == 0 or not _agrees(f, s):
            f.doubts[s], f.doubted[s] = 0, f.tick
        f.doubts[s] += 1
        for i in range(f.rows[s]):
            f.doubt[s, i] = f.residual[i]
        if f.doubts[s] < f.wary or not _begin_anew(f, s):
            return False
    f.believed[s], f.doubts[s] = f.tick, 0
    return True


@jit
def adapt(f: Memory, s: int, i: int, own: float, residual: float, r: float) -> None:
    """Innovation-based R: the mean of residual^2 - C P C^T, as a multiple of the configured one.

    own: C P C^T of row i of sensor s. r: the sample's variance by the present scale.
    """
    if r > 0.0:
        seen = (residual * residual - own) / r * f.scale[s, i]
        scale = f.scale[s, i] + f.adapt * (seen - f.scale[s, i])
        f.scale[s, i] = minimum(maximum(scale, _LEAST), _MOST)
