"""The correction by a sample of a slow sensor, whatever the filter's rules are."""

from typing import Any

import numpy as np

from ...envs.backend.decorators import jit, noinline
from ...envs.backend.elementary import wrap
from ...envs.backend.primitives import absolute, maximum
from ...envs.record import PACKET
from .covariance import dot, predict_measurement, update_with_clone, update_with_states
from .delay import BUFFER, CONSTANT, LARSEN, STORED_ONE, propagate_larsen_gains
from .innovation import adapt_noise, check_sample, compute_packet_variance, project_row
from .intersample import NONE, PSEUDO, correct_sample, split_sample_gain, start_shares
from .memory import COUNTERS, N_SNAPSHOTS, WINDOW, FilterRecord, GainTables, Vector
from .speed import locate_frame_row
from .transition import PSI

HEADING_TOLERANCE = 0.5  # rad: the first heading fix sets the heading where it is so far off


@jit
def _predict_row(f: FilterRecord, s: int, i: int, first: int, captured: int) -> Any:
    """Predict row i of a sample."""
    if first == STORED_ONE and f.late == LARSEN:
        return f.larsen_expected[s, i]
    if first == STORED_ONE:
        stored = maximum(f.tick - f.assumed, f.start) if f.late == CONSTANT else captured
        stored_prediction = dot(f.C[s, i], f.predicted[stored % WINDOW], f.n)  # uneven-delay (15)
        turn = f.past_road_turn[stored % WINDOW]
        return stored_prediction + turn if f.ground[s, i] == 1 else stored_prediction
    if f.between == PSEUDO:
        return f.expected[i]  # before this tick's corrections
    if first >= 0:
        return f.x[first + i]
    return predict_measurement(f, s, i)


@jit
def _align_heading(f: FilterRecord, s: int, turn: float) -> None:
    """Turn the heading onto sensor s's first fix, now and in what it has captured; turn: rad."""
    f.x[PSI] += turn
    f.expected[0] += turn
    if f.first_clone[s] > 0:
        for slot in range(f.frames[s]):
            f.x[f.first_clone[s] + slot * f.rows[s]] += turn
    f.larsen_expected[s, 0] += turn
    if f.late == BUFFER:
        for i in range(N_SNAPSHOTS + 1):
            f.snapshot_x[i, PSI] += turn


@jit
def _compute_residuals(f: FilterRecord, s: int, first: int, packet: Vector) -> None:
    """Compute f.residual of every row, wrapped where it is an angle; a heading fix may set psi."""
    captured = int(packet[PACKET.captured])
    for i in range(f.rows[s]):
        residual = packet[PACKET.value + i] - _predict_row(f, s, i, first, captured)
        f.residual[i] = wrap(residual) if f.angle[s, i] == 1 else residual
    if f.heading_fix[s] == 1 and f.first_fix < 0:
        f.first_fix = captured
        if absolute(f.residual[0]) > HEADING_TOLERANCE:
            _align_heading(f, s, f.residual[0])
            f.residual[0] = 0.0


@jit
def _reduce_residuals(f: FilterRecord, s: int, first: int, i: int, K: Vector) -> None:
    """Subtract row i's correction by the gain K (total,) from the residuals of the rows behind."""
    for j in range(i + 1, f.rows[s]):
        correction = K[first + j] if first >= 0 else dot(f.C[s, j], K, f.n)
        f.residual[j] -= correction * f.residual[i]


@jit
def _correct_periodic(
    f: FilterRecord, gains: GainTables, s: int, first: int, packet: Vector
) -> None:
    """Correct x by the gains of the table, one row after the other."""
    captured = int(packet[PACKET.captured])
    first_row = locate_frame_row(f, s, (captured - f.phase[s]) // f.period[s] % f.pattern)
    for i in range(f.rows[s]):
        K, residual = gains[f.cell, first_row + i], f.residual[i]
        for j in range(f.total):
            f.x[j] += K[j] * residual
        _reduce_residuals(f, s, first, i, K)


@jit
def _correct(f: FilterRecord, s: int, first: int, packet: Vector) -> None:
    """Correct by the rows of a sample, one after the other, with the covariance."""
    for i in range(f.rows[s]):
        residual, r = f.residual[i], compute_packet_variance(f, s, i, packet)
        if f.adapt > 0.0:
            adapt_noise(f, s, i, project_row(f, s, i, first), residual, r)
        if first >= 0:
            update_with_clone(f, first + i, r, residual)
        else:
            update_with_states(f, f.C[s, i], r, residual)
        _reduce_residuals(f, s, first, i, f.gain)
        if f.late == LARSEN:
            propagate_larsen_gains(f, f.C[s, i])


@jit
def _correct_states(f: FilterRecord, s: int) -> None:
    """Correct x <- x + M K residual, Larsen's correction at the arrival."""
    for i in range(f.rows[s]):
        for k in range(f.n):
            f.x[k] += f.larsen_gain[s, i, k] * f.residual[i]


@noinline
def update_filter(
    f: FilterRecord, gains: GainTables, s: int, first: int, packet: Vector, is_gated: bool
) -> bool:
    """Correct by a packet of a slow sensor whose values are sound.

    Args:
        f: Memory of the filter.
        gains: Tables of gains, shape (cells, rows, columns).
        s: Index of the slow sensor.
        first: What the sample measures, see `delay.find_clone`.
        packet: Packet, shape (PACKET_WIDTH,).
        is_gated: Whether the gate judges it and its NIS is taken; not when it is used again in a
            rewound window.

    Returns:
        False if the gate refuses it.
    """
    if is_gated:
        f.nis = np.nan
    previous_fix = f.first_fix
    _compute_residuals(f, s, first, packet)
    if f.between == PSEUDO and f.periodic == 1:
        correct_sample(f, gains, s)
    elif f.between == PSEUDO:
        split_sample_gain(f, s, first, packet)
    elif f.between != NONE:
        start_shares(f, gains, s)
    elif f.periodic == 1:
        _correct_periodic(f, gains, s, first, packet)
    elif first == STORED_ONE and f.late == LARSEN:
        _correct_states(f, s)
    else:
        if is_gated and not check_sample(f, s, first, packet):
            f.counts[COUNTERS.gated] += 1
            f.first_fix = previous_fix
            return False
        _correct(f, s, first, packet)
    return True
