"""A policy's network without torch, and its tensors by name."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from .forward import ACTIVATIONS, OUTPUTS, MemoryLayer, MovingAverages, PackedNetwork, forward

SUFFIX = ".safetensors"
Tensors = dict[str, npt.NDArray[Any]]


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
        object.__setattr__(self, "cells", tuple(self.cells))
        for name, known in (("activation", ACTIVATIONS), ("output", OUTPUTS)):
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"unknown {name} {value!r}; known: {', '.join(known)}")
        if self.clip is not None and not self.clip > 0.0:
            raise ValueError(f"clip is above zero or None, got {self.clip!r}")
        if self.history < 1:
            raise ValueError(f"history is at least 1 frame, got {self.history}")
        self._check_layers()

    def _check_layers(self) -> None:
        """Check the shapes of all arrays, then that they are finite."""
        if not self.weights or len(self.weights) != len(self.biases):
            counts = f"{len(self.weights)} weights and {len(self.biases)} biases"
            raise ValueError(f"a network has a bias a layer, got {counts}")
        width = self._first.shape[-1]
        if width % self.history:
            raise ValueError(f"{width} inputs are not {self.history} frames of one width")
        shape = self.mean.shape
        if shape not in ((self.inputs,), (width,)) or self.scale.shape != shape:
            rule = f"(inputs,) or (history inputs,) with {self.inputs} inputs"
            raise ValueError(f"mean and scale are {rule}, got {shape} and {self.scale.shape}")
        arrays = {"mean": self.mean, "scale": self.scale}
        for i, cell in enumerate(self.cells):
            if cell.weight_in.shape[1] != width:
                raise ValueError(f"cell {i} takes {cell.weight_in.shape[1]} inputs, not {width}")
            width = cell.size
            arrays |= {f"{name} of cell {i}": getattr(cell, name) for name in cell.parts}
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            if W.shape != (*b.shape, width) or b.ndim != 1:
                shapes = f"weights {W.shape} and biases {b.shape}"
                raise ValueError(f"layer {i} takes {width} inputs, got {shapes}")
            width = len(b)
            arrays |= {f"the weights of layer {i}": W, f"the biases of layer {i}": b}
        for name, values in arrays.items():
            if not np.isfinite(values).all():
                raise ValueError(f"{name}: {int((~np.isfinite(values)).sum())} are not finite")
        if (self.scale < 0.0).any():
            raise ValueError("scale is below zero")

    @property
    def _first(self) -> Array:
        """Weights that take z."""
        return self.cells[0].weight_in if self.cells else self.weights[0]

    @property
    def inputs(self) -> int:
        """Number of entries of an observation."""
        return int(self._first.shape[-1]) // self.history

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

        Returns:
            The smaller network.
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
        tensors: Tensors = {"mean": self.mean, "scale": self.scale}
        for i, cell in enumerate(self.cells):
            for part in cell.parts:
                tensors[f"cell_{i}_{part}"] = np.ascontiguousarray(getattr(cell, part), np.float32)
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            tensors[f"weight_{i}"] = np.ascontiguousarray(W, np.float32)
            tensors[f"bias_{i}"] = np.ascontiguousarray(b, np.float32)
        return tensors

    @property
    def dense(self) -> "Network":
        """Dense layers behind cells as a network of what these give; without cells itself."""
        if not self.cells:
            return self
        mean = np.zeros(self.weights[0].shape[1])
        return replace(self, mean=mean, scale=mean + 1.0, clip=None, history=1, cells=())

    def compute_features(self, x: Array, state: Array) -> Array:
        """Compute what the first dense layer reads.

        Args:
            x: Observations, shape (N, inputs).
            state: Memory of each row, shape (N, memory), updated.

        Returns:
            Features, shape (N, k).
        """
        out = np.empty((len(x), int(self.packed.sizes[0])))
        forward(self.packed._replace(sizes=self.packed.sizes[:1]), x, state, out)
        return out

    def __call__(self, x: Array, state: Array | None = None) -> Array:
        """Compute the actions of observations.

        Args:
            x: Observations, shape (N, inputs).
            state: Memory, shape (N, memory), updated; zero, or None, where an episode begins.

        Returns:
            Actions, shape (N, width).
        """
        state = np.zeros((len(x), self.memory)) if state is None else state
        out = np.empty((len(x), self.width))
        forward(self.packed, x, state, out)
        return out
