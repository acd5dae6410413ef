"""Late samples: clones of what a slow sensor captured, held until the sample arrives.

At each capture the measured combinations of the states are cloned; a late sample is a measurement
of its clones, so it is used exactly. The delayed states of tie-vision (12)-(13), held between the
camera's triggers, are these clones: one algorithm under two names. The clones of frame i lie in
slot i mod frames. They are made in the step *after* the capture, as (12) has it, when everything
that is known at the captured tick has been used.

The rule "ignore" takes late samples for fresh ones and needs no clones.
"""

import math
from typing import Any

from ..envs.backend import jit
from ..envs.record import SLOW_NAMES, SlowSensor
from .covariance import clone_covariance
from .memory import CORE, COUNTERS, FRAMES, SEEN, SLOW

RULES = ("clone", "ignore")

DIRECT = -1
DROPPED = -2


def frames_held(sensor: SlowSensor, rule: str) -> int:
    """Frames whose clones must be held at once for the sensor's longest delay."""
    if rule == "ignore":
        return 0
    return math.ceil(sensor.longest_delay / sensor.period - 1e-9)


def place_clones(f: Any, sensors: dict[str, SlowSensor], rule: str, who: str) -> None:
    """Lay the clones of every sensor behind the states; ValueError if there are too many."""
    f.ignore = int(rule == "ignore")
    f.total = f.n
    for name, sensor in sensors.items():
        s, frames = SLOW_NAMES.index(name), frames_held(sensor, rule)
        if frames > FRAMES:
            raise ValueError(
                f"{who}: the {name} can be {sensor.longest_delay:g} s late, {frames} of its periods"
                f" of {sensor.period:g} s; at most {FRAMES} frames can be held"
            )
        f.frames[s], f.home[s] = frames, f.total
        f.total += frames * f.rows[s]
    assert f.n <= CORE


@jit
def latch(f: Any, s: int) -> None:
    """Clone what sensor s captured at the last tick: tie-vision (12) at a trigger."""
    captured = f.next[s]
    slot = ((captured - f.phase[s]) // f.period[s]) % f.frames[s]
    n = f.n
    for i in range(f.rows[s]):
        clone = f.home[s] + slot * f.rows[s] + i
        row = f.row[s, i]
        value, error = 0.0, 0.0
        for k in range(n):
            value += row[k] * f.x[k]
            error += row[k] * f.e[k]
        f.x[clone] = value
        f.e[clone] = error
        if f.periodic == 0:
            clone_covariance(f, row, clone)
    f.stamp[s, slot] = captured


@jit
def latch_due(f: Any, last: int) -> None:
    """Latch every sensor that captured at the tick `last`, and set its clock on."""
    for s in range(SLOW):
        if f.period[s] > 0 and last >= f.next[s]:
            if f.frames[s] > 0 and last == f.next[s]:
                latch(f, s)
            f.next[s] += f.period[s]


@jit
def find(f: Any, s: int, captured: int) -> Any:
    """The first clone that a sample measures, DIRECT for the states, or DROPPED (and counted)."""
    frame = (captured - f.phase[s]) // f.period[s]
    if captured > f.tick:
        f.counts[COUNTERS.future] += 1
        return DROPPED
    if f.phase[s] + frame * f.period[s] != captured:
        f.counts[COUNTERS.unknown] += 1
        return DROPPED
    remembered = f.seen[s, frame % SEEN]
    if remembered == captured:
        f.counts[COUNTERS.duplicates] += 1
        return DROPPED
    if captured < f.start or captured < remembered:
        f.counts[COUNTERS.refused] += 1
        return DROPPED
    f.seen[s, frame % SEEN] = captured
    if f.ignore == 1 or captured == f.tick:
        return DIRECT
    if f.frames[s] > 0:
        slot = frame % f.frames[s]
        if f.stamp[s, slot] == captured:
            f.stamp[s, slot] = -1
            return f.home[s] + slot * f.rows[s]
    f.counts[COUNTERS.refused] += 1
    return DROPPED
