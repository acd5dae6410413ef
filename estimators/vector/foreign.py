"""A batch of users' own estimators, or of late ones: an object a row, one after the other."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ..wrappers.arguments import AnyEstimator, EstimatorSpec
from ..wrappers.outputs import write_outputs
from .batch import BatchEstimator, IntArray
from .designs import Build


class ForeignBatch(BatchEstimator):
    """N estimators of one factory, each an object of its row; none of them compiled.

    ValueError says that they have different states.

    Args:
        first: Estimator of row 0.
        specs: Vehicle, sensors and speed of each estimator, N of them.
        dt: Tick (s).
        build: Function that builds one estimator from its spec.
    """

    def __init__(
        self, first: AnyEstimator, specs: Sequence[EstimatorSpec], dt: float, build: Build
    ) -> None:
        self.name, self.dt, self.names, self.units = first.name, dt, first.names, first.units
        self._build = build
        self._estimators: list[AnyEstimator] = [first, *(build(spec) for spec in specs[1:])]
        self._design_keys = [spec.design for spec in specs]
        self.configure(range(len(specs)), specs)

    def __len__(self) -> int:
        return len(self._estimators)

    def __getitem__(self, i: int) -> AnyEstimator:
        return self._estimators[i]

    def configure(self, rows: Iterable[int], specs: Iterable[EstimatorSpec]) -> None:
        """Fit the estimators of some rows to their specs as `BatchEstimator.configure` does.

        Args:
            rows: Indices of the estimators.
            specs: Spec of each of these estimators.
        """
        for i, spec in zip(rows, specs, strict=True):
            if spec.design != self._design_keys[i]:
                self._estimators[i], self._design_keys[i] = self._build(spec), spec.design
            self._check_states(i, self[i].names)
            self[i].sensors = dict(spec.sensors)

    def take(
        self,
        mask: npt.NDArray[np.bool_] | None,
        fast: Array,
        rows: IntArray,
        packets: Array,
        counts: IntArray,
        *observed: Any,
    ) -> None:
        """Process rows and packets as `BatchEstimator.take` does.

        Args:
            mask: Estimators at work, bool, shape (N,); None for all.
            fast: Fast rows, shape (N, k, FAST_WIDTH).
            rows: Number of fast rows of each estimator, shape (N,).
            packets: Packets, shape (N, capacity, PACKET_WIDTH).
            counts: Number of packets of each estimator, shape (N,).
            *observed: Arguments of `kernel.observe_batch` after `counts`.
        """
        obs, inner, plan, limits, *row_arrays = observed
        chosen = np.arange(len(self)) if mask is None else np.flatnonzero(mask)
        for i in chosen.tolist():
            estimator, (beta, gamma, out, summary) = self[i], (array[i] for array in row_arrays)
            estimator.step(fast[i, : rows[i]], packets[i, : counts[i]])
            write_outputs(estimator, obs[i], inner, plan, limits, beta, gamma, out, summary)

    def get_state(self) -> Any:
        """Return deep copies of the users' objects."""
        return [estimator.get_state() for estimator in self._estimators]

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this batch or of one with the same specs.

        Args:
            snapshot: Result of `get_state`.
        """
        for estimator, state in zip(self._estimators, snapshot, strict=True):
            estimator.set_state(state)
