"""The error map of a filter over one cycle of its schedule, and its eigenvalues.

Without noise the estimation error after a cycle is a matrix times the error before it. Its
spectral radius decides: above one the filter diverges; at one it has an unobservable direction.
"""

import pickle
from functools import lru_cache

import numpy as np

from ...envs.record import Array
from ..core.innovation import CLONE, CONSTANT, DUAL_RATE, PSEUDO, STORED
from ..core.record import FILTER, FilterRecord
from .dual_rate import frame_map
from .kalman import transition_matrix
from .options import FilterConfig
from .periodic import Schedule, build_measurement_rows, design_gains

MARGINAL = 1e-9  # below 1, an eigenvalue's magnitude from which on an error stays


def spectral_radius(M: Array) -> float:
    """Compute the spectral radius, the largest absolute eigenvalue.

    Args:
        M: Matrix, shape (n, n).

    Returns:
        The radius.
    """
    return float(np.abs(np.linalg.eigvals(M)).max())


def find_unobservable(M: Array, names: tuple[str, ...]) -> tuple[str, ...]:
    """Find the directions in which an error stays for ever.

    Args:
        M: Map of the error over a cycle, shape (size, size).
        names: Names of the states, the first rows of M.

    Returns:
        Text of each, "beta 1, psi -1, ...".
    """
    values, vectors = np.linalg.eig(M)
    directions = []
    for i in np.flatnonzero(np.abs(values) > 1.0 - MARGINAL):
        v = np.real(vectors[: len(names), i])
        largest = np.abs(v).max()
        leading = v[0] if abs(v[0]) > 1e-6 * largest else v[np.argmax(np.abs(v))]
        parts = zip(names, v / leading, strict=True)
        terms = (f"{name} {part:.4g}" for name, part in parts if abs(part) > 1e-6)
        directions.append(", ".join(terms))
    return tuple(directions)


@lru_cache(maxsize=512)  # the same filter drives in many envs
def _design_cached(key: bytes) -> tuple[Array, Array]:
    memory, schedule, speed, config = pickle.loads(key)
    f = np.frombuffer(memory, FILTER).view(np.recarray)[0]
    table, record = design_gains(f, schedule, speed, config)
    return table, _compute_error_map(record, table, schedule)


def design_and_map(
    f: FilterRecord, schedule: Schedule, speed: float, config: FilterConfig
) -> tuple[Array, Array]:
    """Design the table of gains and the map of the error at a speed; both are read-only.

    Args:
        f: Memory of the filter, left as it is.
        schedule: Schedule of its slow sensor.
        speed: Speed (m/s).
        config: Parsed options of the filter.

    Returns:
        Table, shape (rows, columns), and map from the error before a cycle to that after it.
    """
    return _design_cached(pickle.dumps((f.tobytes(), schedule, speed, config)))


def _compute_error_map(f: FilterRecord, table: Array, schedule: Schedule) -> Array:
    """Compute the map (size, size) of the error over a cycle, by a table of `design_gains`."""
    # behind the error of states and clones stands what else a rule carries on: the estimated error
    # e, the last innovation or stored predictions
    size, s = int(f.total), int(f.first_slow)
    F = np.eye(size)
    F[: f.n, : f.n] = transition_matrix(f, f.G[: f.dense, : f.n])
    rows = int(f.rows[s]) if s >= 0 else 0
    if f.between == DUAL_RATE:  # from sample to sample, with the weights in the table
        n, r, first = int(f.n), schedule.period, 1 + schedule.cycle + rows * len(schedule.lags)
        B = table[first : first + r * rows, :n].reshape(r, rows, n).transpose(0, 2, 1)
        return frame_map(F[:n, :n], f.C[s, :rows, :n], B)
    late = f.late in (STORED, CONSTANT) and s >= 0
    stored = max(schedule.lags) // schedule.period + 1 if late else 0  # the newest first
    n_errors = 2 if f.between == PSEUDO else 1
    width = n_errors * size + stored * rows
    total: Array = np.eye(width)
    for step in range(schedule.cycle):
        move = np.eye(width)
        step_map = F @ _build_clone_map(f, schedule, step)
        for k in range(n_errors):
            move[k * size : (k + 1) * size, k * size : (k + 1) * size] = step_map
        if stored and step % schedule.period == 0:  # the prediction of what is captured now
            at, end = n_errors * size, width - rows
            store = np.eye(width)
            store[at:] = 0.0
            store[at + rows :, at:end] = np.eye(end - at)
            store[at : at + rows, : f.n] = f.C[s, :rows, : f.n]
            move = store @ move
        correct = _build_pseudo_correction if f.between == PSEUDO else _build_correction
        stored_at = n_errors * size if stored else -1
        total = np.asarray(correct(f, table, schedule, step, width, stored_at) @ move @ total)
    return total


def _build_clone_map(f: FilterRecord, schedule: Schedule, step: int) -> Array:
    """Build the map that clones what was captured in the step before."""
    L, s = np.eye(int(f.total)), int(f.first_slow)
    frame, rest = divmod((step - 1) % schedule.cycle, schedule.period)
    if s >= 0 and f.late == CLONE and f.frames[s] > 0 and rest == 0:
        rows = int(f.rows[s])
        first = int(f.first_clone[s]) + frame % int(f.frames[s]) * rows
        L[first : first + rows] = 0.0
        L[first : first + rows, : f.n] = f.C[s, :rows, : f.n]
    return L


def _build_residual_rows(
    f: FilterRecord, schedule: Schedule, frame: int, width: int, stored_at: int
) -> Array:
    """Build the residuals' rows (m + p, width) by the whole error; stored_at: -1 if none is."""
    lag = schedule.lags[frame] if schedule.lags else 0
    measured = build_measurement_rows(f, frame, lag)
    C = np.zeros((len(measured), width))
    C[:, : measured.shape[1]] = measured
    if stored_at >= 0:
        m, p = int(f.fasts), len(measured) - int(f.fasts)
        C[m:] = 0.0
        at = stored_at + lag // schedule.period * p
        C[m:, at : at + p] = np.eye(p)
    return C


def _build_correction(
    f: FilterRecord, table: Array, schedule: Schedule, step: int, width: int, stored_at: int
) -> Array:
    """Build (I - K C) of the fast rows and of the frames that arrive in a step."""
    size, m = int(f.total), int(f.fasts)
    I = np.eye(width)  # noqa: E741
    M = I.copy()
    fast = _build_residual_rows(f, schedule, 0, width, stored_at)[:m]
    joint = np.zeros((width, width))
    for i in range(m):
        K = np.zeros(width)
        K[:size] = table[1 + step * max(m, 1) + i, :size]
        if f.joint:
            joint += np.outer(K, fast[i])
        else:
            M = (I - np.outer(K, fast[i])) @ M
    M = (I - joint) @ M
    for frame in schedule.find_arriving(step):
        C = _build_residual_rows(f, schedule, frame, width, stored_at)[m:]
        lag = 0 if stored_at >= 0 else schedule.lags[frame]
        measured = build_measurement_rows(f, frame, lag)[m:]
        first = 1 + schedule.cycle * max(m, 1) + frame * len(C)
        total, residual_map = np.zeros((width, len(C))), np.eye(len(C))
        for i in range(len(C)):  # row i's correction changes the residuals of those behind it
            K = np.zeros(width)
            K[:size] = table[first + i, :size]
            total += np.outer(K, residual_map[i])
            is_behind = (np.arange(len(C)) > i)[:, None]
            residual_map -= np.outer(measured @ K[:size], residual_map[i]) * is_behind
        M = (I - total @ C) @ M
    return M


def _build_pseudo_correction(
    f: FilterRecord, table: Array, schedule: Schedule, step: int, width: int, stored_at: int
) -> Array:
    """Build the map (error, e, ...) -> (error, e, ...) of tie-vision (19)-(22)."""
    size, m = int(f.total), int(f.fasts)
    C = build_measurement_rows(f, 0)
    first = 1 + schedule.cycle * max(m, 1) + (len(C) - m) * len(schedule.lags)
    K = table[first : first + len(C), :size].T
    inverse = table[first + len(C) : first + 2 * len(C), :size].T
    M, error, e = np.eye(width), slice(0, size), slice(size, 2 * size)
    arriving = schedule.find_arriving(step)
    if arriving:
        residual_rows = np.zeros((len(C), width))
        residual_rows[:, :size] = C
        if stored_at >= 0:
            residual_rows = _build_residual_rows(f, schedule, arriving[-1], width, stored_at)
        M[error] -= K @ residual_rows  # tie-vision (19)
        M[e] = (inverse - K) @ residual_rows  # tie-vision (20)
        return M
    M[error, error] -= K[:, :m] @ C[:m]  # the fast rows' residuals are real
    M[error, e] -= K[:, m:] @ C[m:]  # tie-vision (22)
    M[e, e] -= K @ C  # tie-vision (21)
    return M
