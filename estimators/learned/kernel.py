"""A correction at every tick, compiled: frames are gathered, and at each pace the network runs.

A car's memory is one vector: some numbers, sums of the fast columns since the last pace, a ring
of frames, and what the layers work on. Paces are counted from tick 0 of the episode, so that
the estimate of a tick is the same for every control period. A frame that is not finite is no
frame: the correction is dropped, and its history begins anew.
"""

from typing import Any, NamedTuple

import numpy as np

from ...envs.backend.decorators import copy_into, jit, noinline
from ...envs.backend.elementary import clip, exp
from ...envs.backend.primitives import maximum
from ...envs.record import FAST, PACKET
from ..core.run import advance, compute_deviation
from .files import FAST_INPUTS, LAGS, Correction

FRAME_TICKS = 10  # ticks
RING_FRAMES = max(LAGS) + 1  # frames
COLUMNS = tuple(getattr(FAST, name) for name in FAST_INPUTS)
MIN_LOG_DEVIATION = -8.0  # log of the least deviation, 0.02 degrees
MIN_SPEED = 1.0  # m/s, below which a_y / v is a_y

TICK, COUNT, FRAMES, SHIFT, DEVIATION, MASS, SLIP_RATE = range(7)
"""Places in a memory: of the last fast row, rows in the sums, frames since the history began, what
is added to beta (rad), the deviation of the sum (rad, 0: there is no correction), the filter's car
(kg), the sum of a_y / v - gyro (rad/s), behind which those of COLUMNS and the ring follow."""
HISTORY = SLIP_RATE + 1 + len(COLUMNS)


class CorrectionNet(NamedTuple):
    """A correction as compiled code takes it.

    Attributes:
        states: Places of the filter's states that are read, beta's among them.
        beta: Place of beta among the filter's states.
        mean: Mean of the inputs, shape (inputs,).
        scale: Scale of the inputs, shape (inputs,).
        clip: Bound of normalised inputs.
        sizes: Sizes of the layers, inputs first.
        numbers: Each layer's weights, (inputs, outputs) row by row, then its biases.
    """

    states: Any
    beta: int
    mean: Any
    scale: Any
    clip: float
    sizes: Any
    numbers: Any


_INTEGERS, _FLOATS = np.zeros(1, np.int64), np.zeros(1)
EXAMPLE = CorrectionNet(_INTEGERS, 0, _FLOATS, _FLOATS, 1.0, _INTEGERS, _FLOATS)
"""For `entry`: all nets have these types."""


def make_net(correction: Correction, states: tuple[str, ...]) -> CorrectionNet:
    """Make the net for a filter.

    Args:
        correction: Network and card.
        states: Names of the filter's states, all of the card's among them.

    Returns:
        The net.
    """
    network = correction.network
    layers = zip(network.weights, network.biases, strict=True)
    return CorrectionNet(
        np.array([states.index(name) for name in correction.card.states], np.int64),
        states.index("beta"),
        np.array(network.mean),
        np.array(network.scale),
        float(network.clip or 0.0),
        np.array([network.inputs, *(len(b) for b in network.biases)], np.int64),
        np.concatenate([part for W, b in layers for part in (W.T.ravel(), b)]),
    )


@jit
def locate_stack(net: Any) -> Any:
    """Locate the stack of frames, which is the network's input, in a memory.

    Args:
        net: `CorrectionNet`.

    Returns:
        Index of its first number.
    """
    return HISTORY + net.sizes[0] // len(LAGS) * RING_FRAMES


def compute_memory_size(net: CorrectionNet, states: int) -> int:
    """Compute the size of a car's memory, in whole cache lines.

    Args:
        net: The net.
        states: Number of the filter's states; states + 1 of its numbers stand at the end.

    Returns:
        Number of numbers.
    """
    return (int(locate_stack(net) + net.sizes.sum()) + states + 8) // 8 * 8


@jit
def reset_memory(m: Any, first: int) -> None:
    """Reset a memory; the car's mass stays.

    Args:
        m: Memory of the correction, shape (memory_size,).
        first: Tick of the first fast row.
    """
    for i in range(len(m)):
        m[i] *= 1.0 if i == MASS else 0.0
    m[TICK] = first - 1.0


@jit
def _gather(m: Any, row: Any) -> None:
    """Add a fast row to the sums of this pace."""
    m[TICK] += 1.0
    m[COUNT] += 1.0
    for i in range(len(COLUMNS)):
        m[SLIP_RATE + 1 + i] += row[COLUMNS[i]]
    v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
    m[SLIP_RATE] += row[FAST.accel_y] / maximum(v, MIN_SPEED) - row[FAST.gyro]


@jit
def _write_frame(f: Any, gains: Any, m: Any, net: Any, offset: int) -> int:
    """Write the frame of this pace at a place; return how many of its numbers are not finite."""
    k, n = len(COLUMNS) + 1, len(net.states)
    for i in range(k):  # the slip rate stands before the columns
        m[offset + i] = m[SLIP_RATE + i] / m[COUNT]
        m[SLIP_RATE + i] = 0.0
    for i in range(n):
        m[offset + k + i] = f.x[net.states[i]]
    m[offset + k + n], m[offset + k + n + 1] = compute_deviation(f, gains, net.beta), m[MASS]
    m[COUNT], n_invalid = 0.0, 0
    for i in range(k + n + 2):
        n_invalid += 0 if m[offset + i] - m[offset + i] == 0.0 else 1
    return n_invalid


@jit
def _run_layers(m: Any, net: Any, offset: int) -> int:
    """Run the network on the stack at a place, which it normalises; return the outputs' place."""
    inputs, weight_offset = net.sizes[0], 0
    for i in range(inputs):
        m[offset + i] = clip((m[offset + i] - net.mean[i]) * net.scale[i], 0.0 - net.clip, net.clip)
    for layer in range(len(net.sizes) - 1):
        outputs = net.sizes[layer + 1]
        z, sums = m[offset : offset + inputs], m[offset + inputs : offset + inputs + outputs]
        copy_into(net.numbers[weight_offset + inputs * outputs :][:outputs], sums)
        for i in range(0, inputs, 4):  # four at once: sums are loaded and stored less often
            a, b, c, d = z[i], z[i + 1], z[i + 2], z[i + 3]
            if layer > 0:
                a, b, c, d = maximum(a, 0.0), maximum(b, 0.0), maximum(c, 0.0), maximum(d, 0.0)
            first = net.numbers[weight_offset + i * outputs :]
            second, third, fourth = first[outputs:], first[2 * outputs :], first[3 * outputs :]
            for o in range(outputs):
                sums[o] = sums[o] + a * first[o] + b * second[o] + c * third[o] + d * fourth[o]
        weight_offset, offset, inputs = (
            weight_offset + (inputs + 1) * outputs,
            offset + inputs,
            outputs,
        )
    return offset


@jit
def _update_correction(f: Any, gains: Any, m: Any, net: Any) -> None:
    """Update the correction at this pace."""
    width, stack, newest = net.sizes[0] // len(LAGS), locate_stack(net), int(m[FRAMES])
    if _write_frame(f, gains, m, net, HISTORY + width * (newest % RING_FRAMES)) > 0:
        m[FRAMES], m[SHIFT], m[DEVIATION] = 0.0, 0.0, 0.0
        return
    m[FRAMES] += 1.0
    for lag in range(len(LAGS)):  # before the first frame there were more like it
        source = HISTORY + width * (maximum(newest - LAGS[lag], 0) % RING_FRAMES)
        copy_into(m[source : source + width], m[stack + lag * width :])
    out = _run_layers(m, net, stack)
    m[SHIFT] = m[out]
    m[DEVIATION] = exp(clip(m[out + 1], MIN_LOG_DEVIATION, 0.0))


@noinline
def filter_and_correct(
    filters: Any, gains: Any, fast: Any, rows: int, packets: Any, count: int, m: Any, net: Any
) -> None:
    """Advance a filter whose gains follow P, pace by pace, and update its correction.

    Args:
        filters: Memory of the filter, dtype `FILTER`, shape (layers,).
        gains: Tables of gains, shape (cells, rows, columns).
        fast: Fast rows, shape (rows or more, FAST_WIDTH).
        rows: Number of fast rows to take.
        packets: Packets, shape (count or more, PACKET_WIDTH).
        count: Number of packets to take.
        m: Memory of the correction, shape (memory_size,).
        net: `CorrectionNet`.
    """
    start, first_packet, empty, last = 0, 0, fast[:0], m[TICK] + rows
    for j in range(rows):
        _gather(m, fast[j])
        is_due, is_last, end = int(m[TICK]) % FRAME_TICKS == 0, j == rows - 1, first_packet
        if is_due or is_last:
            while end < count and (is_last or not m[TICK] < packets[end, PACKET.arrived] <= last):
                end += 1
            fast_rows, due_packets, n_due = (
                fast[start : j + 1],
                packets[first_packet:end],
                end - first_packet,
            )
            advance(
                filters,
                gains,
                fast_rows,
                len(fast_rows),
                due_packets,
                n_due,
                0,
                empty,
                empty,
                m[:0],
            )
            start, first_packet = j + 1, end
        if is_due:
            _update_correction(filters[0], gains, m, net)
    if rows == 0:
        advance(filters, gains, fast, 0, packets, count, 0, empty, empty, m[:0])


@jit
def apply_correction(f: Any, m: Any, net: Any) -> None:
    """Add the correction to a filter's record, whose own numbers go to the memory's end.

    How the sum's error depends on those of the other states is not known: covariances are zero.

    Args:
        f: Memory of the filter.
        m: Memory of the correction, shape (memory_size,).
        net: `CorrectionNet`.
    """
    b, n, row = net.beta, f.n, m[len(m) - f.n - 1 :]
    copy_into(f.P[b, :n], row)
    row[n] = f.x[b]
    if m[DEVIATION] > 0.0:
        f.x[b] += m[SHIFT]
        for i in range(n):
            f.P[b, i], f.P[i, b] = 0.0, 0.0
        f.P[b, b] = m[DEVIATION] * m[DEVIATION]


@jit
def remove_correction(f: Any, m: Any, net: Any) -> None:
    """Restore a filter's own numbers in its record.

    Args:
        f: Memory of the filter.
        m: Memory of the correction, shape (memory_size,).
        net: `CorrectionNet`.
    """
    b, n, row = net.beta, f.n, m[len(m) - f.n - 1 :]
    copy_into(row[:n], f.P[b])
    copy_into(row[:n], f.P[:, b])
    f.x[b] = row[n]
