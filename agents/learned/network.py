"""A policy's network: a normalised observation through dense layers, by NumPy alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
}
OUTPUTS: dict[str, Callable[[Array], Array]] = {"linear": lambda x: x, "tanh": np.tanh}


@dataclass(frozen=True, eq=False)
class Network:
    """action = output(W_n ... activation(W_0 z + b_0) ... + b_n), z = clip((x - mean) scale).

    mean, scale: (inputs,); an entry of scale 0 is not read. clip: z lies within +-clip, None does
    not clip. weights: (outputs, inputs) of each layer, biases: (outputs,), both rounded to single
    precision, in which networks are trained; sums are in double precision, so that a row's result
    depends on the batch around it by rounding of the sixteenth digit only. activation: a name of
    `ACTIVATIONS`, between layers. output: of `OUTPUTS`, after the last one.

    Raises ValueError for shapes that do not fit, a number that is not finite, an unknown name.
    """

    mean: Array
    scale: Array
    weights: Sequence[Array]
    biases: Sequence[Array]
    activation: str = "tanh"
    output: str = "linear"
    clip: float | None = None

    def __post_init__(self) -> None:
        for name in ("mean", "scale"):
            object.__setattr__(self, name, np.array(getattr(self, name), np.float64))
        for name in ("weights", "biases"):
            single = [np.array(each, np.float32) for each in getattr(self, name)]
            object.__setattr__(self, name, tuple(each.astype(np.float64) for each in single))
        for name, known in (("activation", ACTIVATIONS), ("output", OUTPUTS)):
            if getattr(self, name) not in known:
                value = getattr(self, name)
                raise ValueError(f"unknown {name} {value!r}; known: {', '.join(known)}")
        if self.clip is not None and not self.clip > 0.0:
            raise ValueError(f"clip is above zero or None, got {self.clip!r}")
        self._check_shapes()
        self._check_numbers()

    def _check_shapes(self) -> None:
        if not self.weights or len(self.weights) != len(self.biases):
            raise ValueError(
                f"a network has a bias a layer, got {len(self.weights)} weights "
                f"and {len(self.biases)} biases"
            )
        wide = self.mean.shape
        if len(wide) != 1 or self.scale.shape != wide:
            raise ValueError(f"mean and scale are (inputs,), got {wide} and {self.scale.shape}")
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            if W.shape != (*b.shape, *wide) or b.ndim != 1:
                raise ValueError(
                    f"layer {i} takes {wide[0]} inputs, got weights {W.shape} and biases {b.shape}"
                )
            wide = b.shape

    def _check_numbers(self) -> None:
        arrays = {"mean": self.mean, "scale": self.scale}
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"the weights of layer {i}": W, f"the biases of layer {i}": b}
        for name, values in arrays.items():
            if not np.isfinite(values).all():
                raise ValueError(f"{name}: {int((~np.isfinite(values)).sum())} are not finite")
        if (self.scale < 0.0).any():
            raise ValueError("scale is below zero")

    @property
    def inputs(self) -> int:
        """Entries of an observation."""
        return len(self.mean)

    @property
    def hidden(self) -> tuple[int, ...]:
        """Sizes of the layers between."""
        return tuple(len(b) for b in self.biases[:-1])

    @property
    def width(self) -> int:
        """Numbers of an action."""
        return len(self.biases[-1])

    def reading(self, entries: npt.NDArray[np.bool_]) -> "Network":
        """The same network of these entries alone, the others at their mean; entries: (inputs,)."""
        first, *rest = self.weights
        return Network(
            self.mean[entries],
            self.scale[entries],
            (first[:, entries], *rest),
            self.biases,
            self.activation,
            self.output,
            self.clip,
        )

    def __call__(self, x: Array) -> Array:
        """(N, width) of observations (N, inputs)."""
        z = (x - self.mean) * self.scale
        if self.clip is not None:
            z = np.clip(z, -self.clip, self.clip)
        bend = ACTIVATIONS[self.activation]
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            z = bend(z @ W.T + b)
        return OUTPUTS[self.output](z @ self.weights[-1].T + self.biases[-1])
