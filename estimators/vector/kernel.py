"""Many filters in one compiled call: the loop around `observe`.

The tables of gains of all filters lie in one flat array, the pool, since their shapes differ.
"""

from functools import cache
from typing import Any

import numpy as np

from ...envs.backend.arrays import lane_count
from ...envs.backend.decorators import counted, jit
from ...envs.backend.eights import prefetch
from ...envs.backend.primitives import maximum, minimum
from ...envs.backend.simd import LANES
from ..core.memory import FILTER, OFTEN, SMALL, WIDTH, Memory
from ..entry import entry
from ..wrappers.kernel import observe
from .designs import gains_of
from .lanes import Block, blocks, joins
from .ticks import advance_block

_FEW = 4  # filters that are computed alone in less time than in lanes


@jit
def _fetch(f: Memory, like: Memory) -> None:
    """Have the caches fetch what a tick reads of a filter, whose states are as many as `like`'s."""
    for i in range(0, OFTEN + like.total, 8):
        prefetch(f.ahead, i)
    for i in range(0, SMALL, 8):
        prefetch(f.P, WIDTH, i)
    for j in range(0, like.total, 8):
        for i in range(like.total):
            prefetch(f.P, i, j)
    for j in range(0, like.n, 8):
        for i in range(like.n):
            prefetch(f.Q, i, j)
            prefetch(f.G, i, j)
            prefetch(f.GT, i, j)


@jit
def _gather(b: Block, first: int, filters: Any, done: Any, rows: Any) -> int:
    """Which filters from `first` on do their rows in the lanes of a block, equally many, into
    b.here; returns how many rows."""
    together, count = 0, 0
    for lane in range(lane_count()):
        i = first + lane
        b.here[lane] = 0.0
        if i < len(filters) and done[i] == -1 and rows[i] > 0:
            same = count == 0 or rows[i] == together
            if same and len(filters[i]) == 1 and joins(b, lane, filters[i, 0]):
                b.here[lane], together = 1.0, rows[i]
                count += 1
    return together if count >= _FEW else 0


@counted
def observe_batch(
    filters: Any,
    pool: Any,
    places: Any,
    done: Any,
    lanes: Any,
    fast: Any,
    rows: Any,
    packets: Any,
    counts: Any,
    obs: Any,
    inner: int,
    plan: Any,
    limits: Any,
    beta: Any,
    gamma: Any,
    out: Any,
    summary: Any,
) -> int:
    """`observe` for every filter that has not done its rows; returns how many still have not.

    filters: (N, L). places: (N, 4), see `gains_of`. done: (N,) rows done, -1 where a filter has
    not started. lanes: of `lanes.blocks`. fast: (N, k, FAST_WIDTH). packets: (N, capacity,
    PACKET_WIDTH). All others but inner, plan and limits have one row for each filter, too.

    Filters of one shape do their rows in lanes, others alone.
    """
    waiting = 0
    for first in range(0, len(filters), lane_count()):  # without the compiler one by one
        b = lanes[first // LANES]
        together, ahead = _gather(b, first, filters, done, rows), 0
        if together > 0:
            ahead = advance_block(b, first, filters, pool, places, fast, together, packets, counts)
        for lane in range(minimum(lane_count(), len(filters) - first)):
            i = first + lane
            if done[i] < rows[i]:
                f, gains = filters[i], gains_of(pool, places[i])
                start = ahead if b.here[lane] == 1.0 else maximum(done[i], 0)
                own = obs[i], inner, plan, limits, beta[i], gamma[i], out[i], summary[i]
                if ahead == 0 and i + 1 < len(filters):
                    for layer in range(len(f)):
                        _fetch(filters[i + 1, layer], f[layer])
                done[i] = observe(f, gains, fast[i], rows[i], packets[i], counts[i], start, *own)
                waiting += 1 if done[i] < rows[i] else 0
    return waiting


def nothing_observed(count: int) -> tuple[Any, ...]:
    """The arguments of `observe_batch` after `counts` for filters whose outputs nobody reads."""
    none, plan, truth = (
        np.zeros((count, 0), np.float32),
        np.zeros((0, 3), np.int64),
        np.zeros(count),
    )
    return none, 0, plan, np.zeros(0), truth, truth, none, np.zeros((count, 3))


@cache
def batch_entry() -> Any:
    """`observe_batch` as a plain call."""
    filters, whole, cube = np.zeros((1, 1), FILTER), np.zeros(1, np.int64), np.zeros((1, 1, 1))
    memory = filters, np.zeros(1), np.zeros((1, 4), np.int64), whole, blocks(1)
    return entry(observe_batch, *memory, cube, whole, cube, whole, *nothing_observed(1))
