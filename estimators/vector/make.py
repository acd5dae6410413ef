"""Batches of estimators from a name or a factory, and the batch of learned ones."""

import copy
import functools
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ...envs.numerics.jit import jit_nrt
from ...envs.numerics.primitives import Vector
from ...envs.ticks import TICK
from ...envs.vehicle.parameters import COMS, Vehicle, VehicleSource, make_vehicle
from ..estimator import compile_call
from ..filters import FILTERS
from ..learned.correction import EXAMPLE, MASS, LearnedEstimator
from ..make import make_estimator
from ..protocol import EstimatorFactory, ForeignEstimator, get_label
from ..wrappers.estimate import EstimatorSpec
from ..wrappers.outputs import Observed, StepRecord, observe_corrected
from .batch import BatchEstimator, Build, ForeignBatch, Sensors
from .lane_ticks import FilterBank, get_gains
from .lanes import EXAMPLE_BANK, EXAMPLE_RECORD, make_empty_outputs


@jit_nrt
def _correct_batch(
    bank: FilterBank, chosen: Vector, record: StepRecord, observed: Observed, corrections: Any
) -> None:
    """Call `observe_corrected` for the filters of the indices `chosen`."""
    fast, rows, packets, counts = record
    obs, table, beta, gamma, out, summary = observed
    memory, net = corrections
    for k in range(len(chosen)):
        i = chosen[k]
        row_record = StepRecord(fast[i], rows[i], packets[i], counts[i])
        outputs = Observed(obs[i], table, beta[i], gamma[i], out[i], summary[i])
        layers = bank.filters[i], get_gains(bank, i)
        observe_corrected(*layers, row_record, memory[i], net, outputs)


def _build_base(build: Build, **spec: Any) -> Any:
    """Build the filter inside of a learned estimator, by a name that pickle finds."""
    return build(**spec).inner.base  # type: ignore[union-attr]


class _LearnedBatch(BatchEstimator):
    """N learned estimators of one correction; `filters` are their filters' records."""

    def __init__(
        self, first: ForeignEstimator, specs: Sequence[EstimatorSpec], dt: float, build: Build
    ) -> None:
        self.first: LearnedEstimator = first.inner  # type: ignore[assignment]
        self.memory = np.zeros((len(specs), len(self.first.memory)))  # of the corrections
        super().__init__(first.name, specs, dt, functools.partial(_build_base, build))

    def __getitem__(self, i: int) -> Any:
        estimator = copy.copy(self.first)
        estimator.base, estimator.memory = super().__getitem__(i), self.memory[i]
        return ForeignEstimator(estimator, self.name, self.dt, estimator.base.sensors)

    def configure(self, rows: Iterable[int], specs: Iterable[EstimatorSpec]) -> None:
        """Fit the filters of some rows to their specs as `BatchEstimator.configure` does."""
        rows, specs = list(rows), list(specs)
        super().configure(rows, specs)
        self.memory[rows, MASS] = [spec.vehicle.mass for spec in specs]

    def take(self, mask: Any, record: StepRecord, observed: Observed) -> None:
        """Process rows and packets as `BatchEstimator.take` does."""
        chosen = np.arange(len(self)) if mask is None else np.flatnonzero(mask)
        correction = self.memory, self.first.net
        _compile_correct_batch()(self._bank, chosen, record, observed, correction)

    def get_state(self) -> Any:
        """Return copies of the filters and of their corrections."""
        return self.filters.copy(), self.memory.copy()

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this batch or of one with the same specs."""
        self.filters[:], self.memory[:] = snapshot


@functools.cache
def _compile_correct_batch() -> Any:
    """Return `_correct_batch` as a plain call."""
    memory, corrections = (EXAMPLE_BANK, np.zeros(1, np.int64)), (np.zeros((1, 1)), EXAMPLE)
    observed = make_empty_outputs(1)
    return compile_call(_correct_batch, *memory, EXAMPLE_RECORD, observed, corrections)


def build_batch(
    source: str | EstimatorFactory,
    specs: Sequence[EstimatorSpec],
    dt: float,
    options: Mapping[str, Any],
) -> BatchEstimator:
    """Build an estimator for each spec; errors as in `make_estimator`.

    The batch is compiled where all are the package's own and no channel is late. Else it has an
    object for each row.

    Args:
        source: Name or factory.
        specs: Vehicle, sensors and speed of each estimator.
        dt: Tick (s).
        options: Options of `make_estimator`.

    Returns:
        The batch.
    """
    build_one = functools.partial(make_estimator, source, dt=dt, **options)
    if not (isinstance(source, str) and source in FILTERS) or options.get("latency"):
        first = build_one(**specs[0]._asdict())
        if isinstance(first, ForeignEstimator):
            is_learned = isinstance(first.inner, LearnedEstimator)
            kind = _LearnedBatch if is_learned else getattr(first.inner, "batch", ForeignBatch)
            return kind(first, specs, dt, build_one)
        if not first.compiled:
            return ForeignBatch(first, specs, dt, build_one)
    return BatchEstimator(get_label(source), specs, dt, build_one)


def make_batch(
    name: str | EstimatorFactory,
    count: int,
    *,
    vehicle: VehicleSource | Sequence[VehicleSource] = COMS,
    sensors: Sensors | Sequence[Sensors] | None = None,
    dt: float = TICK,
    speed: float | Sequence[float | None] | None = None,
    **options: Any,
) -> BatchEstimator:
    """Build filters by name; the arguments and errors are those of `make_estimator`.

    Args:
        name: Name or factory.
        count: Number of filters N.
        vehicle: Vehicle of all filters, or a list (N,).
        sensors: Slow sensors by name of all filters, or a list (N,).
        dt: Tick (s).
        speed: Speed (m/s) of all filters where it is held, or a list (N,); None measures it.
        **options: Options of `make_estimator`.

    Returns:
        The batch, reset to tick 0.

    Raises:
        ValueError: There is no filter, or a list has another length.
    """
    if count < 1:
        raise ValueError(f"{get_label(name)}: a batch has at least one filter, got {count}")
    cars = _expand_argument("vehicle", vehicle, count, (Vehicle, str, os.PathLike, Mapping))
    row_sensors = _expand_argument("sensors", sensors or {}, count, (Mapping,))
    speeds = _expand_argument("speed", speed, count, (int, float, np.number, type(None)))
    specs = list(map(EstimatorSpec, map(make_vehicle, cars), row_sensors, speeds))
    batch = build_batch(name, specs, dt, options)
    batch.reset(None, row_sensors)
    return batch


def _expand_argument(label: str, value: Any, count: int, types: tuple[type, ...]) -> list[Any]:
    """Expand an argument of one of these types to a list (count,); check the length of a list."""
    if isinstance(value, types):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{label}: one or a list of {count}, got {len(value)}")
    return list(value)
