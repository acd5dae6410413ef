"""The dialect of a text table, the samples among a table's values, and metres on the earth.

A dialect is encoding, separator, decimal mark, header and units. Metres are of WGS 84's tangents.
"""

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..record import Array

if TYPE_CHECKING:
    import pandas as pd

_HEAD_BYTES, _HEAD_LINES = 1 << 16, 100  # in which a dialect shows
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?|[+-]?(nan|inf)", re.I)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
_SIGNS = str.maketrans({"²": "2", "°": "deg", "º": "deg", "µ": "u", "μ": "u", "/": "p"})
_UNITS = {
    alias: names.split()[0]
    for names in (
        "s sec second seconds", "ms", "us", "ns", "m", "mps", "kmh kph kmph", "nm", "g", "radps",
        "rad radian radians", "deg degree degrees grad", "degps dps", "radpm 1pm", "count - 1",
        "mps2 mpsps mps^2 mps**2",
    )
    for alias in names.split()
}  # fmt: skip


def find_unit(text: str) -> str:
    """Translate a unit such as "[km/h]" to that of our column names, "" for an unknown one.

    Args:
        text: Unit as a file writes it.
    """
    return _UNITS.get(re.sub(r"[\s\[\]()·*]", "", text.casefold().translate(_SIGNS)), "")


def read_text(
    data: bytes, is_wanted: Callable[[str], bool]
) -> tuple["pd.DataFrame", list[str], list[str]]:
    """Read a text table (its names may repeat), its units ("" if unknown), remarks on its dialect.

    Args:
        data: Content of the file; ValueError if it is binary, or header and rows differ in length.
        is_wanted: Whether a column's name is looked for; such names identify the header.
    """
    import pandas as pd

    encoding = _find_encoding(data)
    text = data[:_HEAD_BYTES].decode(encoding, "ignore")
    lines = re.split(r"\r\n|\r|\n", text)[:_HEAD_LINES]
    if len(lines) < _HEAD_LINES and len(data) > _HEAD_BYTES:
        del lines[-1]  # it is cut
    declared = re.fullmatch(r'"?sep=(.)"?', lines[0].strip(" "), re.I)
    body = {i: re.sub("^[#%] *", "", line) for i, line in enumerate(lines) if line.strip()}
    if declared:
        del body[0]
    tables = []
    for separator in declared[1] if declared else _SEPARATORS:
        rows = {i: _split_line(line, separator) for i, line in body.items()}
        widths = Counter(len(row) for row in rows.values() if len(row) > 1)
        n_rows, width = max(((n, w) for w, n in widths.items()), default=(0, 1))
        share = 0.5 if separator == " " else 1.0  # spaces stand beside other separators
        tables.append((share * n_rows, width, separator, rows))
    _, width, separator, rows = max(tables, key=lambda table: table[:2])
    header_lines = [
        i for i, row in rows.items()
        if abs(len(row) - width) <= 1 and 2 * sum(map(bool, row)) >= len(row)
        and not any(map(_NUMBER.fullmatch, row))
    ] or list(rows)  # fmt: skip
    best = (i for i in header_lines if any(map(is_wanted, rows[i])))
    header_line = next(best, header_lines[0])
    header, body_rows = rows[header_line], {i: row for i, row in rows.items() if i > header_line}
    if any(header[width:]) or any(any(row[len(header) :]) for row in body_rows.values()):
        raise ValueError(
            f"the header in line {header_line + 1} has {len(header)} names, and rows have "
            f"{width} fields; are numbers written with decimal commas between commas?"
        )
    units, skipped = [""] * len(header), []
    for i, row in body_rows.items():
        n_units, n_filled = sum(map(bool, map(find_unit, row))), sum(map(bool, row))
        is_units = 0 < n_filled <= 2 * n_units and not any(map(_NUMBER.fullmatch, row))
        if len(row) > 1 and not is_units:
            break
        units = [*map(find_unit, row), *units[len(row) :]] if is_units else units
        skipped.append(i)
    numbers = [x for row in body_rows.values() for x in row if _NUMBER.fullmatch(x)]
    has_comma = any("," in x and not _THOUSANDS.fullmatch(x) for x in numbers)
    decimal = "," if has_comma and not any("." in x for x in numbers) else "."
    frame = pd.read_csv(
        io.BytesIO(data), sep=r"\s+" if separator == " " else separator, decimal=decimal,
        encoding=encoding, header=0, names=list(range(len(header))),
        skiprows=[*range(header_line), *skipped] or None, index_col=False, skipinitialspace=True,
        low_memory=False,
    )  # fmt: skip
    frame.columns = pd.Index(header)
    aspects = {
        f"{encoding.upper()} text": encoding != "utf-8-sig",
        f"columns between {_SEPARATORS.get(separator, separator)}": separator != ",",
        "decimal commas": decimal == ",",
        f"the header in line {header_line + 1}": header_line > 0,
        "units below it": any(units),
    }
    summary = ", ".join(aspect for aspect, is_so in aspects.items() if is_so)
    return frame, units[: len(header)], [f"The table was read as: {summary}."] if summary else []


def _find_encoding(data: bytes) -> str:
    """Find the encoding by its mark or zeros, else UTF-8 or Windows-1252; ValueError: binary."""
    head = data[:_HEAD_BYTES]
    even, odd = head[::2].count(0), head[1::2].count(0)
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if min(even, odd) == 0 and max(even, odd) > 0.4 * len(head):
        return "utf-16-le" if odd else "utf-16-be"
    if even or odd:
        raise ValueError("it is a binary file")
    try:
        data.isascii() or data.decode("utf-8")
    except UnicodeDecodeError:
        if re.search(rb"[\x01-\x08\x0e-\x1f]", head[:-1]):
            raise
        data.decode("cp1252")
        return "cp1252"
    return "utf-8-sig"


def _split_line(line: str, separator: str) -> list[str]:
    entries = line.split() if separator == " " else line.split(separator)
    if '"' in line:
        entries = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return list(map(str.strip, entries))


Quantities = dict[str, Array]
"""Quantities of a log by name, in SI units, angles in rad, shape (n,) each; NaN where unknown."""
SENSORS = {  # the values of a packet, as in `SLOW`; the first shows where a sample is
    "camera": ("camera_psi", "camera_y_l"),
    "gps": ("course", "gps_speed", "gps_x", "gps_y", "gps_hdop", "gps_satellites"),
}
LATENCIES = {sensor: f"{sensor}_latency" for sensor in SENSORS}  # of each sample (s)
SLOW_QUANTITIES = {*SENSORS["camera"], *SENSORS["gps"], *LATENCIES.values()}
TRUTH = {"sideslip", "speed_y"}  # may be unknown in any row
KINDS = ("fresh", "held", "interpolated")
"""Values between a slow sensor's samples: samples too, the last one again, or a line."""
LONGEST_GAP = 1.0  # s between values of a fast quantity that are joined by a line
_COMPLETE = 0.75  # of the rows, above which a quantity is one of every row
_SHUFFLED = 0.05  # of the rows, which step back in time
_WRAP = 0.25  # s, by which a quantity's clock steps back where it began anew
_MIN_INTERVALS = 5  # between samples, from which their period is found


def find_samples(
    values: Quantities, needed: Collection[str], kinds: Mapping[str, str], is_strict: bool
) -> list[str]:
    """Reduce a table to its samples, in the rows of the fastest needed quantity, in place.

    Rows that are shuffled, or of which none has all needed quantities, are sorted by time. A slow
    sensor's column that repeats or interpolates its samples keeps these alone, where they have one
    period: the first of each run of held ones, or the knots of the lines. A fast quantity that
    comes at regular gaps is interpolated, up to `LONGEST_GAP`, but not at the ends. A slow sample
    between the rows moves to the next: no estimator may have it before it was captured.

    Args:
        values: Quantities of the log.
        needed: The quantities without which there is no drive.
        kinds: Of `KINDS`, by slow quantity, as far as they are known; others are recognised.
        is_strict: Whether shuffled rows stay as they are.
    """
    remarks = _sort_rows(values, needed, is_strict) + _keep_samples(values, kinds)
    return remarks + _align_clocks(values, needed)


def _sort_rows(values: Quantities, needed: Collection[str], is_strict: bool) -> list[str]:
    time = values["time"]
    n_back = int((np.diff(time) < 0.0).sum())
    is_merged = n_back and not np.isfinite([values[name] for name in needed]).all(0).any()
    is_shuffled = n_back > _SHUFFLED * len(time) and len(np.unique(time)) > 0.99 * len(time)
    if not (is_merged or (is_shuffled and not is_strict)):
        return []
    for name in [x for x in needed if x != "time"] if is_merged else ():
        rows = np.flatnonzero(np.isfinite(values[name]))
        steps = np.diff(time[rows])
        if 0 < np.count_nonzero(steps < -_WRAP) <= max(1.0, 0.001 * len(steps)):
            row = int(rows[np.argmin(steps) + 1])
            raise ValueError(
                f"time steps back by {-steps.min():.6g} s at row {row + 1}, within {name}: the "
                "clock wrapped or began anew; read the parts one by one"
            )
    order = np.argsort(time, kind="stable")
    values.update({name: column[order] for name, column in values.items()})
    return [f"Time steps back in {n_back} of {len(time)} rows: they were sorted by it."]


def _keep_samples(values: Quantities, kinds: Mapping[str, str]) -> list[str]:
    remarks = []
    for first, *others in SENSORS.values():
        if first not in values or kinds.get(first) == "fresh":
            continue
        columns = [values[name] for name in (first, *others) if name in values]
        rows = np.flatnonzero(np.isfinite(columns[0]))
        known = [column[rows] for column in columns if np.isfinite(column[rows]).all()]
        for kind, places in (
            ("held", np.flatnonzero(np.any(np.diff(known), axis=0)) + 1),
            ("held", np.flatnonzero(np.diff(known[0])) + 1),
            ("interpolated", _find_knots(known[0])),
        ):
            period, is_known = _find_period(np.diff(places)), kinds.get(first) == kind
            if not is_known and (not period or first in kinds):
                continue
            if is_known or abs(places[0] - period) <= max(1.0, 0.2 * period):
                places = np.append(0, places)  # the first run is as long as the others
            for column in columns:
                column[np.setdiff1d(np.arange(len(column)), rows[places])] = np.nan
            remarks.append(
                f"{first} is {kind} between its samples: {len(places)} of {len(rows)} values are "
                f"kept (--map {first}_UNIT_fresh=COLUMN takes all)."
            )
            break
    return remarks


def find_sampling(values: Array) -> tuple[str, float]:
    """Find "held" or "interpolated" between slower samples, else "", and their period (rows).

    Args:
        values: Values in SI units without gaps, shape (n,).
    """
    if period := _find_period(np.diff(np.flatnonzero(np.diff(values)))):
        return "held", period
    period = _find_period(np.diff(_find_knots(values)))
    return "interpolated" if period else "", period


def _find_knots(values: Array) -> npt.NDArray[np.int64]:
    """Find where an angle's slope changes by more than rounding; +-180 deg are one."""
    gaps, scale = np.diff(np.unique(values)), float(np.abs(values).max())
    resolution = gaps[gaps > 1e-12 * scale].min(initial=np.pi)
    bends = np.abs(np.diff(np.unwrap(values), 2))
    return np.flatnonzero(bends > 2.5 * resolution + 4e-7 * scale) + 1


def _find_period(lengths: Array) -> float:
    """Find the period of sampling in rows, 0.0 where there is none, from the rows between changes.

    A lost or repeated sample makes a multiple, a coarse value in every row irregular distances.
    """
    if len(lengths) < _MIN_INTERVALS:
        return 0.0
    typical = float(np.quantile(lengths, 0.25, method="lower"))
    period = float(np.mean(lengths[np.abs(lengths - typical) <= max(1.0, 0.1 * typical)]))
    tolerance = 0.6 if period < 4.0 else max(1.0, 0.2 * period)
    deviation = np.abs(lengths - period * np.maximum(np.rint(lengths / period), 1.0))
    n_short, n_beside = (lengths < period - tolerance).sum(), (deviation > tolerance).sum()
    is_rare = n_short <= 0.05 * len(lengths) and n_beside <= 0.15 * len(lengths)
    return period if typical > 1.0 and is_rare else 0.0


def _align_clocks(values: Quantities, needed: Collection[str]) -> list[str]:
    elapsed = np.append(0.0, np.cumsum(np.maximum(np.diff(values["time"]), 0.0)))
    known = {name: np.isfinite(column) for name, column in values.items() if name != "time"}
    base = max(known.keys() & needed, key=lambda name: (known[name].sum(), name))
    is_base, joined, lines = known[base], {}, []
    if is_base.sum() < 2:
        return []
    for name in sorted(known.keys() - SLOW_QUANTITIES):
        is_known, is_base_known = known[name], known[name][is_base]
        is_scarce_truth = name in TRUTH and not is_known[~is_base].any()
        if is_base_known.mean() > _COMPLETE or is_known.sum() < 2 or is_scarce_truth:
            continue
        t, t_base = elapsed[is_known], elapsed[is_base]
        interval = float(np.median(np.diff(t)))
        after = np.clip(np.searchsorted(t, t_base), 1, len(t) - 1)
        is_near = t[after] - t[after - 1] <= min(1.9 * interval, 1.01 * LONGEST_GAP)
        is_near = (is_near & (t_base >= t[0]) & (t_base <= t[-1])) | is_base_known
        if is_near.sum() > is_base_known.sum():
            line = np.interp(t_base, t, values[name][is_known])
            joined[name] = np.where(is_near, line, np.nan)
            lines.append(f"{name} (every {interval:.3g} s)")
    is_other = np.any(list(known.values()), axis=0)
    is_other &= ~np.any([known[n] for n in known.keys() - SLOW_QUANTITIES - TRUTH], axis=0)
    if not joined and not is_other.any():
        return []
    rows = np.flatnonzero(is_base if joined else ~is_other)
    step = float(np.median(np.diff(elapsed[rows])))
    places = np.searchsorted(elapsed[rows], elapsed - 0.01 * step)
    for name, column in list(values.items()):
        values[name] = joined[name] if name in joined else column[rows]
        if name in SLOW_QUANTITIES:
            moved_rows = np.flatnonzero(known[name] & (places < len(rows)))
            values[name] = np.full(len(rows), np.nan)
            values[name][places[moved_rows]] = column[moved_rows]
    columns = [joined[n] for n in joined.keys() - TRUTH]
    complete_rows = np.flatnonzero(np.isfinite([*columns, rows]).all(0))
    if not len(complete_rows):
        raise ValueError(f"{base}, {', '.join(joined)} are not known at the same time")
    used = slice(complete_rows[0], complete_rows[-1] + 1)
    values.update({name: column[used] for name, column in values.items()})
    remarks = [f"Interpolated in the rows of {base}: {', '.join(lines)}."] if joined else []
    if n_ends := len(rows) - len(values["time"]):
        remarks.append(f"{n_ends} rows at the ends, where these are unknown, were left out.")
    return remarks


_EARTH = 6_378_137.0  # m, equatorial radius
_ECCENTRICITY_SQUARED = 6.694379990e-3


def _compute_radii(latitude: float) -> tuple[float, float]:
    """Compute the radii of parallel and meridian (m) at a latitude (degrees north)."""
    phi = math.radians(latitude)
    w = 1.0 - _ECCENTRICITY_SQUARED * math.sin(phi) ** 2
    return _EARTH / math.sqrt(w) * math.cos(phi), _EARTH * (1.0 - _ECCENTRICITY_SQUARED) / w**1.5


def to_metres(
    latitude: Array, longitude: Array, origin: tuple[float, float]
) -> tuple[Array, Array]:
    """Convert places to metres (east, north) of an origin, the inverse of `to_degrees`.

    Args:
        latitude: Latitude (degrees north), shape (n,).
        longitude: Longitude (degrees east), shape (n,).
        origin: Origin (degrees north, degrees east).
    """
    east, north = _compute_radii(origin[0])
    delta = (longitude - origin[1] + 180.0) % 360.0 - 180.0  # over the date line
    return east * np.radians(delta), north * np.radians(latitude - origin[0])


def to_degrees(X: Array, Y: Array, origin: tuple[float, float]) -> tuple[Array, Array]:
    """Convert metres from an origin to (latitude, longitude), within 0.2 m up to 1 km.

    Args:
        X: Metres east (m), shape (n,).
        Y: Metres north (m), shape (n,).
        origin: Origin (degrees north, degrees east).
    """
    east, north = _compute_radii(origin[0])
    return origin[0] + np.degrees(Y / north), origin[1] + np.degrees(X / east)
