"""Many filters in one compiled call: the loops around `advance` and `observe`.

The tables of gains of all filters lie in one flat array, the pool, since their shapes differ.
"""

from functools import cache
from typing import Any

import numpy as np

from ..envs.backend import jit, maximum
from .compiled import entry
from .core import advance
from .memory import FILTER
from .observing import observe


@jit
def gains_of(pool: Any, place: Any) -> Any:
    """The gains that lie in the pool at a place: (offset, then their shape)."""
    start, cells, height, width = place[0], place[1], place[2], place[3]
    return pool[start : start + cells * height * width].reshape((cells, height, width))


@jit
def _advance(
    layers: Any, gains: Any, fast: Any, rows: int, packets: Any, count: int, start: int
) -> int:
    nothing = fast[:0]
    return advance(layers[0], gains, fast, rows, packets, count, start, nothing, nothing)


@jit
def advance_batch(
    filters: Any, pool: Any, places: Any, done: Any, fast: Any, rows: Any, packets: Any, counts: Any
) -> int:
    """`advance` for every filter that has not done its rows; returns how many still have not.

    filters: (N, L). places: (N, 4), see `gains_of`. done: (N,) rows done, -1 where a filter has
    not started. fast: (N, k, FAST_WIDTH). packets: (N, room, PACKET_WIDTH). rows, counts: (N,).
    """
    waiting = 0
    for i in range(len(filters)):
        if done[i] < rows[i]:
            gains, start = gains_of(pool, places[i]), maximum(done[i], 0)
            done[i] = _advance(filters[i], gains, fast[i], rows[i], packets[i], counts[i], start)
            waiting += 1 if done[i] < rows[i] else 0
    return waiting


@jit
def observe_batch(
    filters: Any,
    pool: Any,
    places: Any,
    done: Any,
    fast: Any,
    rows: Any,
    packets: Any,
    counts: Any,
    obs: Any,
    kept: int,
    plan: Any,
    limits: Any,
    beta: Any,
    gamma: Any,
    out: Any,
    said: Any,
) -> int:
    """`advance_batch` that writes observations, as `observe` does; one row each for a filter."""
    waiting = 0
    for i in range(len(filters)):
        if done[i] < rows[i]:
            done[i] = observe(
                filters[i],
                gains_of(pool, places[i]),
                fast[i],
                rows[i],
                packets[i],
                counts[i],
                maximum(done[i], 0),
                obs[i],
                kept,
                plan,
                limits,
                beta[i],
                gamma[i],
                out[i],
                said[i],
            )
            waiting += 1 if done[i] < rows[i] else 0
    return waiting


@cache
def batch_entries() -> tuple[Any, Any]:
    """(`advance_batch`, `observe_batch`) as plain calls."""
    filters, numbers, whole = np.zeros((1, 1), FILTER), np.zeros(1), np.zeros(1, np.int64)
    table, cube = np.zeros((1, 4), np.int64), np.zeros((1, 1, 1))
    single, matrix = np.zeros((1, 1), np.float32), np.zeros((1, 1))
    common = filters, numbers, table, whole, cube, whole, cube, whole
    told = single, 0, np.zeros((1, 3), np.int64), numbers, numbers, numbers, single, matrix
    return entry(advance_batch, *common), entry(observe_batch, *common, *told)
