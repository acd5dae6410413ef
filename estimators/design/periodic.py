"""The schedule of a slow sensor, and the gains of a filter that repeat with it.

A table of gains has a head row; for each step of the cycle a row for every fast measurement (one
where there is none); for each frame of the pattern a row for every slow row. Pseudo-residuals add
K^T and the transposed inverse, dual-rate rules a fraction of the innovation for each step. Behind
the gains of a step stands the upper half of the states' covariance after it.
"""

import pickle
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Scalar, Vector, absolute, maximum
from ...envs.record import FAST_WIDTH, PACKET, PACKET_WIDTH, Array
from ..core.covariance import correct_scalar, project_row
from ..core.filter import NO_OUTPUTS, StepRecord, advance, reset_filters, run_tick
from ..core.late_samples import CLONE, CONSTANT, DROPPED, IGNORE, STORED, find_target
from ..core.memory import FILTER, GAIN, WINDOW, FilterLayers, FilterMemory, GainTables
from .gains import SampledSystem, compute_inverse, observer_gain, transition_matrix
from .options import FilterConfig


def count_ticks(seconds: float, dt: float, label: str) -> int:
    """Convert a time to a number of ticks; ValueError where that is no whole number.

    Args:
        seconds: Time (s).
        dt: Tick (s).
        label: Name of the time for messages.
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


NO_SENSOR = Schedule(1, ())

_GAIN_TOLERANCE = 1e-12  # relative change of a settled gain in a cycle
_CHECK_TOLERANCE = 1e-6  # the same, of a filter that is only checked: it has gains of its own
_MAX_RECURSION = 600.0  # s of driving after which the recursion ends in any case
MARGINAL = 1e-9  # below 1, an eigenvalue's magnitude from which on an error stays
_SMALL = 2.0**-10  # an error whose angles need no wrapping
_BIAS_WALK_TIME = 10.0  # s in which a bias walks by its prior where a filter is checked


@jit
def _iterate_gains(
    filters: FilterLayers, lags: Vector, cycles: int, tolerance: float, table: Matrix,
    before: Vector, gains: GainTables,
) -> int:  # fmt: skip
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
                    to = table[1 + step * width + i]
                    change = maximum(change, _copy_gain(f.tick_gains[i], to, N))
            for frame in range(len(lags)):
                captured = f.tick - lags[frame]
                if (captured - frame * f.period[s]) % cycle != 0 or captured < 0:
                    continue
                first = find_target(f, s, captured)
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


def _compute_table_shape(f: FilterMemory, schedule: Schedule) -> tuple[int, int]:
    """Compute the shape of a table of gains: rows and columns."""
    p, m = int(f.rows.max()), int(f.fasts)
    rows = 1 + schedule.cycle * max(m, 1) + p * len(schedule.lags)
    if f.gain_rule in (GAIN.split, GAIN.pseudo):
        rows += 2 * (m + p)
    elif f.gain_rule == GAIN.dual_rate:
        rows += schedule.cycle * p
    return rows, int(f.total + f.n * (f.n + 1) // 2)


def allocate_gains(f: FilterMemory, schedule: Schedule) -> Array:
    """Allocate zeros for gains (cells of speed, rows, columns); a one where P gives them."""
    cells = round((f.high - f.low) / f.spacing) + 1 if f.spacing > 0.0 else 1
    shape = cells, *_compute_table_shape(f, schedule)
    return np.zeros(shape) if f.gain_rule > GAIN.split else np.ones((1, 1, 1))


def _copy_for_schedule(f: FilterMemory, schedule: Schedule, speed: float) -> FilterLayers:
    """Copy a filter (1,) as one that takes steps of a schedule at a held speed, gains from P."""
    filters: FilterLayers = np.array([f])
    copy = filters.view(np.recarray)[0]
    copy.gain_rule, copy.measured, copy.origin = GAIN.covariance, 0, 0
    copy.pace = 1 if f.stride > 1 else f.pace
    copy.stride, copy.speed, copy.smoothing = 1, speed, 0.0
    copy.delay_rule = CLONE if f.delay_rule == CLONE else IGNORE
    copy.frames[:] = f.frames * (f.delay_rule == CLONE)  # other rules have no clones
    copy.cycle, copy.pattern = schedule.cycle, max(1, len(schedule.lags))
    copy.period[copy.period > 0] = schedule.period
    copy.phase[:] = 0
    return filters


def _design_gains(f: FilterMemory, schedule: Schedule, speed: float, config: FilterConfig) -> Array:
    """Design the table of gains (rows, columns) of a filter at a speed (m/s)."""
    filters = _copy_for_schedule(f, schedule, speed)
    copy = filters.view(np.recarray)[0]
    for i in range(int(f.first_bias), int(f.n)):  # a bias that never moves has no settled gain
        copy.Q[i, i] += f.prior[i, i] * f.step / _BIAS_WALK_TIME
    s = int(f.first_slow)
    table = np.zeros(_compute_table_shape(f, schedule))
    table[0, 0] = 1.0
    if f.gain_rule == GAIN.dual_rate or config.poles:
        reset_filters(filters, 0)
        G: Array = copy.G[: copy.dense, : copy.n].copy()
        if f.gain_rule == GAIN.dual_rate:
            _write_shares(copy, G, schedule, config, table)
        else:
            _write_placed_gains(copy, G, config.poles, table)
    else:
        lags = np.array(schedule.lags, np.int64) * int(f.delay_rule == CLONE)
        cycles = max(2, int(_MAX_RECURSION / float(copy.step)) // schedule.cycle)
        before = np.zeros((int(f.total), int(f.total)))
        tolerance = _GAIN_TOLERANCE if f.gain_rule > GAIN.split else _CHECK_TOLERANCE
        _iterate_gains(filters, lags, cycles, tolerance, table, before, np.zeros((1, 1, 1)))
        if f.gain_rule in (GAIN.split, GAIN.pseudo):
            C = build_measurement_rows(f)
            R = np.diag([*copy.r_fast[: copy.fasts], *copy.r[s, : copy.rows[s]]])
            inverse = compute_inverse(config.inverse, C, before, R)
            _write_pseudo_gains(copy, schedule, table, inverse)
    return table


def build_measurement_rows(f: FilterMemory) -> Array:
    """Build C (m + p, total): the fast rows, then the slow ones, of first clones if any."""
    s, m = int(f.first_slow), int(f.fasts)
    p = int(f.rows[s]) if s >= 0 else 0
    C = np.zeros((m + p, int(f.total)))
    C[:m, : f.n] = f.C_fast[:m, : f.n]
    if s >= 0 and f.delay_rule == CLONE and f.frames[s] > 0:
        first = int(f.first_clone[s])
        C[m:, first : first + p] = np.eye(p)
    elif s >= 0:
        C[m:, : f.n] = f.C[s, :p, : f.n]
    return C


def _write_shares(
    f: FilterMemory, G: Array, schedule: Schedule, config: FilterConfig, table: Array
) -> None:
    """Write the weights of an innovation of the dual-rate rules behind the gains."""
    n, s, total = int(f.n), int(f.first_slow), int(f.total)
    q = int(f.rows[s])
    F, C, R = transition_matrix(f, G), f.C[s, :q, :n], np.diag(f.r[s, :q])
    system = SampledSystem(F, f.Q[:n, :n], C, R, schedule.period)
    poles = np.exp(np.array(config.poles) * float(f.step)) if config.poles else None
    B = system.compute_shares(config.intersample, config.gains, poles)
    first, steps = 1 + schedule.cycle + q * len(schedule.lags), len(B)
    table[first : first + steps * q, :n] = B.transpose(0, 2, 1).reshape(steps * q, n)
    covariances, upper = system.compute_covariances(B), np.triu_indices(n)
    table[1 : 1 + steps, total:] = covariances[:, upper[0], upper[1]]


def _write_placed_gains(f: FilterMemory, G: Array, poles: tuple[float, ...], table: Array) -> None:
    """Write the gains of the fast rows for poles (rad/s), and the covariance, into a table."""
    from scipy.linalg import solve_discrete_lyapunov  # slow to load

    n, m = int(f.n), int(f.fasts)
    F, C = transition_matrix(f, G), f.C_fast[:m, :n]
    K = observer_gain(F, C, np.exp(np.array(poles) * float(f.step)))
    rest = np.eye(n) - K @ C
    noise = rest @ f.Q[:n, :n] @ rest.T + K @ np.diag(f.r_fast[:m]) @ K.T
    P = solve_discrete_lyapunov(rest @ F, noise)
    table[1 : 1 + m, :n] = K.T
    table[1, int(f.total) :] = P[np.triu_indices(n)]


def _write_pseudo_gains(f: FilterMemory, schedule: Schedule, table: Array, inverse: Array) -> None:
    """Append the constant gain and the generalised inverse of the pseudo-residual rule."""
    p, m, total = int(f.rows[f.first_slow]), int(f.fasts), int(f.total)
    cycle, frames, width = schedule.cycle, len(schedule.lags), max(int(f.fasts), 1)
    first = 1 + cycle * width + p * frames
    frame_gains = table[1 + cycle * width : first, :total].reshape(frames, p, total)
    C = build_measurement_rows(f)[m:]
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


@lru_cache(maxsize=512)  # the same filter drives in many envs
def _design_cached(key: bytes) -> tuple[Array, Array]:
    memory, schedule, speed, config = pickle.loads(key)
    f = np.frombuffer(memory, FILTER).view(np.recarray)[0]
    table = _design_gains(f, schedule, speed, config)
    return table, _compute_error_map(f, table, schedule, speed)


def design_and_map(
    f: FilterMemory, schedule: Schedule, speed: float, config: FilterConfig
) -> tuple[Array, Array]:
    """Design gains (rows, columns) at a speed and the error's map over a cycle, both read-only."""
    return _design_cached(pickle.dumps((f.tobytes(), schedule, speed, config)))


def _compute_error_map(f: FilterMemory, table: Array, schedule: Schedule, speed: float) -> Array:
    """Compute the map (size, size) of the error over a cycle by what the compiled filter does."""
    # Behind the error of the states stands what else a rule carries on: the estimated error e,
    # clones or predictions of the captures under way. A column is what becomes of a small error
    # there, where all that is measured is zero.
    cycle, period, lags = schedule.cycle, schedule.period, schedule.lags
    filters = _copy_for_schedule(f, schedule, speed)
    g = filters.view(np.recarray)[0]
    g.delay_rule = f.delay_rule if f.delay_rule in (CLONE, STORED, CONSTANT) else IGNORE
    by_table = {GAIN.covariance: GAIN.table, GAIN.split: GAIN.pseudo}
    g.gain_rule = by_table.get(int(f.gain_rule), f.gain_rule)
    latest, g.heading_fix[:] = max(lags, default=0), 0
    g.assumed, g.spacing, g.recovery_count, g.velocity = latest, 0.0, 0, 0.0
    reset_filters(filters, 0)
    start = (latest // cycle + 1) * cycle  # until then the first samples arrive
    captured = np.arange(0, start + cycle, period) if lags else np.zeros(0)
    packets = np.zeros((len(captured), PACKET_WIDTH))
    packets[:, PACKET.sensor], packets[:, PACKET.captured] = f.first_slow, captured
    packets[:, PACKET.arrived] = captured + np.resize(lags, len(captured))
    packets[:, PACKET.quality] = 1.0
    packets = packets[np.argsort(packets[:, PACKET.arrived], kind="stable")]

    def run(first: int, ticks: int) -> None:
        arrived = packets[:, PACKET.arrived]
        due = packets[(arrived >= first) & (arrived < first + ticks)]
        record = StepRecord(np.zeros((ticks, FAST_WIDTH)), ticks, due, len(due))
        advance(filters, table[None], record, 0, NO_OUTPUTS)

    def list_errors(tick: int) -> list[Array]:
        """List what holds an error before a tick's step, as views of the filter's memory."""
        spans, vectors = [slice(0, f.n)], (g.x, g.e) if g.gain_rule == GAIN.pseudo else (g.x,)
        if f.delay_rule == CLONE and lags:
            s, p = int(f.first_slow), int(f.rows[f.first_slow])
            is_read = g.gain_rule == GAIN.pseudo  # e's is read later
            is_carried = (g.stamp[s, : f.frames[s]] >= 0) | is_read
            firsts = f.first_clone[s] + p * np.flatnonzero(is_carried)
            spans += [slice(first, first + p) for first in firsts]
        late = latest // period if f.delay_rule in (STORED, CONSTANT) else 0
        captures = [(tick - i * period) % WINDOW for i in range(1, late + 1)]
        parts = [vector[span] for vector in vectors for span in spans]
        return parts + [g.predicted[row, : f.n] for row in captures]

    run(0, start)
    memory, columns = filters.copy(), []
    for part in range(len(list_errors(start))):
        for i in range(len(list_errors(start)[part])):
            filters[:] = memory
            list_errors(start)[part][i] = _SMALL
            run(start, cycle)
            columns.append(np.concatenate(list_errors(start + cycle)) / _SMALL)
    return np.array(columns).T


def spectral_radius(M: Array) -> float:
    """Compute the spectral radius, the largest absolute eigenvalue.

    Args:
        M: Matrix, shape (n, n).
    """
    return float(np.abs(np.linalg.eigvals(M)).max())


def find_unobservable(M: Array, names: tuple[str, ...]) -> tuple[str, ...]:
    """Find directions in which an error stays for ever, as "beta 1, psi -1, ..." each.

    Args:
        M: Map of the error over a cycle, shape (size, size).
        names: Names of the states, the first rows of M.
    """
    values, vectors = np.linalg.eig(M)
    directions = []
    for i in np.flatnonzero(np.abs(values) > 1.0 - MARGINAL):
        v = np.real(vectors[: len(names), i])
        if (largest := np.abs(v).max()) == 0.0:  # of a clone alone
            continue
        leading = v[0] if abs(v[0]) > 1e-6 * largest else v[np.argmax(np.abs(v))]
        parts = zip(names, v / leading, strict=True)
        terms = (f"{name} {part:.4g}" for name, part in parts if abs(part) > 1e-6)
        directions.append(", ".join(terms))
    return tuple(directions)
