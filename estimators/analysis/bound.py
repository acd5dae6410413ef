"""The best that any estimator can do: the covariance of the optimal filter of the true model.

Defined where the plant is linear (small-angle plant, linear tyres, speed held) and the filter knows
vehicle, noise and disturbances' statistics, and when tyres change or a gust blows. Of a gust, whose
strength is not Gaussian, this is the least error of a linear estimator.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...envs.record import PACKET, Array, Record
from ...envs.sensors.link import SlowSensor
from ...envs.ticks import TICK
from ...envs.vehicle.parameters import Vehicle
from ..design.models import select_states
from ..estimator import Estimator
from ..make import make_estimator
from ..protocol import UnobservableWarning


class VehicleChange(NamedTuple):
    """Another vehicle from a time on."""

    time: float  # s since the first row
    vehicle: Vehicle  # the later one


class Gust(NamedTuple):
    """A side force of unknown strength that is constant from start to end."""

    force_sd: float  # N, root mean square of the force
    arm: float  # m ahead of the centre of gravity
    start: float  # s since the first row
    end: float  # s since the first row


def compute_error_bound(
    vehicle: Vehicle,
    *,
    record: Record,
    sensors: Mapping[str, SlowSensor],
    speed: float,
    dt: float = TICK,
    change: VehicleChange | None = None,
    gust: Gust | None = None,
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
        change: Later vehicle, or None.
        gust: Gust that the filter feels and does not know, or None.
        **options: Options of `exact-kf` for the true noise, disturbances and latencies.

    Returns:
        Standard deviation (rad), shape (K,).
    """
    if any(options.get("latency", {}).values()) and not (change is None and gust is None):
        raise ValueError("a bound with latency has no change and no gust")
    prior = dict.fromkeys(select_states(tuple(sensors)), 0.0)
    if gust is not None:  # a state that is a constant, as the road's bank is, but pushes as a force
        options |= {"bank_sd": gust.force_sd}
        prior |= {"bank": 0.0}
    options.setdefault("prior", prior)
    common = {"sensors": sensors, "dt": dt, "speed": speed, "slow": list(sensors)} | options
    cars = [vehicle] if change is None else [vehicle, change.vehicle]
    with warnings.catch_warnings():  # the gust's state is seen only where it blows
        warnings.simplefilter("ignore" if gust is not None else "default", UnobservableWarning)
        first, *later = (make_estimator("exact-kf", vehicle=car, **common) for car in cars)
    record = first.prepare_record(record)
    events = list[tuple[float, Callable[[], None]]]()
    if gust is not None:
        for filter_ in (first, *later):
            _set_gust_input(filter_, gust.arm)
        events += [(gust.start, lambda: _reset_gust(first, gust.force_sd**2))]
        events += [(gust.end, lambda: _reset_gust(first, 0.0))]
    if change is not None:
        events.append((change.time, lambda: _copy_model(first, later[0])))
    return _run_events(first, record, sorted(events, key=lambda event: event[0]))


def _set_gust_input(filter_: Estimator, arm: float) -> None:
    """Let the state `bank` push as F_d does, and as N_d by an arm in m."""
    f, names = filter_.filters[0], filter_.names
    gust, force, moment = (names.index(name) for name in ("bank", "F_d", "N_d"))
    for matrix in (f.G, f.C_fast):
        matrix[:, gust] = matrix[:, force] + arm * matrix[:, moment]
    f.GT[gust] = f.G[:, gust]


def _copy_model(filter_: Estimator, later: Estimator) -> None:
    """Copy the model of a later filter at its held speed."""
    for name in ("car", "A", "B", "G", "GT", "H", "HT", "C_fast", "D_fast"):
        filter_.filters[0][name] = later.filters[0][name]


def _reset_gust(filter_: Estimator, variance: float) -> None:
    """Reset the gust's state: from now on it is independent of what was known before."""
    f, index = filter_.filters[0], filter_.names.index("bank")
    f.P[index], f.P[:, index] = 0.0, 0.0
    f.P[index, index] = variance


def _run_events(
    filter_: Estimator, record: Record, events: Sequence[tuple[float, Callable[[], None]]]
) -> Array:
    """Compute the deviations of beta over the record; each event follows the row at its time."""
    fast, packets = np.ascontiguousarray(record.fast), np.ascontiguousarray(record.packets)
    X, S = np.empty((2, len(fast), len(filter_.names)))
    ends = [min(round(time / record.dt) + 1, len(fast)) for time, _ in events]
    row = n_arrived = 0
    for i, end in enumerate([*ends, len(fast)]):
        n_due = int(np.searchsorted(packets[:, PACKET.arrived], record.first + end))
        span, due_packets = slice(row, end), packets[n_arrived:n_due]
        filter_.take(fast[span], end - row, due_packets, len(due_packets), X[span], S[span])
        if i < len(events):
            events[i][1]()
        row, n_arrived = end, n_due
    return S[:, 0]
