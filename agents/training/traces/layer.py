"""Moving averages by torch, for training: `MovingAverages` of the runtime, by whole episodes."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ....envs.backend.extras import require_extra
from ....envs.record import Array
from ....estimators.learned.memory import MovingAverages
from .mixing import MIN_VARIANCE, SAMPLE_STRIDE, compute_whitening

with require_extra("train", "training needs torch"):
    import torch
    from torch import nn

TIMES = (3, 10, 30, 100, 300)
"""Steps of the means: of control periods of 10 ms from the motors' lag to half a drive."""
_BLOCK = 50  # steps whose means are one product of matrices
_MIN_SHARE = 1e-300  # instead of nothing: what a first step leaves of what was before


class TraceLayer(nn.Module):
    """The inputs and SiLU units, with the moving averages of all.

    The inputs and their averages are whitened: `mean` is subtracted, and `mixing` multiplies. The
    small difference of two of them often has most information, as of how a sensor changes.

    Args:
        inputs: Number of inputs.
        n_silu: Number of SiLU units.
        times: Steps of the moving averages.
    """

    def __init__(self, inputs: int, n_silu: int, times: Sequence[float] = TIMES) -> None:
        super().__init__()
        self.inputs, self.times = inputs, tuple(times)
        self.unit = nn.Linear(inputs, n_silu)
        n_linear = inputs * (1 + len(self.times))
        self.mean: torch.Tensor
        self.register_buffer("mean", torch.zeros(n_linear))
        self.mixing: torch.Tensor
        self.register_buffer("mixing", torch.eye(n_linear))

    @property
    def size(self) -> int:
        """Size of the output: inputs and their averages, then SiLU units and theirs."""
        return (self.inputs + self.unit.out_features) * (1 + len(self.times))

    def forward(self, z: Any, state: Any = None) -> tuple[Any, Any]:
        """Compute units and averages of inputs whose episodes began together.

        Args:
            z: Inputs, shape (B, T, k).
            state: Averages and number of steps so far, shape (B, times, units + 1); None at the
                start.

        Returns:
            Units and averages (B, T, size), and the next state.
        """
        u = torch.cat([z, nn.functional.silu(self.unit(z))], -1)
        if state is None:
            state = u.new_zeros(len(u), len(self.times), u.shape[-1] + 1)
        first, means, blocks = int(state[0, 0, -1]), state[..., :-1], []
        for part in torch.split(u, _BLOCK, 1):
            new, old = _compute_weights(self.times, first, part.shape[1])
            values = torch.einsum("nts,bsk->bntk", new, part) + old[..., None] * means[:, :, None]
            blocks.append(values)
            first, means = first + part.shape[1], values[:, :, -1]
        all_values = torch.cat([u[:, None], torch.cat(blocks, 2)], 1).transpose(1, 2)
        linear, silu = (values.flatten(2) for values in all_values.tensor_split([self.inputs], -1))
        age = means.new_full((*means.shape[:-1], 1), float(first))
        mixed = (linear - self.mean) @ self.mixing
        return torch.cat([mixed, silu], -1), torch.cat([means, age], -1)

    def fit_whitening(self, samples: Sequence[tuple[Any, Any]]) -> None:
        """Fit the whitening of inputs and their averages.

        Args:
            samples: Inputs (B, T, k) and masks (B, T) of the steps that count.
        """
        with torch.no_grad():
            outputs = [
                self(torch.from_numpy(z))[0][..., : len(self.mean)][torch.from_numpy(mask)][
                    ::SAMPLE_STRIDE
                ]
                for z, mask in samples
            ]
        linear = torch.cat(outputs).numpy()
        self.mean.copy_(torch.from_numpy(linear.mean(0)))
        self.mixing.copy_(torch.from_numpy(compute_whitening(linear, MIN_VARIANCE)))

    def cell(self, mixing: Array) -> MovingAverages:
        """Make the runtime's layer for inputs that are mixed first.

        Args:
            mixing: Mixing of the inputs, shape (k, k).

        Returns:
            Layer of plain NumPy arrays.
        """
        silu_weights = self.unit.weight.detach().numpy() @ mixing
        bias = np.concatenate([np.zeros(self.inputs), self.unit.bias.detach().numpy()])
        return MovingAverages(
            np.concatenate([mixing, silu_weights]), bias, self.unit.out_features, self.times
        )

    def convert_weights(self, weight: Array, bias: Array) -> tuple[Array, Array]:
        """Convert the next layer's weights for the output of `cell`.

        That output is in the order of times, inputs before SiLU units, without whitening.

        Args:
            weight: Weights, shape (m, size).
            bias: Biases, shape (m,).

        Returns:
            Weights and biases, shape (m,).
        """
        size, times = len(self.mean), 1 + len(self.times)
        linear = weight[:, :size] @ self.mixing.numpy().astype(np.float64).T
        bias = bias - linear @ self.mean.numpy()
        parts = [block.reshape(len(bias), times, -1) for block in (linear, weight[:, size:])]
        return np.concatenate(parts, -1).reshape(len(bias), -1), bias


@functools.cache
def _compute_weights(times: tuple[float, ...], first: int, steps: int) -> tuple[Any, Any]:
    """Compute the weights of a block's moving averages.

    Returns each step's weight (times, T, T) and the past's (times, T). first: steps before the
    block.
    """
    ages = first + 1.0 + np.arange(steps)
    shares = np.maximum(1.0 / ages, -np.expm1(-1.0 / np.array(times))[:, None])
    left = np.log(np.maximum(1.0 - shares, _MIN_SHARE)).cumsum(-1)
    since = left[:, :, None] - left[:, None, :]
    new = np.tril(np.exp(np.minimum(since, 0.0))) * shares[:, None, :]
    return (
        torch.from_numpy(new.astype(np.float32)),
        torch.from_numpy(np.exp(left).astype(np.float32)),
    )
