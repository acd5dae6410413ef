"""Recurrent cells of a policy's network: the numbers of torch's GRU and LSTM."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

GATES = {"gru": 3, "lstm": 4}
"""Gates of a kind of cell, in torch's order: reset, update, candidate; or input, forget,
candidate, output."""
PARTS = ("weight_in", "weight_state", "bias_in", "bias_state")
"""The arrays of a cell: torch's weight_ih, weight_hh, bias_ih and bias_hh."""


@dataclass(frozen=True, eq=False)
class Cell:
    """One layer of cells, whose state is all zero where an episode begins.

    kind: of `GATES`. weight_in: (gates size, inputs), weight_state: (gates size, size), bias_in,
    bias_state: (gates size,), the gates one below the other; all rounded to single precision.

    Raises ValueError for another kind, or shapes that do not fit together.
    """

    kind: str
    weight_in: Array
    weight_state: Array
    bias_in: Array
    bias_state: Array

    def __post_init__(self) -> None:
        if self.kind not in GATES:
            raise ValueError(f"unknown cell {self.kind!r}; known: {', '.join(GATES)}")
        for name in PARTS:
            single = np.array(getattr(self, name), np.float32)
            object.__setattr__(self, name, single.astype(np.float64))
        size, inputs = self.weight_state.shape[-1], self.weight_in.shape[-1]
        shapes = {name: getattr(self, name).shape for name in PARTS}
        if shapes != cell_shapes(self.kind, size, inputs):
            raise ValueError(f"the arrays of a {self.kind} cell do not fit together: {shapes}")

    @property
    def size(self) -> int:
        """Numbers of the output."""
        return len(self.weight_state[0])

    @property
    def memory(self) -> int:
        """Numbers of the state: the output, and of an LSTM what the cells hold behind it."""
        return self.size * (2 if self.kind == "lstm" else 1)


def cell_shapes(kind: str, size: int, inputs: int) -> dict[str, tuple[int, ...]]:
    """The shape of each of `PARTS`."""
    rows = GATES[kind] * size
    return dict(zip(PARTS, ((rows, inputs), (rows, size), (rows,), (rows,)), strict=True))
