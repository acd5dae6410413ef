"""The batch's part of an observation, compiled: every filter's ticks, in lanes or alone."""

from collections.abc import Callable
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
from .lane_ticks import FilterBank, advance_block, get_gains
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
    bank: FilterBank, done: Vector, lanes: Vector, record: Any, observed: Any
) -> int:
    """Call `observe` for every filter that has rows to do; return how many still have."""
    # record, observed: arguments of `observe` with N filters as first axis, but for inner, plan and
    # limits; done: rows done, -1 where a filter has not started, updated; filters of one shape go
    # in lanes
    fast, rows, packets, counts = record
    obs, inner, plan, limits, beta, gamma, out, summary = observed
    filters, n_waiting = bank.filters, 0
    for first in range(0, len(filters), count_lanes()):  # without the compiler one by one
        b = lanes[first // LANES]
        n_rows, n_done = _select_lanes(b, first, filters, done, rows), 0
        if n_rows > 0:
            n_done = advance_block(b, first, bank, fast, n_rows, packets, counts)
        for lane in range(minimum(count_lanes(), len(filters) - first)):
            i = first + lane
            if done[i] < rows[i]:
                f, gains = filters[i], get_gains(bank, i)
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


_INTEGERS, _CUBE = np.zeros(1, np.int64), np.zeros((1, 1, 1))
EXAMPLE_BANK = FilterBank(np.zeros((1, 1), FILTER), np.zeros(1), np.zeros((1, 4), np.int64))
EXAMPLE_RECORD = _CUBE, _INTEGERS, _CUBE, _INTEGERS
"""For `compile_call`: all banks and records have these types."""


@cache
def compile_observe_batch() -> Callable[..., int]:
    """Return `_observe_batch` as a plain call."""
    memory = EXAMPLE_BANK, _INTEGERS, make_blocks(1)
    return compile_call(_observe_batch, *memory, EXAMPLE_RECORD, make_empty_outputs(1))
