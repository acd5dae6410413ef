"""A policy's network without torch, at one observation after another: frames, cells, dense layers.

Arrays lie one behind the other in one vector, weights transposed, so that a layer's sums grow input
by input. Sums are in double precision and in one order, whatever the batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics.jit import jit_nrt
from ...envs.numerics.primitives import Matrix, maximum, minimum
from ...envs.record import Array
from ...envs.validation import check_choice
from .layers import ACTIVATIONS, TANH, MemoryLayer, apply_activation, apply_dense, step_layer

SUFFIX = ".safetensors"
Tensors = dict[str, npt.NDArray[Any]]
OUTPUTS = ("tanh", "linear")


class PackedNetwork(NamedTuple):
    """A network as compiled code takes it."""

    mean: Array  # of a frame, or of the stack
    scale: Array
    clip: float  # bound of normalised inputs, infinite for none
    inputs: int  # entries of a frame
    history: int  # frames
    cells: npt.NDArray[np.int64]  # `form` of each cell, shape (k, 3)
    sizes: npt.NDArray[np.int64]  # of the dense layers, inputs first
    activation: int  # place in `ACTIVATIONS`
    output: int  # place in `OUTPUTS`
    numbers: Array  # of each cell, then of each layer: weights (inputs, outputs), biases


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
            code, size, end = net.cells[c, 0], net.cells[c, 1], position + net.cells[c, 2]
            y = np.empty(size)
            offset = step_layer(code, z, m[position:end], net.numbers, offset, y)
            z, position = y, end
        for layer in range(last):
            y = np.empty(net.sizes[layer + 1])
            offset = apply_dense(z, net.numbers, offset, y)
            kind = net.activation if layer < last - 1 else net.output
            if layer < last - 1 or net.output == TANH:
                for i in range(len(y)):
                    y[i] = apply_activation(y[i], kind)
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
            if count := np.count_nonzero(~np.isfinite(values)):
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
        cells = np.array([cell.form for cell in self.cells], np.int64).reshape(-1, 3)
        sizes = np.array([self.weights[0].shape[1], *map(len, self.biases)], np.int64)
        form = self.inputs, self.history, cells, sizes
        kinds = ACTIVATIONS.index(self.activation), OUTPUTS.index(self.output)
        return PackedNetwork(self.mean, self.scale, clip, *form, *kinds, np.concatenate(numbers))

    @property
    def description(self) -> dict[str, object]:
        """Sizes and kinds by name for its card, JSON types only."""
        cells = [cell.description for cell in self.cells]
        plain = {name: getattr(self, name) for name in ("activation", "output", "clip")}
        sizes = {"action_width": self.width, "history": self.history}
        return {"hidden": list(self.hidden), **plain, **sizes, "cells": cells}

    @property
    def tensors(self) -> Tensors:
        """Tensors by name for its file."""
        arrays = dict[str, Array]()
        for i, cell in enumerate(self.cells):
            arrays |= {f"cell_{i}_{part}": getattr(cell, part) for part in cell.arrays}
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
