"""The dialect of a text table: its encoding, separator, decimal mark, header and units."""

import csv
import io
import re
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

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
    """Translate a unit such as "[km/h]" or "°/s" to that of our column names.

    Args:
        text: Unit as a file writes it.

    Returns:
        Our unit, "" if unknown.
    """
    return _UNITS.get(re.sub(r"[\s\[\]()·*]", "", text.casefold().translate(_SIGNS)), "")


def read_text(
    data: bytes, is_wanted: Callable[[str], bool]
) -> tuple["pd.DataFrame", list[str], list[str]]:
    """Read a text table in any dialect.

    Args:
        data: Content of the file.
        is_wanted: Whether a column's name is looked for; such names identify the header.

    Returns:
        The table, whose names may repeat; the units of its columns, "" for unknown ones; and a
        sentence that describes the dialect, unless it is plain CSV.

    Raises:
        ValueError: For a binary file, and where header and rows differ in length.
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
    ]  # fmt: skip
    best, other = (
        [i for i in lines_group if any(map(is_wanted, rows[i]))]
        for lines_group in (header_lines, () if header_lines else rows)
    )
    header_line = (best or header_lines or other or list(rows))[0]
    header, body_rows = rows[header_line], {i: row for i, row in rows.items() if i > header_line}
    if any(header[width:]) or any(any(row[len(header) :]) for row in body_rows.values()):
        raise ValueError(
            f"the header in line {header_line + 1} has {len(header)} names, and rows have "
            f"{width} fields; are numbers written with decimal commas between commas?"
        )
    units, skipped = [""] * len(header), []
    for i, row in body_rows.items():
        known = sum(map(bool, map(find_unit, row))), sum(map(bool, row))
        is_units = 0 < known[1] <= 2 * known[0] and not any(map(_NUMBER.fullmatch, row))
        if len(row) > 1 and not is_units:
            break
        units = [*map(find_unit, row), *units[len(row) :]] if is_units else units
        skipped.append(i)
    numbers = [x for row in body_rows.values() for x in row if _NUMBER.fullmatch(x)]
    has_comma = any("," in x and not _THOUSANDS.fullmatch(x) for x in numbers)
    decimal = "," if has_comma and not any("." in x for x in numbers) else "."
    frame = pd.read_csv(
        io.BytesIO(data),
        sep=r"\s+" if separator == " " else separator,
        decimal=decimal,
        encoding=encoding,
        header=0,
        names=list(range(len(header))),
        skiprows=[*range(header_line), *skipped] or None,
        index_col=False,
        skipinitialspace=True,
        low_memory=False,
    )
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
    """Find the encoding: by its mark, by its zeros, UTF-8, or else Windows-1252.

    A binary file raises ValueError.
    """
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
    if '"' in line:
        line_fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    else:
        line_fields = line.split() if separator == " " else line.split(separator)
    return [field.strip() for field in line_fields]
