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
from .covariance import clone_covariance, dot, predict_measurement, update_with_states
from .memory import COUNTERS, N_SLOW, N_STAMPS, WINDOW, FilterRecord, Vector
from .transition import compute_row_variance

RULES = ("clone", "ignore", "stored", "constant", "larsen", "buffer", "literal", "lag")
CLONE, IGNORE, STORED, CONSTANT, LARSEN, BUFFER = range(6)
"""Codes of the field `late`."""

DIRECT = -1  # a sample measures the states as they are
DROPPED = -2
STORED_ONE = -3  # it is compared with what was stored at its capture


@jit
def get_direct() -> int:
    """Return DIRECT as a number: a literal argument would have every callee compiled once more."""
    return DIRECT


@jit
def _clone_states(f: FilterRecord, s: int, slot: int) -> None:
    """Clone what sensor s captured at the last tick: tie-vision (12) at a trigger."""
    f.speed_captured[s, slot] = f.speed_before
    for i in range(f.rows[s]):
        clone = f.first_clone[s] + slot * f.rows[s] + i
        row = f.C[s, i]
        f.x[clone] = predict_measurement(f, s, i)
        f.e[clone] = dot(row, f.e, f.n)
        if f.periodic == 0:
            clone_covariance(f, row, clone)


@jit
def _update_covariance(f: FilterRecord, s: int) -> None:
    """Update the covariance at the capture by Larsen's rule; the states follow at the arrival."""
    for i in range(f.rows[s]):
        row = f.C[s, i]
        f.larsen_expected[s, i] = predict_measurement(f, s, i)
        update_with_states(f, row, compute_row_variance(f, s, i, f.speed_before), 0.0)
        for j in range(i):
            _propagate_gain(f, s, j, row)
        for k in range(f.n):
            f.larsen_gain[s, i, k] = f.gain[k]


@jit
def _propagate_gain(f: FilterRecord, s: int, i: int, row: Vector) -> None:
    """Propagate Larsen's M_k K_s of row i past a measurement `row` (n,) with the gain f.gain."""
    projected = dot(row, f.larsen_gain[s, i], f.n)
    for k in range(f.n):
        f.larsen_gain[s, i, k] -= f.gain[k] * projected


@jit
def propagate_larsen_gains(f: FilterRecord, row: Vector) -> None:
    """Propagate Larsen's M_k K_s of every sample under way past a measurement.

    Args:
        f: Memory of the filter with its gain.
        row: Row of C of that measurement, shape (n,).
    """
    for s in range(N_SLOW):
        if f.stamp[s, 0] >= 0:
            for i in range(f.rows[s]):
                _propagate_gain(f, s, i, row)


@jit
def store_due_captures(f: FilterRecord, last: int) -> None:
    """Store what every sensor measured that captured at a tick, and advance its clock.

    Args:
        f: Memory of the filter.
        last: The last tick.
    """
    for s in range(N_SLOW):
        if f.period[s] > 0 and last >= f.next[s]:
            frame = (f.next[s] - f.phase[s]) // f.period[s]
            if (
                f.frames[s] > 0
                and last == f.next[s]
                and f.known_stamps[s, frame % N_STAMPS] != last
            ):
                slot = frame % f.frames[s]
                if f.late == LARSEN:
                    _update_covariance(f, s)
                else:
                    _clone_states(f, s, slot)
                f.stamp[s, slot] = last
            f.next[s] += f.period[s]


@jit
def is_duplicate(f: FilterRecord, s: int, captured: int) -> bool:
    """Return whether a sample of a sensor on its clock came before or is refused; it is counted.

    Args:
        f: Memory of the filter.
        s: Index of the slow sensor.
        captured: Captured tick of the sample.

    Returns:
        True for a sample that must not be used.
    """
    frame = (captured - f.phase[s]) // f.period[s]
    if f.phase[s] + frame * f.period[s] != captured:
        f.counts[COUNTERS.unknown] += 1
        return True
    last_stamp = f.known_stamps[s, frame % N_STAMPS]
    if last_stamp == captured:
        f.counts[COUNTERS.duplicates] += 1
        return True
    if captured < last_stamp:
        f.counts[COUNTERS.refused] += 1
        return True
    return False


@jit
def find_clone(f: FilterRecord, s: int, captured: int) -> int:
    """Find what a sample measures.

    Args:
        f: Memory of the filter.
        s: Index of the slow sensor.
        captured: Captured tick of the sample.

    Returns:
        Index of its first clone, DIRECT for the states, STORED_ONE for what else was stored at its
        capture, or DROPPED (and counted).
    """
    if is_duplicate(f, s, captured):
        return DROPPED
    frame = (captured - f.phase[s]) // f.period[s]
    target = DROPPED
    if f.late == CONSTANT:
        target = STORED_ONE
    elif f.late == IGNORE or captured == f.tick:
        target = DIRECT
    elif f.late == STORED and f.tick - captured < WINDOW:
        target = STORED_ONE
    elif f.frames[s] > 0 and f.stamp[s, frame % f.frames[s]] == captured:
        slot = frame % f.frames[s]
        f.stamp[s, slot] = -1
        target = STORED_ONE if f.late == LARSEN else f.first_clone[s] + slot * f.rows[s]
    if target == DROPPED:
        f.counts[COUNTERS.refused] += 1
    else:
        f.known_stamps[s, frame % N_STAMPS] = captured
    return target
