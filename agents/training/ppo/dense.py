"""Dense layers on float32 rows, and the slopes of their numbers; in arrays that are made once."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Single = npt.NDArray[np.float32]
Activation = Callable[[Single, Single], Any]
_ONE = np.float32(1.0)


def _tanh(z: Single, slope: Single) -> None:
    np.tanh(z, out=z)
    np.multiply(z, z, out=slope)
    np.subtract(_ONE, slope, out=slope)


def _relu(z: Single, slope: Single) -> None:
    slope[...] = z > 0.0
    z *= slope


def _silu(z: Single, slope: Single) -> None:
    np.negative(z, out=slope)
    np.exp(slope, out=slope)
    slope += _ONE
    np.reciprocal(slope, out=slope)  # sigma
    z *= slope
    slope += z * (_ONE - slope)


ACTIVATIONS: dict[str, Activation] = {"Tanh": _tanh, "ReLU": _relu, "SiLU": _silu}
"""By torch's name: (z, slope), of which z becomes f(z), and slope its derivative there."""


class Layer(NamedTuple):
    """W (out, in) and b (out,), and where their slopes go."""

    W: Single
    b: Single
    W_slope: Single
    b_slope: Single


class Dense:
    """Layers with an activation between them, on at most so many rows at once."""

    def __init__(self, layers: Sequence[Layer], activation: Activation, rows: int) -> None:
        self._layers, self._activation = layers, activation
        self._units, self._slopes, self._errors = (
            [np.empty((rows, len(layer.b)), np.float32) for layer in layers] for _ in range(3)
        )
        self._ones = np.ones(rows, np.float32)
        self._x = np.empty((0, 0), np.float32)

    def __call__(self, x: Single) -> Single:
        """(n, out) of x (n, in); it stands until the next call."""
        self._x, n, last = x, len(x), len(self._layers) - 1
        for i, layer in enumerate(self._layers):
            z = self._units[i][:n]
            np.dot(x, layer.W.T, out=z)
            z += layer.b
            if i < last:
                self._activation(z, self._slopes[i][:n])
            x = z
        return x

    def back(self, error: Single) -> None:
        """Write the slopes of a number whose slopes to the last call's rows are these (n, out)."""
        n = len(error)
        for i in reversed(range(len(self._layers))):
            layer, x = self._layers[i], self._units[i - 1][:n] if i else self._x
            np.dot(error.T, x, out=layer.W_slope)
            np.dot(self._ones[:n], error, out=layer.b_slope)
            if i:
                below = self._errors[i - 1][:n]
                np.dot(error, layer.W, out=below)
                below *= self._slopes[i - 1][:n]
                error = below
