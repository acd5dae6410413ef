"""The best that any estimator can do: the covariance of the optimal filter of the true model.

Defined where the plant is linear (small-angle plant, linear tyres, speed held) and the filter knows
vehicle, noise and disturbances' statistics; deterministic wind and biases do not change it.
"""

from collections.abc import Mapping
from typing import Any

from ...envs.record import Array, Record
from ...envs.sensors.link import SlowSensor
from ...envs.ticks import TICK
from ...envs.vehicle.parameters import Vehicle
from ..design.models import select_states
from ..make import make_estimator


def compute_error_bound(
    vehicle: Vehicle,
    *,
    record: Record,
    sensors: Mapping[str, SlowSensor],
    speed: float,
    dt: float = TICK,
    **options: Any,
) -> Array:
    """Compute the standard deviation of the optimal estimate of beta at every row of a record.

    The lowest possible RMSE over a stretch of time is the root of the mean square of this. The
    start is known exactly, as it is in the environment.

    Args:
        vehicle: The true vehicle.
        record: Record with the captured and arrived ticks of the packets.
        sensors: All available slow sensors by name.
        speed: Held speed (m/s).
        dt: Tick (s).
        **options: Options of `exact-kf` for the true noise, disturbances and latencies.

    Returns:
        Standard deviation (rad), shape (K,).
    """
    prior = dict.fromkeys(select_states(tuple(sensors)), 0.0)
    options = {"slow": list(sensors), "prior": prior} | options
    common = {"vehicle": vehicle, "sensors": sensors, "dt": dt, "speed": speed}
    return make_estimator("exact-kf", **common, **options).run(record).std[:, 0]
