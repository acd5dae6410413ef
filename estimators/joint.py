"""A sideslip angle by the filter `joint`: of a recorded drive, or of samples as a CAN bus has them.

Of samples that come in any order and late, the last second stands in a buffer. A sample is written
where it was taken, and the filter runs anew from the oldest row that changed. So any order of
samples gives the numbers of the sorted order.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..envs.numerics import require_extra
from ..envs.record import FAST, PACKET, Array
from ..envs.recordings.dialect import LATENCIES, SENSORS, SLOW_QUANTITIES, TRUTH
from ..envs.recordings.log_file import MAX_HOLE, NEEDED, make_fast_rows, make_packets, read_parts
from ..envs.recordings.tables import parse_column_name
from ..envs.sensors.link import SlowSensor
from ..envs.vehicle.parameters import VehicleSource, make_vehicle
from .core.filter import NO_OUTPUTS, StepRecord
from .core.memory import FilterLayers
from .design.options import FAST_CHANNELS
from .make import make_estimator
from .wires import apply_wires, move_course, read_wires

if TYPE_CHECKING:
    import pandas as pd

    from ..envs.recordings.containers import LogSource

_HEALTH_TIME = 0.05  # s of a recorded drive, after which the filter is asked whether it is healthy
_SNAPSHOT_ROWS = 16
_ROOM = 4  # memories that the buffer holds
_PATIENCE = 10  # successive fast samples outside the memory, after which the clock has jumped


def estimate(
    log: "LogSource", vehicle: VehicleSource, *, mapping: Mapping[str, str] | None = None,
    latency: Mapping[str, float] | None = None,
) -> "pd.DataFrame":  # fmt: skip
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
    car, frames = make_vehicle(vehicle), []
    for part in read_parts(log, mapping)[0]:
        drive = apply_wires(part, wires)
        options = {"sensors": drive.slow, "dt": drive.record.dt, "present": drive.record.present}
        filter_ = make_estimator("joint", vehicle=car, **options)
        estimates, healthy = filter_.run_with_health(drive, _HEALTH_TIME)
        columns = {
            "time_s": drive.origin + estimates.time,
            "sideslip_rad": estimates["beta"],
            "sideslip_sd_rad": estimates.std[:, estimates.names.index("beta")],
            "yaw_rate_radps": estimates["gamma"],
            "healthy": healthy,
        }
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


class SideslipEstimate(NamedTuple):
    """The estimate at the newest sample's stamp."""

    time: float  # s
    sideslip: float  # rad
    sideslip_sd: float  # rad
    yaw_rate: float  # rad/s
    healthy: bool  # False too where a fast channel has been silent for `MAX_HOLE`


def _find_wire(quantity: str) -> str:
    """Find the channel of a vehicle's file whose latency a quantity has."""
    for sensor, names in SENSORS.items():
        if quantity in names:
            return sensor
    column = {"yaw_rate": "gyro", "speed_x": "wheel_left"}.get(quantity, quantity)
    place = getattr(FAST, column, -1)
    return next((name for name, columns in FAST_CHANNELS.items() if place in columns), "")


class Stream:
    """A filter `joint` that takes samples by name, as a CAN bus brings them.

    Args:
        vehicle: Vehicle as for `make_vehicle`. A file brings along the steering's ratio, sign and
            offset, latencies, and the antenna's place.
        channels: Names with units, such as "yaw_rate_degps", that will come, each once; speed_x,
            yaw_rate and steer must be among them, else ValueError.
        dt: Time from one yaw rate to the next (s).
        memory: Time back to which a late sample is used (s).

    Attributes:
        counts: Samples ignored: "outside" the memory.
    """

    def __init__(
        self, vehicle: VehicleSource, channels: Sequence[str], *, dt: float = 0.01,
        memory: float = 1.0,
    ) -> None:  # fmt: skip
        parsed = {name: parse_column_name(name.casefold()) for name in channels}
        quantities = [quantity for quantity, _, _ in parsed.values()]
        if missing := [name for name in NEEDED[1:] if name not in quantities]:
            raise ValueError(f"no channel of {', '.join(missing)} among {', '.join(channels)}")
        if twice := [name for name in dict.fromkeys(quantities) if quantities.count(name) > 1]:
            raise ValueError(f"{', '.join(twice)} comes twice among {', '.join(channels)}")
        if latencies := [name for name in LATENCIES.values() if name in quantities]:
            raise ValueError(f"{latencies[0]}: no channel, for a sample that is pushed has come")
        if strange := [name for name in quantities if name in ("time", *TRUTH)]:
            raise ValueError(f"{strange[0]} is no sensor's channel")
        if kinds := [x for x in channels if x.casefold().endswith(("_held", "_interpolated"))]:
            raise ValueError(f"{kinds[0]}: what is pushed is a sample, neither held nor made")
        gps, *more = SENSORS["gps"]
        if gps not in quantities and (extra := [name for name in more if name in quantities]):
            raise ValueError(f"{extra[0]} is used beside {gps} alone")
        lacking = [name for name in SENSORS["camera"] if name not in quantities]
        if 0 < len(lacking) < len(SENSORS["camera"]):
            raise ValueError(f"a camera's sample has both values; no channel of {lacking[0]}")
        if not (0.0 < dt <= MAX_HOLE and dt < memory < math.inf):
            raise ValueError(f"expected 0 < dt <= {MAX_HOLE} s < memory, got {dt}, {memory}")
        wires = read_wires(vehicle)
        if "accel" in wires.at:
            raise ValueError("a stream takes accelerations of the centre of gravity: no at.accel")
        self._at = wires.at
        self._channels: dict[str, tuple[int, float, float, float]] = {}
        for place, (name, (quantity, factor, shift)) in enumerate(parsed.items()):
            if quantity == "steer":
                factor, shift = factor * wires.gain, wires.offset
            latency = wires.latency.get(_find_wire(quantity), 0.0)
            if not latency < memory:
                raise ValueError(f"{name} is {latency:g} s late: memory {memory:g} s is too short")
            self._channels[name] = place, factor, shift, latency
        self.dt, self.counts = dt, {"outside": 0}
        self._places = {name: place for place, name in enumerate(quantities)}
        self._is_fast = np.array([name not in SLOW_QUANTITIES for name in quantities])
        self._memory, self._hole = round(memory / dt), round(MAX_HOLE / dt)
        capacity = _ROOM * self._memory + self._hole + 2 * _SNAPSHOT_ROWS
        self._rows = np.empty((capacity, len(quantities)))  # NaN where nothing came
        self._filled = np.empty_like(self._rows)  # the last value held
        self._latest = np.empty(len(quantities))  # ticks of the newest samples
        self._x: Array
        self._sd: Array
        self._strange, self._origin = 0, 0  # ticks in here are not negative
        self._begin(0)
        slow = [name for name, values in SENSORS.items() if values[0] in quantities]
        sensors = dict.fromkeys(slow, SlowSensor(period=dt, phase=0.0))
        self._filter = make_estimator(
            "joint", vehicle=make_vehicle(vehicle), sensors=sensors, dt=dt, present=quantities
        )

    def _begin(self, tick: int) -> None:
        """Forget everything; `tick` is that of the buffer's first row."""
        self._base, self._newest, self._first = tick, tick - 1, -1  # ticks; -1: not all have come
        self._changed = self._done = tick  # from which on rows changed, or are not filtered yet
        self._snapshots: dict[int, FilterLayers] = {}  # of the filter before a tick's row
        self._rows.fill(np.nan)
        self._filled.fill(np.nan)
        self._latest.fill(-np.inf)

    def push(self, channel: str, stamp: float, value: float) -> None:
        """Take a sample.

        Args:
            channel: Name of the channel, one of those of the construction.
            stamp: Time at which it was taken, or, if the vehicle's file has the channel's latency,
                at which it came (s), finite, else ValueError.
            value: Value in the channel's unit, finite, else ValueError.
        """
        if channel not in self._channels:
            raise ValueError(f"unknown channel {channel!r}; known: {', '.join(self._channels)}")
        place, factor, shift, latency = self._channels[channel]
        if not (math.isfinite(stamp) and math.isfinite(value)):
            raise ValueError(f"{channel}: expected finite numbers, got {stamp} s, {value}")
        tick = round((stamp - latency) / self.dt)
        if self._newest < self._base or self._strange > _PATIENCE:
            self._origin = min(tick, 0)
            self._begin(tick - self._origin - self._memory)
        tick -= self._origin
        oldest = max(self._newest - self._memory, self._base)
        if not oldest <= tick <= max(self._newest, self._base + self._memory) + self._hole:
            self._strange += self._is_fast[place]  # a receiver may send many old fixes at once
            self.counts["outside"] += 1
            return
        self._strange *= not self._is_fast[place]
        if tick - self._base >= len(self._rows):
            self._shift()
        self._rows[tick - self._base, place] = factor * value + shift
        self._newest, self._changed = max(tick, self._newest), min(tick, self._changed)
        self._latest[place] = max(tick, self._latest[place])

    def _shift(self) -> None:
        """Move the buffer, so that it begins with what can still change and the row before."""
        self.estimate()  # whoever asks seldom still has every row filtered
        rows = self._newest - self._base + 1
        drop = rows - self._memory - _SNAPSHOT_ROWS - 2
        for buffer in (self._rows, self._filled):
            buffer[: rows - drop] = buffer[drop:rows].copy()
            buffer[rows - drop :] = np.nan
        self._base += drop

    def estimate(self) -> SideslipEstimate | None:
        """Estimate the sideslip angle at the newest sample; None before all fast channels come."""
        end = self._newest + 1
        self._fill(self._changed, end)
        if not self._restart():
            return None
        if self._done < end:
            self._run(self._done, end)
        x, sd, names = self._x, self._sd, self._filter.names
        beta, gamma = names.index("beta"), names.index("gamma")
        silence = self._newest - self._latest[self._is_fast].min()
        healthy = self._filter.is_healthy and bool(silence <= self._hole)
        time = (self._newest + self._origin) * self.dt
        return SideslipEstimate(time, float(x[beta]), float(sd[beta]), float(x[gamma]), healthy)

    def _fill(self, start: int, end: int) -> None:
        """Hold the last values of the fast channels from a tick on."""
        for row in range(start - self._base, end - self._base):
            new = self._rows[row]
            self._filled[row] = np.where(np.isnan(new), self._filled[row - 1], new) if row else new

    def _restart(self) -> bool:
        """Take the filter back to the oldest changed row; False if it cannot begin yet."""
        changed, self._changed = self._changed, self._newest + 1
        if self._first < 0 or changed <= self._first:
            fast = self._filled[: self._newest + 1 - self._base, self._is_fast]
            complete = np.isfinite(fast).all(axis=1)
            if not complete.any():
                return False
            self._first = self._done = self._base + int(np.argmax(complete))
            self._snapshots.clear()
            self._filter.reset(first=self._first)
        elif changed < self._done:
            self._done = max(tick for tick in self._snapshots if tick <= changed)
            self._filter.set_state(self._snapshots[self._done])
        return True

    def _run(self, start: int, end: int) -> None:
        """Filter the rows of the ticks from start to end."""
        before = start - (start > self._first)  # an input acts from its row to the next
        rows = slice(before - self._base, end - self._base)
        values: dict[str, Array] = {"time": np.arange(before, end, dtype=np.float64) * self.dt}
        for name, place in self._places.items():
            source = self._rows if name in SLOW_QUANTITIES else self._filled
            values[name] = source[rows, place]
        fast = make_fast_rows(values)[0][start - before :]
        packets = make_packets(values, before, self.dt)[0]
        packets = packets[packets[:, PACKET.captured] >= start]
        move_course(fast, packets, start, self._at)
        oldest, snapshots = end - self._memory - 2 * _SNAPSHOT_ROWS, self._snapshots
        self._snapshots = {tick: snapshots[tick] for tick in snapshots if oldest <= tick <= start}
        while start < end:
            if start == self._first or start % _SNAPSHOT_ROWS == 0:
                self._snapshots.setdefault(start, self._filter.get_state())
            stop = min(end, (start // _SNAPSHOT_ROWS + 1) * _SNAPSHOT_ROWS)
            now, fast = fast[: stop - start], fast[stop - start :]
            count = int(np.searchsorted(packets[:, PACKET.arrived], stop))
            X, S = np.empty((2, len(now), len(self._filter.names)))
            record = StepRecord(now, len(now), packets[:count], count)
            self._filter.take(record, NO_OUTPUTS._replace(X=X, S=S))
            packets, start, self._x, self._sd = packets[count:], stop, X[-1], S[-1]
        self._done = end
