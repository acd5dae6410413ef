"""A sideslip angle with its interval from a recorded drive: a table in, a table out."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..envs.numerics import require_extra
from ..envs.record import PACKET
from ..envs.recordings.log_file import read_parts
from ..envs.vehicle.parameters import Vehicle, VehicleSource, make_vehicle
from .core.filter import NO_OUTPUTS, StepRecord
from .make import make_estimator
from .wires import apply_wires, read_wires

if TYPE_CHECKING:
    import pandas as pd

    from ..envs.record import Log
    from ..envs.recordings.containers import LogSource

_HEALTH_TIME = 0.05  # s, after which the filter is asked whether it is healthy


def estimate(
    log: "LogSource",
    vehicle: VehicleSource,
    *,
    mapping: Mapping[str, str] | None = None,
    latency: Mapping[str, float] | None = None,
) -> "pd.DataFrame":
    """Estimate the sideslip angle of a recorded drive with `joint` (needs the extra `report`).

    The log needs time, speed, yaw rate and steering at the road wheels, in columns such as time_s,
    speed_x_kmh, yaw_rate_degps and steer_deg. Lateral acceleration, wheel speeds, course and camera
    are used where they are there. A slow sensor's column is NaN, held or interpolated between its
    samples. Rows are read as `read_parts` does; across a hole the filter begins anew. ValueError
    stands for a missing column, no number, an unknown channel, or what is later than the memory.

    Args:
        log: Table, or its file (CSV, Parquet, MATLAB, MDF, CAN trace, ROS bag, MCAP, VBO).
        vehicle: Vehicle as for `make_vehicle`. A file brings along the steering's ratio, sign and
            offset, latencies, and where sensors sit.
        mapping: Our column names, unit included, to the log's: {"yaw_rate_degps": "GyroZ"}.
            "dbc" names the description of a CAN trace.
        latency: Latency of a channel (s), such as {"gps": 0.2}; overrules the vehicle's file.

    Returns:
        Time (s), sideslip angle and its standard deviation (rad), yaw rate (rad/s), and whether
        the filter is healthy; a row each tick of an even clock, close to the log's.
    """
    with require_extra("report", "estimating from a table needs pandas"):
        import pandas as pd
    wires = read_wires(vehicle)
    wires = wires._replace(latency={**wires.latency, **(latency or {})}).check()
    car = make_vehicle(vehicle)
    parts = [apply_wires(part, wires) for part in read_parts(log, mapping)[0]]
    return pd.concat([_run_joint(part, car) for part in parts], ignore_index=True)


def _run_joint(log: "Log", car: Vehicle) -> "pd.DataFrame":
    """Run `joint` over a drive with the sensors that it has."""
    import pandas as pd

    dt = log.record.dt
    present = log.record.present
    filter_ = make_estimator("joint", vehicle=car, sensors=log.slow, dt=dt, present=present)
    record = filter_.prepare_record(log)
    fast, packets = (np.ascontiguousarray(a, np.float64) for a in (record.fast, record.packets))
    X, S = np.empty((2, len(fast), len(filter_.names)))
    healthy = np.empty(len(fast), bool)
    block = max(round(_HEALTH_TIME / dt), 1)
    for start in range(0, len(fast), block):
        rows = fast[start : start + block]
        ends = record.first + np.array([start, start + len(rows)])
        first, last = np.searchsorted(packets[:, PACKET.arrived], ends)
        now = slice(start, start + len(rows))
        part = StepRecord(rows, len(rows), packets[first:last], last - first)
        filter_.take(part, NO_OUTPUTS._replace(X=X[now], S=S[now]))
        healthy[now] = filter_.is_healthy
    beta, gamma = (filter_.names.index(name) for name in ("beta", "gamma"))
    return pd.DataFrame(
        {
            "time_s": log.origin + record.ticks * dt,
            "sideslip_rad": X[:, beta],
            "sideslip_sd_rad": S[:, beta],
            "yaw_rate_radps": X[:, gamma],
            "healthy": healthy,
        }
    )
