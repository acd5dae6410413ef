"""Late samples: what a filter holds of the moment of capture, and which sample it may still use.

clone: at each capture the measured combinations of the states are cloned; a late sample is a
measurement of its clones, so it is used exactly. The delayed states of tie-vision (12)-(13), held
between the camera's triggers, are these clones: one algorithm under two names. The clones of frame
i lie in slot i mod frames. They are made in the step *after* the capture, as (12) has it, when
everything that is known at the captured tick has been used.
buffer: the window is told again from the capture on (`rewind`): exact for any clock. A sample that
is older than what a rule holds (clone, larsen: its frames; buffer, stored: `WINDOW` ticks) is
refused and counted; a sensor whose longest delay is that long is refused when the filter is built.
larsen: the covariance takes the sample at its capture, the states when it arrives (Larsen 1998);
exact where exactly one sample is under way and none is lost.
stored: its residual is taken against the prediction stored at the capture and used as if it were
fresh: uneven-delay (15)-(16). constant: the same, for an assumed delay instead of the stamp.
literal, lag: the model has late states that follow at every step, by one step (tie-vision (12) read
literally at 1 ms) or by a first-order lag of the delay. ignore: late samples are taken for fresh.
"""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.sensors.slow import GPS
from .covariance import clone_covariance, measure_state
from .memory import COUNTERS, SEEN, SLOW, WINDOW

RULES = ("clone", "ignore", "stored", "constant", "larsen", "buffer", "literal", "lag")
CLONE, IGNORE, STORED, CONSTANT, LARSEN, BUFFER = range(6)

DIRECT = -1
DROPPED = -2
HELD = -3


@jit
def direct() -> int:
    """DIRECT, as a number: a literal argument would have every callee compiled once more."""
    return DIRECT


@jit
def _clone(f: Any, s: int, slot: int) -> None:
    """Clone what sensor s captured at the last tick: tie-vision (12) at a trigger."""
    for i in range(f.rows[s]):
        clone = f.home[s] + slot * f.rows[s] + i
        row = f.row[s, i]
        value, error = 0.0, 0.0
        for k in range(f.n):
            value += row[k] * f.x[k]
            error += row[k] * f.e[k]
        f.x[clone] = value
        f.e[clone] = error
        if s == GPS:
            f.r_held[slot] = f.r_before
        if f.periodic == 0:
            clone_covariance(f, row, clone)


@jit
def _promise(f: Any, s: int) -> None:
    """Larsen's update at the capture: the covariance now, the states when the sample is here."""
    for i in range(f.rows[s]):
        row, value = f.row[s, i], 0.0
        for k in range(f.n):
            value += row[k] * f.x[k]
        f.promised[s, i] = value
        measure_state(f, row, f.r_before if s == GPS and i == 0 else f.r[s, i], 0.0)
        for j in range(i):
            keep_promise(f, s, j, row)
        for k in range(f.n):
            f.promise[s, i, k] = f.gain[k]


@jit
def keep_promise(f: Any, s: int, i: int, row: Any) -> None:
    """A measurement `row` with the gain f.gain came: promise <- (I - K C) promise."""
    along = 0.0
    for k in range(f.n):
        along += row[k] * f.promise[s, i, k]
    for k in range(f.n):
        f.promise[s, i, k] -= f.gain[k] * along


@jit
def keep_promises(f: Any, row: Any) -> None:
    """`keep_promise` for every sample under way."""
    for s in range(SLOW):
        if f.stamp[s, 0] >= 0:
            for i in range(f.rows[s]):
                keep_promise(f, s, i, row)


@jit
def latch_due(f: Any, last: int) -> None:
    """Latch every sensor that captured at the tick `last`, and set its clock on."""
    for s in range(SLOW):
        if f.period[s] > 0 and last >= f.next[s]:
            frame = (f.next[s] - f.phase[s]) // f.period[s]
            if f.frames[s] > 0 and last == f.next[s] and f.seen[s, frame % SEEN] != last:
                slot = frame % f.frames[s]
                if f.late == LARSEN:
                    _promise(f, s)
                else:
                    _clone(f, s, slot)
                f.stamp[s, slot] = last
            f.next[s] += f.period[s]


@jit
def known(f: Any, s: int, captured: int) -> bool:
    """Whether a sample of a sensor on its clock came before or is refused; it is counted."""
    frame = (captured - f.phase[s]) // f.period[s]
    if f.phase[s] + frame * f.period[s] != captured:
        f.counts[COUNTERS.unknown] += 1
        return True
    remembered = f.seen[s, frame % SEEN]
    if remembered == captured:
        f.counts[COUNTERS.duplicates] += 1
        return True
    if captured < remembered:
        f.counts[COUNTERS.refused] += 1
        return True
    return False


@jit
def find(f: Any, s: int, captured: int) -> Any:
    """The first clone that a sample measures, DIRECT for the states, HELD for what else is held of
    its capture, or DROPPED (and counted)."""
    if known(f, s, captured):
        return DROPPED
    frame = (captured - f.phase[s]) // f.period[s]
    if f.late == CONSTANT:
        f.seen[s, frame % SEEN] = captured
        return HELD
    if f.late == IGNORE or captured == f.tick:
        f.seen[s, frame % SEEN] = captured
        return DIRECT
    if f.late == STORED:
        if f.tick - captured < WINDOW:
            f.seen[s, frame % SEEN] = captured
            return HELD
    elif f.frames[s] > 0:
        slot = frame % f.frames[s]
        if f.stamp[s, slot] == captured:
            f.seen[s, frame % SEEN] = captured
            f.stamp[s, slot] = -1
            return HELD if f.late == LARSEN else f.home[s] + slot * f.rows[s]
    f.counts[COUNTERS.refused] += 1
    return DROPPED
