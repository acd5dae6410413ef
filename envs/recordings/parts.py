"""A recorded drive with holes as whole drives: short holes are filled, long ones divide it."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..record import Array, Log
from .columns import read_quantities
from .log_file import GAPS, NEEDED, find_clock, make_log
from .samples import LONGEST_GAP, SLOW_QUANTITIES

WARNING_PREFIX = "WARNING: "  # begins a remark that concerns the result
MAX_HOLE = 0.25  # s, the longest hole that is filled by interpolation
MIN_PART = 2.0  # s, of a part
_SAME_STEP = 1e-3  # of a step, by which those of parts may differ


def read_parts(
    path: str | Path,
    mapping: Mapping[str, str] | None = None,
    start: float = 0.0,
    end: float | None = None,
) -> tuple[list[Log], list[str]]:
    """Read a recorded drive as `read_log` does, but mend its clock and divide it at long holes.

    Shuffled rows are sorted. Rows without a value in a column that must be complete, and rows whose
    time is not after that of those before, are dropped; a file of which most rows lack a value at
    irregular places is refused. Holes up to `MAX_HOLE` s are filled by interpolation on an even
    clock; longer ones, and a clock that is set back by more, divide the log, and parts under
    `MIN_PART` s are left out. All parts have the dt of the longest; one without a slow sensor's
    sample lacks the sensor.

    Args:
        path: Table as `read_log` reads it.
        mapping: Our column names, unit included, to the log's.
        start: Time after the first row from which it is read (s).
        end: Time after the first row up to which it is read (s); None: to its end.

    Returns:
        Whole drives, and sentences on what was done.

    Raises:
        ValueError: If no part is left, and for all else that `read_log` refuses.
    """
    source = Path(path)
    values, remarks = read_quantities(source, mapping or {}, NEEDED, None)
    gaps = {name: np.isnan(v) for name, v in values.items() if name not in GAPS}
    known = ~np.any(list(gaps.values()), axis=0)
    elapsed = np.append(0.0, np.cumsum(np.maximum(np.diff(values["time"]), 0.0)))
    is_used = known & (elapsed >= start) & (elapsed < (math.inf if end is None else end))
    count = int(np.count_nonzero(~known))
    drop_reason = "rows lack a value and were dropped"
    try:
        if count > len(known) / 2:
            names = ", ".join(name for name, gap in gaps.items() if gap.any())
            drop_reason = f"of {len(known)} rows lack a value of {names}"
            if np.count_nonzero(known[1:] & known[:-1]) < np.count_nonzero(known) / 2:
                regular = f"regular gaps up to {LONGEST_GAP:g} s could be filled"
                raise ValueError(f"{count} {drop_reason}; {regular}")
            remarks, count = (
                [f"{WARNING_PREFIX}{count} {drop_reason} and were dropped.", *remarks],
                0,
            )
        if np.count_nonzero(is_used) < 2:
            raise ValueError("fewer than two rows are complete, or are in the time asked for")
        pieces, done = _split_pieces({name: column[is_used] for name, column in values.items()})
        dt = None
        if len(pieces) > 1:
            dt = find_clock(max((piece["time"] for piece in pieces), key=len))[1]
            pieces = [_resample_evenly(piece, dt, _SAME_STEP) for piece in pieces]
        logs = [make_log(piece, source, dt) for piece in pieces]
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    remarks += [f"{count} {text}." for count, text in [*done, (count, drop_reason)] if count]
    sensors = set[str]().union(*(log.slow for log in logs))
    for i, log in enumerate(logs if len(logs) > 1 else ()):
        logs[i] = dataclasses.replace(log, name=f"{log.name}, part {i + 1}")
        remarks += [f"Part {i + 1} has no sample of {name}." for name in sensors - log.slow.keys()]
    return logs, remarks


def _split_pieces(values: dict[str, Array]) -> tuple[list[dict[str, Array]], list[tuple[int, str]]]:
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
        rows, dropped = rows[is_later], dropped + int(np.count_nonzero(~is_later))
        if (len(ends) and time[rows[-1]] - time[rows[0]] < MIN_PART) or len(rows) < 2:
            short += 1
            continue
        holes += int(np.count_nonzero(np.diff(time[rows]) > 1.5 * typical))
        pieces.append(
            _resample_evenly({name: column[rows] for name, column in values.items()}, typical)
        )
    if dropped > len(time) / 2:
        raise ValueError(
            f"time stands still or steps back in {dropped} of {len(time)} rows: have its stamps "
            "lost digits?"
        )
    if not pieces:
        raise ValueError(
            f"no part of the log lasts {MIN_PART:g} s without a hole of {MAX_HOLE:g} s"
        )
    return pieces, [
        (dropped, "rows whose time steps back or stands still were dropped"),
        (
            int(np.count_nonzero(is_backward)),
            "times the clock was set back: the log is divided there",
        ),
        (holes, f"holes up to {MAX_HOLE:g} s were filled by interpolation"),
        (len(pieces) if len(pieces) > 1 else 0, "parts, between which rows are missing"),
        (short, f"parts under {MIN_PART:g} s were left out"),
    ]


def _resample_evenly(
    values: dict[str, Array], dt: float, tolerance: float = math.inf
) -> dict[str, Array]:
    """Resample the quantities to an even clock: interpolated, slow samples in the nearest row.

    Those whose clock is even already, and within this fraction of dt, stay as they are.
    """
    time = values["time"]
    try:
        if abs(find_clock(time)[1] / dt - 1.0) <= tolerance:
            return values
    except ValueError:
        pass
    even = np.linspace(time[0], time[-1], round((time[-1] - time[0]) / dt) + 1)
    resampled = {name: np.interp(even, time, column) for name, column in values.items()}
    for name in SLOW_QUANTITIES & values.keys():
        known = np.isfinite(values[name])
        resampled[name] = np.full(len(even), np.nan)
        resampled[name][np.rint((time[known] - time[0]) / (even[1] - even[0])).astype(int)] = (
            values[name][known]
        )
    return resampled
