"""A sample's innovation: its variance, whether it is possible at all, and what it tells of R."""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import maximum, minimum, sqrt
from ...envs.record import PACKET
from .covariance import dot, project, project_clone
from .delay import CLONE
from .memory import Memory, Row
from .transition import variance

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
def adapt(f: Memory, s: int, i: int, own: float, residual: float, r: float) -> None:
    """Innovation-based R: the mean of residual^2 - C P C^T, as a multiple of the configured one.

    own: C P C^T of row i of sensor s. r: the sample's variance by the present scale.
    """
    if r > 0.0:
        seen = (residual * residual - own) / r * f.scale[s, i]
        scale = f.scale[s, i] + f.adapt * (seen - f.scale[s, i])
        f.scale[s, i] = minimum(maximum(scale, _LEAST), _MOST)
