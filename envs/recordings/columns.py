"""A table on disk as named quantities in SI units (needs the extra `report`)."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..arguments import brief, listed
from ..record import Array
from ..vehicle.vehicle import GRAVITY
from .tables import read_table

if TYPE_CHECKING:
    import pandas as pd

_LARGEST = 1e15  # a time in ms since 1970 is below
_SPEED = {"mps": 1.0, "kmh": 1.0 / 3.6}
_ANGLE = {"rad": 1.0, "deg": np.pi / 180.0}
_ANGLE_RATE = {"radps": 1.0, "degps": np.pi / 180.0}
_ACCELERATION = {"mps2": 1.0, "g": GRAVITY}
_LENGTH = {"m": 1.0}
_TORQUE = {"nm": 1.0}
_NUMBER = {"count": 1.0}
_CURVATURE = {"radpm": 1.0}

COLUMNS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3},
    "speed_x": _SPEED,
    "speed_y": _SPEED,
    "yaw_rate": _ANGLE_RATE,
    "accel_x": _ACCELERATION,
    "accel_y": _ACCELERATION,
    "roll_rate": _ANGLE_RATE,
    "steer": _ANGLE,
    "sideslip": _ANGLE,
    "wheel_left": _SPEED,
    "wheel_right": _SPEED,
    "torque_left": _TORQUE,
    "torque_right": _TORQUE,
    "steer_command": _ANGLE,
    "accel_command": _ACCELERATION,
    "curvature": _CURVATURE,
    "course": _ANGLE,
    "gps_speed": _SPEED,
    "gps_x": _LENGTH,
    "gps_y": _LENGTH,
    "gps_hdop": _NUMBER,
    "gps_satellites": _NUMBER,
    "camera_psi": _ANGLE,
    "camera_y_l": _LENGTH,
}
"""What a log may hold and the units it may come in, with their factors to SI. A column is called
quantity_unit (`yaw_rate_radps`). Axes are ISO 8855; angles, the course too, are positive to the
left."""


def column_name(quantity: str) -> str:
    """The name of a quantity's column in SI units."""
    return f"{quantity}_{next(iter(COLUMNS[quantity]))}"


def quantity_of(name: str) -> tuple[str, float]:
    """(quantity, factor to SI) of a column's name; ValueError if it is none of ours."""
    quantity, _, unit = name.rpartition("_")
    if unit in COLUMNS.get(quantity, {}):
        return quantity, COLUMNS[quantity][unit]
    near = next((known for known in (name, quantity) if known in COLUMNS), None)
    known = (
        [column_name(q) for q in COLUMNS]
        if near is None
        else [f"{near}_{u}" for u in COLUMNS[near]]
    )
    raise ValueError(f"unknown column name {name!r}; expected one of {', '.join(known)}")


def parse_mapping(texts: Sequence[str]) -> dict[str, str]:
    """{"yaw_rate_radps": "MyColumn"} from texts such as "yaw_rate_radps=MyColumn".

    Raises ValueError for a text of another form, an unknown name and a quantity given twice.
    """
    mapping: dict[str, str] = {}
    for text in texts:
        ours, _, theirs = (part.strip() for part in text.partition("="))
        if not (ours and theirs):
            raise ValueError(f"expected NAME=COLUMN, such as steer_rad=Delta, got {text!r}")
        if ours in mapping:
            raise ValueError(f"{ours} is mapped twice, to {mapping[ours]!r} and to {theirs!r}")
        quantity_of(ours)
        mapping[ours] = theirs
    return mapping


def read_quantities(
    path: Path, mapping: Mapping[str, str], needed: Sequence[str], gaps: Collection[str] | None
) -> dict[str, Array]:
    """The file's known quantities in SI units, (n,) each; other columns are ignored.

    mapping: our column name, unit included, to the file's. needed: quantities that must be there.
    gaps: quantities that may hold NaN, any other is complete; None: all but the time. An empty
    column counts as absent.

    Raises what `read_table` does, and ValueError for a missing column, one given twice, a value
    that is no finite number, NaN, and fewer than two rows. Rows count from 1 below the header.
    """
    table = read_table(path)
    try:
        found = _find(table, mapping)
        missing = [column_name(name) for name in needed if name not in found]
        if missing:
            raise ValueError(f"no column {' nor '.join(missing)}; {_there(table)}")
        if len(table) < 2:
            rows = "no rows" if table.empty else "one row"
            raise ValueError(f"the log has {rows}; a drive needs two or more")
        values = {}
        for quantity, (name, factor) in found.items():
            column = _numbers(table, name)
            unknown = np.isnan(column)
            if unknown.all() and quantity not in needed:
                continue
            if unknown.any() and (quantity not in gaps if gaps is not None else quantity == "time"):
                row = int(np.argmax(unknown)) + 1
                raise ValueError(f"column {name!r} has no value (NaN) in row {row}")
            values[quantity] = factor * column
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return values


def _there(table: "pd.DataFrame") -> str:
    return f"the log has {listed(map(str, table.columns))}"


def _find(table: "pd.DataFrame", mapping: Mapping[str, str]) -> dict[str, tuple[str, float]]:
    """(column, factor) of each quantity: as mapped, else by our names."""
    found: dict[str, tuple[str, float]] = {}
    for ours, theirs in mapping.items():
        quantity, factor = quantity_of(ours)
        if quantity in found:
            raise ValueError(f"{quantity} is mapped twice")
        if theirs not in table.columns:
            raise ValueError(f"no column {theirs!r} for {ours}; {_there(table)}")
        found[quantity] = theirs, factor
    for quantity, units in COLUMNS.items():
        names = [f"{quantity}_{unit}" for unit in units if f"{quantity}_{unit}" in table.columns]
        if quantity in found or not names:
            continue
        if len(names) > 1:
            raise ValueError(f"{quantity} is given twice, as {' and '.join(names)}")
        found[quantity] = names[0], quantity_of(names[0])[1]
    return found


def _numbers(table: "pd.DataFrame", name: str) -> Array:
    """A column as float64; ValueError names the first value that is no finite number."""
    import pandas as pd

    column = table[name]
    for kind in ("datetime64_any", "timedelta64", "bool"):
        if getattr(pd.api.types, f"is_{kind}_dtype")(column.dtype):
            raise ValueError(f"column {name!r} holds {column.dtype}; expected numbers")
    numbers = column
    if not pd.api.types.is_numeric_dtype(column.dtype):
        try:
            numbers = pd.to_numeric(column, errors="coerce")
        except OverflowError as error:
            raise ValueError(f"column {name!r}: expected numbers, got {error}") from None
    values = np.asarray(numbers.to_numpy(np.float64, na_value=np.nan))
    bad = (np.abs(values) > _LARGEST) | (np.isnan(values) & column.notna().to_numpy())
    if bad.any():
        row = int(np.argmax(bad))
        text = brief(str(column.iloc[row]))
        raise ValueError(f"column {name!r}, row {row + 1}: expected a number, got {text}")
    return values
