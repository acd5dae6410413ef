"""Adam's step in NumPy, on the parameters and the state of torch's optimiser."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ....envs.backend.extras import extra
from .dense import Single

with extra("train", "training needs {}"):
    import torch

_NEAR_ZERO = 1e-6  # added to a norm, as `torch.nn.utils.clip_grad_norm_` does


class Adam:
    """An optimiser's tensors, one behind the other in a vector, and the slopes that a step takes.

    parameters, slopes: as many arrays as tensors, in their order and shapes.
    """

    def __init__(self, optimizer: torch.optim.Adam, tensors: Sequence[torch.Tensor]) -> None:
        self._optimizer, self._tensors = optimizer, tensors
        states = [optimizer.state.get(each, {}) for each in tensors]
        self._steps = int(states[0]["step"]) if states[0] else 0
        self._flat = _joined(tensors)
        self._mean, self._square = (
            _joined(
                [
                    state.get(name, torch.zeros_like(t))
                    for state, t in zip(states, tensors, strict=True)
                ]
            )
            for name in ("exp_avg", "exp_avg_sq")
        )
        self._slopes = np.zeros_like(self._flat)
        self.parameters, self.slopes = self._apart(self._flat), self._apart(self._slopes)

    def step(self, longest: float) -> None:
        """Go down the slopes, which are made shorter first where all together are longer."""
        group, g, one = self._optimizer.param_groups[0], self._slopes, np.float32(1.0)
        g *= np.float32(min(1.0, longest / (float(np.sqrt(g @ g)) + _NEAR_ZERO)))
        self._steps += 1
        first, second = (np.float32(beta) for beta in group["betas"])
        self._mean *= first
        self._mean += (one - first) * g
        self._square *= second
        self._square += (one - second) * (g * g)
        rate, root = (1.0 - beta**self._steps for beta in group["betas"])
        scale = np.sqrt(self._square) / np.float32(np.sqrt(root)) + np.float32(group["eps"])
        self._flat -= np.float32(group["lr"] / rate) * self._mean / scale

    def write_back(self) -> None:
        """Hand parameters and state over to torch."""
        parts = zip(*map(self._apart, (self._flat, self._mean, self._square)), strict=True)
        with torch.no_grad():
            for tensor, (values, mean, square) in zip(self._tensors, parts, strict=True):
                tensor.copy_(torch.from_numpy(values))
                self._optimizer.state[tensor] = {
                    "step": torch.tensor(float(self._steps)),
                    "exp_avg": torch.from_numpy(mean.copy()),
                    "exp_avg_sq": torch.from_numpy(square.copy()),
                }

    def _apart(self, flat: Single) -> list[Single]:
        ends = np.cumsum([each.numel() for each in self._tensors])[:-1]
        parts = zip(np.split(flat, ends), self._tensors, strict=True)
        return [part.reshape(tuple(tensor.shape)) for part, tensor in parts]


def _joined(tensors: Sequence[Any]) -> Single:
    return np.concatenate([each.detach().numpy().ravel() for each in tensors])
