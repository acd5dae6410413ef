"""The schedule of a slow sensor, and the gains of a filter that repeat with it.

The covariance filter is run over the schedule until its gains repeat. A table of gains has a head
row; for each step of the cycle a row for every fast measurement (one where there is none); for
each frame of the pattern a row for every slow row. Pseudo-residuals add K^T and the transposed
inverse, dual-rate rules a fraction of the innovation for each step. Behind the gains of a step
stands the upper half of the states' covariance after it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Scalar, Vector, absolute, maximum
from ...envs.record import Array
from ..core.covariance import correct_scalar, project_row
from ..core.filter import reset_filters, run_tick
from ..core.innovation import CLONE, DROPPED, DUAL_RATE, IGNORE, NONE, PSEUDO, find_clone
from ..core.record import FilterRecord, FilterRecords, GainTables
from .dual_rate import SampledSystem
from .kalman import compute_inverse, observer_gain, transition_matrix
from .options import FilterConfig


def count_ticks(seconds: float, dt: float, label: str) -> int:
    """Convert a time to a number of ticks.

    Args:
        seconds: Time (s).
        dt: Tick (s).
        label: Name of the time for messages.

    Returns:
        Number of ticks.

    Raises:
        ValueError: The time is no whole number of ticks.
    """
    count = round(seconds / dt)
    if abs(seconds / dt - count) > 1e-6 * max(1.0, count):
        raise ValueError(f"{label} of {seconds:g} s is no whole number of ticks of {dt:g} s")
    return count


@dataclass(frozen=True)
class Schedule:
    """Cycle of a slow sensor: frame i is captured at the step i `period`, arrives lags[i] later.

    A schedule without frames has one step.
    """

    period: int  # steps between two captures
    lags: tuple[int, ...]  # steps from the capture of each frame of the cycle to its arrival

    @property
    def cycle(self) -> int:
        """Steps after which everything repeats, the slots of the clones included."""
        return self.period * max(1, len(self.lags))

    def find_arriving(self, step: int) -> list[int]:
        """Find the frames that arrive in a step of the cycle.

        Args:
            step: Step within the cycle.

        Returns:
            Indices of the frames.
        """
        arrival_steps = ((i * self.period + lag) % self.cycle for i, lag in enumerate(self.lags))
        return [i for i, arrival_step in enumerate(arrival_steps) if arrival_step == step]


NO_SENSOR = Schedule(1, ())

_GAIN_TOLERANCE = 1e-12  # relative change of a settled gain in a cycle
_CHECK_TOLERANCE = 1e-6  # the same, of a filter that is only checked: it has gains of its own
_MAX_RECURSION = 600.0  # s of driving after which the recursion ends in any case
_BIAS_WALK_TIME = 10.0  # s in which a bias walks by its prior where a filter is checked


@jit
def _iterate_gains(
    filters: FilterRecords,
    lags: Vector,
    cycles: int,
    tolerance: float,
    table: Matrix,
    before: Vector,
    gains: GainTables,
) -> int:
    """Run a covariance filter over its schedule until its gains settle; return the cycles used."""
    # filled: table (rows, columns), and before (total, total), the covariance before the last
    # frame; lags (pattern,): steps from capture to arrival
    f = filters[0]
    reset_filters(filters, 0)
    n, N, cycle, width, s = f.n, f.total, f.cycle, maximum(f.fasts, 1), f.first_slow
    for cycle_index in range(cycles):
        change = 0.0
        for step in range(cycle):
            run_tick(f, gains)
            if f.tick % f.pace == 0:
                for i in range(f.fasts):
                    change = maximum(change, _copy_gain(f.share[i], table[1 + step * width + i], N))
            for frame in range(len(lags)):
                captured = f.tick - lags[frame]
                if (captured - frame * f.period[s]) % cycle != 0 or captured < 0:
                    continue
                first = find_clone(f, s, captured)
                if first == DROPPED:
                    continue
                for i in range(N):
                    _copy_gain(f.P[i], before[i], N)
                for i in range(f.rows[s]):
                    correct_scalar(f, project_row(f, s, i, first) + f.r[s, i], 0.0)
                    to = table[1 + cycle * width + frame * f.rows[s] + i]
                    change = maximum(change, _copy_gain(f.gain, to, N))
            k = N
            for i in range(n):
                for j in range(i, n):
                    table[1 + step * width, k] = f.P[i, j]
                    k += 1
        if change < tolerance:
            return cycle_index + 1
    return cycles


@jit
def _copy_gain(source: Vector, target: Vector, size: int) -> Scalar:
    """Copy `size` entries of a gain; return the largest relative change."""
    change = 0.0
    for i in range(size):
        new = source[i]
        change = maximum(change, absolute(new - target[i]) / maximum(absolute(new), 1e-9))
        target[i] = new
    return change


def compute_table_shape(f: FilterRecord, schedule: Schedule) -> tuple[int, int]:
    """Compute the shape of a table of gains.

    Args:
        f: Memory of the filter.
        schedule: Schedule of its slow sensor.

    Returns:
        Rows and columns.
    """
    p, m = int(f.rows.max()), int(f.fasts)
    extra = {NONE: 0, PSEUDO: 2 * (m + p), DUAL_RATE: schedule.cycle * p}[int(f.between)]
    rows = 1 + schedule.cycle * max(m, 1) + p * len(schedule.lags) + extra
    return rows, int(f.total + f.n * (f.n + 1) // 2)


def design_gains(
    f: FilterRecord, schedule: Schedule, speed: float, config: FilterConfig
) -> tuple[Array, FilterRecord]:
    """Design the table of gains at a speed.

    Args:
        f: Memory of the filter, left as it is.
        schedule: Schedule of its slow sensor.
        speed: Speed (m/s).
        config: Parsed options of the filter.

    Returns:
        Table, shape (rows, columns), and the memory with the G and the C_fast of this speed.
    """
    record: FilterRecord = np.array([f]).view(np.recarray)[0]
    filters: FilterRecords = np.array([f])
    copy = filters.view(np.recarray)[0]
    copy.periodic = copy.measured = copy.origin = copy.joint = copy.between = 0
    copy.pace = 1 if f.stride > 1 else f.pace
    copy.stride, copy.speed = 1, speed
    copy.late = CLONE if f.late == CLONE else IGNORE
    copy.cycle, copy.pattern = schedule.cycle, max(1, len(schedule.lags))
    copy.period[copy.period > 0] = schedule.period
    copy.phase[:] = 0
    for i in range(int(f.dense), int(f.n)):  # a bias that never moves has no settled gain
        if f.pushed[i - f.dense] < 0:
            copy.Q[i, i] += f.prior[i, i] * f.step / _BIAS_WALK_TIME
    s = int(f.first_slow)
    table = np.zeros(compute_table_shape(f, schedule))
    table[0, 0] = 1.0
    if f.between == DUAL_RATE or config.poles:
        reset_filters(filters, 0)
        G: Array = copy.G[: copy.dense, : copy.n].copy()
        if f.between == DUAL_RATE:
            _write_shares(copy, G, schedule, config, table)
        else:
            _write_placed_gains(copy, G, config.poles, table)
    else:
        lags = np.array(schedule.lags, np.int64) * int(f.late == CLONE)
        cycles = max(2, int(_MAX_RECURSION / float(copy.step)) // schedule.cycle)
        before = np.zeros((int(f.total), int(f.total)))
        tolerance = _GAIN_TOLERANCE if f.periodic else _CHECK_TOLERANCE
        _iterate_gains(filters, lags, cycles, tolerance, table, before, np.zeros((1, 1, 1)))
        if f.between == PSEUDO:
            C = build_measurement_rows(f, 0)
            R = np.diag([*copy.r_fast[: copy.fasts], *copy.r[s, : copy.rows[s]]])
            inverse = compute_inverse(config.inverse, C, before, R)
            _write_pseudo_gains(copy, schedule, table, inverse)
    record.G[:], record.C_fast[:] = copy.G, copy.C_fast  # an accelerometer's row has the speed
    return table, record


def build_measurement_rows(f: FilterRecord, frame: int, lag: int = 1) -> Array:
    """Build C over states and clones: the fast rows, then the slow rows of a frame.

    A frame without lag, or where there are no clones, measures the states.

    Args:
        f: Memory of the filter.
        frame: Index of the frame in the pattern.
        lag: Steps from its capture to its arrival.

    Returns:
        Measurement matrix, shape (m + p, total).
    """
    s, m = int(f.first_slow), int(f.fasts)
    p = int(f.rows[s]) if s >= 0 else 0
    C = np.zeros((m + p, int(f.total)))
    C[:m, : f.n] = f.C_fast[:m, : f.n]
    if s >= 0 and f.late == CLONE and f.frames[s] > 0 and lag > 0:
        first = int(f.first_clone[s]) + frame % int(f.frames[s]) * p
        C[m:, first : first + p] = np.eye(p)
    elif s >= 0:
        C[m:, : f.n] = f.C[s, :p, : f.n]
    return C


def _write_shares(
    f: FilterRecord, G: Array, schedule: Schedule, config: FilterConfig, table: Array
) -> None:
    """Write the weights of an innovation of the dual-rate rules behind the gains."""
    n, s, total = int(f.n), int(f.first_slow), int(f.total)
    q = int(f.rows[s])
    F, C, R = transition_matrix(f, G), f.C[s, :q, :n], np.diag(f.r[s, :q])
    system = SampledSystem(F, f.Q[:n, :n], C, R, schedule.period)
    poles = np.exp(np.array(config.poles) * float(f.step)) if config.poles else None
    B = system.compute_shares(config.intersample, config.gains, poles)
    first = 1 + schedule.cycle + q * len(schedule.lags)
    system.write_shares(B, table, first, total)


def _write_placed_gains(f: FilterRecord, G: Array, poles: tuple[float, ...], table: Array) -> None:
    """Write the gains of the fast rows for poles (rad/s), and the covariance, into a table."""
    n, m = int(f.n), int(f.fasts)
    F, C = transition_matrix(f, G), f.C_fast[:m, :n]
    K = observer_gain(F, C, np.exp(np.array(poles) * float(f.step)))
    rest = np.eye(n) - K @ C
    noise = rest @ f.Q[:n, :n] @ rest.T + K @ np.diag(f.r_fast[:m]) @ K.T
    P = solve_discrete_lyapunov(rest @ F, noise)
    table[1 : 1 + m, :n] = K.T
    table[1, int(f.total) :] = P[np.triu_indices(n)]


def _write_pseudo_gains(f: FilterRecord, schedule: Schedule, table: Array, inverse: Array) -> None:
    """Append the constant gain and the generalised inverse of the pseudo-residual rule."""
    p, m, total = int(f.rows[f.first_slow]), int(f.fasts), int(f.total)
    cycle, frames, width = schedule.cycle, len(schedule.lags), max(int(f.fasts), 1)
    first = 1 + cycle * width + p * frames
    frame_gains = table[1 + cycle * width : first, :total].reshape(frames, p, total)
    C = build_measurement_rows(f, 0)[m:]
    slow = np.mean([_combine_gains(gains, C) for gains in frame_gains], axis=0)
    fast = table[1 : 1 + cycle * width, :total].reshape(cycle, width, total)[:, :m]
    # every step corrects by a pseudo-residual, so each takes its even fraction of the slow gain
    K = np.column_stack([fast.mean(0).T, slow.T / schedule.period])
    table[first : first + m + p, :total] = K.T
    table[first + m + p :, :total] = inverse.T


def _combine_gains(K: Array, C: Array) -> Array:
    """Combine gains (p, n) of rows that correct one after the other to joint ones; C: (p, n)."""
    joint = np.zeros_like(K)
    for i in range(len(K)):
        joint[:i] -= np.outer(joint[:i] @ C[i], K[i])
        joint[i] = K[i]
    return joint
