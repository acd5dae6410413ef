"""The float32 observation of a step, and what `info` reads of the state; compiled."""

from typing import Any

from ..backend.decorators import jit
from ..backend.elementary import clip
from ..backend.primitives import select
from ..record import FAST, PACKET
from ..sensors.slow import WIDTHS
from ..task.info import REPORT
from ..task.observation import AGE_CAP, SAMPLED
from ..ticks import NEVER, TICK
from .layout import FLAGS, P, Z


@jit
def observe(row: Any, n: int, count: int, refs: Any, bounds: Any) -> None:
    """Write the float32 observation of a record of n ticks and `count` packets, every entry
    clipped at its bounds (2, k); entries as in `observation_layout`."""
    p, z, obs, rows, packets = row.p, row.z, row.obs, row.rows, row.packets
    k = 0
    for column in range(SAMPLED):
        if row.switches[FLAGS.all_samples]:
            for j in range(n):
                obs[k] = clip(rows[j, column], bounds[0, k], bounds[1, k])
                k += 1
        else:
            total = 0.0
            for j in range(n):
                total = total + rows[j, column]
            obs[k] = clip(rows[n - 1, column], bounds[0, k], bounds[1, k])
            obs[k + 1] = clip(total / n, bounds[0, k + 1], bounds[1, k + 1])
            k += 2
    for i in range(4):
        obs[k] = clip(rows[n - 1, FAST.steer + i], bounds[0, k], bounds[1, k])
        k += 1
    tick = z[Z.clock.tick]
    for sensor in range(len(Z.slow)):
        at = Z.slow[sensor]
        if p[P.slow[sensor].period] > 0.0:
            for i in range(WIDTHS[sensor]):
                obs[k] = clip(z[at.values[0] + i], bounds[0, k], bounds[1, k])
                k += 1
            age = (tick - z[at.captured]) * TICK
            obs[k] = clip(select(z[at.captured] != NEVER, age, AGE_CAP), 0.0, AGE_CAP)
            fresh = 0.0
            for i in range(count):
                newest = packets[i, PACKET.arrived] == z[at.arrived]  # not late, no duplicate
                if packets[i, PACKET.sensor] == sensor and newest:
                    fresh = 1.0
            obs[k + 1] = fresh
            k += 2
    obs[k] = clip(refs[0], bounds[0, k], bounds[1, k])
    obs[k + 1] = clip(refs[1], bounds[0, k + 1], bounds[1, k + 1])


@jit
def write_report(report: Any, z: Any) -> None:
    """Write what `info` reads of the state; cost and references are the caller's."""
    report[REPORT.t] = z[Z.clock.tick] * TICK
    report[REPORT.gamma] = z[Z.motion.gamma]
    report[REPORT.psi] = z[Z.motion.psi]
    report[REPORT.failure] = z[Z.clock.failure]
