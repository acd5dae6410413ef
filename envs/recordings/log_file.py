"""A recorded drive from a file: the same record that the simulated car writes."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Array, Fast, Log, Record
from ..sensors.gps import COURSE_SPEED
from ..sensors.link import SlowSensor
from ..sensors.slow import SLOW_NAMES
from ..ticks import TICK
from .columns import COLUMNS, make_column_name, parse_mapping, read_quantities
from .samples import SENSORS, SLOW_QUANTITIES, TRUTH

__all__ = ["COLUMNS", "NEEDED", "make_column_name", "make_packet_rows", "parse_mapping", "read_log"]

NEEDED = ("time", "speed_x", "yaw_rate", "steer")
"""The quantities without which a log cannot be read."""

_SAMPLED = {  # column of the record: quantity of the log
    "gyro": "yaw_rate",
    "accel_y": "accel_y",
    "accel_x": "accel_x",
    "roll_rate": "roll_rate",
    "wheel_left": "wheel_left",
    "wheel_right": "wheel_right",
}
_INPUTS = ("steer", "torque_left", "torque_right", "steer_command", "accel_command", "curvature")
GAPS = {*TRUTH, *SLOW_QUANTITIES}
"""Quantities that need not be known in every row."""
_GAP = 1.5  # steps of time
_STILL = 1e-3  # of a step of time
_DRIFT = 1e-4  # of the log's length
_STANDING = 0.5  # m/s; below it the sideslip angle is 0


def read_log(path: str | Path, mapping: Mapping[str, str] | None = None) -> Log:
    """Read a recorded drive from a table of `read_table` (needs the extra `report`).

    The record's dt is the mean step of time, its first tick that of the first row (0 where time
    starts below 0: ticks are never negative). A logged input (steering, torque, command) acts from
    its own row to the next, so it stands one row later in the record. Without both wheel speeds
    both wheels turn at speed_x. Slow sensors (course, camera_psi) are NaN between their samples; a
    sample is captured and arrives in its row, and the sensor's period is the longest that has every
    sample on its clock. truth["beta"] is the sideslip angle, or atan2(speed_y, speed_x) where only
    that is logged; 0 at 0.5 m/s and below, NaN where unknown, left out where the log has neither.
    The name is the file's with its folder's. ModuleNotFoundError is raised without the extra.

    Args:
        path: Table with columns named as in `COLUMNS`; those of `NEEDED` must be present, unknown
            ones are ignored.
        mapping: Our column names, unit included, to the log's ({"yaw_rate_degps": "GyroZ"});
            `parse_mapping` makes it from texts.

    Returns:
        The log.

    Raises:
        ValueError: For a file that is no table, a missing column, a value that is no number, fewer
            than two rows, and a clock that runs backward, stands still, jumps or is uneven. Rows in
            messages count from 1 below the header.
    """
    source = Path(path)
    values, _ = read_quantities(source, mapping or {}, NEEDED, GAPS)
    try:
        return make_log(values, source)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def make_log(values: dict[str, Array], source: Path, dt: float | None = None) -> Log:
    """Make the log of quantities in SI units; ValueError for a bad clock.

    Args:
        values: Quantities by name, shape (n,) each.
        source: Path of the file, for the log's name.
        dt: Step of the clock (s); None finds it.

    Returns:
        The log.
    """
    dt = find_clock(values["time"])[1] if dt is None else dt
    first = max(round(float(values["time"][0]) / dt), 0)
    fast, present = _make_fast_rows(values)
    packets, slow = _make_packets(values, first, dt)
    record = Record(fast, packets, first, dt, present)
    return Log(
        record, slow, _compute_truth(values), f"{source.resolve().parent.name}/{source.stem}"
    )


def make_packet_rows(
    sensor: str,
    captured: Array,
    arrived: Array,
    values: Array,
    quality: Array,
) -> Array:
    """Make the packets of one sensor in capture order.

    Args:
        sensor: Name of the sensor, "camera" or "gps".
        captured: Ticks of capture, shape (count,).
        arrived: Ticks of arrival, shape (count,).
        values: Values in SI units, shape (count, up to VALUES).
        quality: Quality, shape (count,).

    Returns:
        Packets, shape (count, PACKET_WIDTH).
    """
    packets = np.zeros((len(captured), PACKET_WIDTH))
    packets[:, PACKET.sensor] = SLOW_NAMES.index(sensor)
    packets[:, PACKET.captured] = captured
    packets[:, PACKET.arrived] = arrived
    packets[:, PACKET.quality] = quality
    packets[:, PACKET.sequence] = np.arange(len(captured))
    packets[:, PACKET.value : PACKET.value + values.shape[1]] = values
    return packets


def find_clock(time: Array) -> tuple[int, float]:
    """Find the first tick and the step of an even clock.

    Args:
        time: Time of each row (s), shape (n,).

    Returns:
        First tick and dt (s).

    Raises:
        ValueError: If the clock is uneven, with the row.
    """
    steps = np.diff(time)
    typical = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    min_step = _STILL * typical
    for is_wrong, what in (
        (steps < -min_step, "runs backward"),
        (np.abs(steps) <= min_step, "stands still"),
        (steps > _GAP * typical, f"jumps (a step is {typical:.6g} s)"),
    ):
        if is_wrong.any():
            row = int(np.argmax(is_wrong)) + 1
            raise ValueError(
                f"time {what} at row {row + 1}: {time[row]:.12g} s after {time[row - 1]:.12g} s"
            )
    dt = round(float(time[-1] - time[0]) / len(steps), 12)
    deviation = np.abs(time - time[0] - dt * np.arange(len(time)))
    if deviation.max() > dt + _DRIFT * (time[-1] - time[0]):
        row = int(np.argmax(deviation)) + 1
        raise ValueError(
            f"time is uneven: row {row} is {deviation.max():.6g} s beside a clock of {dt:.6g} "
            "s a row"
        )
    if dt < TICK * (1.0 - 1e-6):
        raise ValueError(f"rows are {dt:.6g} s apart; the shortest step is {TICK} s")
    return max(round(float(time[0]) / dt), 0), dt


def _make_fast_rows(values: dict[str, Array]) -> tuple[Array, tuple[str, ...]]:
    """The record's fast rows and the names of those of its columns that carry something."""
    fast = np.zeros((len(values["time"]), FAST_WIDTH))
    if not {"wheel_left", "wheel_right"} <= values.keys():
        values = values | {"wheel_left": values["speed_x"], "wheel_right": values["speed_x"]}
    present = set()
    for name, quantity in _SAMPLED.items():
        if quantity in values:
            fast[:, getattr(FAST, name)] = values[quantity]
            present.add(name)
    for name in _INPUTS:
        if name in values:
            fast[0, getattr(FAST, name)] = values[name][0]
            fast[1:, getattr(FAST, name)] = values[name][:-1]
            present.add(name)
    return fast, tuple(name for name in Fast._fields if name in present)


def _make_packets(
    values: dict[str, Array], first: int, dt: float
) -> tuple[Array, dict[str, SlowSensor]]:
    """The packets of all slow sensors and their clocks."""
    packets, clocks = [np.zeros((0, PACKET_WIDTH))], {}
    for sensor, names in SENSORS.items():
        if not np.isfinite(values.get(names[0], np.nan)).any():
            continue
        known = np.flatnonzero(np.isfinite(values[names[0]]))
        ticks = (first + known).astype(np.float64)
        absent = np.full(len(values["time"]), np.nan)
        columns = np.stack([values.get(name, absent)[known] for name in names], axis=1)
        quality = np.ones(len(known))
        if sensor == "gps":
            columns[:, 0] = np.arctan2(np.sin(columns[:, 0]), np.cos(columns[:, 0]))
            quality[values["speed_x"][known] < COURSE_SPEED] = 0.0
        packets.append(make_packet_rows(sensor, ticks, ticks, columns, quality))
        rows = int(np.gcd.reduce(np.diff(known))) if len(known) > 1 else len(values["time"])
        clocks[sensor] = SlowSensor(period=rows * dt, phase=(first + int(known[0])) % rows * dt)
    all_packets = np.concatenate(packets)
    order = np.lexsort((all_packets[:, PACKET.sensor], all_packets[:, PACKET.arrived]))
    return all_packets[order], clocks


def _compute_truth(values: dict[str, Array]) -> dict[str, Array]:
    """The sideslip angle where the log knows it; 0 at a standstill."""
    v_x, v_y = values["speed_x"], values.get("speed_y")
    if "sideslip" in values:
        beta = values["sideslip"]
    elif v_y is not None:
        beta = np.arctan2(v_y, v_x)
    else:
        return {}
    is_standing = np.hypot(v_x, 0.0 if v_y is None else np.nan_to_num(v_y)) <= _STANDING
    return {"beta": np.where(is_standing, 0.0, beta)}
