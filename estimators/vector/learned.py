"""A batch of learned estimators: all filters and their corrections in one compiled call."""

import copy
import functools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit_nrt
from ..core.memory import FILTER
from ..entry import compile_call
from ..learned.correction import LearnedEstimator
from ..learned.kernel import EXAMPLE, MASS
from ..protocol import ForeignEstimator
from ..wrappers.arguments import EstimatorSpec
from ..wrappers.kernel import observe_corrected
from .batch import BatchEstimator
from .designs import Build, get_gains
from .kernel import make_empty_outputs


@jit_nrt
def correct_batch(
    filters: Any, pool: Any, places: Any, chosen: Any, record: Any, observed: Any, corrections: Any
) -> None:
    """Call `observe_corrected` for the chosen filters.

    Args:
        filters: Memories, dtype `FILTER`, shape (N, layers).
        pool: Gains of all filters in one array, shape (total,).
        places: Place of each filter's gains in the pool, shape (N, 4), see `get_gains`.
        chosen: Indices of the filters.
        record: Arguments of `kernel.observe_batch` from `fast` to `counts`.
        observed: Arguments of `kernel.observe_batch` behind `counts`.
        corrections: Memories of the corrections, shape (N, memory_size), and the network.
    """
    fast, rows, packets, counts = record
    obs, inner, plan, limits, beta, gamma, out, summary = observed
    memory, net = corrections
    for k in range(len(chosen)):
        i = chosen[k]
        row_record, gains = (fast[i], rows[i], packets[i], counts[i]), get_gains(pool, places[i])
        outputs = obs[i], inner, plan, limits, beta[i], gamma[i], out[i], summary[i]
        observe_corrected(filters[i], gains, row_record, memory[i], net, outputs)


def _build_base(build: Build, spec: EstimatorSpec) -> Any:
    """Build the filter inside of a learned estimator, by a name that pickle finds."""
    return build(spec).inner.base  # type: ignore[union-attr]


class LearnedBatch(BatchEstimator):
    """N learned estimators of one correction; `filters` are their filters' records.

    Args:
        first: Estimator of row 0.
        specs: Vehicle, sensors and speed of each estimator, N of them.
        dt: Tick (s).
        build: Function that builds one estimator from its spec.

    Attributes:
        memory: Memories of the corrections, shape (N, memory_size).
    """

    def __init__(
        self, first: ForeignEstimator, specs: Sequence[EstimatorSpec], dt: float, build: Build
    ) -> None:
        self.first: LearnedEstimator = first.inner  # type: ignore[assignment]
        self.memory = np.zeros((len(specs), len(self.first.memory)))
        super().__init__(first.name, specs, dt, functools.partial(_build_base, build))

    def __getitem__(self, i: int) -> Any:
        estimator = copy.copy(self.first)
        estimator.base, estimator.memory = super().__getitem__(i), self.memory[i]
        return ForeignEstimator(estimator, self.name, self.dt, estimator.base.sensors)

    def configure(self, rows: Iterable[int], specs: Iterable[EstimatorSpec]) -> None:
        """Fit the filters of some rows to their specs as `BatchEstimator.configure` does.

        Args:
            rows: Indices of the filters.
            specs: Spec of each of these filters.
        """
        rows, specs = list(rows), list(specs)
        super().configure(rows, specs)
        self.memory[rows, MASS] = [spec.vehicle.mass for spec in specs]

    def take(self, mask: Any, *arguments: Any) -> None:
        """Process rows and packets as `BatchEstimator.take` does.

        Args:
            mask: Filters at work, bool, shape (N,); None for all.
            *arguments: Arguments of `kernel.observe_batch` from `fast` on.
        """
        chosen = np.arange(len(self)) if mask is None else np.flatnonzero(mask)
        layers = self.filters, self._designs.pool, self._places, chosen
        _compile_correct_batch()(
            *layers, arguments[:4], arguments[4:], (self.memory, self.first.net)
        )

    def get_state(self) -> Any:
        """Return copies of the filters and of their corrections."""
        return self.filters.copy(), self.memory.copy()

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this batch or of one with the same specs.

        Args:
            snapshot: Result of `get_state`.
        """
        self.filters[:], self.memory[:] = snapshot


@functools.cache
def _compile_correct_batch() -> Any:
    """Return `correct_batch` as a plain call."""
    integers, cube = np.zeros(1, np.int64), np.zeros((1, 1, 1))
    layers = np.zeros((1, 1), FILTER), np.zeros(1), np.zeros((1, 4), np.int64), integers
    corrections = np.zeros((1, 1)), EXAMPLE
    return compile_call(
        correct_batch, *layers, (cube, integers, cube, integers), make_empty_outputs(1), corrections
    )
