"""Memory of a policy's network: torch's GRU and LSTM, and running means (traces)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...envs.record import Array

GATES = {"gru": 3, "lstm": 4}
"""Gates of a kind of cell, in torch's order: reset, update, candidate; or input, forget,
candidate, output."""
MAX_TIME = 1e9  # steps of a mean: beyond any drive, and a number that arrays hold
CELL_WEIGHTS = ("weight_in", "weight_state", "bias_in", "bias_state")
"""The arrays of a cell: torch's weight_ih, weight_hh, bias_ih and bias_hh."""


@dataclass(frozen=True, eq=False)
class RecurrentCell:
    """One layer of cells, whose state is all zero where an episode begins.

    Arrays are rounded to single precision, their gates one below the other.

    Attributes:
        kind: Name of `GATES`.
        weight_in: Weights of the input, shape (gates size, inputs).
        weight_state: Weights of the state, shape (gates size, size).
        bias_in: Biases of the input, shape (gates size,).
        bias_state: Biases of the state, shape (gates size,).

    Raises:
        ValueError: Another kind, or shapes that do not fit together.
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
        """Number of outputs."""
        return len(self.weight_state[0])

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

    Attributes:
        weight_in: Weights, shape (units, inputs), rounded to single precision.
        bias_in: Biases, shape (units,), rounded to single precision.
        n_silu: Number of SiLU units.
        times: Times of the means (steps).

    Raises:
        ValueError: Shapes that do not fit together, or a number out of range.
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
        """Arrays as compiled code takes them.

        They are the final weight of a new number, of each time, then weights (inputs, units) row by
        row, and biases.
        """
        shares = -np.expm1(-1.0 / np.array(self.times))
        return np.concatenate([shares, self.weight_in.T.ravel(), self.bias_in])


MemoryLayer = RecurrentCell | MovingAverages
"""What a network has between its observation and its dense layers."""


def compute_cell_shapes(kind: str, size: int, inputs: int) -> dict[str, tuple[int, ...]]:
    """Compute the shape of each of `CELL_WEIGHTS`.

    Args:
        kind: Name of `GATES`.
        size: Number of outputs.
        inputs: Number of inputs.

    Returns:
        Shape by name.
    """
    rows = GATES[kind] * size
    return dict(zip(CELL_WEIGHTS, ((rows, inputs), (rows, size), (rows,), (rows,)), strict=True))
