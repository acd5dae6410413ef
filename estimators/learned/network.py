"""A policy's network: a normalised observation through cells and dense layers, without torch."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from .forward import ACTIVATIONS as ACTIVATIONS
from .forward import OUTPUTS, PackedNetwork, forward, pack_network
from .memory import MemoryLayer


@dataclass(frozen=True, eq=False)
class Network:
    """action = output(W_n ... activation(W_0 z + b_0) ... + b_n), z = clip((x - mean) scale).

    Weights and biases are rounded to single precision, in which networks are trained. Sums are in
    double precision, so that a row's result depends on the batch around it by rounding of the
    sixteenth digit only.

    Attributes:
        mean: Mean of each frame before it is stacked, shape (inputs,), or of the stack, (history
            inputs,).
        scale: Scale of the same shape; what has scale 0 is not read.
        weights: Weights of each layer, shape (outputs, inputs).
        biases: Biases of each layer, shape (outputs,).
        activation: Name of `ACTIVATIONS`, between layers.
        output: Name of `OUTPUTS`, after the last one.
        clip: z lies within +-clip; None does not clip.
        history: Number of frames side by side in z, oldest first, those before the episode zero
            (the stack of stable-baselines3's VecFrameStack).
        cells: Cells between z and the first layer.

    Raises:
        ValueError: Shapes that do not fit, a number that is not finite, an unknown name.
    """

    mean: Array
    scale: Array
    weights: Sequence[Array]
    biases: Sequence[Array]
    activation: str = "tanh"
    output: str = "linear"
    clip: float | None = None
    history: int = 1
    cells: Sequence[MemoryLayer] = ()

    def __post_init__(self) -> None:
        for name in ("mean", "scale"):
            object.__setattr__(self, name, np.array(getattr(self, name), np.float64))
        for name in ("weights", "biases"):
            single = [np.array(array, np.float32) for array in getattr(self, name)]
            object.__setattr__(self, name, tuple(array.astype(np.float64) for array in single))
        object.__setattr__(self, "cells", tuple(self.cells))
        for name, known in (("activation", ACTIVATIONS), ("output", OUTPUTS)):
            if getattr(self, name) not in known:
                value = getattr(self, name)
                raise ValueError(f"unknown {name} {value!r}; known: {', '.join(known)}")
        if self.clip is not None and not self.clip > 0.0:
            raise ValueError(f"clip is above zero or None, got {self.clip!r}")
        if self.history < 1:
            raise ValueError(f"history is at least 1 frame, got {self.history}")
        self._check_shapes()
        self._check_numbers()

    def _check_shapes(self) -> None:
        if not self.weights or len(self.weights) != len(self.biases):
            raise ValueError(
                f"a network has a bias a layer, got {len(self.weights)} weights "
                f"and {len(self.biases)} biases"
            )
        stacked = self._first.shape[-1]
        if stacked % self.history:
            raise ValueError(f"{stacked} inputs are not {self.history} frames of one width")
        if self.mean.shape not in ((self.inputs,), (stacked,)) or self.scale.shape != (
            self.mean.shape
        ):
            raise ValueError(
                f"mean and scale are (inputs,) or (history inputs,) with {self.inputs} inputs, "
                f"got {self.mean.shape} and {self.scale.shape}"
            )
        width = stacked
        for i, cell in enumerate(self.cells):
            if cell.weight_in.shape[1] != width:
                raise ValueError(f"cell {i} takes {cell.weight_in.shape[1]} inputs, not {width}")
            width = cell.size
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            if W.shape != (*b.shape, width) or b.ndim != 1:
                raise ValueError(
                    f"layer {i} takes {width} inputs, got weights {W.shape} and biases {b.shape}"
                )
            width = len(b)

    def _check_numbers(self) -> None:
        arrays = {"mean": self.mean, "scale": self.scale}
        for i, cell in enumerate(self.cells):
            arrays |= {f"{name} of cell {i}": getattr(cell, name) for name in cell.parts}
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
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
        return replace(
            self, mean=self.mean[selected], scale=self.scale[selected], weights=weights, cells=cells
        )

    @cached_property
    def _network_arrays(self) -> PackedNetwork:
        scaling, kinds = (self.mean, self.scale, self.clip), (self.activation, self.output)
        layers = list(zip(self.weights, self.biases, strict=True))
        return pack_network(scaling, self.history, self.cells, layers, *kinds)

    @property
    def dense(self) -> "Network":
        """Dense layers behind cells as a network of what these give; without cells itself."""
        if not self.cells:
            return self
        width = self.weights[0].shape[1]
        scaling = np.zeros(width), np.ones(width)
        return replace(self, mean=scaling[0], scale=scaling[1], clip=None, history=1, cells=())

    def replace_dense(self, dense: "Network") -> "Network":
        """Replace the dense layers.

        Args:
            dense: Network of what they read, with the new layers.

        Returns:
            The network with its layers, activation and output.
        """
        layers = replace(self, weights=dense.weights, biases=dense.biases)
        return replace(layers, activation=dense.activation, output=dense.output)

    def compute_features(self, x: Array, state: Array) -> Array:
        """Compute what the first dense layer reads.

        Args:
            x: Observations, shape (N, inputs).
            state: Memory of each row, shape (N, memory), updated.

        Returns:
            Features, shape (N, k).
        """
        memory_part = self._network_arrays._replace(sizes=self._network_arrays.sizes[:1])
        out = np.empty((len(x), int(memory_part.sizes[0])))
        forward(memory_part, x, state, out)
        return out

    def __call__(self, x: Array, state: Array | None = None) -> Array:
        """Compute the actions of observations.

        Args:
            x: Observations, shape (N, inputs).
            state: Memory, shape (N, memory), updated in place; zero, or None, where an episode
                begins.

        Returns:
            Actions, shape (N, width).
        """
        if state is None:
            state = np.zeros((len(x), self.memory))
        out = np.empty((len(x), self.width))
        forward(self._network_arrays, x, state, out)
        return out
