"""What a policy's network remembers with: torch's GRU and LSTM, and running means (traces)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

GATES = {"gru": 3, "lstm": 4}
"""Gates of a kind of cell, in torch's order: reset, update, candidate; or input, forget,
candidate, output."""
MAX_TIME = 1e9  # steps of a mean: beyond any drive, and a number that arrays hold
CELL_WEIGHTS = ("weight_in", "weight_state", "bias_in", "bias_state")
"""The arrays of a cell: torch's weight_ih, weight_hh, bias_ih and bias_hh."""


@dataclass(frozen=True, eq=False)
class RecurrentCell:
    """One layer of cells, whose state is all zero where an episode begins.

    kind: of `GATES`. weight_in: (gates size, inputs), weight_state: (gates size, size), bias_in,
    bias_state: (gates size,), the gates one below the other; all rounded to single precision.

    Raises ValueError for another kind, or shapes that do not fit together.
    """

    parts: ClassVar[tuple[str, ...]] = CELL_WEIGHTS
    kind: str
    weight_in: Array
    weight_state: Array
    bias_in: Array
    bias_state: Array

    def __post_init__(self) -> None:
        if self.kind not in GATES:
            raise ValueError(f"unknown cell {self.kind!r}; known: {', '.join(GATES)}")
        for name in CELL_WEIGHTS:
            single = np.array(getattr(self, name), np.float32)
            object.__setattr__(self, name, single.astype(np.float64))
        size, inputs = self.weight_state.shape[-1], self.weight_in.shape[-1]
        shapes = {name: getattr(self, name).shape for name in CELL_WEIGHTS}
        if shapes != compute_cell_shapes(self.kind, size, inputs):
            raise ValueError(f"the arrays of a {self.kind} cell do not fit together: {shapes}")

    @property
    def size(self) -> int:
        """Numbers of the output."""
        return len(self.weight_state[0])

    @property
    def memory(self) -> int:
        """Numbers of the state: the output, and of an LSTM what the cells hold behind it."""
        return self.size * (2 if self.kind == "lstm" else 1)

    @property
    def form(self) -> tuple[int, int, int, int]:
        """Gates, size, and two numbers of `MovingAverages` alone."""
        return GATES[self.kind], self.size, 0, 0

    @property
    def numbers(self) -> Array:
        """As compiled code takes them: each of `CELL_WEIGHTS`, weights (inputs, outputs) row by
        row."""
        return np.concatenate([getattr(self, name).T.ravel() for name in CELL_WEIGHTS])


@dataclass(frozen=True, eq=False)
class MovingAverages:
    """Units u = W z + b, of which the last ones are bent by SiLU, and running means of each.

    A mean is that of the episode so far, and from its time on a leaky one: a new u counts for
    max(1 / steps so far, 1 - exp(-1 / time)). No gate decides what is kept, so that minutes of a
    small signal add up; what is to be averaged, products too, the bent units make.

    weight_in: (units, inputs), bias_in: (units,), rounded to single precision. bent: how many are.
    times: of the means, in steps.

    Raises ValueError for shapes that do not fit together, or a number out of range.
    """

    kind: ClassVar[str] = "traces"
    parts: ClassVar[tuple[str, ...]] = ("weight_in", "bias_in")
    weight_in: Array
    bias_in: Array
    n_silu: int
    times: Sequence[float]

    def __post_init__(self) -> None:
        for name in self.parts:
            single = np.array(getattr(self, name), np.float32)
            object.__setattr__(self, name, single.astype(np.float64))
        object.__setattr__(self, "times", tuple(self.times))
        if self.weight_in.ndim != 2 or self.bias_in.shape != self.weight_in.shape[:1]:
            shapes = self.weight_in.shape, self.bias_in.shape
            raise ValueError(
                f"traces have weights (units, inputs) and biases (units,), got {shapes}"
            )
        if not 0 <= self.n_silu <= len(self.bias_in):
            raise ValueError(f"of {len(self.bias_in)} units {self.n_silu} cannot be bent")
        if not self.times or not all(0.0 < time <= MAX_TIME for time in self.times):
            raise ValueError(
                f"traces last one time or more, each above 0 steps and {MAX_TIME:g} at most, got "
                f"{self.times}"
            )

    @property
    def size(self) -> int:
        """Numbers of the output: the units, then the means of all of them, time by time."""
        return len(self.bias_in) * (1 + len(self.times))

    @property
    def memory(self) -> int:
        """Numbers of the state: steps so far, and the means."""
        return 1 + len(self.bias_in) * len(self.times)

    @property
    def form(self) -> tuple[int, int, int, int]:
        """No gates, units, how many are bent, and times."""
        return 0, len(self.bias_in), self.n_silu, len(self.times)

    @property
    def numbers(self) -> Array:
        """As compiled code takes them: what a new number counts for in the end, of each time, then
        weights (inputs, units) row by row, and biases."""
        shares = -np.expm1(-1.0 / np.array(self.times))
        return np.concatenate([shares, self.weight_in.T.ravel(), self.bias_in])


MemoryLayer = RecurrentCell | MovingAverages
"""What a network has between its observation and its dense layers."""


def compute_cell_shapes(kind: str, size: int, inputs: int) -> dict[str, tuple[int, ...]]:
    """The shape of each of `CELL_WEIGHTS`."""
    rows = GATES[kind] * size
    return dict(zip(CELL_WEIGHTS, ((rows, inputs), (rows, size), (rows,), (rows,)), strict=True))
