"""A batch of users' own estimators, or of late ones: an object a row, one after the other."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..wrappers.arguments import AnyEstimator, Setup
from ..wrappers.outputs import write
from .batch import Array, BatchEstimator, Whole
from .designs import Build


class ForeignBatch(BatchEstimator):
    """N estimators of one factory, each an object of its row; none of them compiled.

    first: row 0's, built already. Raises ValueError if they have different states.
    """

    def __init__(
        self, first: AnyEstimator, setups: Sequence[Setup], dt: float, build: Build
    ) -> None:
        self.name, self.dt, self.names, self.units = first.name, dt, first.names, first.units
        self._build = build
        self._estimators: list[AnyEstimator] = [first, *(build(each) for each in setups[1:])]
        self._of = [each.design for each in setups]
        self.configure(range(len(setups)), setups)

    def __len__(self) -> int:
        return len(self._estimators)

    def __getitem__(self, i: int) -> AnyEstimator:
        return self._estimators[i]

    def configure(self, rows: Iterable[int], setups: Iterable[Setup]) -> None:
        """As `BatchEstimator.configure`."""
        for i, setup in zip(rows, setups, strict=True):
            if setup.design != self._of[i]:
                self._estimators[i], self._of[i] = self._build(setup), setup.design
            self._check_states(i, self[i].names)
            self[i].sensors = dict(setup.sensors)

    def take(
        self,
        mask: npt.NDArray[np.bool_] | None,
        fast: Array,
        rows: Whole,
        packets: Array,
        counts: Whole,
        *observed: Any,
    ) -> None:
        """As `BatchEstimator.take`."""
        obs, inner, plan, limits, *others = observed
        chosen = np.arange(len(self)) if mask is None else np.flatnonzero(mask)
        for i in chosen.tolist():
            own, (beta, gamma, out, summary) = self[i], (each[i] for each in others)
            own.step(fast[i, : rows[i]], packets[i, : counts[i]])
            write(own, obs[i], inner, plan, limits, beta, gamma, out, summary)

    def get_state(self) -> Any:
        """As `BatchEstimator.get_state`: deep copies of the users' objects."""
        return [each.get_state() for each in self._estimators]

    def set_state(self, snapshot: Any) -> None:
        """As `BatchEstimator.set_state`."""
        for own, state in zip(self._estimators, snapshot, strict=True):
            own.set_state(state)
