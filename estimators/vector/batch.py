"""Many filters of one kind at work side by side, each with its own memory and covariance."""

import copy
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.backend.eights import zeros_on_lines
from ...envs.record import FAST_WIDTH, PACKET_WIDTH, Log, Record
from ...envs.sensors.link import SlowSensor
from ..core.memory import FILTER, Counters
from ..estimates import Estimates
from ..wrappers.arguments import Setup
from .designs import Build, Designs
from .kernel import batch_entry, nothing_observed
from .lanes import blocks

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int64]
Sensors = Mapping[str, SlowSensor]


class BatchEstimator:
    """N filters of one name in one compiled call; built by `make_batch`.

    `batch[i]` is the `Estimator` at work in row i: it shares that row's memory. `filters`
    (N, layers) are the records of all filters. `names`, `units`: of their states. Filters of equal
    setups, but for the phases of clocks, share one table of gains.

    Raises ValueError if the filters have different states.
    """

    def __init__(self, name: str, setups: Sequence[Setup], dt: float, build: Build) -> None:
        self.name, self.dt = name, dt
        self._designs = Designs(build)
        self._setups: list[Setup] = list(setups)
        self._of: list[Any] = [None] * len(setups)  # each row's design
        first = self._designs.built(setups[0])
        self.names, self.units = first.names, first.units
        self.filters = zeros_on_lines((len(setups), len(first.filters)), FILTER)
        self.configure(range(len(setups)), setups)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy's records lie on cache lines, too, and its lanes are empty."""
        self.__dict__.update(state)
        filters, self.filters = self.filters, zeros_on_lines(self.filters.shape, FILTER)
        self.filters[:], self._lanes = filters, blocks(len(filters))

    def __len__(self) -> int:
        return len(self.filters)

    def __getitem__(self, i: int) -> Any:
        design = self._of[i]
        estimator = copy.copy(self._designs[design])
        estimator.sensors = {name: self._setups[i].sensors[name] for name in estimator.sensors}
        estimator.filters, estimator.gains = self.filters[i], self._designs.gains(design)
        return estimator

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))

    def configure(self, rows: Iterable[int], setups: Iterable[Setup]) -> None:
        """Fit the filters of some rows to their setups; to be reset then.

        A filter whose setup differs in more than the phases of its clocks is built anew.
        """
        changed = False
        for i, each in zip(rows, setups, strict=True):
            self._setups[i], design = each, each.design
            if design == self._of[i]:
                continue
            built = self._designs.built(each)
            self._check_states(i, built.names)
            self._of[i], self.filters[i], changed = design, built.filters, True
        if changed:
            self._lanes = blocks(len(self))  # empty: they hold models
            self._places = self._designs.place(self._of)

    def _check_states(self, i: int, names: tuple[str, ...]) -> None:
        if names != self.names:
            raise ValueError(
                f"{self.name}: the filters of a batch have the same states, row 0 has "
                f"{', '.join(self.names)} and row {i} {', '.join(names)}"
            )

    def reset(
        self,
        mask: npt.ArrayLike | None = None,
        sensors: Sensors | Sequence[Sensors] | None = None,
        first: int = 0,
    ) -> None:
        """Let the filters of a mask (N,) forget everything (None: all); see `Estimator.reset`.

        sensors: slow sensors whose clocks have a new phase, of all filters or a list (N,).
        """
        for i in _rows_of(mask, len(self)):
            own = sensors if sensors is None or isinstance(sensors, Mapping) else sensors[i]
            self[i].reset(own, first)

    def step(
        self,
        fast: Array,
        packets: Array,
        counts: npt.ArrayLike | None = None,
        rows: npt.ArrayLike | None = None,
    ) -> None:
        """Take each filter's fast rows (N, k, FAST_WIDTH) and packets (N, capacity, PACKET_WIDTH).

        counts, rows: (N,), how many of each filter's packets and rows are there (all if None; a
        filter with none of either stands still). Raises ValueError for other shapes.
        """
        N = len(self)
        fast = np.ascontiguousarray(fast, np.float64)
        packets = np.ascontiguousarray(packets, np.float64)
        _check_shape("fast rows", fast, N, FAST_WIDTH)
        _check_shape("packets", packets, N, PACKET_WIDTH)
        rows = _how_many("rows", fast.shape[1] if rows is None else rows, N, fast.shape[1])
        counts = _how_many(
            "counts", packets.shape[1] if counts is None else counts, N, packets.shape[1]
        )
        self.take(None, fast, rows, packets, counts, *self._unread)

    @functools.cached_property
    def _unread(self) -> tuple[Any, ...]:
        return nothing_observed(len(self))

    def run(self, sources: Sequence[Log | Record]) -> list[Estimates]:
        """`Estimator.run` of each filter on a record of its own."""
        if len(sources) != len(self):
            raise ValueError(f"{self.name}: {len(self)} filters, got {len(sources)} records")
        return [self[i].run(source) for i, source in enumerate(sources)]

    def take(
        self,
        mask: npt.NDArray[np.bool_] | None,
        fast: Array,
        rows: Whole,
        packets: Array,
        counts: Whole,
        *observed: Any,
    ) -> None:
        """`step` of the filters of a mask without any checks of C-contiguous arrays.

        observed: what `kernel.observe_batch` takes after `counts`.
        """
        done = np.full(len(self), -1) if mask is None else np.where(mask, -1, rows)
        memory = self.filters, self._designs.pool, self._places, done, self._lanes
        while batch_entry()(*memory, fast, rows, packets, counts, *observed) > 0:
            self._design_missing(np.flatnonzero(done < rows))

    def _design_missing(self, rows: Whole) -> None:
        """Make the tables of gains that compiled code has just asked for, each once."""
        wanted = {(self._of[i], int(self.filters[i, 0].wanted)): int(i) for i in rows}
        for i in wanted.values():
            self[i].design_missing()

    def get_state(self) -> Any:
        """A snapshot that `set_state` continues from, bit for bit."""
        return self.filters.copy()

    def set_state(self, snapshot: Any) -> None:
        """Go back to a snapshot of this batch or of one with the same setups."""
        self.filters[:] = snapshot

    @property
    def x(self) -> Array:
        """The states now, (N, n)."""
        return np.array([each.x for each in self])

    @property
    def P(self) -> Array:
        """Their covariances now, (N, n, n), as `Estimator.P`."""
        return np.array([each.P for each in self])

    @property
    def counts(self) -> dict[str, Whole]:
        """All counters by name, each (N,)."""
        counts = [each.counts for each in self]
        return {name: np.array([each[name] for each in counts]) for name in Counters._fields}

    def __repr__(self) -> str:
        return f"<{len(self)} x {self.name}: {', '.join(self.names)}>"


def _rows_of(mask: npt.ArrayLike | None, count: int) -> list[int]:
    if mask is None:
        return list(range(count))
    chosen = np.asarray(mask)
    if chosen.shape != (count,) or chosen.dtype != np.bool_:
        raise ValueError(
            f"a mask has shape ({count},) and dtype bool, got {chosen.shape} and {chosen.dtype}"
        )
    return [int(i) for i in np.flatnonzero(chosen)]


def _check_shape(what: str, array: Array, count: int, width: int) -> None:
    if array.ndim != 3 or array.shape[::2] != (count, width):
        raise ValueError(f"{what} have shape ({count}, k, {width}), got {array.shape}")


def _how_many(what: str, value: npt.ArrayLike, count: int, largest: int) -> Whole:
    numbers = np.ascontiguousarray(np.broadcast_to(np.asarray(value, np.int64), (count,)))
    if numbers.min() < 0 or numbers.max() > largest:
        raise ValueError(f"{what} are 0 to {largest}, got {numbers.min()} to {numbers.max()}")
    return numbers
