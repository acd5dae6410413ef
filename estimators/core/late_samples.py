"""Late samples: what each rule does at a capture, with each step, at the arrival, and to the past.

In this room `packets` besides filters the past anew for "buffer", and `update` takes what was
WEIGHED. `design.assemble` allocates what a rule stores; `vector.batch` lists those that lanes have.
"""

from typing import NamedTuple

from ...envs.numerics.jit import inline, jit
from ...envs.numerics.primitives import Scalar, Vector, maximum
from ...envs.record import PACKET
from .covariance import (
    apply_transition,
    correct_scalar,
    dot,
    has_covariance,
    predict_measurement,
    project,
)
from .memory import COUNTERS, N_SLOW, N_SNAPSHOTS, N_STAMPS, WINDOW, FilterMemory
from .model import PSI, compute_row_variance

# what a sample measures, where it is no clone (its place, positive)
DIRECT = -1  # the states as they are
DROPPED = -2  # nothing: it is not used
PREDICTED = -3  # the states as they were predicted for its capture
ASSUMED = -4  # the same, for the capture that `assumed` supposes
WEIGHED = -5  # what the covariance has taken already; LARSEN


class DelayRule(NamedTuple):
    """What a rule does with samples; frames that it stores come before `late`."""

    late: int = DROPPED  # what a sample measures that was captured before this tick
    fresh: int = DIRECT  # what one of this tick does
    max_age: int = 1 << 62  # ticks from which one is refused; beyond any drive: none is
    snapshots: int = 0  # states of the past, which is redone


RULES = {
    "clone": DelayRule(),
    "ignore": DelayRule(DIRECT),
    "stored": DelayRule(PREDICTED, max_age=WINDOW),
    "constant": DelayRule(ASSUMED, ASSUMED),
    "larsen": DelayRule(),
    "buffer": DelayRule(snapshots=N_SNAPSHOTS + 1),
    "literal": DelayRule(DIRECT),
    "lag": DelayRule(DIRECT),
}
"""Rules for late samples; what is older than a rule stores is refused and counted.

clone: what is measured is cloned in the step after each capture, so a late sample measures its
clones, exactly (tie-vision (12)-(13)); frame i is in slot i mod frames. ignore: taken for fresh.
stored: the residual against the prediction at the capture is used as if it were fresh, uneven-delay
(15)-(16). constant: the same, for an assumed delay. larsen: the covariance takes it at its capture,
the states when it arrives (Larsen 1998), exact for one under way and none lost. buffer: the window
is filtered anew (`packets`), exact. literal, lag: late states follow by one step or a lag."""
# codes of the field `delay_rule`, places in RULES; the last two are IGNORE with late states
CLONE, IGNORE, STORED, CONSTANT, LARSEN, BUFFER = range(6)

_LATE, _FRESH, _MAX_AGE, _SNAPSHOTS = zip(*RULES.values(), strict=True)  # by code


@jit
def get_direct() -> int:
    """Return DIRECT as a number: a literal argument would have every callee compiled once more."""
    return DIRECT


@jit
def _is_weighed_at_capture(f: FilterMemory) -> Scalar:
    """Return whether the covariance takes a sample when it is captured, by Larsen's rule."""
    return f.delay_rule == LARSEN


@jit
def _clone_states(f: FilterMemory, s: int, slot: int) -> None:
    """Clone what sensor s captured at the last tick: tie-vision (12) at a trigger."""
    f.speed_captured[s, slot] = f.speed_before
    for i in range(f.rows[s]):
        clone = f.first_clone[s] + slot * f.rows[s] + i
        row = f.C[s, i]
        f.x[clone] = predict_measurement(f, s, i)
        f.e[clone] = dot(row, f.e, f.n)
        if has_covariance(f):
            variance = project(f, row)
            for j in range(f.total):
                f.P[clone, j] = f.PC[j]
                f.P[j, clone] = f.PC[j]
            f.P[clone, clone] = variance


@jit
def _update_covariance(f: FilterMemory, s: int) -> None:
    """Update the covariance at the capture by Larsen's rule; the states follow at the arrival."""
    for i in range(f.rows[s]):
        row = f.C[s, i]
        f.larsen_expected[s, i] = predict_measurement(f, s, i)
        r = compute_row_variance(f, s, i, f.speed_before)
        correct_scalar(f, project(f, row) + r, 0.0)
        for j in range(i):
            _correct_larsen_gain(f, s, j, row)
        for k in range(f.n):
            f.larsen_gain[s, i, k] = f.gain[k]


@jit
def _correct_larsen_gain(f: FilterMemory, s: int, i: int, row: Vector) -> None:
    """Correct Larsen's M_k K_s of row i for a measurement `row` (n,) with the gain f.gain."""
    projected = dot(row, f.larsen_gain[s, i], f.n)
    for k in range(f.n):
        f.larsen_gain[s, i, k] -= f.gain[k] * projected


@jit
def store_due_captures(f: FilterMemory, last: int) -> None:
    """Store what the sensors that captured at this tick measured, and advance their clocks."""
    for s in range(N_SLOW):
        if f.period[s] > 0 and last >= f.next[s]:
            frame = (f.next[s] - f.phase[s]) // f.period[s]
            is_unknown = f.known_stamps[s, frame % N_STAMPS] != last
            if f.frames[s] > 0 and last == f.next[s] and is_unknown:
                slot = frame % f.frames[s]
                if _is_weighed_at_capture(f):
                    _update_covariance(f, s)
                else:
                    _clone_states(f, s, slot)
                f.stamp[s, slot] = last
            f.next[s] += f.period[s]


@inline
def predict_late(f: FilterMemory) -> None:
    """Predict Larsen's M_k K_s of every sample under way by a step."""
    if _is_weighed_at_capture(f):
        for s in range(N_SLOW):
            if f.stamp[s, 0] >= 0:
                for i in range(f.rows[s]):
                    apply_transition(f, f.larsen_gain[s, i])


@inline
def correct_late(f: FilterMemory, row: Vector) -> None:
    """Correct Larsen's M_k K_s of every sample under way for a measurement."""
    if _is_weighed_at_capture(f):
        for s in range(N_SLOW):
            if f.stamp[s, 0] >= 0:
                for i in range(f.rows[s]):
                    _correct_larsen_gain(f, s, i, row)


@jit
def is_duplicate(f: FilterMemory, s: int, captured: int) -> bool:
    """Return whether a sample of a sensor on its clock must not be used; then it is counted."""
    frame = (captured - f.phase[s]) // f.period[s]
    last_stamp = f.known_stamps[s, frame % N_STAMPS]
    if f.phase[s] + frame * f.period[s] != captured:
        f.counts[COUNTERS.unknown] += 1
    elif last_stamp == captured:
        f.counts[COUNTERS.duplicates] += 1
    elif captured < last_stamp:
        f.counts[COUNTERS.refused] += 1
    else:
        return False
    return True


@jit
def find_target(f: FilterMemory, s: int, captured: int) -> int:
    """Find what an arrived sample measures: its first clone, or a code; it counts as taken"""
    if is_duplicate(f, s, captured):
        return DROPPED
    frame = (captured - f.phase[s]) // f.period[s]
    target: int = _LATE[f.delay_rule] if captured < f.tick else _FRESH[f.delay_rule]
    if f.tick - captured >= _MAX_AGE[f.delay_rule]:
        target = DROPPED
    elif captured < f.tick and f.frames[s] > 0 and f.stamp[s, frame % f.frames[s]] == captured:
        slot = frame % f.frames[s]
        f.stamp[s, slot] = -1
        target = f.first_clone[s] + slot * f.rows[s]  # of LARSEN's one frame, WEIGHED
    if target == DROPPED:
        f.counts[COUNTERS.refused] += 1
    else:
        f.known_stamps[s, frame % N_STAMPS] = captured
    return target


@jit
def predict_sample(f: FilterMemory, s: int, i: int, target: int) -> Scalar:
    """Predict row i of the sample in f.sample."""
    if target == WEIGHED:
        return f.larsen_expected[s, i]
    if target in (PREDICTED, ASSUMED):
        captured = int(f.sample[PACKET.captured])
        stored = maximum(f.tick - f.assumed, f.start) if target == ASSUMED else captured
        stored_prediction = dot(f.C[s, i], f.predicted[stored % WINDOW], f.n)  # uneven-delay (15)
        turn = f.past_road_turn[stored % WINDOW]
        return stored_prediction + turn if f.ground[s, i] == 1 else stored_prediction
    if target >= 0:
        return f.x[target + i]
    return predict_measurement(f, s, i)


@jit
def turn_heading(f: FilterMemory, s: int, turn: float) -> None:
    """Turn the heading, the first row of sensor s, now and in what is stored of it."""
    f.x[PSI] += turn
    f.expected[0] += turn
    if f.first_clone[s] > 0:
        for slot in range(f.frames[s]):
            f.x[f.first_clone[s] + slot * f.rows[s]] += turn
    f.larsen_expected[s, 0] += turn
    for i in range(_SNAPSHOTS[f.delay_rule]):
        f.snapshot_x[i, PSI] += turn


@jit
def inflate_covariance(f: FilterMemory, state: int, variance: Scalar) -> None:
    """Add a variance to a state's, now and in what is stored of it."""
    v = f.PC
    for i in range(f.total):
        v[i] = 0.0
    v[state] = 1.0
    for s in range(N_SLOW):
        if f.first_clone[s] > 0:
            for k in range(f.frames[s] * f.rows[s]):
                v[f.first_clone[s] + k] = f.C[s, k % f.rows[s], state]
    for i in range(f.total):
        for j in range(f.total):
            f.P[i, j] += variance * (v[i] * v[j])
    for i in range(_SNAPSHOTS[f.delay_rule]):
        f.snapshot_P[i, state, state] += variance
