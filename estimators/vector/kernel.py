"""The batch's part of an observation, compiled: every filter's ticks, in lanes or alone."""

from functools import cache
from typing import Any

import numpy as np

from ...envs.numerics.jit import jit, jit_nrt
from ...envs.numerics.packed import count_lanes
from ...envs.numerics.primitives import Matrix, Vector, maximum, minimum
from ...envs.numerics.simd import LANES
from ...envs.numerics.simd8 import prefetch
from ..core.record import FILTER, N_SMALL, N_TOTAL, X_OFFSET, FilterRecord
from ..estimator import compile_call
from ..wrappers.kernel import observe
from .lane_ticks import advance_block, get_gains
from .lanes import LaneBlock, is_lane_compatible, make_blocks

_MIN_LANES = 4  # filters that are computed alone in less time than in lanes


@jit
def _fetch(f: FilterRecord, template: FilterRecord) -> None:
    """Have the caches fetch what a tick reads of a filter with as many states as `template`."""
    for i in range(0, X_OFFSET + template.total, 8):
        prefetch(f.padding, i)
    for i in range(0, N_SMALL, 8):
        prefetch(f.P, N_TOTAL, i)
    for j in range(0, template.total, 8):
        for i in range(template.total):
            prefetch(f.P, i, j)
    for j in range(0, template.n, 8):
        for i in range(template.n):
            prefetch(f.Q, i, j)
            prefetch(f.G, i, j)
            prefetch(f.GT, i, j)


@jit
def _select_lanes(b: LaneBlock, first: int, filters: Matrix, done: Vector, rows: Vector) -> int:
    """Select the filters that do their rows in lanes into b.here; return how many rows all do."""
    n_rows, count = 0, 0
    for lane in range(count_lanes()):
        i = first + lane
        b.here[lane] = 0.0
        if i < len(filters) and done[i] == -1 and rows[i] > 0:
            is_same = count == 0 or rows[i] == n_rows
            if is_same and len(filters[i]) == 1 and is_lane_compatible(b, lane, filters[i, 0]):
                b.here[lane], n_rows = 1.0, rows[i]
                count += 1
    return n_rows if count >= _MIN_LANES else 0


@jit_nrt
def _observe_batch(
    filters: Matrix,
    pool: Vector,
    places: Any,
    done: Vector,
    lanes: Vector,
    fast: Vector,
    rows: Vector,
    packets: Vector,
    counts: Vector,
    obs: Vector,
    inner: int,
    plan: Any,
    limits: Any,
    beta: Vector,
    gamma: Vector,
    out: Vector,
    summary: Vector,
) -> int:
    """Call `observe` for every filter that has rows to do; return how many still have."""
    # arguments are those of `observe` with N filters as first axis, but for inner, plan and limits;
    # done: rows done, -1 where a filter has not started, updated; filters of one shape go in lanes
    n_waiting = 0
    for first in range(0, len(filters), count_lanes()):  # without the compiler one by one
        b = lanes[first // LANES]
        n_rows, n_done = _select_lanes(b, first, filters, done, rows), 0
        if n_rows > 0:
            n_done = advance_block(b, first, filters, pool, places, fast, n_rows, packets, counts)
        for lane in range(minimum(count_lanes(), len(filters) - first)):
            i = first + lane
            if done[i] < rows[i]:
                f, gains = filters[i], get_gains(pool, places[i])
                start = n_done if b.here[lane] == 1.0 else maximum(done[i], 0)
                outputs = obs[i], inner, plan, limits, beta[i], gamma[i], out[i], summary[i]
                if n_done == 0 and i + 1 < len(filters):
                    for layer in range(len(f)):
                        _fetch(filters[i + 1, layer], f[layer])
                done[i] = observe(
                    f, gains, fast[i], rows[i], packets[i], counts[i], start, *outputs
                )
                n_waiting += 1 if done[i] < rows[i] else 0
    return n_waiting


def make_empty_outputs(count: int) -> tuple[Any, ...]:
    """Make the arguments of `observe` from `obs` on, for N filters whose outputs are not read.

    Args:
        count: Number of filters N.

    Returns:
        The arguments in their order.
    """
    empty, plan = np.zeros((count, 0), np.float32), np.zeros((0, 3), np.int64)
    truth = np.zeros(count)
    return empty, 0, plan, np.zeros(0), truth, truth, empty, np.zeros((count, 3))


@cache
def compile_observe_batch() -> Any:
    """Return `_observe_batch` as a plain call."""
    filters, integers, cube = np.zeros((1, 1), FILTER), np.zeros(1, np.int64), np.zeros((1, 1, 1))
    memory = filters, np.zeros(1), np.zeros((1, 4), np.int64), integers, make_blocks(1)
    return compile_call(
        _observe_batch, *memory, cube, integers, cube, integers, *make_empty_outputs(1)
    )
