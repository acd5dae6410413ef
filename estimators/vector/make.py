"""Batches of estimators from a name or a factory."""

import functools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...envs.ticks import TICK
from ...envs.vehicle.vehicle import COMS, Vehicle
from ...envs.vehicle.vehicles import VehicleSource, make_vehicle
from ..filters import FILTERS
from ..learned.correction import LearnedEstimator
from ..protocol import EstimatorFactory, ForeignEstimator, get_label
from ..wrappers.arguments import EstimatorSpec, build_estimator
from .batch import BatchEstimator, Sensors
from .foreign import ForeignBatch
from .learned import LearnedBatch


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
    build_one = functools.partial(build_estimator, source, dict(options), dt)
    if not (isinstance(source, str) and source in FILTERS) or options.get("latency"):
        first = build_one(specs[0])
        if isinstance(first, ForeignEstimator) and isinstance(first.inner, LearnedEstimator):
            return LearnedBatch(first, specs, dt, build_one)
        if isinstance(first, ForeignEstimator):
            kind = getattr(first.inner, "batch", ForeignBatch)  # one that takes all rows at once
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
    specs = [
        EstimatorSpec(make_vehicle(c), s, v)
        for c, s, v in zip(cars, row_sensors, speeds, strict=True)
    ]
    batch = build_batch(name, specs, dt, options)
    batch.reset(None, row_sensors)
    return batch


def _expand_argument(
    label: str, value: Any, count: int, single_types: tuple[type, ...]
) -> list[Any]:
    if isinstance(value, single_types):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{label}: one or a list of {count}, got {len(value)}")
    return list(value)
