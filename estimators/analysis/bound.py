"""The best that any estimator can do: the covariance of the optimal filter of the true model.

Defined where the plant is linear (small-angle plant, linear tyres, speed held): then no estimator
has a smaller mean squared error than the filter that knows the vehicle, the noise and the
disturbances' statistics. Deterministic wind and biases do not change it: it knows them. A vehicle
that changes on the way does, and the filter has one vehicle: for a scenario with a tyre_change_time
it is no bound.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import Record
from ...envs.sensors.link import SlowSensor
from ...envs.ticks import TICK
from ...envs.vehicle.vehicle import Vehicle
from ..design.models import states_for
from ..make import make_estimator

Array = npt.NDArray[np.float64]


def bound(
    vehicle: Vehicle,
    *,
    record: Record,
    sensors: Mapping[str, SlowSensor],
    speed: float,
    dt: float = TICK,
    **options: Any,
) -> Array:
    """Standard deviation of the optimal estimate of beta at every row of a record, (K,) in rad.

    vehicle: the true one. sensors: all slow sensors that are there; the packets' captured and
    arrived ticks are those of the record. speed: held, m/s. options: those of `exact-kf` that say
    the true noise and disturbances. The start is known exactly, as it is in the environment.

    The lowest possible RMSE over a stretch of time is the root of the mean square of this.
    """
    options.setdefault("prior", dict.fromkeys(states_for(tuple(sensors)), 0.0))
    filter_ = make_estimator(
        "exact-kf",
        vehicle=vehicle,
        sensors=sensors,
        dt=dt,
        speed=speed,
        slow=list(sensors),
        **options,
    )
    return filter_.run(record).std[:, 0]
