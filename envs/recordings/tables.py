"""Tables on disk as named quantities in SI units (needs the extra `report`).

Files are told apart by content. Columns have our names or mapped ones.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..io import read_document
from ..record import Array
from ..validation import join_names, short_repr
from ..vehicle.parameters import GRAVITY
from .containers import LogTable, read_table
from .dialect import KINDS, LATENCIES, Quantities, find_samples, find_unit

if TYPE_CHECKING:
    from .containers import LogSource

DBC = "dbc"  # name in a mapping of the file that describes a CAN trace
_LARGEST = 1e15  # in SI units
_SPEED = {"mps": 1.0, "kmh": 1.0 / 3.6}
_ANGLE = {"rad": 1.0, "deg": np.pi / 180.0}
_ANGLE_RATE = {"radps": 1.0, "degps": np.pi / 180.0}
_ACCELERATION = {"mps2": 1.0, "g": GRAVITY}
_LENGTH, _TORQUE = {"m": 1.0}, {"nm": 1.0}
_NUMBER, _CURVATURE = {"count": 1.0}, {"radpm": 1.0}

COLUMNS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "speed_x": _SPEED, "speed_y": _SPEED, "yaw_rate": _ANGLE_RATE, "accel_x": _ACCELERATION,
    "accel_y": _ACCELERATION, "roll_rate": _ANGLE_RATE, "steer": _ANGLE, "sideslip": _ANGLE,
    "wheel_left": _SPEED, "wheel_right": _SPEED, "torque_left": _TORQUE, "torque_right": _TORQUE,
    "steer_command": _ANGLE, "accel_command": _ACCELERATION, "curvature": _CURVATURE,
    "course": _ANGLE | {"degnorth": -np.pi / 180.0}, "gps_speed": _SPEED, "gps_x": _LENGTH,
    "gps_y": _LENGTH, "gps_hdop": _NUMBER, "gps_satellites": _NUMBER, "camera_psi": _ANGLE,
    "camera_y_l": _LENGTH, **{name: {"s": 1.0, "ms": 1e-3} for name in LATENCIES.values()},
}  # fmt: skip
"""What a log may hold and the units it may come in, with their factors to SI. A column is called
quantity_unit (`yaw_rate_radps`). Axes are ISO 8855; angles, the course too, are positive to the
left; `course_degnorth` alone counts from north, clockwise, as a compass does. The names of course
and camera_psi may end on a kind of samples: `course_deg_held`."""
_NAMES = {
    f"{quantity}_{unit}{kind}": (quantity, factor, np.pi / 2.0 if unit == "degnorth" else 0.0)
    for quantity, units in COLUMNS.items()
    for unit, factor in units.items()
    for kind in ("", *(f"_{kind}" * (quantity in ("course", "camera_psi")) for kind in KINDS))
}


def _make_column_name(quantity: str) -> str:
    """Make the name of a quantity's column in SI units, such as "yaw_rate_radps"."""
    return f"{quantity}_{next(iter(COLUMNS[quantity]))}"


def parse_column_name(name: str) -> tuple[str, float, float]:
    """Parse a column's name; ValueError for one that is none of ours.

    Args:
        name: Name in lower case, unit included.

    Returns:
        Quantity, factor to SI units, and what is added then (pi / 2 rad for a course from north).
    """
    if name in _NAMES:
        return _NAMES[name]
    known = list(map(_make_column_name, COLUMNS))
    if near := next((q for q in (name, name.rpartition("_")[0]) if q in COLUMNS), None):
        known = [f"{near}_{u}" for u in COLUMNS[near]]
    raise ValueError(f"unknown column name {name!r}; expected one of {', '.join(known)}")


def parse_mapping(texts: Sequence[str] | None) -> dict[str, str]:
    """Parse a mapping of column names: "yaw_rate_radps=MyColumn" to {"yaw_rate_radps": "MyColumn"}.

    Raises FileNotFoundError for a TOML file that does not exist, and ValueError for a text of
    another form, an unknown name and a name mapped twice.

    Args:
        texts: NAME=COLUMN, dbc=FILE that describes a CAN trace, and TOML files, a DBC beside them.
    """
    mapping: dict[str, str] = {}
    for text in texts or ():
        name, _, column = (part.strip() for part in text.partition("="))
        if text.endswith(".toml") and not column:
            entries = read_document(Path(text), "mapping")
            entries |= {DBC: str(Path(text).parent / str(entries[DBC]))} if DBC in entries else {}
        elif name and column:
            entries = {name: column}
        else:
            raise ValueError(f"expected NAME=COLUMN, such as steer_rad=Delta, got {text!r}")
        for name, column in entries.items():
            if name in mapping:
                raise ValueError(f"{name} is mapped twice, to {mapping[name]!r} and to {column!r}")
            if name != DBC:
                parse_column_name(name)
            if not isinstance(column, str):
                raise ValueError(f"{text}: {name} is a column's name, got {short_repr(column)}")
            mapping[name] = column
    return mapping


def read_columns(
    source: "LogSource", mapping: Mapping[str, str], needed: Sequence[str]
) -> tuple[Quantities, dict[str, str], list[str]]:
    """Read a log's known columns in SI units as they stand: rows unsorted, NaN where empty.

    An empty column counts as absent. Raises ValueError for a missing column, one given twice, a
    value that is no finite number, a time that is NaN and fewer than two rows, and the errors of
    `read_table`.

    Args:
        source: Path of the table, or the table itself.
        mapping: Our column names, unit included, to the log's; other columns are ignored.
        needed: Quantities that must be present.

    Returns:
        Quantities, kinds of samples that names tell, and remarks.
    """
    mapped = {name: column for name, column in mapping.items() if name != DBC}
    wanted = {*COLUMNS, *map(str.casefold, mapped.values())}
    table = read_table(
        source, lambda name: name.casefold() in wanted or bool(_match_column(name, "")), mapped,
        mapping.get(DBC, ""),
    )  # fmt: skip
    remarks = [*table.remarks]
    columns = _find_columns(table, mapped, remarks)
    if missing := [_make_column_name(name) for name in needed if name not in columns]:
        has = f"the log has {join_names(table.names)}; --map {missing[0]}=COLUMN names one"
        raise ValueError(f"no column {' nor '.join(missing)}; {has}")
    if len(table.frame) < 2:
        rows = "no rows" if table.frame.empty else "one row"
        raise ValueError(f"the log has {rows}; a drive needs two or more")
    values = {}
    for quantity, (place, name) in columns.items():
        column = _convert_column(table, place, name, remarks)
        if quantity in needed or not np.isnan(column).all():
            values[quantity] = column
    _check_complete(values, ["time"])
    kinds = {quantity: name.rpartition("_")[2] for quantity, (_, name) in columns.items()}
    return values, {quantity: kind for quantity, kind in kinds.items() if kind in KINDS}, remarks


def read_quantities(
    source: "LogSource", mapping: Mapping[str, str], needed: Sequence[str],
    gaps: Collection[str] | None,
) -> tuple[Quantities, list[str]]:  # fmt: skip
    """Read a log's quantities, and sentences on how they were read.

    Rows in messages count from 1 below the header. Raises the errors of `read_columns`, and
    ValueError for NaN in a quantity without gaps.

    Args:
        source: Path of the table, or the table itself.
        mapping: Our column names, unit included, to the log's; other columns are ignored.
        needed: Quantities that must be present.
        gaps: Quantities that may hold NaN; None: all but the time, and shuffled rows are sorted.
    """
    values, kinds, remarks = read_columns(source, mapping, needed)
    remarks += find_samples(values, needed, kinds, gaps is not None)
    if gaps is not None:
        _check_complete(values, [name for name in values if name not in gaps])
    return values, remarks


def name_log(source: "LogSource") -> str:
    """Name a log in messages by its path, or as "the frame".

    Args:
        source: Path of the table, or the table itself.
    """
    return str(source) if isinstance(source, str | Path) else "the frame"


def _check_complete(values: Quantities, quantities: Sequence[str]) -> None:
    for quantity in quantities:
        if (unknown := np.isnan(values[quantity])).any():
            name, row = _make_column_name(quantity), int(np.argmax(unknown)) + 1
            raise ValueError(f"column {name!r} has no value (NaN) in row {row}")


def _match_column(name: str, unit: str) -> str:
    """Match a column, its unit in the name, in brackets or beside it, to our name; "" for none."""
    folded = name.casefold()
    if folded not in _NAMES:
        base, _, bracket = folded.rstrip("])").replace("(", "[").partition("[")
        folded = f"{re.sub('[ -]+', '_', base.strip())}_{find_unit(bracket) or unit}"
    return folded if folded in _NAMES else ""


def _find_columns(
    table: LogTable, mapping: Mapping[str, str], remarks: list[str]
) -> dict[str, tuple[int, str]]:
    """Find each quantity's place and name: by the mapping, by ours, by names with units; remark."""
    names, quantities = [str(name) for name in table.frame.columns], set()
    for name, column in mapping.items():
        if column.casefold() not in map(str.casefold, names):
            has = f"the log has {join_names(table.names)}"
            raise ValueError(f"no column {column!r} for {name}; {has}")
        quantity = parse_column_name(name)[0]
        if quantity in quantities:
            raise ValueError(f"{quantity} is mapped twice")
        quantities.add(quantity)
    candidates: dict[str, list[tuple[int, int, str]]] = {}  # level, place and name by quantity
    for place, (label, unit) in enumerate(zip(names, table.units, strict=True)):
        options = [(0, name) for name, c in mapping.items() if c.casefold() == label.casefold()]
        if match := _match_column(label, unit):
            options.append((1 if match == label.casefold() else 2, match))
        for level, name in options:
            candidates.setdefault(_NAMES[name][0], []).append((level, place, name))
    columns = {}
    for quantity, matches in candidates.items():
        level = min(matches)[0]
        (_, place, name), *others = [x for x in matches if x[0] == level]
        label, unit = names[place], table.units[place]
        name_unit = name.replace("degnorth", "deg").removeprefix(f"{quantity}_").split("_")[0]
        if unit not in ("", "count", name_unit):
            if level:
                rule = f"--map {quantity}_{unit}={label} or --map {name}={label} says which it is"
                raise ValueError(f"{label} has the unit {unit} in the file; {rule}")
            remarks.append(f"{label} is read as {name}, though its unit in the file is {unit}.")
        for _, other, alias in others:
            if alias != name:
                raise ValueError(f"{quantity} is given twice, as {name} and {alias}")
            if not table.frame.iloc[:, place].equals(table.frame.iloc[:, other]):
                where = f"in columns {place + 1} and {other + 1}, with other values"
                raise ValueError(f"{label} is given twice, {where}; rename or delete one")
            remarks.append(f"{label} is given twice, with the same values.")
        columns[quantity] = place, name
    return columns


def _convert_column(table: LogTable, place: int, name: str, remarks: list[str]) -> Array:
    """Convert a column to SI units; ValueError names the first value that is no finite number.

    A time that is far off in its unit, but not in another since 1970, is read in that, which is
    remarked.
    """
    import pandas as pd

    column, label = table.frame.iloc[:, place], str(table.frame.columns[place])
    # times, durations, truth values, also as categories
    if column.dtype.kind in "Mm" or pd.api.types.is_bool_dtype(column.dtype):
        raise ValueError(f"column {label!r} holds {column.dtype}; expected numbers")
    try:
        numbers = pd.to_numeric(column, errors="coerce")
    except OverflowError as error:
        raise ValueError(f"column {label!r}: expected numbers, got {error}") from None
    values = np.array(numbers.to_numpy(np.float64, na_value=np.nan))
    quantity, factor, offset = parse_column_name(name)
    if quantity == "time" and abs(values[0]) * factor > 1e11:
        for unit, scale in COLUMNS["time"].items():
            if 3e8 < values[0] * scale < 4e9:
                factor = scale
                remarks.append(f"{label} is read in {unit} since 1970; no other unit fits.")
    values *= factor
    if offset:
        values += offset
    is_none = np.isinf(values) | (np.isnan(values) & column.notna().to_numpy())
    if (bad := is_none | (np.abs(values) > _LARGEST)).any():
        row = int(np.argmax(bad))
        text, expected = str(column.iloc[row]), f"a number up to {_LARGEST / abs(factor):g}"
        if is_none[row]:
            expected = "a number" + " with a decimal point alone" * ("," in text)
        got = f"expected {expected}, got {short_repr(text)}"
        raise ValueError(f"column {label!r}, row {row + 1}: {got}")
    return values
