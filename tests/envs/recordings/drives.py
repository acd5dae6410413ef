"""A small drive as a table, on disk, and read as it is: without mending its clock."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from sideslip.envs.record import Log
from sideslip.envs.recordings.log_file import _GAPS, NEEDED, _make_log
from sideslip.envs.recordings.tables import read_quantities


def drive(rows: int = 50, dt: float = 0.01, start: float = 3.0) -> pd.DataFrame:
    t = start + dt * np.arange(rows)
    return pd.DataFrame(
        {
            "time_s": t,
            "speed_x_mps": 20.0 + np.sin(t),
            "speed_y_mps": 0.3 * np.cos(t),
            "yaw_rate_radps": 0.1 * np.sin(2.0 * t),
            "accel_x_mps2": np.cos(t),
            "accel_y_mps2": 2.0 * np.sin(2.0 * t),
            "steer_rad": 0.02 * np.sin(2.0 * t + 0.3),
            "sideslip_rad": 0.01 * np.cos(2.0 * t),
        }
    )


def saved(table: pd.DataFrame, folder: Path, name: str = "drive.csv", sep: str = ",") -> Path:
    path = folder / name
    table.to_csv(path, index=False, sep=sep)
    return path


def read_log(path: Path, mapping: Mapping[str, str] | None = None) -> Log:
    """The drive of a table that `read_parts` would leave whole."""
    try:
        values, _ = read_quantities(path, mapping or {}, NEEDED, _GAPS)
        return _make_log(values, f"{path.resolve().parent.name}/{path.stem}")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
