"""The schedule of a slow sensor in steps of a filter: when frames are captured and arrive.

Gains of a periodic schedule: the covariance filter is run over it until its gains repeat.

A table of gains has a head row, then, for each step of the cycle, one row for every fast
measurement (one where there is none), then one for each slow row at each frame of the pattern.
Pseudo-residuals add K^T and the transposed inverse, shared innovations a share for each step.
Behind the gains of a step stands the upper half of the states' covariance after that step.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import absolute, maximum
from ...envs.record import Array
from ...envs.sensors.link import SlowSensor
from ..core.covariance import update_with_clone, update_with_states
from ..core.filter import reset_filter, reset_filters, run_tick
from ..core.innovation import CLONE, DIRECT, DROPPED, IGNORE, find_clone
from ..core.record import FilterRecord, FilterRecords, GainTables, Vector
from ..core.update import DUAL_RATE, NONE, PSEUDO
from .config import FilterConfig
from .dual_rate import compute_shares, write_shares
from .kalman import compute_inverse, constant_gain, transition_matrix, write_placed_gains


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

    Attributes:
        period: Steps between two captures.
        lags: Steps from the capture of each frame of the cycle to its arrival.
    """

    period: int
    lags: tuple[int, ...]

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


def make_schedules(
    label: str, sensor: SlowSensor, dt: float, stride: int, pace: int, frames: int
) -> tuple[Schedule, ...]:
    """Make the sensor's possible schedules: one where it repeats, else its two extremes.

    Args:
        label: Name of the sensor for messages.
        sensor: Clock and delays of the sensor.
        dt: Tick (s).
        stride: Ticks of a filter's step.
        pace: Ticks between steps that listen; a sample is used in the first of them at or after its
            arrival.
        frames: Number of stored captures, whose slots take turns; 0 for a filter that does not look
            at the lag.

    Returns:
        One schedule, or those of the shortest and the longest delays.
    """
    period = count_ticks(sensor.period, dt, f"{label}'s period") // stride
    late = [count_ticks(delay, dt, f"a delay: {label}'s") for delay in sensor.delays]
    jitter = count_ticks(sensor.jitter, dt, f"{label}'s jitter")

    def make_schedule(extra: int) -> Schedule:
        lags = [math.ceil((lag + extra) / pace) * pace // stride for lag in late]
        if len(set(lags)) == 1:
            lags = lags[:1]
        return Schedule(period, tuple(lags * (math.lcm(len(lags), max(1, frames)) // len(lags))))

    shortest, longest = make_schedule(0), make_schedule(jitter)
    return (longest,) if shortest == longest else (shortest, longest)


GAIN_TOLERANCE = 1e-12
MAX_RECURSION = 600.0  # s of the recursion
BIAS_WALK_TIME = 10.0  # s in which a bias walks by its prior where a filter is checked


@jit
def iterate_gains(
    filters: FilterRecords,
    s: int,
    lags: Any,
    cycles: int,
    table: Any,
    before: Any,
    gains: GainTables,
) -> int:
    """Run a covariance filter over its schedule and write its gains.

    Args:
        filters: Memory of the filter in covariance mode, with ticks that are steps, shape (1,).
        s: Index of its slow sensor, -1 for none.
        lags: Steps from capture to arrival of each frame, shape (pattern,).
        cycles: Largest number of cycles.
        table: Output, gains and covariances, shape (rows, columns).
        before: Output, covariance before the last frame, shape (total, total).
        gains: Tables that a filter with periodic gains would read.

    Returns:
        Number of cycles used.
    """
    f = filters[0]
    reset_filter(f, 0)
    n, size, cycle, width = f.n, f.total, f.cycle, maximum(f.fasts, 1)
    for cycle_index in range(cycles):
        change = 0.0
        for step in range(cycle):
            run_tick(f, gains)
            if f.tick % f.pace == 0:
                for i in range(f.fasts):
                    change = maximum(
                        change, _copy_gain(f.share[i], table[1 + step * width + i], size)
                    )
            for frame in range(len(lags)):
                captured = f.tick - lags[frame]
                if (captured - frame * f.period[s]) % cycle != 0 or captured < 0:
                    continue
                first = find_clone(f, s, captured)
                if first == DROPPED:
                    continue
                for i in range(size):
                    _copy_gain(f.P[i], before[i], size)
                for i in range(f.rows[s]):
                    if first == DIRECT:
                        update_with_states(f, f.C[s, i], f.r[s, i], 0.0)
                    else:
                        update_with_clone(f, first + i, f.r[s, i], 0.0)
                    to = table[1 + cycle * width + frame * f.rows[s] + i]
                    change = maximum(change, _copy_gain(f.gain, to, size))
            k = size
            for i in range(n):
                for j in range(i, n):
                    table[1 + step * width, k] = f.P[i, j]
                    k += 1
        if change < GAIN_TOLERANCE:
            return cycle_index + 1
    return cycles


@jit
def _copy_gain(source: Vector, target: Vector, size: int) -> Any:
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
    table, copy = _design_settled(f, schedule, speed, config)
    record: FilterRecord = np.array([f]).view(np.recarray)[0]
    record.G[:], record.C_fast[:] = copy.G, copy.C_fast  # an accelerometer's row has the speed
    return table, record


def _design_settled(
    f: FilterRecord, schedule: Schedule, speed: float, config: FilterConfig
) -> tuple[Array, FilterRecord]:
    filters: FilterRecords = np.array([f])
    copy = filters.view(np.recarray)[0]
    copy.periodic = copy.measured = copy.origin = copy.joint = copy.between = 0
    copy.pace = 1 if f.stride > 1 else f.pace
    copy.stride, copy.speed = 1, speed
    copy.late = CLONE if f.late == CLONE else IGNORE
    copy.cycle, copy.pattern = schedule.cycle, max(1, len(schedule.lags))
    copy.period[copy.period > 0] = schedule.period
    copy.phase[:] = 0
    _add_bias_walk(copy)
    s = int(f.first_slow)
    table = np.zeros(compute_table_shape(f, schedule))
    table[0, 0] = 1.0
    if f.between == DUAL_RATE or config.poles:
        reset_filters(filters, 0)
        G: Array = copy.G[: copy.dense, : copy.n].copy()
        if f.between == DUAL_RATE:
            _write_shares(copy, G, schedule, config, table)
        else:
            write_placed_gains(copy, G, config.poles, table)
        return table, copy
    lags = np.array(schedule.lags, np.int64) * int(f.late == CLONE)
    cycles = max(2, int(MAX_RECURSION / float(copy.step)) // schedule.cycle)
    before = np.zeros((int(f.total), int(f.total)))
    iterate_gains(filters, s, lags, cycles, table, before, np.zeros((1, 1, 1)))
    if f.between == PSEUDO:
        C = build_measurement_rows(f, 0)
        R = np.diag([*copy.r_fast[: copy.fasts], *copy.r[s, : copy.rows[s]]])
        _write_pseudo_gains(copy, schedule, table, compute_inverse(config.inverse, C, before, R))
    return table, copy


def _add_bias_walk(f: FilterRecord) -> None:
    """Let a constant bias walk by its prior in 10 s, for a filter that has gains of its own.

    What never moves has no settled gain, but whether it is seen is the same.
    """
    for i in range(int(f.dense), int(f.n)):
        if f.pushed[i - f.dense] < 0:
            f.Q[i, i] += f.prior[i, i] * f.step / BIAS_WALK_TIME


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
    F, C, Q, R = transition_matrix(f, G), f.C[s, :q, :n], f.Q[:n, :n], np.diag(f.r[s, :q])
    poles = np.exp(np.array(config.poles) * float(f.step)) if config.poles else None
    B = compute_shares(config.intersample, config.gains, poles, F, Q, C, R, schedule.period)
    first = 1 + schedule.cycle + q * len(schedule.lags)
    write_shares(F, Q, C, R, B, table, first, total)


def _write_pseudo_gains(f: FilterRecord, schedule: Schedule, table: Array, inverse: Array) -> None:
    """Append the constant gain and the generalised inverse of the pseudo-residual rule."""
    p, m, total = int(f.rows[f.first_slow]), int(f.fasts), int(f.total)
    cycle, frames, width = schedule.cycle, len(schedule.lags), max(int(f.fasts), 1)
    first = 1 + cycle * width + p * frames
    frame_gains = table[1 + cycle * width : first, :total].reshape(frames, p, total)
    slow = np.mean(
        [combine_gains(gains, build_measurement_rows(f, 0)[m:]) for gains in frame_gains], axis=0
    )
    fast = table[1 : 1 + cycle * width, :total].reshape(cycle, width, total)[:, :m]
    K = constant_gain(fast, slow, schedule.period)
    table[first : first + m + p, :total] = K.T
    table[first + m + p :, :total] = inverse.T


def combine_gains(K: Array, C: Array) -> Array:
    """Combine gains of rows that correct one after the other to gains of a joint correction.

    Args:
        K: Gain of each row, shape (p, n).
        C: Measurement matrix, shape (p, n).

    Returns:
        Joint gain of each row, shape (p, n).
    """
    joint = np.zeros_like(K)
    for i in range(len(K)):
        joint[:i] -= np.outer(joint[:i] @ C[i], K[i])
        joint[i] = K[i]
    return joint
