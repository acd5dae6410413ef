"""Late samples: what a filter stores of the moment of capture, and which sample it may still use.

clone: at each capture the measured combinations of the states are cloned; a late sample is a
measurement of its clones, so it is used exactly. The delayed states of tie-vision (12)-(13), held
between the camera's triggers, are these clones: one algorithm under two names. The clones of frame
i lie in slot i mod frames. They are made in the step *after* the capture, as (12) has it, when
everything that is known at the captured tick has been used.
buffer: the window is filtered anew from the capture on (`rewind`): exact for any clock. A sample
that is older than what a rule stores (clone, larsen: its frames; buffer, stored: `WINDOW` ticks) is
refused and counted; a sensor whose longest delay is that long is refused when the filter is built.
larsen: the covariance takes the sample at its capture, the states when it arrives (Larsen 1998);
exact where exactly one sample is under way and none is lost.
stored: its residual is taken against the prediction stored at the capture and used as if it were
fresh: uneven-delay (15)-(16). constant: the same, for an assumed delay instead of the stamp.
literal, lag: the model has late states that follow at every step, by one step (tie-vision (12) read
literally at 1 ms) or by a first-order lag of the delay. ignore: late samples are taken for fresh.
"""

from ...envs.backend.decorators import jit
from .covariance import clone_covariance, dot, expected, measure_state
from .memory import COUNTERS, SEEN, SLOW, WINDOW, Memory, Row
from .transition import variance

RULES = ("clone", "ignore", "stored", "constant", "larsen", "buffer", "literal", "lag")
CLONE, IGNORE, STORED, CONSTANT, LARSEN, BUFFER = range(6)
"""Codes of the field `late`."""

DIRECT = -1  # a sample measures the states as they are
DROPPED = -2
STORED_ONE = -3  # it is compared with what was stored at its capture


@jit
def direct() -> int:
    """DIRECT, as a number: a literal argument would have every callee compiled once more."""
    return DIRECT


@jit
def _clone(f: Memory, s: int, slot: int) -> None:
    """Clone what sensor s captured at the last tick: tie-vision (12) at a trigger."""
    f.speed_captured[s, slot] = f.speed_before
    for i in range(f.rows[s]):
        clone = f.first_clone[s] + slot * f.rows[s] + i
        row = f.C[s, i]
        f.x[clone] = expected(f, s, i)
        f.e[clone] = dot(row, f.e, f.n)
        if f.periodic == 0:
            clone_covariance(f, row, clone)


@jit
def _take_covariance(f: Memory, s: int) -> None:
    """Larsen's update at the capture: the covariance now, the states when the sample is here."""
    for i in range(f.rows[s]):
        row = f.C[s, i]
        f.larsen_expected[s, i] = expected(f, s, i)
        measure_state(f, row, variance(f, s, i, f.speed_before), 0.0)
        for j in range(i):
            _carry_gain(f, s, j, row)
        for k in range(f.n):
            f.larsen_gain[s, i, k] = f.gain[k]


@jit
def _carry_gain(f: Memory, s: int, i: int, row: Row) -> None:
    """Larsen's M_k K_s of row i after a measurement `row` (n,) with the gain f.gain."""
    along = dot(row, f.larsen_gain[s, i], f.n)
    for k in range(f.n):
        f.larsen_gain[s, i, k] -= f.gain[k] * along


@jit
def carry_gains(f: Memory, row: Row) -> None:
    """`_carry_gain` of every sample under way, past a measurement `row` (n,)."""
    for s in range(SLOW):
        if f.stamp[s, 0] >= 0:
            for i in range(f.rows[s]):
                _carry_gain(f, s, i, row)


@jit
def latch_due(f: Memory, last: int) -> None:
    """Store what every sensor measured that captured at the tick `last`; set its clock on."""
    for s in range(SLOW):
        if f.period[s] > 0 and last >= f.next[s]:
            frame = (f.next[s] - f.phase[s]) // f.period[s]
            if f.frames[s] > 0 and last == f.next[s] and f.seen[s, frame % SEEN] != last:
                slot = frame % f.frames[s]
                if f.late == LARSEN:
                    _take_covariance(f, s)
                else:
                    _clone(f, s, slot)
                f.stamp[s, slot] = last
            f.next[s] += f.period[s]


@jit
def known(f: Memory, s: int, captured: int) -> bool:
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
def find(f: Memory, s: int, captured: int) -> int:
    """The first clone that a sample measures, DIRECT for the states, STORED_ONE for what else was
    stored at its capture, or DROPPED (and counted)."""
    if known(f, s, captured):
        return DROPPED
    frame = (captured - f.phase[s]) // f.period[s]
    found = DROPPED
    if f.late == CONSTANT:
        found = STORED_ONE
    elif f.late == IGNORE or captured == f.tick:
        found = DIRECT
    elif f.late == STORED and f.tick - captured < WINDOW:
        found = STORED_ONE
    elif f.frames[s] > 0 and f.stamp[s, frame % f.frames[s]] == captured:
        slot = frame % f.frames[s]
        f.stamp[s, slot] = -1
        found = STORED_ONE if f.late == LARSEN else f.first_clone[s] + slot * f.rows[s]
    if found == DROPPED:
        f.counts[COUNTERS.refused] += 1
    else:
        f.seen[s, frame % SEEN] = captured
    return found
