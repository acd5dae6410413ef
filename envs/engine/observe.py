"""The float32 observation of a step, and what `info` reads of the state; compiled."""

from typing import Any

from ..backend.arrays import load_element, store_element
from ..backend.decorators import jit
from ..backend.elementary import clip
from ..backend.primitives import select
from ..record import FAST, PACKET
from ..sensors.slow import WIDTHS
from ..task.info import REPORT
from ..task.observation import AGE_CAP, N_SAMPLED
from ..ticks import NEVER, TICK
from .layout import FLAGS, P, Z


@jit
def observe(row: Any, n: int, count: int, refs: Any, bounds: Any) -> None:
    """Write the float32 observation of a record of n ticks and `count` packets, every entry
    clipped at its bounds (2, k); entries as in `make_observation_layout`."""
    k = observe_fast(row.rows, n, refs, bounds, row.switches, row.obs)
    observe_slow(row, k, count, bounds)


@jit
def observe_fast(rows: Any, n: int, refs: Any, bounds: Any, switches: Any, obs: Any) -> int:
    """Write the entries of n fast rows, which come first, and of the references, which come last;
    returns how many come first. rows, obs: of a vehicle, or with an axis more for those of a block.
    """
    k = 0
    for column in range(N_SAMPLED):
        if switches[FLAGS.all_samples]:
            for j in range(n):
                _store_clipped(obs, load_element(rows, j, column), bounds, k)
                k += 1
        else:
            total = 0.0
            for j in range(n):
                total = total + load_element(rows, j, column)
            _store_clipped(obs, load_element(rows, n - 1, column), bounds, k)
            _store_clipped(obs, total / n, bounds, k + 1)
            k += 2
    for i in range(4):
        _store_clipped(obs, load_element(rows, n - 1, FAST.steer + i), bounds, k)
        k += 1
    if switches[FLAGS.with_map]:
        _store_clipped(obs, load_element(rows, n - 1, FAST.curvature), bounds, k)
        k += 1
    last = len(obs) - 2
    _store_clipped(obs, refs[0], bounds, last)
    _store_clipped(obs, refs[1], bounds, last + 1)
    return k


@jit
def _store_clipped(obs: Any, value: Any, bounds: Any, k: int) -> None:
    store_element(obs, clip(value, bounds[0, k], bounds[1, k]), k)


@jit
def observe_slow(row: Any, k: int, count: int, bounds: Any) -> None:
    """Write the entries of the slow sensors, from k on, of a record of `count` packets."""
    p, z, obs, packets = row.p, row.z, row.obs, row.packets
    tick = z[Z.clock.tick]
    for sensor in range(len(Z.slow)):
        newest = Z.slow[sensor]
        if p[P.slow[sensor].period] > 0.0:
            for i in range(WIDTHS[sensor]):
                obs[k] = clip(z[newest.values[0] + i], bounds[0, k], bounds[1, k])
                k += 1
            age = (tick - z[newest.captured]) * TICK
            obs[k] = clip(select(z[newest.captured] != NEVER, age, AGE_CAP), 0.0, AGE_CAP)
            is_fresh = 0.0
            for i in range(count):
                is_newest = (
                    packets[i, PACKET.arrived] == z[newest.arrived]
                )  # not late, no duplicate
                if packets[i, PACKET.sensor] == sensor and is_newest:
                    is_fresh = 1.0
            obs[k + 1] = is_fresh
            k += 2


@jit
def write_report(report: Any, z: Any) -> None:
    """Write what `info` reads of the state; cost and references are the caller's."""
    report[REPORT.t] = z[Z.clock.tick] * TICK
    report[REPORT.gamma] = z[Z.motion.gamma]
    report[REPORT.psi] = z[Z.motion.psi]
    report[REPORT.failure] = z[Z.clock.failure]
