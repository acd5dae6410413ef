"""A policy's network at one observation after another, compiled: frames, cells, dense layers.

Arrays lie one behind the other in one vector, weights transposed, so that a layer's sums grow input
by input. Sums are in double precision and in one order, whatever the batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics.functions import clip, exp
from ...envs.numerics.jit import jit, jit_nrt
from ...envs.numerics.primitives import Matrix, Scalar, Vector, maximum, minimum
from ...envs.record import Array

# Gates in torch's order: reset, update, candidate; or input, forget, candidate, output.
GATES = {"gru": 3, "lstm": 4}
_MAX_TIME = 1e9  # steps of a mean: beyond any drive, and a number that arrays hold
# The arrays of a cell: torch's weight_ih, weight_hh, bias_ih and bias_hh.
CELL_WEIGHTS = ("weight_in", "weight_state", "bias_in", "bias_state")


@dataclass(frozen=True, eq=False)
class RecurrentCell:
    """One layer of cells, whose state is all zero where an episode begins.

    Arrays are rounded to single precision, their gates one below the other.
    """

    parts: ClassVar[tuple[str, ...]] = CELL_WEIGHTS
    kind: str  # name of `GATES`
    weight_in: Array  # of the input, shape (gates size, inputs)
    weight_state: Array  # of the state, shape (gates size, size)
    bias_in: Array  # of the input, shape (gates size,)
    bias_state: Array  # of the state, shape (gates size,)

    def __post_init__(self) -> None:
        if self.kind not in GATES:
            raise ValueError(f"unknown cell {self.kind!r}; known: {', '.join(GATES)}")
        _round_arrays(self)
        rows, inputs = GATES[self.kind] * self.size, self.weight_in.shape[-1]
        shapes = {name: getattr(self, name).shape for name in CELL_WEIGHTS}
        if [*shapes.values()] != [(rows, inputs), (rows, self.size), (rows,), (rows,)]:
            raise ValueError(f"the arrays of a {self.kind} cell do not fit together: {shapes}")

    @property
    def size(self) -> int:
        """Number of outputs."""
        return int(self.weight_state.shape[-1])

    @property
    def memory(self) -> int:
        """Numbers of the state: the output, and behind it an LSTM's cell state."""
        return self.size * (2 if self.kind == "lstm" else 1)

    @property
    def form(self) -> tuple[int, int, int, int]:
        """Gates, size, and two numbers of `MovingAverages` alone."""
        return GATES[self.kind], self.size, 0, 0

    @property
    def numbers(self) -> Array:
        """Arrays as compiled code takes them: each of `CELL_WEIGHTS`, transposed, row by row."""
        return np.concatenate([getattr(self, name).T.ravel() for name in CELL_WEIGHTS])


@dataclass(frozen=True, eq=False)
class MovingAverages:
    """Units u = W z + b, of which the last ones pass SiLU, and running means of each.

    A mean is that of the episode so far, and from its time on a leaky one: a new u counts for
    max(1 / steps so far, 1 - exp(-1 / time)). No gate decides what is kept, so that minutes of a
    small signal add up; what is to be averaged, products too, the SiLU units make.
    """

    kind: ClassVar[str] = "traces"
    parts: ClassVar[tuple[str, ...]] = ("weight_in", "bias_in")
    weight_in: Array  # shape (units, inputs), rounded to single precision
    bias_in: Array  # shape (units,), rounded to single precision
    n_silu: int  # number of SiLU units
    times: Sequence[float]  # of the means (steps)

    def __post_init__(self) -> None:
        _round_arrays(self)
        object.__setattr__(self, "times", tuple(self.times))
        if self.weight_in.ndim != 2 or self.bias_in.shape != self.weight_in.shape[:1]:
            pair = self.weight_in.shape, self.bias_in.shape
            raise ValueError(f"traces have weights (units, inputs) and biases (units,), got {pair}")
        if self.n_silu not in range(len(self.bias_in) + 1):
            raise ValueError(f"of {len(self.bias_in)} units {self.n_silu} cannot be bent")
        if not self.times or not all(0.0 < time <= _MAX_TIME for time in self.times):
            rule = f"each above 0 steps and {_MAX_TIME:g} at most, got {self.times}"
            raise ValueError(f"traces last one time or more, {rule}")

    @property
    def size(self) -> int:
        """Number of outputs: the units, then the means of all of them, time by time."""
        return len(self.bias_in) * (1 + len(self.times))

    @property
    def memory(self) -> int:
        """Numbers of the state: steps so far, and the means."""
        return 1 + len(self.bias_in) * len(self.times)

    @property
    def form(self) -> tuple[int, int, int, int]:
        """No gates, units, SiLU units, and times."""
        return 0, len(self.bias_in), self.n_silu, len(self.times)

    @property
    def numbers(self) -> Array:
        """Final weights of a new number by time, weights (inputs, units) row by row, biases."""
        shares = -np.expm1(-1.0 / np.array(self.times))
        return np.concatenate([shares, self.weight_in.T.ravel(), self.bias_in])


def _round_arrays(layer: RecurrentCell | MovingAverages) -> None:
    """Round a layer's arrays to single precision."""
    for name in layer.parts:
        single = np.array(getattr(layer, name), np.float32)
        object.__setattr__(layer, name, single.astype(np.float64))


MemoryLayer = RecurrentCell | MovingAverages  # between an observation and the dense layers
ACTIVATIONS = ("tanh", "relu", "elu", "leaky-relu", "silu")
OUTPUTS = ("tanh", "linear")
_TANH, _RELU, _ELU, _LEAKY, _SILU = range(len(ACTIVATIONS))
_MAX_EXPONENT = 40.0  # where e^-x is nothing beside 1


class PackedNetwork(NamedTuple):
    """A network as compiled code takes it."""

    mean: Array  # of a frame, or of the stack
    scale: Array
    clip: float  # bound of normalised inputs, infinite for none
    inputs: int  # entries of a frame
    history: int  # frames
    cells: npt.NDArray[np.int64]  # `form` of each cell, shape (k, 4)
    sizes: npt.NDArray[np.int64]  # of the dense layers, inputs first
    activation: int  # place in `ACTIVATIONS`
    output: int  # place in `OUTPUTS`
    numbers: Array  # of each cell, then of each layer: weights (inputs, outputs), biases


@jit
def _tanh(x: Scalar) -> Scalar:
    return 1.0 - 2.0 / (1.0 + exp(clip(x + x, 0.0 - _MAX_EXPONENT, _MAX_EXPONENT)))


@jit
def _sigmoid(x: Scalar) -> Scalar:
    return 1.0 / (1.0 + exp(clip(0.0 - x, 0.0 - _MAX_EXPONENT, _MAX_EXPONENT)))


@jit
def _apply_activation(x: Scalar, kind: int) -> Scalar:
    """Apply an activation with torch's default arguments."""
    if kind == _TANH:
        return _tanh(x)
    if kind == _RELU:
        return maximum(x, 0.0)
    if kind == _LEAKY:
        return maximum(x, 0.01 * x)
    if kind == _SILU:
        return x * _sigmoid(x)
    return x if x > 0.0 else exp(maximum(x, 0.0 - _MAX_EXPONENT)) - 1.0


@jit
def _apply_dense(z: Vector, numbers: Vector, offset: int, out: Vector) -> int:
    """Write out = W z + b with the numbers at a place; return the place behind them."""
    n = len(out)
    bias = offset + len(z) * n
    for o in range(n):
        out[o] = numbers[bias + o]
    for i in range(len(z)):
        row, x = numbers[offset + i * n : offset + i * n + n], z[i]
        for o in range(n):
            out[o] += row[o] * x
    return bias + n


@jit_nrt
def _step_cell(z: Vector, h: Vector, gates: int, numbers: Vector, offset: int) -> int:
    """Step torch's GRU (3 gates) or LSTM (4); h: its state, updated; return the place behind."""
    n = len(h) // (gates - 2)
    from_input, from_state = np.empty(gates * n), np.empty(gates * n)
    offset = _compute_gates(z, h[:n], numbers, offset, from_input, from_state)
    for i in range(n):
        if gates == 3:
            reset = _sigmoid(from_input[i] + from_state[i])
            update = _sigmoid(from_input[n + i] + from_state[n + i])
            candidate = _tanh(from_input[2 * n + i] + reset * from_state[2 * n + i])
            h[i] = (1.0 - update) * candidate + update * h[i]
        else:
            enter, forget = from_input[i] + from_state[i], from_input[n + i] + from_state[n + i]
            candidate = from_input[2 * n + i] + from_state[2 * n + i]
            leave = from_input[3 * n + i] + from_state[3 * n + i]
            h[n + i] = _sigmoid(forget) * h[n + i] + _sigmoid(enter) * _tanh(candidate)
            h[i] = _sigmoid(leave) * _tanh(h[n + i])
    return offset


@jit
def _compute_gates(
    z: Vector, h: Vector, numbers: Vector, offset: int, from_input: Vector, from_state: Vector
) -> int:
    """Compute a cell's sums of input and state, whose arrays stand as in `CELL_WEIGHTS`."""
    n, n_inputs = len(from_input), len(z) + len(h)
    for o in range(n):
        from_input[o] = numbers[offset + n_inputs * n + o]
        from_state[o] = numbers[offset + (n_inputs + 1) * n + o]
    for i in range(n_inputs):
        row = numbers[offset + i * n : offset + i * n + n]
        target = from_input if i < len(z) else from_state
        x = z[i] if i < len(z) else h[i - len(z)]
        for o in range(n):
            target[o] += row[o] * x
    return offset + (n_inputs + 2) * n


@jit_nrt
def _step_averages(z: Vector, m: Vector, form: Vector, numbers: Vector, offset: int) -> Any:
    """Step `MovingAverages`, whose state m is updated; return the output and the place behind."""
    units, times = form[1], form[3]
    out = np.empty(units * (1 + times))
    end = _apply_dense(z, numbers, offset + times, out[:units])
    for i in range(units - form[2], units):
        out[i] = _apply_activation(out[i], _SILU)
    m[0] += 1.0
    for j in range(times):
        share = maximum(numbers[offset + j], 1.0 / m[0])
        for i in range(units):
            k = j * units + i
            m[1 + k] += share * (out[i] - m[1 + k])
            out[units + k] = m[1 + k]
    return out, end


@jit_nrt
def forward(net: PackedNetwork, x: Matrix, state: Matrix, out: Matrix) -> None:
    """Compute the network's outputs.

    Args:
        net: Weights of the network.
        x: Observations, shape (N, inputs).
        state: Memory of each row, shape (N, memory), updated.
        out: Output, shape (N, width).
    """
    k, stacked, last = net.inputs, net.inputs * net.history, len(net.sizes) - 1
    framewise, frames = len(net.mean) == k, stacked - k
    for row in range(len(x)):
        m, z = state[row], np.empty(stacked)
        z[:frames] = m[:frames]
        z[frames:] = x[row]
        for i in range(stacked):
            if i >= frames or not framewise:
                j = i - frames if framewise else i
                value = (z[i] - net.mean[j]) * net.scale[j]
                z[i] = minimum(maximum(value, 0.0 - net.clip), net.clip)
        if framewise:
            m[:frames] = z[k:]
        else:
            for i in range(frames):
                m[i] = m[i + k] if i + k < frames else x[row, i + k - frames]
        offset, position = 0, frames
        for c in range(len(net.cells)):
            gates, size = net.cells[c, 0], net.cells[c, 1]
            n_state = size * (gates - 2) if gates else 1 + size * net.cells[c, 3]
            memory = m[position : position + n_state]
            if gates == 0:
                z, offset = _step_averages(z, memory, net.cells[c], net.numbers, offset)
            else:
                offset = _step_cell(z, memory, gates, net.numbers, offset)
                z = memory[:size].copy()
            position += n_state
        for layer in range(last):
            y = np.empty(net.sizes[layer + 1])
            offset = _apply_dense(z, net.numbers, offset, y)
            kind = net.activation if layer < last - 1 else net.output
            if layer < last - 1 or net.output == _TANH:
                for i in range(len(y)):
                    y[i] = _apply_activation(y[i], kind)
            z = y
        out[row] = z
