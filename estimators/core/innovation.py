"""Late samples, and a sample's innovation: which one a filter uses, and how noisy it is.

A gate alone starves a filter that has lost itself. Gated samples in a row whose residuals agree
show that the filter is wrong, or that what is measured has jumped, as a flipped antenna's heading:
then the state that only this sensor measures is forgotten by as much as the residual.
"""

from ...envs.numerics.functions import wrap
from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Scalar, Vector, minimum, sqrt
from ...envs.record import PACKET
from .covariance import correct_scalar, dot, predict_measurement, project, project_row
from .model import compute_row_variance
from .record import COUNTERS, N_SLOW, N_SNAPSHOTS, N_STAMPS, WINDOW, FilterRecord

RULES = ("clone", "ignore", "stored", "constant", "larsen", "buffer", "literal", "lag")
"""Rules for late samples; what is older than a rule stores is refused and counted.

clone: what is measured is cloned in the step after each capture, so a late sample measures its
clones, exactly (tie-vision (12)-(13)); frame i is in slot i mod frames. ignore: taken for fresh.
stored: the residual against the prediction at the capture is used as if it were fresh, uneven-delay
(15)-(16). constant: the same, for an assumed delay. larsen: the covariance takes it at its capture,
the states when it arrives (Larsen 1998), exact for one under way and none lost. buffer: the window
is filtered anew (`packets`), exact. literal, lag: late states follow by one step or a lag."""
CLONE, IGNORE, STORED, CONSTANT, LARSEN, BUFFER = range(6)  # of the field `delay_rule`
NONE, PSEUDO, DUAL_RATE = range(3)  # of the field `intersample_rule`

DIRECT = -1  # a sample measures the states as they are
DROPPED = -2  # it is not used
STORED_ONE = -3  # it is compared with what was stored at its capture


@jit
def get_direct() -> int:
    """Return DIRECT as a number: a literal argument would have every callee compiled once more."""
    return DIRECT


@jit
def _clone_states(f: FilterRecord, s: int, slot: int) -> None:
    """Clone what sensor s captured at the last tick: tie-vision (12) at a trigger."""
    f.speed_captured[s, slot] = f.speed_before
    for i in range(f.rows[s]):
        clone = f.first_clone[s] + slot * f.rows[s] + i
        row = f.C[s, i]
        f.x[clone] = predict_measurement(f, s, i)
        f.e[clone] = dot(row, f.e, f.n)
        if f.periodic == 0:
            variance = project(f, row)
            for j in range(f.total):
                f.P[clone, j] = f.PC[j]
                f.P[j, clone] = f.PC[j]
            f.P[clone, clone] = variance


@jit
def _update_covariance(f: FilterRecord, s: int) -> None:
    """Update the covariance at the capture by Larsen's rule; the states follow at the arrival."""
    for i in range(f.rows[s]):
        row = f.C[s, i]
        f.larsen_expected[s, i] = predict_measurement(f, s, i)
        r = compute_row_variance(f, s, i, f.speed_before)
        correct_scalar(f, project(f, row) + r, 0.0)
        for j in range(i):
            _propagate_gain(f, s, j, row)
        for k in range(f.n):
            f.larsen_gain[s, i, k] = f.gain[k]


@jit
def _propagate_gain(f: FilterRecord, s: int, i: int, row: Vector) -> None:
    """Propagate Larsen's M_k K_s of row i past a measurement `row` (n,) with the gain f.gain."""
    projected = dot(row, f.larsen_gain[s, i], f.n)
    for k in range(f.n):
        f.larsen_gain[s, i, k] -= f.gain[k] * projected


@jit
def propagate_larsen_gains(f: FilterRecord, row: Vector) -> None:
    """Propagate Larsen's M_k K_s of every sample under way past a measurement.

    Args:
        f: Memory of the filter with its gain.
        row: Row of C of that measurement, shape (n,).
    """
    for s in range(N_SLOW):
        if f.stamp[s, 0] >= 0:
            for i in range(f.rows[s]):
                _propagate_gain(f, s, i, row)


@jit
def store_due_captures(f: FilterRecord, last: int) -> None:
    """Store what the sensors that captured at this tick measured, and advance their clocks.

    Args:
        f: Memory of the filter.
        last: Tick of the filter's previous step.
    """
    for s in range(N_SLOW):
        if f.period[s] > 0 and last >= f.next[s]:
            frame = (f.next[s] - f.phase[s]) // f.period[s]
            is_unknown = f.known_stamps[s, frame % N_STAMPS] != last
            if f.frames[s] > 0 and last == f.next[s] and is_unknown:
                slot = frame % f.frames[s]
                if f.delay_rule == LARSEN:
                    _update_covariance(f, s)
                else:
                    _clone_states(f, s, slot)
                f.stamp[s, slot] = last
            f.next[s] += f.period[s]


@jit
def is_duplicate(f: FilterRecord, s: int, captured: int) -> bool:
    """Return whether a sample of a sensor on its clock must not be used; then it is counted.

    Args:
        f: Memory of the filter.
        s: Index of the slow sensor.
        captured: Captured tick of the sample.
    """
    frame = (captured - f.phase[s]) // f.period[s]
    last_stamp = f.known_stamps[s, frame % N_STAMPS]
    if f.phase[s] + frame * f.period[s] != captured:
        f.counts[COUNTERS.unknown] += 1
    elif last_stamp == captured:
        f.counts[COUNTERS.duplicates] += 1
    elif captured < last_stamp:
        f.counts[COUNTERS.refused] += 1
    else:
        return False
    return True


@jit
def find_clone(f: FilterRecord, s: int, captured: int) -> int:
    """Find a sample's first clone, or DIRECT, STORED_ONE, DROPPED (counted); mark it as taken.

    Args:
        f: Memory of the filter.
        s: Index of the slow sensor.
        captured: Captured tick of the sample.
    """
    if is_duplicate(f, s, captured):
        return DROPPED
    frame = (captured - f.phase[s]) // f.period[s]
    target = DROPPED
    if f.delay_rule == CONSTANT:
        target = STORED_ONE
    elif f.delay_rule == IGNORE or captured == f.tick:
        target = DIRECT
    elif f.delay_rule == STORED and f.tick - captured < WINDOW:
        target = STORED_ONE
    elif f.frames[s] > 0 and f.stamp[s, frame % f.frames[s]] == captured:
        slot = frame % f.frames[s]
        f.stamp[s, slot] = -1
        target = STORED_ONE if f.delay_rule == LARSEN else f.first_clone[s] + slot * f.rows[s]
    if target == DROPPED:
        f.counts[COUNTERS.refused] += 1
    else:
        f.known_stamps[s, frame % N_STAMPS] = captured
    return target


MAX_SURPRISE = 50.0  # squared innovation over its variance, of which more says no more


@jit
def note_surprise(f: FilterRecord, kind: int, surprise: Scalar, weight: Scalar) -> None:
    """Note how large an innovation was.

    Args:
        f: Memory of the filter.
        kind: 0 of a fast row, 1 of a slow sample.
        surprise: Squared innovation over its variance.
        weight: Weight in the mean.
    """
    f.surprise[kind] += weight * (minimum(surprise, MAX_SURPRISE) - f.surprise[kind])


_AGREEMENT_SD = 4.0  # standard deviations within which two gated residuals agree


@jit
def interpolate_hdop(f: FilterRecord, s: int, packet: Vector) -> Scalar:
    """Interpolate the factor on deviations at a packet's HDOP; 1 without a table or an HDOP.

    Args:
        f: Memory of the filter.
        s: Index of the slow sensor.
        packet: Packet, shape (PACKET_WIDTH,).
    """
    if f.knots == 0 or f.hdop_column[s] == 0:
        return 1.0
    hdop, last = packet[f.hdop_column[s]], f.knots - 1
    if hdop - hdop != 0.0:  # not finite
        return 1.0
    if hdop <= f.hdop[0]:
        return f.hdop_factor[0]
    for i in range(last):
        if hdop <= f.hdop[i + 1]:
            position = (hdop - f.hdop[i]) / (f.hdop[i + 1] - f.hdop[i])
            return f.hdop_factor[i] + position * (f.hdop_factor[i + 1] - f.hdop_factor[i])
    return f.hdop_factor[last]


@jit
def compute_sample_variance(f: FilterRecord, s: int, i: int) -> Scalar:
    """Compute the variance of a row of the packet in f.sample.

    Args:
        f: Memory of the filter.
        s: Index of the slow sensor.
        i: Index of its row.
    """
    factor, variance = interpolate_hdop(f, s, f.sample), f.r[s, i]
    captured = int(f.sample[PACKET.captured])
    if f.delay_rule == CLONE and f.noise_over_speed[s, i] > 0.0 and captured < f.tick:
        slot = (captured - f.phase[s]) // f.period[s] % f.frames[s]
        variance = compute_row_variance(f, s, i, f.speed_captured[s, slot])
    return variance * f.scale[s, i] * factor * factor


@jit
def _test_innovation(f: FilterRecord, s: int, first: int) -> bool:
    """Compute f.nis = residual^T S^-1 residual (f.residual); return whether it passes the gate."""
    p, S, nis = f.rows[s], f.S, 0.0
    for i in range(p):  # C P C^T + R, its lower half
        projected = project_row(f, s, i, first)
        S[i, i] = projected + compute_sample_variance(f, s, i)
        for j in range(i + 1, p):
            S[j, i] = f.PC[first + j] if first >= 0 else dot(f.C[s, j], f.PC, f.n)
    for i in range(p):  # Cholesky and forward substitution in one go
        remainder = f.residual[i]
        for j in range(i):
            remainder -= S[i, j] * f.white[j]
        for j in range(i):
            S[i, i] -= S[i, j] * S[i, j]
        S[i, i] = sqrt(S[i, i])
        for k in range(i + 1, p):
            for j in range(i):
                S[k, i] -= S[k, j] * S[i, j]
            S[k, i] /= S[i, i]
        f.white[i] = remainder / S[i, i]
        nis += f.white[i] * f.white[i]
    f.nis = nis
    return not (f.gate[p] > 0.0 and nis > f.gate[p])


@jit
def _is_consistent(f: FilterRecord, s: int) -> bool:
    """Return whether every residual is within `_AGREEMENT_SD` deviations of the last gated one."""
    for i in range(f.rows[s]):
        difference, row_variance = f.residual[i] - f.rejected_residual[s, i], 0.0
        if f.angle[s, i] == 1:
            difference = wrap(difference)
        for j in range(i + 1):
            row_variance += f.S[i, j] * f.S[i, j]  # f.S holds Cholesky's factor
        # a difference of two residuals has twice the variance of one
        if difference * difference > 2.0 * _AGREEMENT_SD * _AGREEMENT_SD * row_variance:
            return False
    return True


@jit
def _is_observed_elsewhere(f: FilterRecord, s: int, state: int) -> bool:
    """Return whether another sensor of a state was accepted since s was first gated."""
    for other in range(N_SLOW):
        if other != s and f.rows[other] > 0 and f.last_accepted[other] >= f.first_rejected[s]:
            for i in range(f.rows[other]):
                if f.C[other, i, state] != 0.0:
                    return True
    return False


@jit
def _inflate_covariance(f: FilterRecord, state: int, variance: Scalar) -> None:
    """Add a variance (the state's unit squared) to a state, now and in what was captured of it."""
    v = f.PC
    for i in range(f.total):
        v[i] = 0.0
    v[state] = 1.0
    if f.delay_rule == CLONE:
        for s in range(N_SLOW):
            for k in range(f.frames[s] * f.rows[s]):
                v[f.first_clone[s] + k] = f.C[s, k % f.rows[s], state]
    for i in range(f.total):
        for j in range(f.total):
            f.P[i, j] += variance * (v[i] * v[j])
    if f.delay_rule == BUFFER:
        for i in range(N_SNAPSHOTS + 1):
            f.snapshot_P[i, state, state] += variance


@jit
def _reset_sensor_states(f: FilterRecord, s: int) -> bool:
    """Forget what only sensor s measures, of each row the last dense state; False without one."""
    has_reset = False
    for i in range(f.rows[s]):
        state = 0
        for k in range(f.dense):  # its misalignment stays
            if f.C[s, i, k] != 0.0:
                state = k
        if not _is_observed_elsewhere(f, s, state):
            _inflate_covariance(f, state, f.residual[i] * f.residual[i])
            has_reset = True
    return has_reset


@jit
def check_sample(f: FilterRecord, s: int, first: int) -> bool:
    """Return whether to use f.sample: it passes the gate, or the filter re-starts with the sensor.

    Args:
        f: Memory of the filter.
        s: Index of the slow sensor.
        first: Clone of its first row, negative where it measures the states.
    """
    passed = _test_innovation(f, s, first)
    if f.recovery_count == 0:
        return passed
    if not passed and f.last_accepted[s] >= 0:
        if f.rejections[s] == 0 or not _is_consistent(f, s):
            f.rejections[s], f.first_rejected[s] = 0, f.tick
        f.rejections[s] += 1
        for i in range(f.rows[s]):
            f.rejected_residual[s, i] = f.residual[i]
        if f.rejections[s] < f.recovery_count or not _reset_sensor_states(f, s):
            return False
    f.last_accepted[s], f.rejections[s] = f.tick, 0
    return True
