"""The filter itself, compiled: fast rows and packets in; states, or an observation, out.

Layers are the filters of an estimator: one, or the two of double-layer-gps. A tick stores
what was captured at the last one and predicts from there; then fast sensors correct, then packets.
A filter at the slow sensor's rate listens every `pace` ticks; in between it holds its states
(`stride`) or predicts them.
"""

from typing import NamedTuple

import numpy as np

from ...envs.numerics.functions import sincos, wrap
from ...envs.numerics.jit import copy_into, jit, noinline
from ...envs.numerics.primitives import Matrix, Scalar, Vector, maximum, minimum, sqrt
from ...envs.record import PACKET
from .covariance import has_covariance
from .innovation import interpolate_hdop
from .intersample import locate_step_row
from .late_samples import store_due_captures
from .memory import COUNTERS, N_SLOW, WINDOW, FilterLayers, FilterMemory, GainTables
from .model import BETA, CURVATURE, build_model, is_finite, linearise
from .packets import apply_waiting, process_packet, store_history
from .predict import advance_state, find_next_cell, read_fast_row
from .update import FIRST_VARIANCE, compute_excess, correct_fast, is_healthy


class StepRecord(NamedTuple):
    """What a filter gets in a call, such as an env's newest step; of N cars (N, ...) each."""

    fast: Matrix  # fast rows, shape (k, FAST_WIDTH)
    rows: Scalar  # number of fast rows that are there (an env's `rows` are the rows themselves)
    packets: Matrix  # shape (capacity, PACKET_WIDTH)
    count: Scalar  # how many of them there are


class FilterOutputs(NamedTuple):
    """What a filter writes in a call; what is empty is not written."""

    X: Matrix  # states, shape (rows, n)
    S: Matrix  # their standard deviations, shape (rows, n)
    nis: Vector  # normalised innovation squared of each packet, shape (count,)


class OutputTable(NamedTuple):
    """What `observe` writes behind an observation."""

    inner: int  # entries of the env's observation to copy
    # a row for each output, shape (m, 3): its state's index over all layers; 1 if it is an angle to
    # wrap; whose truth the NEES takes (1 beta, 2 gamma, 0 none)
    plan: Matrix
    limits: Vector  # bounds of the outputs in their units, shape (m,)


class Observed(NamedTuple):
    """Inputs and targets of an observation; for N cars all but `table` have them as first axis."""

    obs: Vector  # observation of the env, float32, shape (at least inner,)
    table: OutputTable
    beta: Scalar  # true sideslip angle (rad)
    gamma: Scalar  # true yaw rate (rad/s)
    out: Vector  # float32, filled, shape (inner + m,), or (inner + 2 m,) with standard deviations
    # filled, shape (4,): beta (the first state where there is no beta), its standard deviation, and
    # the normalised estimation error squared of the outputs beta and gamma per state,
    # e' P_e^-1 e / len(e), with expectation 1; 0 where P_e is singular; 0 for a filter that is lost
    summary: Vector


NO_OUTPUTS = FilterOutputs(np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0))


@jit
def _fill(vector: Vector, value: Scalar) -> None:
    for i in range(len(vector)):
        vector[i] = value


@noinline
def _reset_filter(f: FilterMemory, first: int) -> None:
    """Reset a filter to its start, before the fast row of the tick `first`."""
    f.start, f.tick, f.has_started, f.at = first, first - 1, 0, 0
    f.cell, f.missing_cell, f.cursor, f.waits, f.u_count = 0, -1, 0, 0, 0
    f.first_fix, f.since, f.nis, f.turning, f.road_turn = -1, -1, np.nan, 0.0, 0.0
    for vector in (f.x, f.e, f.gain):
        _fill(vector, 0.0)
    for vector in (f.innovation, f.u, f.u_sum):
        _fill(vector, 0.0)
    _fill(f.eps, 0.0)
    copy_into(f.first, f.x)
    for i in range(len(f.tick_gains)):
        _fill(f.tick_gains[i], 0.0)
    for i in range(len(f.P)):
        _fill(f.P[i], 0.0)
    for i in range(len(f.prior)):
        copy_into(f.prior[i], f.P[i])
    for s in range(N_SLOW):
        _fill(f.scale[s], 1.0)
        _fill(f.last[s], np.nan)
        f.last_accepted[s], f.rejections[s] = -1, 0
        _fill(f.stamp[s], -1)
        _fill(f.known_stamps[s], -1)
        if f.period[s] > 0:
            since_phase = maximum(first - f.phase[s], 0)
            f.next[s] = f.phase[s] + (since_phase + f.period[s] - 1) // f.period[s] * f.period[s]
    _fill(f.counts, 0)
    f.evicted = -1
    for i in range(len(f.recent)):
        f.recent[i, PACKET.captured] = -1  # an empty place
    for i in range(len(f.own_decay)):
        f.own_decay[i] = 0.0 if i < f.dense else f.decay[i] if i < f.n else 1.0
    _fill(f.surprise, 1.0)
    if f.r_share > 0.0:
        f.blocks, f.block_rows = 0, 0
        _fill(f.block_sum, 0.0)
        for i in range(f.fasts):
            f.r_fast[i] = FIRST_VARIANCE * f.r_nominal[i]
    f.steer_before = np.nan
    f.felt[f.accel_scale_state] = 0.0
    if f.tyre_states > 0:
        linearise(f, 0.0)
    if f.measured == 1:
        f.speed, f.model_speed = 0.0, 0.0
    else:
        build_model(f, f.speed, 0.0)
    f.beta_scale = 1.0


@jit
def run_tick(f: FilterMemory, gains: GainTables) -> None:
    """Step from the last tick to this one, whose fast row was read."""
    f.tick += 1
    if f.stride > 1:
        for i in range(f.inputs):
            f.u_sum[i] += f.u[i]
        f.u_count += 1
    listens = f.pace == 1 or (f.tick >= f.origin and (f.tick - f.origin) % f.pace == 0)
    if f.stride > 1 and not listens:
        return
    if f.has_started == 1:
        store_due_captures(f, f.tick - f.stride)
        if f.stride > 1:
            for i in range(f.inputs):
                f.u_sum[i] /= f.u_count
        u = f.u_sum if f.stride > 1 else f.u
        if f.inputs > CURVATURE:
            f.road_turn += f.model_speed * u[CURVATURE] * f.step
        advance_state(f, u)
        f.at = f.at + 1 if f.at + 1 < f.cycle else 0
    else:  # the first step has nothing to predict from
        f.has_started = 1
        f.at = ((f.tick - f.origin) // f.stride) % f.cycle
        f.x[0] += f.velocity * f.speed
    slot = f.tick % WINDOW
    f.past_road_turn[slot] = f.road_turn
    for i in range(f.stored):
        f.predicted[slot, i] = f.x[i]
    if listens:
        correct_fast(f, gains)
    store_history(f)
    for i in range(f.inputs):
        f.u_sum[i] = 0.0
    f.u_count = 0
    if f.pace > 1 and listens:
        apply_waiting(f, gains)


@jit
def _read_covariance(f: FilterMemory, gains: GainTables, i: int, j: int) -> Scalar:
    """Read P[i, j], i <= j; with tables of gains that of the settled cycle."""
    if has_covariance(f):
        return f.P[i, j]
    return gains[f.cell, locate_step_row(f), f.total + i * f.n - i * (i - 1) // 2 + j - i]


@jit
def _compute_deviation(f: FilterMemory, gains: GainTables, i: int) -> Scalar:
    """Compute a state's present standard deviation; of a lost filter, larger by its surprise."""
    growth = maximum(compute_excess(f), 1.0)
    return sqrt(maximum(_read_covariance(f, gains, i, i), 0.0) * growth)


@jit
def _update_second_layer(
    first: FilterMemory, second: FilterMemory, gains: GainTables, packet: Vector
) -> None:
    """Correct the second layer by a packet as a velocity: double-layer-gps (8)-(9)."""
    # v_x = V cos(beta), v_y = V sin(beta), with beta as it was predicted for the captured tick;
    # their variances: (sigma_V hdop)^2 and (V sigma_beta)^2 + (sigma_V hdop sin(beta))^2, (m/s)^2
    s, captured = int(packet[PACKET.sensor]), int(packet[PACKET.captured])
    beta = first.x[BETA]
    if captured >= maximum(first.start, first.tick - WINDOW + 1) and captured < first.tick:
        beta = first.predicted[captured % WINDOW, BETA]
    sine, cosine = sincos(beta)
    V = packet[first.speed_column[s]]
    if not is_finite(V):
        first.counts[COUNTERS.invalid] += 1
        return
    velocity = second.sample
    copy_into(packet, velocity)
    velocity[PACKET.value] = V * cosine
    velocity[PACKET.value + 1] = V * sine
    factor = interpolate_hdop(first, s, packet)
    speed_variance = second.r_speed * factor * factor
    second.r[s, 0] = speed_variance
    second.r[s, 1] = V * V * first.P[BETA, BETA] + speed_variance * sine * sine
    process_packet(second, gains, velocity)


@jit
def _take_packet(
    layers: FilterLayers, gains: GainTables, packets: Matrix, position: int, nis: Vector
) -> None:
    """Process a packet by all layers, and write its NIS."""
    was_used = process_packet(layers[0], gains, packets[position])
    if len(nis) > 0:
        nis[position] = layers[0].nis
    if was_used and len(layers) > 1:
        _update_second_layer(layers[0], layers[1], gains, packets[position])


@jit
def _write_row(layers: FilterLayers, gains: GainTables, j: int, X: Matrix, S: Matrix) -> None:
    """Write states and deviations of all layers in row j of X and S."""
    column = 0
    for layer in range(len(layers)):
        f = layers[layer]
        for i in range(f.n):
            X[j, column] = f.x[i]
            S[j, column] = _compute_deviation(f, gains, i)
            column += 1


@jit
def write_estimate(layers: FilterLayers, gains: GainTables, x: Vector, P: Matrix) -> bool:
    """Write the states of all layers and their covariance; False where gains for P are missing.

    Args:
        layers: Memory of the estimator, shape (layers,).
        gains: Tables of gains, shape (cells, rows, columns).
        x: Output for the states, shape (n,).
        P: Output for the covariance, zeros of shape (n, n), or (0, 0).
    """
    offset, f = 0, layers[0]
    if len(P) > 0 and gains[f.cell, 0, 0] == 0.0:
        return False
    for layer in range(len(layers)):
        f = layers[layer]
        growth = maximum(compute_excess(f), 1.0)  # as `_compute_deviation`: lost, it is less sure
        for i in range(f.n):
            x[offset + i] = f.x[i]
            for j in range(f.n if len(P) > 0 else 0):  # a table holds one triangle
                variance = _read_covariance(f, gains, minimum(i, j), maximum(i, j))
                P[offset + i, offset + j] = growth * variance
        offset += f.n
    return True


@noinline
def advance(
    layers: FilterLayers, gains: GainTables, record: StepRecord, start: int, outputs: FilterOutputs
) -> int:
    """Process a record's rows from `start` on and its packets; return rows done, to go on there."""
    fast, rows, packets, count = record
    X, S, nis = outputs
    f = layers[0]
    position, end_tick = 0 if start == 0 else f.cursor, f.tick + rows - start
    for j in range(start, rows):
        if not has_covariance(f):
            cell = find_next_cell(f, fast[j])
            if gains[cell, 0, 0] == 0.0:
                f.missing_cell, f.cursor = cell, position
                return j
        for layer in range(len(layers)):
            read_fast_row(layers[layer], fast[j])
            run_tick(layers[layer], gains)
        # a packet waits only if it arrives at a later tick of this call; due, overdue or beyond the
        # last row it goes now, and `process_packet` judges it
        while position < count and not (f.tick < packets[position, PACKET.arrived] <= end_tick):
            _take_packet(layers, gains, packets, position, nis)
            position += 1
        if len(X) > 0:
            _write_row(layers, gains, j, X, S)
    for k in range(position, count):  # of a call without rows
        _take_packet(layers, gains, packets, k, nis)
    return int(rows)


@jit
def reset_filters(layers: FilterLayers, first: int) -> None:
    """Reset all layers of an estimator."""
    for i in range(len(layers)):
        _reset_filter(layers[i], first)


@jit
def _clip_symmetric(value: Scalar, limit: Scalar) -> Scalar:
    """Clip the value to +-limit; NaN stays, so that a filter that failed is seen."""
    return value if value != value else minimum(maximum(value, 0.0 - limit), limit)


@jit
def _compute_nees(
    f: FilterMemory, gains: GainTables, i: int, j: int, beta: Scalar, gamma: Scalar
) -> Scalar:
    """Compute e' P_e^-1 e / len(e) of the states i (beta) and j (gamma; -1: none), or 0."""
    if i >= 0 and j >= 0:
        a, b = f.x[i] - beta, f.x[j] - gamma
        p, q = _read_covariance(f, gains, i, i), _read_covariance(f, gains, j, j)
        r = _read_covariance(f, gains, i, j)
        det = p * q - r * r
        return 0.5 * (a * a * q - 2.0 * a * b * r + b * b * p) / det if det > 0.0 else 0.0
    k = maximum(i, j)
    if k < 0:
        return 0.0
    a = f.x[k] - (beta if i >= 0 else gamma)
    p = _read_covariance(f, gains, k, k)
    return a * a / p if p > 0.0 else 0.0


@noinline
def observe(
    layers: FilterLayers, gains: GainTables, record: StepRecord, start: int, observed: Observed
) -> int:
    """Advance the filter and write the observation; return the rows done as `advance` does."""
    obs, (inner, plan, limits), beta, gamma, out, summary = observed
    nothing = FilterOutputs(record.fast[:0], record.fast[:0], summary[:0])
    done = advance(layers, gains, record, start, nothing)
    if done < record.rows:
        return done
    for i in range(inner):
        out[i] = obs[i]
    m, beta_at, gamma_at = len(plan), -1, -1
    for i in range(m):
        layer, state = 0, plan[i, 0]
        while state >= layers[layer].n:
            state -= layers[layer].n
            layer += 1
        f = layers[layer]
        value = f.x[state]
        if plan[i, 1] == 1:
            value = wrap(value)
        out[inner + i] = _clip_symmetric(value, limits[i])
        if len(out) > inner + m:
            out[inner + m + i] = _clip_symmetric(_compute_deviation(f, gains, state), limits[i])
        if plan[i, 2] == 1:
            beta_at = state
        elif plan[i, 2] == 2:
            gamma_at = state
    f = layers[0]
    summary[0], summary[1] = f.x[0], _compute_deviation(f, gains, 0)
    nees = _compute_nees(f, gains, beta_at, gamma_at, beta, gamma)
    summary[2] = nees / maximum(compute_excess(f), 1.0)  # lost, it is less sure
    summary[3] = 1.0 if is_healthy(f) else 0.0
    return done
