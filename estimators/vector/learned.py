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
    """`observe_corrected` for the chosen filters.

    record, observed: the arguments of `kernel.observe_batch` from `fast` to `counts` and behind.
    corrections: memory (N, memory_size), net.
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
    """The filter inside of a learned estimator, by a name that pickle finds."""
    return build(spec).inner.base  # type: ignore[union-attr]


class LearnedBatch(BatchEstimator):
    """N learned estimators of one correction; `filters` are their filters' records.

    first: row 0's, built already. `memory`: (N, memory_size), the corrections' own.
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
        """As `BatchEstimator.configure`."""
        rows, specs = list(rows), list(specs)
        super().configure(rows, specs)
        self.memory[rows, MASS] = [spec.vehicle.mass for spec in specs]

    def take(self, mask: Any, *arguments: Any) -> None:
        """As `BatchEstimator.take`."""
        chosen = np.arange(len(self)) if mask is None else np.flatnonzero(mask)
        layers = self.filters, self._designs.pool, self._places, chosen
        _compile_correct_batch()(
            *layers, arguments[:4], arguments[4:], (self.memory, self.first.net)
        )

    def get_state(self) -> Any:
        """The filters and their corrections."""
        return self.filters.copy(), self.memory.copy()

    def set_state(self, snapshot: Any) -> None:
        """As `BatchEstimator.set_state`."""
        self.filters[:], self.memory[:] = snapshot


@functools.cache
def _compile_correct_batch() -> Any:
    """`correct_batch` as a plain call."""
    integers, cube = np.zeros(1, np.int64), np.zeros((1, 1, 1))
    layers = np.zeros((1, 1), FILTER), np.zeros(1), np.zeros((1, 4), np.int64), integers
    corrections = np.zeros((1, 1)), EXAMPLE
    return compile_call(
        correct_batch, *layers, (cube, integers, cube, integers), make_empty_outputs(1), corrections
    )
