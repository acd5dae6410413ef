"""A recorded drive from a CSV or Parquet file (needs the extra `report`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .record import (
    FAST,
    FAST_WIDTH,
    PACKET,
    PACKET_WIDTH,
    SLOW_NAMES,
    SLOW_VALUES,
    TICK,
    Array,
    Fast,
    Log,
    Record,
    SlowSensor,
)
from .sensors import COURSE_SPEED

if TYPE_CHECKING:
    import pandas as pd

_SPEED = {"mps": 1.0, "kmh": 1.0 / 3.6}
_ANGLE = {"rad": 1.0, "deg": np.pi / 180.0}
_ANGLE_RATE = {"radps": 1.0, "degps": np.pi / 180.0}
_ACCELERATION = {"mps2": 1.0, "g": 9.81}
_METRES = {"m": 1.0}

COLUMNS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3},
    "speed_x": _SPEED,
    "speed_y": _SPEED,
    "yaw_rate": _ANGLE_RATE,
    "accel_x": _ACCELERATION,
    "accel_y": _ACCELERATION,
    "steer": _ANGLE,
    "sideslip": _ANGLE,
    "wheel_left": _SPEED,
    "wheel_right": _SPEED,
    "torque_left": {"nm": 1.0},
    "torque_right": {"nm": 1.0},
    "steer_command": _ANGLE,
    "accel_command": _ACCELERATION,
    "course": _ANGLE,
    "gps_speed": _SPEED,
    "gps_x": _METRES,
    "gps_y": _METRES,
    "camera_psi": _ANGLE,
    "camera_y_l": _METRES,
}
"""What a log may hold, and the units it may come in with their factors to SI: a column is called
quantity_unit (`yaw_rate_radps`). Axes are ISO 8855, angles positive to the left."""

NEEDED = ("time", "speed_x", "yaw_rate", "steer")
_INPUTS = ("steer", "torque_left", "torque_right", "steer_command", "accel_command")
_SAMPLED = {  # column of the record: quantity of the log
    "gyro": "yaw_rate",
    "accel_y": "accel_y",
    "accel_x": "accel_x",
    "wheel_left": "wheel_left",
    "wheel_right": "wheel_right",
}
_SLOW = {  # in the order of SLOW_VALUES; the first decides where there is a sample
    "camera": ("camera_psi", "camera_y_l"),
    "gps": ("course", "gps_speed", "gps_x", "gps_y"),
}
_TRUTH = ("sideslip", "speed_y")
_GAP = 1.5  # steps of time
_DRIFT = 1e-4  # of the log's length, that an uneven clock may go beside an even one
_STANDING = 0.5  # m/s; the sideslip angle is 0 below it


def parse_mapping(texts: Sequence[str]) -> dict[str, str]:
    """{"yaw_rate_radps": "MyColumn"} from texts such as "yaw_rate_radps=MyColumn".

    Raises ValueError for a text without "=", an unknown name and a name given twice.
    """
    mapping: dict[str, str] = {}
    for text in texts:
        ours, equals, theirs = (part.strip() for part in text.partition("="))
        if not (equals and ours and theirs):
            raise ValueError(f"expected OUR_NAME=COLUMN such as steer_rad=Delta, got {text!r}")
        if ours in mapping:
            raise ValueError(f"{ours!r} is mapped twice, to {mapping[ours]!r} and to {theirs!r}")
        _quantity(ours)
        mapping[ours] = theirs
    return mapping


def read_log(path: str | Path, mapping: Mapping[str, str] | None = None) -> Log:
    """Read a recorded drive.

    path: CSV (comma, semicolon or tab) or Parquet, told apart by content. Columns are named as in
    `COLUMNS`; time, speed_x, yaw_rate and steer are needed, others are ignored. mapping: our name,
    unit included, to the log's ({"yaw_rate_degps": "GyroZ"}).

    Gives a Log. Its record's dt is the mean step of time, its first tick that of the first row.
    Inputs (steering, torques, commands) are sampled when they begin to act and so move one row
    down. Without wheel speeds both wheels turn at speed_x. Slow sensors (course, camera_psi) hold
    NaN between their samples, and a sample arrives in the row where it stands. truth["beta"] is
    the sideslip angle, or atan2(speed_y, speed_x) where only that is there, NaN where unknown.

    Rows in messages count from 1 below the header. Raises ModuleNotFoundError without the extra,
    FileNotFoundError, and ValueError for a file that is no table, a missing column, a value that
    is no number, and a clock that runs backward, stands still, jumps or is uneven.
    """
    source = Path(path)
    values = _quantities(_table(source), dict(mapping or {}), str(source))
    first, dt = _clock(values["time"], str(source))
    fast, present = _fast(values)
    packets, slow = _packets(values, first, dt)
    record = Record(fast, packets, first, dt, present)
    return Log(record, slow, _truth(values), source.stem)


def _table(path: Path) -> "pd.DataFrame":
    """The file's columns as they stand there; ValueError where it is no table."""
    try:
        import pandas as pd
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "reading a log needs pandas: pip install 'sideslip[report]'"
        ) from error
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, found a folder")
    with path.open("rb") as stream:
        head = stream.read(65536)
    if not head.strip():
        raise ValueError(f"{path}: the file is empty")
    try:
        if head.startswith(b"PAR1"):
            return pd.read_parquet(path)
        if b"\0" in head:
            raise ValueError("it is a binary file")
        title = head.splitlines()[0].decode("utf-8-sig")
        separator = max(",;\t", key=title.count)
        table = pd.read_csv(
            path,
            sep=separator,
            encoding="utf-8-sig",
            index_col=False,
            skipinitialspace=True,
            low_memory=False,
            compression=None,
        )
    except (ValueError, OSError) as error:  # pandas' and pyarrow's parser errors are ValueErrors
        reason = "it is not text" if isinstance(error, UnicodeDecodeError) else str(error).strip()
        raise ValueError(f"{path}: expected CSV or Parquet, but {reason}") from None
    return table.rename(columns=lambda name: str(name).strip())


def _quantity(name: str) -> tuple[str, float]:
    """(quantity, factor to SI) of a column's name; ValueError if it is none of ours."""
    quantity, _, unit = name.rpartition("_")
    if unit not in COLUMNS.get(quantity, {}):
        units = COLUMNS.get(name) or COLUMNS.get(quantity)
        known = [f"{name if name in COLUMNS else quantity}_{u}" for u in units or ()]
        known = known or [_name(quantity) for quantity in COLUMNS]
        raise ValueError(f"unknown column name {name!r}; expected {' or '.join(known)}")
    return quantity, COLUMNS[quantity][unit]


def _name(quantity: str) -> str:
    return f"{quantity}_{next(iter(COLUMNS[quantity]))}"


def _quantities(table: "pd.DataFrame", mapping: dict[str, str], where: str) -> dict[str, Array]:
    """Every known quantity of the table in SI units; NaN only where a sensor or truth may be."""
    there = f"the log has {', '.join(map(str, table.columns))}"
    found: dict[str, tuple[str, float]] = {}
    for ours, theirs in mapping.items():
        quantity, factor = _quantity(ours)
        if theirs not in table.columns:
            raise ValueError(f"{where}: no column {theirs!r} for {ours}; {there}")
        if quantity in found:
            raise ValueError(f"{where}: {quantity} is mapped twice")
        found[quantity] = theirs, factor
    for quantity, units in COLUMNS.items():
        if quantity in found:
            continue
        names = [f"{quantity}_{unit}" for unit in units if f"{quantity}_{unit}" in table.columns]
        if len(names) > 1:
            raise ValueError(f"{where}: {quantity} is given twice, as {' and '.join(names)}")
        if names:
            found[quantity] = names[0], _quantity(names[0])[1]
    missing = [_name(quantity) for quantity in NEEDED if quantity not in found]
    if missing:
        raise ValueError(f"{where}: no column {' nor '.join(missing)}; {there}")
    if len(table) < 2:
        raise ValueError(f"{where}: {len(table)} row(s); a drive has two or more")
    with_gaps = {*_TRUTH, *(name for names in _SLOW.values() for name in names)}
    values = {}
    for quantity, (name, factor) in found.items():
        column = _numbers(table[name], where)
        if quantity not in NEEDED and np.isnan(column).all():
            continue  # an empty column is an absent one
        if quantity not in with_gaps and np.isnan(column).any():
            row = int(np.argmax(np.isnan(column))) + 1
            raise ValueError(f"{where}: column {name!r} has no value (NaN) in row {row}")
        values[quantity] = factor * column
    return values


def _numbers(column: "pd.Series", where: str) -> Array:
    """The column as float64; ValueError naming the first value that is no finite number."""
    import pandas as pd

    if not pd.api.types.is_numeric_dtype(column.dtype):
        if pd.api.types.is_datetime64_any_dtype(column.dtype):
            raise ValueError(f"{where}: column {column.name!r} holds dates; expected numbers")
        numbers = pd.to_numeric(column, errors="coerce")
        bad = (numbers.isna() & column.notna()).to_numpy()
    else:
        numbers = column
        bad = np.isinf(column.to_numpy(np.float64, na_value=np.nan))
    if bad.any():
        row = int(np.argmax(bad))
        raise ValueError(
            f"{where}: column {column.name!r}, row {row + 1}: expected a number, "
            f"got {str(column.iloc[row])!r}"
        )
    return np.asarray(numbers.to_numpy(np.float64, na_value=np.nan))
