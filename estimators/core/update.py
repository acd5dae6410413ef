"""The correction by a sample of a slow sensor, whatever the filter's rules are."""

from typing import Any

import numpy as np

from ...envs.backend.decorators import apart, jit
from ...envs.backend.elementary import wrap
from ...envs.backend.primitives import absolute, maximum
from ...envs.record import PACKET
from .covariance import dot, expected, measure_clone, measure_state
from .delay import BUFFER, CONSTANT, LARSEN, STORED_ONE, carry_gains
from .innovation import adapt, believe, noise_of, project_row
from .intersample import NONE, PSEUDO, begin_shares, correct_sample, share_sample
from .memory import COUNTERS, SNAPSHOTS, WINDOW, Gains, Memory, Row
from .speed import frame_row
from .transition import PSI

ASTRAY = 0.5  # rad: the first heading fix sets the heading where it is so far off


@jit
def _expected(f: Memory, s: int, i: int, first: int, captured: int) -> Any:
    """What the filter expects row i of a sample to be."""
    if first == STORED_ONE and f.late == LARSEN:
        return f.larsen_expected[s, i]
    if first == STORED_ONE:
        stored = maximum(f.tick - f.assumed, f.start) if f.late == CONSTANT else captured
        before = dot(f.C[s, i], f.predicted[stored % WINDOW], f.n)  # uneven-delay (15)
        turn = f.past_road_turn[stored % WINDOW]
        return before + turn if f.ground[s, i] == 1 else before
    if f.between == PSEUDO:
        return f.expected[i]  # before this tick's corrections
    if first >= 0:
        return f.x[first + i]
    return expected(f, s, i)


@jit
def _align(f: Memory, s: int, turn: float) -> None:
    """Turn the heading onto sensor s's first fix, now and in what it has captured; turn: rad."""
    f.x[PSI] += turn
    f.expected[0] += turn
    if f.first_clone[s] > 0:
        for slot in range(f.frames[s]):
            f.x[f.first_clone[s] + slot * f.rows[s]] += turn
    f.larsen_expected[s, 0] += turn
    if f.late == BUFFER:
        for i in range(SNAPSHOTS + 1):
            f.snapshot_x[i, PSI] += turn


@jit
def _residuals(f: Memory, s: int, first: int, packet: Row) -> None:
    """f.residual of every row, wrapped where it is an angle; a heading fix may set psi."""
    captured = int(packet[PACKET.captured])
    for i in range(f.rows[s]):
        residual = packet[PACKET.value + i] - _expected(f, s, i, first, captured)
        f.residual[i] = wrap(residual) if f.angle[s, i] == 1 else residual
    if f.heading_fix[s] == 1 and f.first_fix < 0:
        f.first_fix = captured
        if absolute(f.residual[0]) > ASTRAY:
            _align(f, s, f.residual[0])
            f.residual[0] = 0.0


@jit
def _rest(f: Memory, s: int, first: int, i: int, K: Row) -> None:
    """What row i's correction by the gain K (total,) leaves of the residuals of the rows behind."""
    for j in range(i + 1, f.rows[s]):
        moved = K[first + j] if first >= 0 else dot(f.C[s, j], K, f.n)
        f.residual[j] -= moved * f.residual[i]


@jit
def _correct_periodic(f: Memory, gains: Gains, s: int, first: int, packet: Row) -> None:
    """x += K residual with the gains of the table, one row after the other."""
    captured = int(packet[PACKET.captured])
    at = frame_row(f, s, (captured - f.phase[s]) // f.period[s] % f.pattern)
    for i in range(f.rows[s]):
        K, residual = gains[f.cell, at + i], f.residual[i]
        for j in range(f.total):
            f.x[j] += K[j] * residual
        _rest(f, s, first, i, K)


@jit
def _correct(f: Memory, s: int, first: int, packet: Row) -> None:
    """The rows of a sample, one after the other, with the covariance."""
    for i in range(f.rows[s]):
        residual, r = f.residual[i], noise_of(f, s, i, packet)
        if f.adapt > 0.0:
            adapt(f, s, i, project_row(f, s, i, first), residual, r)
        if first >= 0:
            measure_clone(f, first + i, r, residual)
        else:
            measure_state(f, f.C[s, i], r, residual)
        _rest(f, s, first, i, f.gain)
        if f.late == LARSEN:
            carry_gains(f, f.C[s, i])


@jit
def _correct_states(f: Memory, s: int) -> None:
    """x <- x + M K residual, Larsen's correction at the arrival."""
    for i in range(f.rows[s]):
        for k in range(f.n):
            f.x[k] += f.larsen_gain[s, i, k] * f.residual[i]


@apart
def measure(f: Memory, gains: Gains, s: int, first: int, packet: Row, judge: bool) -> bool:
    """Correct by a packet (PACKET_WIDTH,) of sensor s whose values are sound; False if gated.

    first: of `delay.find`. judge: whether the gate judges it and its NIS is taken (not when it is
    used again in a rewound window).
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
        begin_shares(f, gains, s)
    elif f.periodic == 1:
        _correct_periodic(f, gains, s, first, packet)
    elif first == STORED_ONE and f.late == LARSEN:
        _correct_states(f, s)
    else:
        if judge and not believe(f, s, first, packet):
            f.counts[COUNTERS.gated] += 1
            f.first_fix = fix
            return False
        _correct(f, s, first, packet)
    return True
