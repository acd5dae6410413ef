"""A recorded steering trace as a scenario: what a log's driver did, driven again."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..recordings.columns import read_quantities
from ..recordings.log_file import find_clock
from .scenario import Scenario

TABLE_SUFFIXES = (".csv", ".parquet")


def read_trace(path: str | os.PathLike[str], mapping: Mapping[str, str] | None = None) -> Scenario:
    """Read a scenario that steers as a recorded drive, at its first speed, as long as it lasts.

    Everything else is `Scenario`'s default; a mapping over it
    (`{"base": "drive.csv", "friction": 0.4}`) changes that.

    Args:
        path: CSV or Parquet (needs the extra `report`) with the columns of `COLUMNS` for time and
            steering angle (time_s, steer_rad or steer_deg) and optionally speed (speed_x_mps).
        mapping: Our column names to the log's.

    Returns:
        The scenario.

    Raises:
        ValueError: For a clock that runs backward, stands still, jumps or is uneven, and for what
            `read_log` refuses: a file that is no table, a missing column, NaN.
    """
    source = Path(path)
    values, _ = read_quantities(source, mapping or {}, ("time", "steer"), {"speed_x"})
    try:
        _, step = find_clock(values["time"])
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    speed = values.get("speed_x", np.zeros(0))
    known_speed = speed[np.isfinite(speed)]
    trace = tuple(values["steer"].tolist())
    scenario = Scenario(
        name=source.stem,
        steering="trace",
        trace=trace,
        trace_step=step,
        duration=round((len(trace) - 1) * step, 9),
    )
    return (
        scenario.replace(speed=max(float(known_speed[0]), 0.0)) if len(known_speed) else scenario
    )  # noise at rest
