"""Batches of estimators from a name or a factory."""

import functools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...envs.ticks import TICK
from ...envs.vehicle.parameters import COMS, Vehicle, VehicleSource, make_vehicle
from ..filters import FILTERS
from ..make import make_estimator
from ..protocol import EstimatorFactory, ForeignEstimator, get_label
from ..wrappers.estimate import EstimatorSpec
from .batch import BatchEstimator, ForeignBatch, Sensors


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
            batch_class = getattr(first.inner, "batch", ForeignBatch)
            return batch_class(first, specs, dt, build_one)
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
