"""A sample's innovation: its variance, whether it is possible at all, and what it says about R."""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import maximum, minimum, sqrt
from ...envs.record import PACKET
from ...envs.sensors.slow import GPS
from .covariance import project, project_clone
from .delay import CLONE

HDOP, SATELLITES = 4, 5  # values of a GPS packet
_LEAST, _MOST = 0.05, 100.0  # of the scale of R


@jit
def dilution(f: Any, hdop: Any) -> Any:
    """The factor on the GPS's noise at an HDOP: the filter's table, linear between its knots."""
    last = f.knots - 1
    if f.knots == 0 or hdop - hdop != 0.0:
        return 1.0
    if hdop <= f.hdop[0]:
        return f.hdop_factor[0]
    for i in range(last):
        if hdop <= f.hdop[i + 1]:
            share = (hdop - f.hdop[i]) / (f.hdop[i + 1] - f.hdop[i])
            return f.hdop_factor[i] + share * (f.hdop_factor[i + 1] - f.hdop_factor[i])
    return f.hdop_factor[last]


@jit
def _at_capture(f: Any, packet: Any) -> Any:
    """The variance of a GPS packet's first row at the speed at which it was captured."""
    captured = int(packet[PACKET.captured])
    if f.late == CLONE and f.r_course > 0.0 and captured < f.tick:
        return f.r_held[(captured - f.phase[GPS]) // f.period[GPS] % f.frames[GPS]]
    return f.r[GPS, 0]


@jit
def noise_of(f: Any, s: int, i: int, packet: Any) -> Any:
    """The variance of row i of a packet of sensor s."""
    if s != GPS:
        return f.r[s, i] * f.scale[s, i]
    factor = dilution(f, packet[PACKET.value + HDOP])
    r = _at_capture(f, packet) if i == 0 else f.r[s, i]
    return r * f.scale[s, i] * factor * factor


@jit
def project_row(f: Any, s: int, i: int, first: int) -> Any:
    """f.ph = P C^T of row i, of the states (first < 0) or of a clone; returns C P C^T."""
    return project_clone(f, first + i) if first >= 0 else project(f, f.row[s, i])


@jit
def _covariance(f: Any, s: int, first: int, packet: Any) -> None:
    """f.S = C P C^T + R of the sample, its lower half."""
    for i in range(f.rows[s]):
        own = project_row(f, s, i, first)
        f.S[i, i] = own + noise_of(f, s, i, packet)
        for j in range(i + 1, f.rows[s]):
            total = 0.0
            if first >= 0:
                total = f.ph[first + j]
            else:
                for k in range(f.n):
                    total += f.row[s, j, k] * f.ph[k]
            f.S[j, i] = total


@jit
def innovate(f: Any, s: int, first: int, packet: Any) -> bool:
    """f.nis = residual^T S^-1 residual (f.residual); whether the gate lets the sample pass."""
    p, S = f.rows[s], f.S
    _covariance(f, s, first, packet)
    nis = 0.0
    for i in range(p):  # Cholesky and forward substitution in one go
        rest = f.residual[i]
        for j in range(i):
            rest -= S[i, j] * f.eps[j]
        for j in range(i):
            S[i, i] -= S[i, j] * S[i, j]
        S[i, i] = sqrt(S[i, i])
        for k in range(i + 1, p):
            for j in range(i):
                S[k, i] -= S[k, j] * S[i, j]
            S[k, i] /= S[i, i]
        f.eps[i] = rest / S[i, i]
        nis += f.eps[i] * f.eps[i]
    f.nis = nis
    return not (f.gate[p] > 0.0 and nis > f.gate[p])


@jit
def adapt(f: Any, s: int, i: int, own: Any, residual: Any, r: Any) -> None:
    """Innovation-based R: the mean of residual^2 - C P C^T, as a multiple of what was told.

    r: the sample's variance by the present scale.
    """
    if r > 0.0:
        seen = (residual * residual - own) / r * f.scale[s, i]
        scale = f.scale[s, i] + f.adapt * (seen - f.scale[s, i])
        f.scale[s, i] = minimum(maximum(scale, _LEAST), _MOST)
