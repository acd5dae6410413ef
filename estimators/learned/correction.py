"""The learned estimator: a filter, and a network that corrects its sideslip angle at each pace.

A car's memory is one vector: some numbers, sums of the fast columns since the last pace, a ring
of frames, and what the layers work on. Paces are counted from tick 0 of the episode, so that the
estimate of a tick is the same for every control period. A frame that is not finite drops the
correction, whose history begins anew.
"""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics.functions import clip, exp
from ...envs.numerics.jit import copy_into, jit, noinline
from ...envs.numerics.primitives import Matrix, Scalar, Vector, maximum
from ...envs.record import FAST, PACKET, PACKET_WIDTH, Array
from ...envs.sensors.link import SlowSensor
from ...envs.ticks import TICK
from ...envs.vehicle.parameters import Vehicle
from ..core.filter import advance, compute_deviation
from ..core.record import FILTER, FilterRecord, GainTables
from ..estimator import Estimator, compile_call
from ..make import make_estimator
from .correction_file import FAST_INPUTS, LAGS, Correction, load_correction

FRAME_TICKS = 10  # ticks
RING_FRAMES = max(LAGS) + 1  # frames
COLUMNS = tuple(getattr(FAST, name) for name in FAST_INPUTS)
MIN_LOG_DEVIATION = -8.0  # log of the least deviation, 0.02 degrees
MIN_SPEED = 1.0  # m/s, below which a_y / v is a_y

TICK_PLACE, COUNT, FRAMES, SHIFT, DEVIATION, MASS, SLIP_RATE = range(7)
"""Places in a memory: of the last fast row, rows in the sums, frames since the history began, what
is added to beta (rad), the deviation of the sum (rad, 0: there is no correction), the filter's car
(kg), the sum of a_y / v - gyro (rad/s), behind which those of COLUMNS and the ring follow."""
HISTORY = SLIP_RATE + 1 + len(COLUMNS)


class CorrectionNet(NamedTuple):
    """A correction as compiled code takes it."""

    states: npt.NDArray[np.int64]  # places of the states that are read, beta's among them
    beta: int  # place of beta among the filter's states
    mean: Array  # of the inputs, shape (inputs,)
    scale: Array  # of the same shape
    clip: float  # bound of normalised inputs
    sizes: npt.NDArray[np.int64]  # of the layers, inputs first
    numbers: Array  # each layer's weights, (inputs, outputs) row by row, then its biases


_INTEGERS, _FLOATS = np.zeros(1, np.int64), np.zeros(1)
EXAMPLE = CorrectionNet(_INTEGERS, 0, _FLOATS, _FLOATS, 1.0, _INTEGERS, _FLOATS)
"""For `compile_call`: all nets have these types."""


def _make_net(correction: Correction, states: tuple[str, ...]) -> CorrectionNet:
    """Make the net for a filter's states by name, all of the card's among them."""
    net, read = correction.network.packed, [states.index(name) for name in correction.card.states]
    beta = states.index("beta")
    return CorrectionNet(
        np.array(read), beta, net.mean, net.scale, net.clip, net.sizes, net.numbers
    )


@jit
def locate_stack(net: CorrectionNet) -> Scalar:
    """Locate the stack of frames, which is the network's input, in a memory.

    Args:
        net: Network of the correction.

    Returns:
        Index of its first number.
    """
    return HISTORY + net.sizes[0] // len(LAGS) * RING_FRAMES


@jit
def _reset_memory(m: Vector, first: int) -> None:
    """Reset a memory to the tick before the first fast row; the car's mass stays."""
    for i in range(len(m)):
        m[i] *= 1.0 if i == MASS else 0.0
    m[TICK_PLACE] = first - 1.0


@jit
def _gather(m: Vector, row: Vector) -> None:
    """Add a fast row to the sums of this pace."""
    m[TICK_PLACE] += 1.0
    m[COUNT] += 1.0
    for i in range(len(COLUMNS)):
        m[SLIP_RATE + 1 + i] += row[COLUMNS[i]]
    v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
    m[SLIP_RATE] += row[FAST.accel_y] / maximum(v, MIN_SPEED) - row[FAST.gyro]


@jit
def _write_frame(
    f: FilterRecord, gains: GainTables, m: Vector, net: CorrectionNet, offset: int
) -> int:
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
def _run_layers(m: Vector, net: CorrectionNet, offset: int) -> int:
    """Run the network on the stack at a place, which it normalises; return the outputs' place."""
    inputs, at = net.sizes[0], 0
    for i in range(inputs):
        m[offset + i] = clip((m[offset + i] - net.mean[i]) * net.scale[i], 0.0 - net.clip, net.clip)
    for layer in range(len(net.sizes) - 1):
        outputs = net.sizes[layer + 1]
        z, sums = m[offset : offset + inputs], m[offset + inputs : offset + inputs + outputs]
        copy_into(net.numbers[at + inputs * outputs :][:outputs], sums)
        for i in range(0, inputs, 4):  # four at once: sums are loaded and stored less often
            a, b, c, d = z[i], z[i + 1], z[i + 2], z[i + 3]
            if layer > 0:
                a, b, c, d = maximum(a, 0.0), maximum(b, 0.0), maximum(c, 0.0), maximum(d, 0.0)
            first = net.numbers[at + i * outputs :]
            second, third, fourth = first[outputs:], first[2 * outputs :], first[3 * outputs :]
            for o in range(outputs):
                sums[o] = sums[o] + a * first[o] + b * second[o] + c * third[o] + d * fourth[o]
        at, offset, inputs = at + (inputs + 1) * outputs, offset + inputs, outputs
    return offset


@jit
def _update_correction(f: FilterRecord, gains: GainTables, m: Vector, net: CorrectionNet) -> None:
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
    filters: Vector,
    gains: Matrix,
    fast: Matrix,
    rows: int,
    packets: Matrix,
    count: int,
    m: Vector,
    net: CorrectionNet,
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
        net: Network of the correction.
    """
    start, first_packet, empty, last = 0, 0, fast[:0], m[TICK_PLACE] + rows
    for j in range(rows):
        _gather(m, fast[j])
        is_due, is_last, end = int(m[TICK_PLACE]) % FRAME_TICKS == 0, j == rows - 1, first_packet
        if is_due or is_last:
            while end < count and (
                is_last or not m[TICK_PLACE] < packets[end, PACKET.arrived] <= last
            ):
                end += 1
            chunk, due, n_due = fast[start : j + 1], packets[first_packet:end], end - first_packet
            advance(filters, gains, chunk, len(chunk), due, n_due, 0, empty, empty, m[:0])
            start, first_packet = j + 1, end
        if is_due:
            _update_correction(filters[0], gains, m, net)
    if rows == 0:
        advance(filters, gains, fast, 0, packets, count, 0, empty, empty, m[:0])


@jit
def apply_correction(f: FilterRecord, m: Vector, net: CorrectionNet) -> None:
    """Add the correction to a filter's record, whose own numbers go to the memory's end.

    How the sum's error depends on those of the other states is not known: covariances are zero.

    Args:
        f: Memory of the filter.
        m: Memory of the correction, shape (memory_size,).
        net: Network of the correction.
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
def remove_correction(f: FilterRecord, m: Vector, net: CorrectionNet) -> None:
    """Restore a filter's own numbers in its record.

    Args:
        f: Memory of the filter.
        m: Memory of the correction, shape (memory_size,).
        net: Network of the correction.
    """
    b, n, row = net.beta, f.n, m[len(m) - f.n - 1 :]
    copy_into(row[:n], f.P[b])
    copy_into(row[:n], f.P[:, b])
    f.x[b] = row[n]


class LearnedEstimator:
    """A filter whose beta and its deviation a network corrects, as an `EstimatorLike`.

    Every 10 ticks the network reads what the filter and the fast sensors gave in the last 0.4 s,
    its memory, and gives what is added to beta until the next time, and the standard deviation of
    the sum; the other states are the filter's. Where a number that it reads is not finite, beta is
    the filter's own.

    Args:
        base: Filter that is corrected.
        correction: Network and card.
        vehicle: The filter's vehicle, whose mass the network reads.

    Attributes:
        net: The correction as compiled code takes it.
        memory: Its memory, shape (memory_size,).

    Raises:
        ValueError: The correction was made for another filter, other states or another tick.
    """

    def __init__(self, base: Estimator, correction: Correction, vehicle: Vehicle) -> None:
        card, base_states = correction.card, base.names[: int(base.filters[0].n)]
        if not base.compiled:
            raise ValueError(f"{base.name} with latency={base.config.latency} has no correction")
        if base.name != card.base or not set(card.states) <= set(base_states) or base.dt != TICK:
            raise ValueError(
                f"the correction was trained on {card.base} with {', '.join(card.states)} and "
                f"ticks of {TICK:g} s; this is {base.name} with {', '.join(base_states)} and "
                f"ticks of {base.dt:g} s"
            )
        self.base, self.names, self.correction = base, base.names, correction
        self.net = _make_net(correction, base.names)
        n_numbers = int(locate_stack(self.net) + self.net.sizes.sum()) + len(base.names) + 1
        self.memory = np.zeros((n_numbers + 7) // 8 * 8)  # whole cache lines
        self.memory[MASS] = vehicle.mass
        self.reset(base.sensors, 0)

    def reset(self, sensors: Mapping[str, SlowSensor] | None, first: int) -> None:
        """Reset as `EstimatorLike.reset` does.

        Args:
            sensors: Slow sensors of this episode by name; None keeps the clocks of the last one.
            first: Tick of the first fast row.
        """
        self.base.reset(sensors, first)
        _reset_memory(self.memory, first)

    def step(self, rows: Array, packets: Array) -> None:
        """Process fast rows and packets as `EstimatorLike.step` does.

        Args:
            rows: Fast rows, shape (k, FAST_WIDTH).
            packets: Packets, shape (count, PACKET_WIDTH).
        """
        record = rows, len(rows), packets.reshape(-1, PACKET_WIDTH), len(packets)
        _compile_step()(self.base.filters, self.base.gains, *record, self.memory, self.net)

    @property
    def x(self) -> Array:
        """The present states, shape (n,)."""
        x = self.base.x
        x[self.net.beta] += self.memory[SHIFT]
        return x

    @property
    def P(self) -> Array:
        """Their present covariance, shape (n, n)."""
        P, beta, deviation = self.base.P, self.net.beta, self.memory[DEVIATION]
        if deviation > 0.0:  # else there is no correction
            P[beta], P[:, beta], P[beta, beta] = 0.0, 0.0, deviation * deviation
        return P


@functools.cache
def _compile_step() -> Callable[..., None]:
    """Return `filter_and_correct` as a plain call."""
    matrix, layers = np.zeros((1, 1)), (np.zeros(1, FILTER), np.zeros((1, 1, 1)))
    return compile_call(filter_and_correct, *layers, matrix, 0, matrix, 0, np.zeros(1), EXAMPLE)


def learned(
    *,
    vehicle: Vehicle,
    sensors: Mapping[str, SlowSensor],
    dt: float = TICK,
    speed: float | None = None,
    file: str | Path | Correction = "joint",
    **options: Any,
) -> LearnedEstimator:
    """Build the filter that a correction was trained on, with that correction.

    It is an `EstimatorFactory`; errors are those of `load_correction` and `make_estimator`.

    Args:
        vehicle: The filter's vehicle.
        sensors: Slow sensors by name; the filter takes all, as in the training.
        dt: Tick (s).
        speed: Speed (m/s) if it is held; None measures it.
        file: Name of a shipped correction, path of a file, or a `Correction`.
        **options: Options of the filter, over those of the training.

    Returns:
        The estimator.
    """
    correction = file if isinstance(file, Correction) else load_correction(file)
    settings = {"slow": list(sensors)} | correction.card.base_options | options
    facts: dict[str, Any] = {"vehicle": vehicle, "sensors": sensors, "dt": dt, "speed": speed}
    base = make_estimator(correction.card.base, **facts, **settings)
    return LearnedEstimator(base, correction, vehicle)


learned_exact_kf = functools.partial(learned, file="exact-kf")
learned_joint = functools.partial(learned, file="joint")
