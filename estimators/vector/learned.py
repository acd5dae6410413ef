"""A batch of learned estimators: all filters and their corrections in one compiled call."""

import copy
import functools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ...envs.backend.decorators import counted
from ..core.memory import FILTER
from ..entry import entry
from ..learned.correction import Learned
from ..learned.kernel import EXAMPLE, MASS
from ..protocol import ForeignEstimator
from ..wrappers.arguments import Setup
from ..wrappers.kernel import observe_corrected
from .batch import BatchEstimator
from .designs import Build, gains_of
from .kernel import nothing_observed


@counted
def correct_batch(
    filters: Any, pool: Any, places: Any, chosen: Any, record: Any, observed: Any, own: Any
) -> None:
    """`observe_corrected` for the chosen filters.

    record, observed: the arguments of `kernel.observe_batch` from `fast` to `counts` and behind.
    own: memory (N, memory_size), net.
    """
    fast, rows, packets, counts = record
    obs, inner, plan, limits, beta, gamma, out, summary = observed
    memory, net = own
    for k in range(len(chosen)):
        i = chosen[k]
        one, gains = (fast[i], rows[i], packets[i], counts[i]), gains_of(pool, places[i])
        told = obs[i], inner, plan, limits, beta[i], gamma[i], out[i], summary[i]
        observe_corrected(filters[i], gains, one, memory[i], net, told)


def _base(build: Build, setup: Setup) -> Any:
    """The filter inside of a learned estimator, by a name that pickle finds."""
    return build(setup).inner.base  # type: ignore[union-attr]


class LearnedBatch(BatchEstimator):
    """N learned estimators of one correction; `filters` are their filters' records.

    first: row 0's, built already. `memory`: (N, memory_size), the corrections' own.
    """

    def __init__(
        self, first: ForeignEstimator, setups: Sequence[Setup], dt: float, build: Build
    ) -> None:
        self.first: Learned = first.inner  # type: ignore[assignment]
        self.memory = np.zeros((len(setups), len(self.first.memory)))
        super().__init__(first.name, setups, dt, functools.partial(_base, build))

    def __getitem__(self, i: int) -> Any:
        own = copy.copy(self.first)
        own.base, own.memory = super().__getitem__(i), self.memory[i]
        return ForeignEstimator(own, self.name, self.dt, own.base.sensors)

    def configure(self, rows: Iterable[int], setups: Iterable[Setup]) -> None:
        """As `BatchEstimator.configure`."""
        rows, setups = list(rows), list(setups)
        super().configure(rows, setups)
        self.memory[rows, MASS] = [each.vehicle.mass for each in setups]

    def take(self, mask: Any, *arguments: Any) -> None:
        """As `BatchEstimator.take`."""
        chosen = np.arange(len(self)) if mask is None else np.flatnonzero(mask)
        layers = self.filters, self._designs.pool, self._places, chosen
        _entry()(*layers, arguments[:4], arguments[4:], (self.memory, self.first.net))

    def get_state(self) -> Any:
        """The filters and their corrections."""
        return self.filters.copy(), self.memory.copy()

    def set_state(self, snapshot: Any) -> None:
        """As `BatchEstimator.set_state`."""
        self.filters[:], self.memory[:] = snapshot


@functools.cache
def _entry() -> Any:
    """`correct_batch` as a plain call."""
    whole, cube = np.zeros(1, np.int64), np.zeros((1, 1, 1))
    layers = np.zeros((1, 1), FILTER), np.zeros(1), np.zeros((1, 4), np.int64), whole
    own = np.zeros((1, 1)), EXAMPLE
    return entry(correct_batch, *layers, (cube, whole, cube, whole), nothing_observed(1), own)
