"""Layers of a network without torch: activations, dense layers, and layers with a memory.

A kind of memory layer is a class, by which files and cards have it, and a branch of `step_layer`.
Sums are in double precision and in one order, whatever the batch.

Args:
    z: Input.
    memory: Memory of a layer, which is updated.
    numbers: Numbers of a network.
    offset: Place of a layer's `numbers`; a dense one's are weights (inputs, outputs) and biases.
    out: Output.
    code: Place of a layer's kind in `MEMORY_LAYERS`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...envs.numerics.functions import clip, exp
from ...envs.numerics.jit import jit, jit_nrt
from ...envs.numerics.primitives import Scalar, Vector, maximum
from ...envs.record import Array

ACTIVATIONS = ("tanh", "relu", "elu", "leaky-relu", "silu")
TANH, RELU, ELU, LEAKY, SILU = range(len(ACTIVATIONS))
_MAX_EXPONENT = 40.0  # where e^-x is nothing beside 1
_MAX_TIME = 1e9  # steps of a mean: beyond any drive, and a number that arrays hold

MEMORY_LAYERS: dict[str, type["MemoryLayer"]] = {}  # by kind, in the order of compiled code


@dataclass(frozen=True, eq=False)
class MemoryLayer:
    """A layer between an observation and the dense layers, with a memory of zeros at first.

    A subclass is registered by its `kind`. Its arrays are rounded to single precision, in which
    networks are trained, the rows of its gates one below the other.
    """

    kind: ClassVar[str]  # name in cards
    gates: ClassVar[int]  # rows of the weights for each unit
    arrays: ClassVar[tuple[str, ...]]  # fields that are arrays
    weight_in: Array  # of the input, shape (gates units, inputs)

    def __init_subclass__(cls, kind: str = "", gates: int = 1) -> None:
        cls.kind, cls.gates = kind, gates
        if kind:
            MEMORY_LAYERS[kind] = cls

    def __post_init__(self) -> None:
        for name in self.arrays:
            single = np.array(getattr(self, name), np.float32)
            object.__setattr__(self, name, single.astype(np.float64))

    @property
    def units(self) -> int:
        """Number of units."""
        return len(self.weight_in) // self.gates

    @property
    def size(self) -> int:
        """Number of outputs."""
        return self.units

    @property
    def memory(self) -> int:
        """Numbers of the memory."""
        return self.units

    @property
    def form(self) -> tuple[int, int, int]:
        """Place of the kind in `MEMORY_LAYERS`, size and memory, for compiled code."""
        return list(MEMORY_LAYERS).index(self.kind), self.size, self.memory

    @property
    def description(self) -> list[object]:
        """Kind, units and the fields that are no arrays, for a card, JSON types only."""
        return [self.kind, self.units]

    @property
    def numbers(self) -> Array:
        """Arrays as compiled code takes them, each transposed, row by row."""
        return np.concatenate([getattr(self, name).T.ravel() for name in self.arrays])


@dataclass(frozen=True, eq=False)
class RecurrentLayer(MemoryLayer):
    """Torch's recurrent cells, whose output is their memory or its first half."""

    arrays = ("weight_in", "weight_state", "bias_in", "bias_state")  # torch's ih, hh, ih, hh
    weight_state: Array  # of the output before, shape (gates units, units)
    bias_in: Array  # of the input, shape (gates units,)
    bias_state: Array  # of the output before, shape (gates units,)

    def __post_init__(self) -> None:
        super().__post_init__()
        rows, inputs = self.gates * self.units, self.weight_in.shape[-1]
        shapes = {name: getattr(self, name).shape for name in self.arrays}
        if [*shapes.values()] != [(rows, inputs), (rows, self.units), (rows,), (rows,)]:
            raise ValueError(f"the arrays of a {self.kind} cell do not fit together: {shapes}")


class Gru(RecurrentLayer, kind="gru", gates=3):
    """Cells with the gates reset, update and candidate."""


class Lstm(RecurrentLayer, kind="lstm", gates=4):
    """Cells with the gates input, forget, candidate and output."""

    @property
    def memory(self) -> int:
        """Numbers of the memory: outputs, and the cell state."""
        return 2 * self.units


@dataclass(frozen=True, eq=False)
class MovingAverages(MemoryLayer, kind="traces"):
    """Units u = W z + b, of which the last ones pass SiLU, and running means of each.

    A mean is that of the episode so far, and from its time on a leaky one: a new u counts for
    max(1 / steps so far, 1 - exp(-1 / time)). No gate decides what is kept, so that minutes of a
    small signal add up; what is to be averaged, products too, the SiLU units make.
    """

    arrays = ("weight_in", "bias_in")
    bias_in: Array  # shape (units,)
    n_silu: int  # number of SiLU units
    times: Sequence[float]  # of the means (steps)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "times", tuple(self.times))
        if self.weight_in.ndim != 2 or self.bias_in.shape != self.weight_in.shape[:1]:
            pair = self.weight_in.shape, self.bias_in.shape
            raise ValueError(f"traces have weights (units, inputs) and biases (units,), got {pair}")
        if self.n_silu not in range(self.units + 1):
            raise ValueError(f"of {self.units} units {self.n_silu} cannot be bent")
        if not self.times or not all(0.0 < time <= _MAX_TIME for time in self.times):
            rule = f"each above 0 steps and {_MAX_TIME:g} at most, got {self.times}"
            raise ValueError(f"traces last one time or more, {rule}")

    @property
    def size(self) -> int:
        """Number of outputs: the units, then the means of all of them, time by time."""
        return self.units * (1 + len(self.times))

    @property
    def memory(self) -> int:
        """Numbers of the memory: steps so far, and the means."""
        return 1 + self.units * len(self.times)

    @property
    def description(self) -> list[object]:
        """Kind, units, SiLU units and times."""
        return [*super().description, self.n_silu, list(self.times)]

    @property
    def numbers(self) -> Array:
        """Numbers of SiLU units and times, final weights of a new number by time, and arrays."""
        shares = -np.expm1(-1.0 / np.array(self.times))
        return np.concatenate([[self.n_silu, len(self.times)], shares, super().numbers])


GRU, LSTM, TRACES = range(len(MEMORY_LAYERS))
_GATES = tuple(layer.gates for layer in MEMORY_LAYERS.values())


@jit
def _tanh(x: Scalar) -> Scalar:
    return 1.0 - 2.0 / (1.0 + exp(clip(x + x, 0.0 - _MAX_EXPONENT, _MAX_EXPONENT)))


@jit
def _sigmoid(x: Scalar) -> Scalar:
    return 1.0 / (1.0 + exp(clip(0.0 - x, 0.0 - _MAX_EXPONENT, _MAX_EXPONENT)))


@jit
def apply_activation(x: Scalar, kind: int) -> Scalar:
    """Apply an activation with torch's default arguments.

    Args:
        x: Sum of a unit.
        kind: Place in `ACTIVATIONS`.
    """
    if kind == TANH:
        return _tanh(x)
    if kind == RELU:
        return maximum(x, 0.0)
    if kind == LEAKY:
        return maximum(x, 0.01 * x)
    if kind == SILU:
        return x * _sigmoid(x)
    return x if x > 0.0 else exp(maximum(x, 0.0 - _MAX_EXPONENT)) - 1.0


@jit
def apply_dense(z: Vector, numbers: Vector, offset: int, out: Vector) -> int:
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
def step_layer(
    code: int, z: Vector, memory: Vector, numbers: Vector, offset: int, out: Vector
) -> int:
    """Step a memory layer; return the place behind its numbers."""
    if code == TRACES:
        return _step_averages(z, memory, numbers, offset, out)
    n = len(out)
    a, b = np.empty(_GATES[code] * n), np.empty(_GATES[code] * n)
    end = _compute_gates(z, memory[:n], numbers, offset, a, b)
    _update_units(code, a, b, memory, n)
    out[:] = memory[:n]
    return end


@jit
def _update_units(code: int, a: Vector, b: Vector, h: Vector, n: int) -> None:
    """Update recurrent outputs h[:n] by their gates' sums of input, a, and of state, b."""
    if code == GRU:
        for i in range(n):
            reset, update = _sigmoid(a[i] + b[i]), _sigmoid(a[n + i] + b[n + i])
            candidate = _tanh(a[2 * n + i] + reset * b[2 * n + i])
            h[i] = (1.0 - update) * candidate + update * h[i]
    elif code == LSTM:
        for i in range(n):
            enter, forget = a[i] + b[i], a[n + i] + b[n + i]
            candidate, leave = a[2 * n + i] + b[2 * n + i], a[3 * n + i] + b[3 * n + i]
            h[n + i] = _sigmoid(forget) * h[n + i] + _sigmoid(enter) * _tanh(candidate)
            h[i] = _sigmoid(leave) * _tanh(h[n + i])


@jit
def _compute_gates(
    z: Vector, h: Vector, numbers: Vector, offset: int, from_input: Vector, from_state: Vector
) -> int:
    """Compute a layer's sums of input and state; return the place behind its numbers."""
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


@jit
def _step_averages(z: Vector, m: Vector, numbers: Vector, offset: int, out: Vector) -> int:
    """Step `MovingAverages`; return the place behind its numbers."""
    n_silu, times = int(numbers[offset]), int(numbers[offset + 1])
    units, shares = len(out) // (1 + times), offset + 2
    end = apply_dense(z, numbers, shares + times, out[:units])
    for i in range(units - n_silu, units):
        out[i] = apply_activation(out[i], SILU)
    m[0] += 1.0
    for j in range(times):
        share = maximum(numbers[shares + j], 1.0 / m[0])
        for i in range(units):
            k = j * units + i
            m[1 + k] += share * (out[i] - m[1 + k])
            out[units + k] = m[1 + k]
    return end
