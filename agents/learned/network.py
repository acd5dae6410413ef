"""A policy's network without torch, at one observation after another: frames, cells, dense layers.

Arrays lie one behind the other in one vector, weights transposed, so that a layer's sums grow input
by input. Sums are in double precision and in one order, whatever the batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics.functions import clip, exp
from ...envs.numerics.jit import jit, jit_nrt
from ...envs.numerics.primitives import Matrix, Scalar, Vector, maximum, minimum
from ...envs.record import Array
from ...envs.validation import check_choice

SUFFIX = ".safetensors"
Tensors = dict[str, npt.NDArray[Any]]
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
        check_choice("cell", self.kind, GATES)
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
    n = len(h) // (gates - 2)  # an LSTM has two numbers a unit
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
def _forward(net: PackedNetwork, x: Matrix, state: Matrix, out: Matrix) -> None:
    """Compute outputs (N, width) of observations (N, inputs) and memories (N, memory), updated."""
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


@dataclass(frozen=True, eq=False)
class Network:
    """action = output(W_n ... activation(W_0 z + b_0) ... + b_n), z = clip((x - mean) scale).

    Weights and biases are rounded to single precision, in which networks are trained.
    """

    mean: Array  # of a frame before it is stacked, shape (inputs,), or of the stack
    scale: Array  # of the same shape; what has scale 0 is not read
    weights: Sequence[Array]  # of each layer, shape (outputs, inputs)
    biases: Sequence[Array]  # of each layer, shape (outputs,)
    activation: str = "tanh"  # name of `ACTIVATIONS`, between layers
    output: str = "linear"  # name of `OUTPUTS`, after the last one
    clip: float | None = None  # z lies within +-clip; None does not clip
    history: int = 1  # frames side by side in z, oldest first, those before the episode zero
    cells: Sequence[MemoryLayer] = ()  # between z and the first layer

    def __post_init__(self) -> None:
        for name in ("mean", "scale"):
            object.__setattr__(self, name, np.array(getattr(self, name), np.float64))
        for name in ("weights", "biases"):
            single = [np.array(array, np.float32) for array in getattr(self, name)]
            object.__setattr__(self, name, tuple(array.astype(np.float64) for array in single))
        check_choice("activation", self.activation, ACTIVATIONS)
        check_choice("output", self.output, OUTPUTS)
        if self.clip is not None and not self.clip > 0.0:
            raise ValueError(f"clip is above zero or None, got {self.clip!r}")
        if self.history < 1:
            raise ValueError(f"history is at least 1 frame, got {self.history}")
        if not self.weights or len(self.weights) != len(self.biases):
            counts = f"{len(self.weights)} weights and {len(self.biases)} biases"
            raise ValueError(f"a network has a bias a layer, got {counts}")
        width = (self.cells[0].weight_in if self.cells else self.weights[0]).shape[-1]
        if width % self.history:
            raise ValueError(f"{width} inputs are not {self.history} frames of one width")
        shape = self.mean.shape
        if shape not in ((self.inputs,), (width,)) or self.scale.shape != shape:
            rule = f"(inputs,) or (history inputs,) with {self.inputs} inputs"
            raise ValueError(f"mean and scale are {rule}, got {shape} and {self.scale.shape}")
        for i, cell in enumerate(self.cells):
            if cell.weight_in.shape[1] != width:
                raise ValueError(f"cell {i} takes {cell.weight_in.shape[1]} inputs, not {width}")
            width = cell.size
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            if W.shape != (*b.shape, width) or b.ndim != 1:
                shapes = f"weights {W.shape} and biases {b.shape}"
                raise ValueError(f"layer {i} takes {width} inputs, got {shapes}")
            width = len(b)
        for name, values in self.tensors.items():
            if not np.isfinite(values).all():
                count = np.count_nonzero(~np.isfinite(values))
                raise ValueError(f"{name}: {count} are not finite")
        if (self.scale < 0.0).any():
            raise ValueError("scale is below zero")

    @property
    def inputs(self) -> int:
        """Number of entries of an observation."""
        first = self.cells[0].weight_in if self.cells else self.weights[0]
        return int(first.shape[-1]) // self.history

    @property
    def hidden(self) -> tuple[int, ...]:
        """Sizes of the dense layers between."""
        return tuple(len(b) for b in self.biases[:-1])

    @property
    def width(self) -> int:
        """Number of entries of an action."""
        return len(self.biases[-1])

    @property
    def memory(self) -> int:
        """Numbers of a row's memory: the older frames, then each cell's state."""
        return (self.history - 1) * self.inputs + sum(cell.memory for cell in self.cells)

    @property
    def reads(self) -> npt.NDArray[np.bool_]:
        """Entries of an observation that are read in any frame, bool, shape (inputs,)."""
        return np.asarray((self.scale.reshape(-1, self.inputs) > 0.0).any(axis=0))

    def select_inputs(self, entries: npt.NDArray[np.bool_]) -> "Network":
        """Restrict the network to some entries, the others at their mean.

        Args:
            entries: Entries of an observation that stay, bool, shape (inputs,).
        """
        columns = np.tile(entries, self.history)
        selected = columns if len(self.mean) == len(columns) else entries
        cells, weights = list(self.cells), list(self.weights)
        if cells:
            cells[0] = replace(cells[0], weight_in=cells[0].weight_in[:, columns])
        else:
            weights[0] = weights[0][:, columns]
        mean, scale = self.mean[selected], self.scale[selected]
        return replace(self, mean=mean, scale=scale, weights=weights, cells=cells)

    @cached_property
    def packed(self) -> PackedNetwork:
        """The network as compiled code takes it."""
        layers = zip(self.weights, self.biases, strict=True)
        numbers = [cell.numbers for cell in self.cells]
        numbers += [part.T.ravel() for layer in layers for part in layer]
        clip = np.inf if self.clip is None else float(self.clip)
        cells = np.array([cell.form for cell in self.cells], np.int64).reshape(-1, 4)
        sizes = np.array([self.weights[0].shape[1], *map(len, self.biases)], np.int64)
        form = self.inputs, self.history, cells, sizes
        kinds = ACTIVATIONS.index(self.activation), OUTPUTS.index(self.output)
        return PackedNetwork(self.mean, self.scale, clip, *form, *kinds, np.concatenate(numbers))

    @property
    def description(self) -> dict[str, object]:
        """Sizes and kinds by name for its card, JSON types only."""
        cells = [
            [cell.kind, len(cell.bias_in), cell.n_silu, list(cell.times)]
            if isinstance(cell, MovingAverages)
            else [cell.kind, cell.size]
            for cell in self.cells
        ]
        plain = {name: getattr(self, name) for name in ("activation", "output", "clip")}
        sizes = {"action_width": self.width, "history": self.history}
        return {"hidden": list(self.hidden), **plain, **sizes, "cells": cells}

    @property
    def tensors(self) -> Tensors:
        """Tensors by name for its file."""
        arrays = dict[str, Array]()
        for i, cell in enumerate(self.cells):
            arrays |= {f"cell_{i}_{part}": getattr(cell, part) for part in cell.parts}
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"weight_{i}": W, f"bias_{i}": b}
        single = {name: np.ascontiguousarray(x, np.float32) for name, x in arrays.items()}
        return {"mean": self.mean, "scale": self.scale} | single

    def __call__(self, x: Array, state: Array | None = None) -> Array:
        """Compute actions (N, width) of observations (N, inputs).

        The memory (N, memory) is updated; it is zero, or None, where an episode begins.
        """
        out, memory = np.empty((len(x), self.width)), np.zeros((len(x), self.memory))
        _forward(self.packed, x, memory if state is None else state, out)
        return out

    def predict(
        self, observation: npt.NDArray[np.float32], state: Array | None = None,
        episode_start: npt.NDArray[np.bool_] | None = None, deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], Array]:  # fmt: skip
        """Compute actions within [-1, 1] and the next memory, as an agent of any cars.

        Args:
            observation: Observations, shape (N, inputs).
            state: Memory from the last call, shape (N, memory); None at first.
            episode_start: Rows whose episode has just begun, shape (N,).
            deterministic: Without effect.
        """
        memory = np.zeros((len(observation), self.memory)) if state is None else state.copy()
        if episode_start is not None:
            memory[episode_start] = 0.0
        actions = self(observation.astype(np.float64), memory)
        return np.clip(actions, -1.0, 1.0).astype(np.float32), memory
