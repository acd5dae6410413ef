"""The correction by a sample of a slow sensor, whatever the filter's rules are."""

from typing import Any

import numpy as np

from ...envs.backend.decorators import apart, jit
from ...envs.backend.elementary import wrap
from ...envs.backend.primitives import absolute, maximum
from ...envs.record import PACKET
from ...envs.sensors.slow import GPS
from .covariance import measure_clone, measure_state
from .delay import BUFFER, CONSTANT, HELD, LARSEN, keep_promises
from .innovation import adapt, innovate, noise_of, project_row
from .intersample import NONE, PSEUDO, correct_sample, share_sample, spread_sample
from .memory import COUNTERS, SNAPSHOTS, WINDOW

ASTRAY = 0.5  # rad: the first course sets the heading where it is so far off


@jit
def _sum(row: Any, v: Any, n: int) -> Any:
    """The product of a row and a vector of n states."""
    total = 0.0
    for k in range(n):
        total += row[k] * v[k]
    return total


@jit
def _expected(f: Any, s: int, i: int, first: int, captured: int) -> Any:
    """What the filter expects row i of a sample to be."""
    if first == HELD and f.late == LARSEN:
        return f.promised[s, i]
    if first == HELD:
        held = maximum(f.tick - f.assumed, f.start) if f.late == CONSTANT else captured
        return _sum(f.row[s, i], f.trail[held % WINDOW], f.n)  # uneven-delay (15)
    if f.between == PSEUDO:
        return f.expected[i]  # before this tick's corrections
    if first >= 0:
        return f.x[first + i]
    return _sum(f.row[s, i], f.x, f.n)


@jit
def _align(f: Any, turn: Any) -> None:
    """Turn the heading, now and as far as it is held, onto a first course that is far off."""
    f.x[2] += turn
    f.expected[0] += turn
    if f.home[GPS] > 0:
        for i in range(f.frames[GPS]):
            f.x[f.home[GPS] + i] += turn
    f.promised[GPS, 0] += turn
    if f.late == BUFFER:
        for i in range(SNAPSHOTS + 1):
            f.shot_x[i, 2] += turn


@jit
def _residuals(f: Any, s: int, first: int, packet: Any) -> None:
    """f.residual of every row, wrapped where it is an angle; the first course may set psi."""
    captured = int(packet[PACKET.captured])
    for i in range(f.rows[s]):
        residual = packet[PACKET.value + i] - _expected(f, s, i, first, captured)
        f.residual[i] = wrap(residual) if f.angle[s, i] == 1 else residual
    if s == GPS and f.angle[s, 0] == 1 and f.first_fix < 0:
        f.first_fix = captured
        if absolute(f.residual[0]) > ASTRAY:
            _align(f, f.residual[0])
            f.residual[0] = 0.0


@jit
def _rest(f: Any, s: int, first: int, i: int, K: Any) -> None:
    """What row i's correction by the gain K leaves of the residuals of the rows behind it."""
    for j in range(i + 1, f.rows[s]):
        moved = K[first + j] if first >= 0 else _sum(f.row[s, j], K, f.n)
        f.residual[j] -= moved * f.residual[i]


@jit
def _correct_periodic(f: Any, gains: Any, s: int, first: int, packet: Any) -> None:
    """x += K residual with the gains of the table, one row after the other."""
    captured = int(packet[PACKET.captured])
    frame = (captured - f.phase[s]) // f.period[s] % f.pattern
    at = 1 + f.cycle * maximum(f.fasts, 1) + frame * f.rows[s]
    for i in range(f.rows[s]):
        K, residual = gains[f.cell, at + i], f.residual[i]
        for j in range(f.total):
            f.x[j] += K[j] * residual
        _rest(f, s, first, i, K)


@jit
def _correct(f: Any, s: int, first: int, packet: Any) -> None:
    """The rows of a sample, one after the other, with the covariance."""
    for i in range(f.rows[s]):
        residual, r = f.residual[i], noise_of(f, s, i, packet)
        if f.adapt > 0.0:
            adapt(f, s, i, project_row(f, s, i, first), residual, r)
        if first >= 0:
            measure_clone(f, first + i, r, residual)
        else:
            measure_state(f, f.row[s, i], r, residual)
        _rest(f, s, first, i, f.gain)
        if f.late == LARSEN:
            keep_promises(f, f.row[s, i])


@jit
def _deliver_promise(f: Any, s: int) -> None:
    """x <- x + M K residual, Larsen's correction at the arrival."""
    for i in range(f.rows[s]):
        for k in range(f.n):
            f.x[k] += f.promise[s, i, k] * f.residual[i]


@apart
def measure(f: Any, gains: Any, s: int, first: int, packet: Any, judge: bool) -> bool:
    """Correct by one packet of sensor s whose values are sound; False if the gate refused it.

    judge: whether the gate judges it and its NIS is taken (not when it is told again).
    """
    if judge:
        f.nis = np.nan
    fix = f.first_fix
    _residuals(f, s, first, packet)
    if f.between == PSEUDO and f.periodic == 1:
        correct_sample(f, gains, s)
    elif f.between == PSEUDO:
        share_sample(f, s, first, packet)
    elif f.between != NONE:
        spread_sample(f, gains, s)
    elif f.periodic == 1:
        _correct_periodic(f, gains, s, first, packet)
    elif first == HELD and f.late == LARSEN:
        _deliver_promise(f, s)
    else:
        if judge and not innovate(f, s, first, packet):
            f.counts[COUNTERS.gated] += 1
            f.first_fix = fix
            return False
        _correct(f, s, first, packet)
    return True
