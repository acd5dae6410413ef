"""The error map of a filter over one cycle of its schedule, and what it says.

Without noise the estimation error after a cycle is a matrix times the error before it. Its
spectral radius decides: above one the filter diverges; at one it has an unobservable direction.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from .periodic import measured_rows, slow_index
from .schedule import Schedule

Array = npt.NDArray[np.float64]

MARGINAL = 1e-9


def spectral_radius(M: Array) -> float:
    """The largest absolute eigenvalue."""
    return float(np.abs(np.linalg.eigvals(M)).max())


def unobservable(M: Array, names: tuple[str, ...]) -> tuple[str, ...]:
    """The directions in which an error stays for ever, each as "beta 1, psi -1, ..."."""
    values, vectors = np.linalg.eig(M)
    found = []
    for i in np.flatnonzero(np.abs(values) > 1.0 - MARGINAL):
        v = np.real(vectors[: len(names), i])
        largest = np.abs(v).max()
        lead = v[0] if abs(v[0]) > 1e-6 * largest else v[np.argmax(np.abs(v))]
        parts = zip(names, v / lead, strict=True)
        found.append(", ".join(f"{name} {part:.4g}" for name, part in parts if abs(part) > 1e-6))
    return tuple(found)


def error_map(f: Any, table: Array, G: Array, schedule: Schedule) -> Array:
    """The error after one cycle over that before it, (size, size); for pseudo-residuals the
    estimated error e stands behind the error, (2 size, 2 size).

    f: the filter's record. table, G: from `periodic.design`.
    """
    n, size, s = int(f.n), int(f.total), slow_index(f)
    F = np.eye(size)
    F[: len(G), :n] = G
    F[range(len(G), n), range(len(G), n)] = f.decay[len(G) : n]
    correct = _pseudo_correction if f.pseudo else _correction
    total: Array = np.eye(2 * size if f.pseudo else size)
    for step in range(schedule.cycle):
        move: Array = F @ _latched(f, s, schedule, step)
        if f.pseudo:
            move = np.asarray(np.kron(np.eye(2), move), np.float64)
        total = np.asarray(correct(f, s, table, schedule, step) @ move @ total, np.float64)
    return total


def _latched(f: Any, s: int, schedule: Schedule, step: int) -> Array:
    """Clones of what was captured in the step before."""
    L = np.eye(int(f.total))
    frame, rest = divmod((step - 1) % schedule.cycle, schedule.period)
    if s >= 0 and f.frames[s] > 0 and rest == 0:
        rows = int(f.rows[s])
        first = int(f.home[s]) + frame % int(f.frames[s]) * rows
        L[first : first + rows] = 0.0
        L[first : first + rows, : f.n] = f.row[s, :rows, : f.n]
    return L


def _correction(f: Any, s: int, table: Array, schedule: Schedule, step: int) -> Array:
    """(I - K C) of the gyro and of the frames that arrive in a step."""
    size = int(f.total)
    I = np.eye(size)  # noqa: E741
    M = I - np.outer(table[1 + step, :size], measured_rows(f, s, 0)[0])
    for frame in schedule.arriving(step):
        C = measured_rows(f, s, frame, schedule.lags[frame])
        for i in range(1, len(C)):
            K = table[schedule.cycle + frame * (len(C) - 1) + i, :size]
            M = (I - np.outer(K, C[i])) @ M
    return M


def _pseudo_correction(f: Any, s: int, table: Array, schedule: Schedule, step: int) -> Array:
    """(error, e) -> (error, e): tie-vision (19)-(22)."""
    size, C = int(f.total), measured_rows(f, s, 0)
    first = 1 + schedule.cycle + (len(C) - 1) * len(schedule.lags)
    K = table[first : first + len(C), :size].T
    inverse = table[first + len(C) : first + 2 * len(C), :size].T
    I, zero = np.eye(size), np.zeros((size, size))  # noqa: E741
    if schedule.arriving(step):
        return np.block([[I - K @ C, zero], [(inverse - K) @ C, zero]])  # (19)-(20)
    fast = np.outer(K[:, 0], C[0])
    return np.block([[I - fast, fast - K @ C], [zero, I - K @ C]])  # (21)-(22)
