"""A sample's innovation: how noisy it is, and whether a filter uses it.

A gate alone starves a filter that has lost itself. Gated samples in a row whose residuals agree
show that the filter is wrong, or that what is measured has jumped, as a flipped antenna's heading:
then the state that only this sensor measures is forgotten by as much as the residual.
"""

from ...envs.numerics.functions import wrap
from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Scalar, Vector, minimum, sqrt
from ...envs.record import PACKET
from .covariance import dot, project_row
from .late_samples import inflate_covariance
from .memory import N_SLOW, FilterMemory
from .model import compute_row_variance

MAX_SURPRISE = 50.0  # squared innovation over its variance, of which more says no more


@jit
def note_surprise(f: FilterMemory, kind: int, surprise: Scalar, weight: Scalar) -> None:
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
def interpolate_hdop(f: FilterMemory, s: int, packet: Vector) -> Scalar:
    """Interpolate the factor on deviations at a packet's HDOP; 1 without a table or an HDOP."""
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
def compute_sample_variance(f: FilterMemory, s: int, i: int) -> Scalar:
    """Compute the variance of a row of the packet in f.sample."""
    factor, variance = interpolate_hdop(f, s, f.sample), f.r[s, i]
    captured = int(f.sample[PACKET.captured])
    if f.first_clone[s] > 0 and f.noise_over_speed[s, i] > 0.0 and captured < f.tick:
        slot = (captured - f.phase[s]) // f.period[s] % f.frames[s]
        variance = compute_row_variance(f, s, i, f.speed_captured[s, slot])
    return variance * f.scale[s, i] * factor * factor


@jit
def _test_innovation(f: FilterMemory, s: int, target: int) -> bool:
    """Compute f.nis = residual^T S^-1 residual (f.residual); return whether it passes the gate."""
    p, S, nis = f.rows[s], f.S, 0.0
    for i in range(p):  # C P C^T + R, its lower half
        projected = project_row(f, s, i, target)
        S[i, i] = projected + compute_sample_variance(f, s, i)
        for j in range(i + 1, p):
            S[j, i] = f.PC[target + j] if target >= 0 else dot(f.C[s, j], f.PC, f.n)
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
def _is_consistent(f: FilterMemory, s: int) -> bool:
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
def _is_observed_elsewhere(f: FilterMemory, s: int, state: int) -> bool:
    """Return whether another sensor of a state was accepted since s was first gated."""
    for other in range(N_SLOW):
        if other != s and f.rows[other] > 0 and f.last_accepted[other] >= f.first_rejected[s]:
            for i in range(f.rows[other]):
                if f.C[other, i, state] != 0.0:
                    return True
    return False


@jit
def _reset_sensor_states(f: FilterMemory, s: int) -> bool:
    """Forget what only sensor s measures, of each row the last dense state; False without one."""
    has_reset = False
    for i in range(f.rows[s]):
        state = 0
        for k in range(f.dense):  # its misalignment stays
            if f.C[s, i, k] != 0.0:
                state = k
        if not _is_observed_elsewhere(f, s, state):
            inflate_covariance(f, state, f.residual[i] * f.residual[i])
            has_reset = True
    return has_reset


@jit
def check_sample(f: FilterMemory, s: int, target: int) -> bool:
    """Return whether to use f.sample: it passes the gate, or the filter starts anew with it."""
    passed = _test_innovation(f, s, target)
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
