"""Batches of estimators from a name or a factory."""

import functools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...envs.ticks import TICK
from ...envs.vehicle.vehicle import COMS, Vehicle
from ...envs.vehicle.vehicles import VehicleSource, vehicle_from
from ..filters import FILTERS
from ..learned.correction import Learned
from ..protocol import EstimatorFactory, ForeignEstimator, label_of
from ..wrappers.arguments import Setup, build
from .batch import BatchEstimator, Sensors
from .foreign import ForeignBatch
from .learned import LearnedBatch


def batch_of(
    source: str | EstimatorFactory, setups: Sequence[Setup], dt: float, options: Mapping[str, Any]
) -> BatchEstimator:
    """An estimator for each setup: a compiled batch where they are ours and no channel is late,
    else one of objects.

    source, options, errors: as in `make_estimator`.
    """
    each = functools.partial(build, source, dict(options), dt)
    if not (isinstance(source, str) and source in FILTERS) or options.get("latency"):
        first = each(setups[0])
        if isinstance(first, ForeignEstimator) and isinstance(first.inner, Learned):
            return LearnedBatch(first, setups, dt, each)
        if isinstance(first, ForeignEstimator):
            kind = getattr(first.inner, "batch", ForeignBatch)  # one that takes all rows at once
            return kind(first, setups, dt, each)
        if not first.compiled:
            return ForeignBatch(first, setups, dt, each)
    return BatchEstimator(label_of(source), setups, dt, each)


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
    """Build `count` filters by name; the arguments are those of `make_estimator`.

    vehicle, sensors and speed may each be a list of `count`: one for each filter. Raises what
    `make_estimator` raises, and ValueError for a list of another length.
    """
    if count < 1:
        raise ValueError(f"{label_of(name)}: a batch has at least one filter, got {count}")
    cars = _each("vehicle", vehicle, count, (Vehicle, str, os.PathLike, Mapping))
    clocks = _each("sensors", sensors or {}, count, (Mapping,))
    speeds = _each("speed", speed, count, (int, float, np.number, type(None)))
    setups = [Setup(vehicle_from(c), s, v) for c, s, v in zip(cars, clocks, speeds, strict=True)]
    batch = batch_of(name, setups, dt, options)
    batch.reset(None, clocks)
    return batch


def _each(what: str, value: Any, count: int, alone: tuple[type, ...]) -> list[Any]:
    if isinstance(value, alone):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{what}: one or a list of {count}, got {len(value)}")
    return list(value)
