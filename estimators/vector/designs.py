"""The few different filters of a batch: each is designed once, their gains lie in one pool."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.backend.decorators import counted
from ..estimator import Estimator
from ..wrappers.arguments import AnyEstimator, Setup

Array = npt.NDArray[np.float64]
Build = Callable[[Setup], AnyEstimator]


@counted
def gains_of(pool: Any, place: Any) -> Any:
    """The gains that lie in the pool at a place: (offset, then their shape)."""
    start, cells, height, width = place[0], place[1], place[2], place[3]
    return pool[start : start + cells * height * width].reshape((cells, height, width))


class Designs:
    """Estimators of ours by the design of their setups, and the pool of their gains."""

    def __init__(self, build: Build) -> None:
        self._build = build
        self._built: dict[Any, Estimator] = {}
        self._places: dict[Any, tuple[int, ...]] = {}
        self.pool = np.zeros(0)

    def __getitem__(self, design: Any) -> Estimator:
        return self._built[design]

    def built(self, setup: Setup) -> Estimator:
        """The estimator for this, built unless it is at hand.

        Raises TypeError where a factory that built a filter of ours builds something else.
        """
        design = setup.design
        if design not in self._built:
            found = self._build(setup)
            if not isinstance(found, Estimator):
                raise TypeError(f"a batch is of filters of ours or of none, got {found!r} as well")
            self._built[design] = found
        return self._built[design]

    def gains(self, design: Any) -> Array:
        """The table of a design, to be read and written in the pool."""
        start, *shape = self._places[design]
        return self.pool[start : start + int(np.prod(shape))].reshape(shape)

    def place(self, used: Sequence[Any]) -> npt.NDArray[np.int64]:
        """Lay the gains of the designs in use side by side in a new pool and drop the others.

        Returns where each one's lie, (len(used), 4): offset and shape.
        """
        self._built = {design: self._built[design] for design in dict.fromkeys(used)}
        tables = [
            self.gains(design) if design in self._places else built.gains
            for design, built in self._built.items()
        ]
        ends = np.cumsum([table.size for table in tables])
        self.pool = np.concatenate([table.ravel() for table in tables])
        self._places = {
            design: (int(end) - table.size, *table.shape)
            for design, table, end in zip(self._built, tables, ends, strict=True)
        }
        return np.array([self._places[design] for design in used], np.int64)
