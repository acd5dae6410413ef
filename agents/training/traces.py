"""Running means by torch, for training: `Traces` of the runtime, whole episodes at once."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...envs.backend.extras import extra
from ...estimators.learned.memory import Array, Traces

with extra("train", "training needs torch"):
    import torch
    from torch import nn

TIMES = (3, 10, 30, 100, 300)
"""Steps of the means: of control periods of 10 ms from the motors' lag to half a drive."""
_BLOCK = 50  # steps whose means are one product of matrices
_LEAST = 1e-300  # instead of nothing: what a first step leaves of what was before


class TraceLayer(nn.Module):
    """The inputs themselves mixed, so many bent units, and the means of all.

    inputs: as many units stay plain. bent: units behind SiLU.
    """

    def __init__(self, inputs: int, bent: int, times: Sequence[float] = TIMES) -> None:
        super().__init__()
        self.bent, self.times = bent, tuple(times)
        self.unit = nn.Linear(inputs, inputs + bent)
        with torch.no_grad():
            self.unit.weight[:inputs] = torch.eye(inputs)
            self.unit.bias[:inputs] = 0.0

    @property
    def size(self) -> int:
        """Numbers of the output."""
        return self.unit.out_features * (1 + len(self.times))

    def forward(self, z: Any, state: Any = None) -> tuple[Any, Any]:
        """(units and their means (B, T, size), the next state) of inputs (B, T, k), all of one age.

        state: (B, times, units + 1) means, and steps so far; None where episodes begin.
        """
        u = self.unit(z)
        plain, bent = u[..., : -self.bent or None], u[..., u.shape[-1] - self.bent :]
        u = torch.cat([plain, nn.functional.silu(bent)], -1) if self.bent else u
        if state is None:
            state = u.new_zeros(len(u), len(self.times), u.shape[-1] + 1)
        first, means, found = int(state[0, 0, -1]), state[..., :-1], []
        for part in u.split(_BLOCK, 1):
            new, old = _weights(self.times, first, part.shape[1])
            each = torch.einsum("nts,bsk->bntk", new, part) + old[..., None] * means[:, :, None]
            found.append(each)
            first, means = first + part.shape[1], each[:, :, -1]
        traces = torch.cat(found, 2).transpose(1, 2).flatten(2)
        age = means.new_full((*means.shape[:-1], 1), float(first))
        return torch.cat([u, traces], -1), torch.cat([means, age], -1)

    def cell(self, mixing: Array) -> Traces:
        """The same of inputs that are mixed first, (k, k), by NumPy."""
        weight = self.unit.weight.detach().numpy() @ mixing
        return Traces(weight, self.unit.bias.detach().numpy().copy(), self.bent, self.times)


@functools.cache
def _weights(times: tuple[float, ...], first: int, steps: int) -> tuple[Any, Any]:
    """What each step of a block counts for in the means of each, (times, T, T), and what was
    before, (times, T); first: steps before the block."""
    ages = first + 1.0 + np.arange(steps)
    shares = np.maximum(1.0 / ages, -np.expm1(-1.0 / np.array(times))[:, None])
    left = np.log(np.maximum(1.0 - shares, _LEAST)).cumsum(-1)
    since = left[:, :, None] - left[:, None, :]
    new = np.tril(np.exp(np.minimum(since, 0.0))) * shares[:, None, :]
    return (
        torch.from_numpy(new.astype(np.float32)),
        torch.from_numpy(np.exp(left).astype(np.float32)),
    )
