"""The few different filters of a batch: each is designed once, their gains lie in one pool."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.backend.decorators import jit_nrt
from ...envs.record import Array
from ..estimator import Estimator
from ..wrappers.arguments import AnyEstimator, EstimatorSpec

Build = Callable[[EstimatorSpec], AnyEstimator]


@jit_nrt
def get_gains(pool: Any, place: Any) -> Any:
    """Return the table of gains at a place in the pool.

    Args:
        pool: Gains of all filters in one array, shape (total,).
        place: Offset, cells, rows and columns, shape (4,).

    Returns:
        View of shape (cells, rows, columns).
    """
    start, cells, height, width = place[0], place[1], place[2], place[3]
    return pool[start : start + cells * height * width].reshape((cells, height, width))


class GainPool:
    """Estimators of the package by the design of their specs, and the pool of their gains.

    Args:
        build: Function that builds one estimator from its spec.
    """

    def __init__(self, build: Build) -> None:
        self._build = build
        self._estimators: dict[Any, Estimator] = {}
        self._places: dict[Any, tuple[int, ...]] = {}
        self.pool = np.zeros(0)

    def __getitem__(self, design: Any) -> Estimator:
        return self._estimators[design]

    def get_estimator(self, spec: EstimatorSpec) -> Estimator:
        """Return the estimator for a spec, built unless it is at hand.

        Args:
            spec: Vehicle, sensors and speed.

        Returns:
            An estimator of the spec's design.

        Raises:
            TypeError: The factory builds an `Estimator` for other specs and something else for this
                one.
        """
        design = spec.design
        if design not in self._estimators:
            estimator = self._build(spec)
            if not isinstance(estimator, Estimator):
                raise TypeError(
                    f"a batch is of filters of ours or of none, got {estimator!r} as well"
                )
            self._estimators[design] = estimator
        return self._estimators[design]

    def gains(self, design: Any) -> Array:
        """Return the table of a design, to be read and written in the pool.

        Args:
            design: `EstimatorSpec.design`.

        Returns:
            View of shape (cells, rows, columns).
        """
        start, *shape = self._places[design]
        return self.pool[start : start + int(np.prod(shape))].reshape(shape)

    def place(self, used_keys: Sequence[Any]) -> npt.NDArray[np.int64]:
        """Lay the gains of the designs in use side by side in a new pool and drop the others.

        Args:
            used_keys: Design of each row, N of them.

        Returns:
            Offset and shape of each row's table, shape (N, 4).
        """
        self._estimators = {design: self._estimators[design] for design in dict.fromkeys(used_keys)}
        tables = [
            self.gains(design) if design in self._places else estimator.gains
            for design, estimator in self._estimators.items()
        ]
        ends = np.cumsum([table.size for table in tables])
        self.pool = np.concatenate([table.ravel() for table in tables])
        self._places = {
            design: (int(end) - table.size, *table.shape)
            for design, table, end in zip(self._estimators, tables, ends, strict=True)
        }
        return np.array([self._places[design] for design in used_keys], np.int64)
