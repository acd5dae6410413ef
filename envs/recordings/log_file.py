"""Recorded drives from files: the same record that the simulated car writes."""

import dataclasses
import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..numerics.functions import TICK
from ..record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Array, Fast, Log, Record
from ..sensors.link import SlowSensor
from ..sensors.slow import COURSE_SPEED, SLOW_NAMES
from .dialect import LATENCIES, LONGEST_GAP, SENSORS, SLOW_QUANTITIES, TRUTH, Quantities
from .tables import name_log, read_quantities

if TYPE_CHECKING:
    from .containers import LogSource

NEEDED = ("time", "speed_x", "yaw_rate", "steer")  # without which a log cannot be read
_SAMPLED = {  # column of the record: quantity of the log
    "gyro": "yaw_rate",
    **{name: name for name in ("accel_y", "accel_x", "roll_rate", "wheel_left", "wheel_right")},
}
_INPUTS = ("steer", "torque_left", "torque_right", "steer_command", "accel_command", "curvature")
_GAPS = {*TRUTH, *SLOW_QUANTITIES}  # need not be known in every row
_SLOW_ROWS = 0.011  # s, rows so far apart that half of one counts
_GAP = 1.5  # steps of time
_STILL = 1e-3  # of a step of time
_DRIFT = 1e-4  # of the log's length
_STANDING = 0.5  # m/s; below it the sideslip angle is 0


def _make_log(values: Quantities, name: str, dt: float | None = None, origin: float = 0.0) -> Log:
    """Make the log of quantities; dt None finds the clock's step (s).

    Its first tick is that of the first row, by the time from `origin` (s) on. A logged input
    (steering, torque, command) acts from its row to the next, so it stands one row later in the
    record; rows slower than 100 Hz take the mean of both rows' steering.
    """
    dt = find_step(values["time"]) if dt is None else dt
    first = round((float(values["time"][0]) - origin) / dt)
    fast, present = make_fast_rows(values)
    packets, slow = make_packets(values, first, dt)
    record = Record(fast, packets, first, dt, present)
    camera = [name for name in SENSORS["camera"] if np.isfinite(values.get(name, np.nan)).any()]
    if camera and "camera" not in slow:
        both = " and ".join(SENSORS["camera"])
        raise ValueError(f"no row has both {both}: a camera's sample is of both")
    return Log(record, slow, _compute_truth(values), name, origin)


def find_step(time: Array) -> float:
    """Find the step of an even clock (s); ValueError, with the row, for an uneven one.

    Args:
        time: Time of each row (s), shape (n,).
    """
    steps = np.diff(time)
    typical = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    for is_wrong, what in (
        (steps < -_STILL * typical, "runs backward"),
        (np.abs(steps) <= _STILL * typical, "stands still"),
        (steps > _GAP * typical, f"jumps (a step is {typical:.6g} s)"),
    ):
        if is_wrong.any():
            row = int(np.argmax(is_wrong)) + 1
            after = f"{time[row]:.12g} s after {time[row - 1]:.12g} s"
            raise ValueError(f"time {what} at row {row + 1}: {after}")
    dt = round(float(time[-1] - time[0]) / len(steps), 12)
    deviation = np.abs(time - time[0] - dt * np.arange(len(time)))
    if deviation.max() > dt + _DRIFT * (time[-1] - time[0]):
        row = int(np.argmax(deviation)) + 1
        clock = f"{deviation.max():.6g} s beside a clock of {dt:.6g} s a row"
        raise ValueError(f"time is uneven: row {row} is {clock}")
    if dt < TICK * (1.0 - 1e-6):
        raise ValueError(f"rows are {dt:.6g} s apart; the shortest step is {TICK} s")
    return dt


def make_fast_rows(values: Quantities) -> tuple[Array, tuple[str, ...]]:
    """Make the fast rows, shape (n, FAST_WIDTH), and the names of those that carry something.

    Args:
        values: Quantities of the log.
    """
    fast, present = np.zeros((len(values["time"]), FAST_WIDTH)), set()
    if not {"wheel_left", "wheel_right"} <= values.keys():
        values = values | dict.fromkeys(("wheel_left", "wheel_right"), values["speed_x"])
    for name, quantity in _SAMPLED.items():
        if quantity in values:
            fast[:, getattr(FAST, name)] = values[quantity]
            present.add(name)
    for name in _INPUTS:
        if name in values:
            fast[:, getattr(FAST, name)] = np.append(values[name][:1], values[name][:-1])
            present.add(name)
    time = values["time"]
    if len(time) > 1 and time[-1] - time[0] > _SLOW_ROWS * (len(time) - 1):
        steer = values["steer"]  # sampled, not held: its mean over a row is that of both ends
        fast[1:, FAST.steer] = 0.5 * (steer[:-1] + steer[1:])
    return fast, tuple(name for name in Fast._fields if name in present)


def make_packets(values: Quantities, first: int, dt: float) -> tuple[Array, dict[str, SlowSensor]]:
    """Make the packets, shape (count, PACKET_WIDTH), and slow sensors by name.

    Args:
        values: Quantities of the log.
        first: Tick of the first row.
        dt: Tick (s).
    """
    parts, clocks = [np.zeros((0, PACKET_WIDTH))], {}
    absent = np.full(len(values["time"]), np.nan)
    for sensor, names in SENSORS.items():
        known = np.flatnonzero(np.isfinite(values.get(names[0], absent)))
        if sensor == "camera":  # a filter takes both values or none
            known = known[np.isfinite(values.get(names[1], absent)[known])]
        if not len(known):
            continue
        late = np.nan_to_num(values.get(LATENCIES[sensor], absent)[known]) / dt
        late = np.maximum(np.ceil(late - _STILL), 0.0)  # no estimator has it before it came
        packets = np.zeros((len(known), PACKET_WIDTH))
        packets[:, PACKET.sensor] = SLOW_NAMES.index(sensor)
        packets[:, PACKET.captured] = first + known
        packets[:, PACKET.arrived] = packets[:, PACKET.captured] + late
        packets[:, PACKET.quality] = 1.0
        packets[:, PACKET.sequence] = np.arange(len(known))
        for place, name in enumerate(names, PACKET.value):
            packets[:, place] = values.get(name, absent)[known]
        if sensor == "gps":
            course = packets[:, PACKET.value]
            packets[:, PACKET.value] = np.arctan2(np.sin(course), np.cos(course))
            packets[values["speed_x"][known] < COURSE_SPEED, PACKET.quality] = 0.0
        parts.append(packets)
        n = int(np.gcd.reduce(np.diff(known))) if len(known) > 1 else len(values["time"])
        phase, delays = (first + int(known[0])) % n * dt, (float(late.min()) * dt,)
        clocks[sensor] = SlowSensor(n * dt, delays, phase, jitter=float(np.ptp(late)) * dt)
    rows = np.concatenate(parts)
    return rows[np.lexsort((rows[:, PACKET.sensor], rows[:, PACKET.arrived]))], clocks


def _compute_truth(values: Quantities) -> dict[str, Array]:
    """Compute the sideslip angle (rad) where the log knows it; 0 at a standstill."""
    if not TRUTH & values.keys():
        return {}
    v_x, v_y = values["speed_x"], values.get("speed_y", np.zeros(1))
    beta = values["sideslip"] if "sideslip" in values else np.arctan2(v_y, v_x)
    is_standing = np.hypot(v_x, np.nan_to_num(v_y)) <= _STANDING
    return {"beta": np.where(is_standing, 0.0, beta)}


WARNING_PREFIX = "WARNING: "  # begins a remark that concerns the result
MAX_HOLE = 0.25  # s, the longest hole that is filled by interpolation
_MIN_PART = 2.0  # s, of a part
_SAME_STEP = 1e-3  # of a step, by which those of parts may differ


def read_parts(
    source: "LogSource", mapping: Mapping[str, str] | None = None, start: float = 0.0,
    end: float | None = None,
) -> tuple[list[Log], list[str]]:  # fmt: skip
    """Read whole drives of a table, and sentences on what was done (needs the extra `report`).

    Without both wheel speeds both wheels turn at speed_x. Slow sensors (course, camera_psi) are NaN
    between their samples. One is captured in its row, and arrives there or by its gps_latency or
    camera_latency later; the sensor's period is the longest that has every sample on its clock.
    truth["beta"] is the sideslip angle, or atan2(speed_y, speed_x) where only that is logged; 0 at
    0.5 m/s and below, NaN where unknown, left out where the log has neither.

    Shuffled rows are sorted. Rows without a value in a column that must be complete, and rows whose
    time is not after that of those before, are dropped; a file of which most rows lack a value at
    irregular places is refused. Holes up to `MAX_HOLE` s are filled by interpolation on an even
    clock; longer ones, and a clock that is set back by more, divide the log, and parts under
    `_MIN_PART` s are left out. All parts have the dt of the longest. Raises ValueError where no
    part is left, and the errors of `tables.read_columns`.

    Args:
        source: Table or its file, whose known columns are named as in `tables.COLUMNS`.
        mapping: Our column names to the log's, as `tables.parse_mapping` makes it.
        start: Time after the first row from which it is read (s).
        end: Time after the first row up to which it is read (s); None: to its end.
    """
    label = title = name_log(source)
    if isinstance(source, str | Path):  # the file's with its folder's
        title = f"{Path(source).resolve().parent.name}/{Path(source).stem}"
    try:
        values, remarks = read_quantities(source, mapping or {}, NEEDED, None)
        gaps = {name: np.isnan(v) for name, v in values.items() if name not in _GAPS}
        known = ~np.any(list(gaps.values()), axis=0)
        elapsed = np.append(0.0, np.cumsum(np.maximum(np.diff(values["time"]), 0.0)))
        is_used = known & (elapsed >= start) & (elapsed < (math.inf if end is None else end))
        count = int(np.count_nonzero(~known))
        if count > len(known) / 2:
            names = ", ".join(name for name, gap in gaps.items() if gap.any())
            lack = f"{count} of {len(known)} rows lack a value of {names}"
            if np.count_nonzero(known[1:] & known[:-1]) < np.count_nonzero(known) / 2:
                raise ValueError(f"{lack}; regular gaps up to {LONGEST_GAP:g} s could be filled")
            remarks, count = [f"{WARNING_PREFIX}{lack} and were dropped.", *remarks], 0
        if np.count_nonzero(is_used) < 2:
            raise ValueError("fewer than two rows are complete, or are in the time asked for")
        pieces, done = _split_pieces({name: column[is_used] for name, column in values.items()})
        dt = None
        if len(pieces) > 1:
            dt = find_step(max((piece["time"] for piece in pieces), key=len))
            pieces = [_resample_evenly(piece, dt, _SAME_STEP) for piece in pieces]
        origin = min(0.0, *(float(piece["time"][0]) for piece in pieces))  # no tick is negative
        logs = [_make_log(piece, title, dt, origin) for piece in pieces]
    except ValueError as error:
        raise ValueError(f"{label}: {error}") from None
    done.append((count, "rows lack a value and were dropped"))
    remarks += [f"{count} {text}." for count, text in done if count]
    sensors = set[str]().union(*(log.slow for log in logs))
    for i, log in enumerate(logs if len(logs) > 1 else ()):
        logs[i] = dataclasses.replace(log, name=f"{log.name}, part {i + 1}")
        remarks += [f"Part {i + 1} has no sample of {name}." for name in sensors - log.slow.keys()]
    return logs, remarks


def _split_pieces(values: Quantities) -> tuple[list[Quantities], list[tuple[int, str]]]:
    """Split the log into whole drives on even clocks; list (count, text) of what was done."""
    time, pieces, short, dropped, holes = values["time"], [], 0, 0, 0
    steps = np.diff(time)
    if not (steps > 0.0).any():
        raise ValueError(f"time stands still at row 2: {time[1]:.12g} s after {time[0]:.12g} s")
    typical = float(np.median(steps[steps > 0.0]))
    is_backward = steps < -MAX_HOLE
    ends = np.flatnonzero(is_backward | (steps > MAX_HOLE + typical)) + 1
    for rows in np.split(np.arange(len(time)), ends):
        newest = np.maximum.accumulate(time[rows])
        is_later = np.append(True, time[rows][1:] > newest[:-1] + 1e-3 * typical)
        rows, dropped = rows[is_later], dropped + int((~is_later).sum())
        if (len(ends) and time[rows[-1]] - time[rows[0]] < _MIN_PART) or len(rows) < 2:
            short += 1
            continue
        holes += int((np.diff(time[rows]) > 1.5 * typical).sum())
        pieces.append(_resample_evenly({n: column[rows] for n, column in values.items()}, typical))
    if dropped > len(time) / 2:
        text = f"stands still or steps back in {dropped} of {len(time)} rows"
        raise ValueError(f"time {text}: have its stamps lost digits?")
    if not pieces:
        text = f"lasts {_MIN_PART:g} s without a hole of {MAX_HOLE:g} s"
        raise ValueError(f"no part of the log {text}")
    return pieces, [
        (dropped, "rows whose time steps back or stands still were dropped"),
        (int(is_backward.sum()), "times the clock was set back: the log is divided there"),
        (holes, f"holes up to {MAX_HOLE:g} s were filled by interpolation"),
        (len(pieces) if len(pieces) > 1 else 0, "parts, between which rows are missing"),
        (short, f"parts under {_MIN_PART:g} s were left out"),
    ]


def _resample_evenly(values: Quantities, dt: float, tolerance: float = math.inf) -> Quantities:
    """Resample the quantities to an even clock: interpolated, slow samples in the nearest row.

    A clock that is even already, its step within the tolerance (a fraction) of dt, stays.
    """
    time = values["time"]
    with suppress(ValueError):
        if abs(find_step(time) / dt - 1.0) <= tolerance:
            return values
    even = np.linspace(time[0], time[-1], round((time[-1] - time[0]) / dt) + 1)
    resampled = {name: np.interp(even, time, column) for name, column in values.items()}
    for name in SLOW_QUANTITIES & values.keys():
        known = np.isfinite(values[name])
        resampled[name] = np.full(len(even), np.nan)
        rows = np.rint((time[known] - time[0]) / (even[1] - even[0])).astype(int)
        resampled[name][rows] = values[name][known]
    return resampled
