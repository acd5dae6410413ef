"""Many filters of one kind side by side, compiled together, or an object a row."""

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.numerics.simd8 import allocate_aligned
from ...envs.record import Array
from ..core.filter import StepRecord
from ..core.record import FILTER
from ..estimator import Estimator
from ..wrappers.estimate import AnyEstimator, EstimatorSpec
from ..wrappers.outputs import Observed, write_outputs
from .lane_ticks import FilterBank
from .lanes import compile_observe_batch, make_blocks

Build = Callable[..., AnyEstimator]
_Mask = npt.NDArray[np.bool_]


class _GainPool:
    """Estimators by the design of their specs, and their gains in one flat array, the pool."""

    def __init__(self, build: Build) -> None:
        self._build = build
        self._estimators: dict[Any, Estimator] = {}
        self._places: dict[Any, tuple[int, ...]] = {}
        self.pool = np.zeros(0)

    def __getitem__(self, design: Any) -> Estimator:
        return self._estimators[design]

    def get_estimator(self, spec: EstimatorSpec) -> Estimator:
        """Return the estimator for a spec, built unless it is at hand."""
        design = spec.design
        if design not in self._estimators:
            estimator = self._build(**spec._asdict())
            if not isinstance(estimator, Estimator):
                text = "a batch is of filters of ours or of none"
                raise TypeError(f"{text}, got {estimator!r} as well")
            self._estimators[design] = estimator
        return self._estimators[design]

    def gains(self, design: Any) -> Array:
        """Return a design's table in the pool, shape (cells, rows, columns)."""
        start, *shape = self._places[design]
        return self.pool[start : start + int(np.prod(shape))].reshape(shape)

    def place(self, used_keys: Sequence[Any]) -> npt.NDArray[np.int64]:
        """Lay the gains of all rows' designs side by side in a new pool: their places, (N, 4)."""
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


class BatchEstimator:
    """N filters of one name in one compiled call.

    `batch[i]` is the `Estimator` at work in row i: it shares that row's memory in `filters`, shape
    (N, layers). Filters of equal specs, but for the phases of clocks, share one table of gains.
    ValueError says that the filters have different states.

    Args:
        name: Name of the filters.
        specs: Vehicle, sensors and speed of each filter, N of them.
        dt: Tick (s).
        build: Function that builds one filter from its spec.
    """

    def __init__(self, name: str, specs: Sequence[EstimatorSpec], dt: float, build: Build) -> None:
        self.name, self.dt = name, dt
        self._designs = _GainPool(build)
        self._specs: list[EstimatorSpec] = list(specs)
        self._design_keys: list[Any] = [None] * len(specs)  # each row's design
        first = self._designs.get_estimator(specs[0])
        self.names, self.units = first.names, first.units
        self.filters = allocate_aligned((len(specs), len(first.filters)), FILTER)
        self.configure(range(len(specs)), specs)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy: its records lie on cache lines, too, and its lanes are empty."""
        self.__dict__.update(state)
        if "filters" not in state:  # estimators of a user's, each an object of its own
            return
        filters, self.filters = self.filters, allocate_aligned(self.filters.shape, FILTER)
        self.filters[:], self._lanes = filters, make_blocks(len(filters))

    def __len__(self) -> int:
        return len(self.filters)

    def __getitem__(self, i: int) -> Any:
        design = self._design_keys[i]
        estimator = copy.copy(self._designs[design])
        estimator.sensors = {name: self._specs[i].sensors[name] for name in estimator.sensors}
        estimator.filters, estimator.gains = self.filters[i], self._designs.gains(design)
        return estimator

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))

    def configure(self, rows: Iterable[int], specs: Iterable[EstimatorSpec]) -> None:
        """Fit the filters of some rows to their specs; a reset has to follow.

        A filter whose spec differs in more than the phases of its clocks is built anew.

        Args:
            rows: Indices of the filters.
            specs: Spec of each of these filters.
        """
        has_changed = False
        for i, spec in zip(rows, specs, strict=True):
            self._specs[i], design = spec, spec.design
            if design == self._design_keys[i]:
                continue
            built = self._designs.get_estimator(spec)
            self._check_states(i, built.names)
            self._design_keys[i], self.filters[i], has_changed = design, built.filters, True
        if has_changed:
            self._lanes = make_blocks(len(self))  # empty: they hold models
            self._places = self._designs.place(self._design_keys)

    def _check_states(self, i: int, names: tuple[str, ...]) -> None:
        if names != self.names:
            first, other = ", ".join(self.names), ", ".join(names)
            text = f"{self.name}: the filters of a batch have the same states"
            raise ValueError(f"{text}, row 0 has {first} and row {i} {other}")

    def reset(self, mask: _Mask) -> None:
        """Reset some filters to the clocks of their specs.

        Args:
            mask: Filters to reset, bool, shape (N,).
        """
        for i in np.flatnonzero(mask).tolist():
            self[i].reset()

    def take(self, mask: _Mask | None, record: StepRecord, observed: Observed) -> None:
        """Process rows and packets of some filters and write their outputs.

        Args:
            mask: Filters at work, bool, shape (N,); None for all.
            record: Records of N cars.
            observed: Observations and outputs of N cars.
        """
        done = np.full(len(self), -1) if mask is None else np.where(mask, -1, record.rows)
        bank = FilterBank(self.filters, self._designs.pool, self._places)
        while compile_observe_batch()(bank, done, self._lanes, record, observed) > 0:
            missing = np.flatnonzero(done < record.rows)  # without gains; each design is made once
            keys = [(self._design_keys[i], int(self.filters[i, 0].missing_cell)) for i in missing]
            for i in dict(zip(keys, missing.tolist(), strict=True)).values():
                self[i].design_missing()

    def get_state(self) -> Any:
        """Return a snapshot, from which `set_state` restores every bit."""
        return self.filters.copy()

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this batch or of one with the same specs.

        Args:
            snapshot: Result of `get_state`.
        """
        self.filters[:] = snapshot

    def __repr__(self) -> str:
        return f"<{len(self)} x {self.name}: {', '.join(self.names)}>"


class ForeignBatch(BatchEstimator):
    """N estimators of one factory, each an object of its row; none of them compiled.

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
        self._build, others = build, [build(**spec._asdict()) for spec in specs[1:]]
        self._estimators: list[AnyEstimator] = [first, *others]
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
                self._estimators[i] = self._build(**spec._asdict())
                self._design_keys[i] = spec.design
            self._check_states(i, self[i].names)
            self[i].sensors = dict(spec.sensors)

    def take(self, mask: _Mask | None, record: StepRecord, observed: Observed) -> None:
        """Process rows and packets as `BatchEstimator.take` does.

        Args:
            mask: Estimators at work, bool, shape (N,); None for all.
            record: Records of N cars.
            observed: Observations and outputs of N cars.
        """
        chosen = (np.arange(len(self)) if mask is None else np.flatnonzero(mask)).tolist()
        obs, table, beta, gamma, out, summary = observed
        for i in self._step_rows(chosen, record):
            row = Observed(obs[i], table, beta[i], gamma[i], out[i], summary[i])
            write_outputs(self[i], row)

    def _step_rows(self, rows: Sequence[int], record: StepRecord) -> Iterator[int]:
        """Step the estimators of some rows, and yield each row when it is done."""
        for i in rows:
            fast, n_rows, packets, count = (array[i] for array in record)
            self[i].step(fast[:n_rows], packets[:count])
            yield i

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
