"""NMEA 0183 sentences: bytes between "$" and the line's end, checked, and their fields as values.

The forms of the fields and their conversion are pynmeagps's (needs the extra `wires`). Its parser
of whole sentences is not used: it loses a sentence for one bad field ("0NaN" of a receiver in a
tunnel), while here that field alone is left out.
"""

import math
import re
from collections.abc import Iterator
from datetime import date
from functools import cache
from typing import Any, NamedTuple

from ..backend.extras import require_extra

with require_extra("wires", "decoding NMEA needs pynmeagps"):
    from pynmeagps import NMEAMessage, calc_checksum, get_parts
    from pynmeagps.exceptions import NMEAMessageError
    from pynmeagps.nmeatypes_core import NMEA_TALKERS
    from pynmeagps.nmeatypes_get import NMEA_PAYLOADS_GET

DECODED = ("GLL", "GSA", "VTG", "RMC", "GNS", "GGA", "GSV", "ZDA")  # later ones overrule
_NO_FIX = "NEMS"  # modes of GNS: none, dead reckoning, typed in, simulated
VENDOR, OTHER = "of vendors", "other"
_RANGES = {
    "lat": (0.0, 90.0), "lon": (0.0, 180.0), "cog": (0.0, 360.0), "cogt": (0.0, 360.0),
    "spd": (0.0, 1e4), "sogn": (0.0, 1e4), "sogk": (0.0, 1e4), "HDOP": (0.0, 1e4),
    "numSV": (0, 999), "quality": (0, 9), "year": (1980, 9999), "month": (1, 12), "day": (1, 31),
}  # fmt: skip
_ANY = (-1e12, 1e12)
_TIME = re.compile(r"(\d\d)(\d\d)(\d\d(?:\.\d*)?)", re.ASCII)


class Sentence(NamedTuple):
    """A sentence with a right checksum."""

    talker: str
    """The system: GP, GL, GN, ..."""
    kind: str
    """One of `DECODED`, `VENDOR` or `OTHER`."""
    values: dict[str, Any]
    """The fields that hold something, by pynmeagps's names; empty for a kind not in `DECODED`."""
    bad: list[str]
    """The names of the fields that hold no value of theirs."""


def read_sentence(text: bytes) -> Sentence | None:
    """Read a sentence and check it.

    Args:
        text: Bytes between "$" and the line's end.

    Returns:
        The sentence; None for a wrong checksum.

    Raises:
        ValueError: For one without a checksum.
    """
    try:
        content, talker, kind, fields, checksum = get_parts(text)
    except NMEAMessageError:
        raise ValueError("the sentence is cut short or no text") from None
    if calc_checksum(content) != checksum.strip().upper():
        return None
    if talker == "P" or kind not in DECODED:
        return Sentence("", VENDOR if talker == "P" else OTHER, {}, [])
    talker = talker if talker in NMEA_TALKERS else ""
    if kind == "GSV":  # a number of the signal may follow the satellites
        fields = fields[: 3 + (len(fields) - 3) // 4 * 4]
    initial_values = {"numSV": sum(map(bool, fields[2:14]))} if kind == "GSA" else {}
    sentence = Sentence(talker, kind, initial_values, [])
    for (name, form), field in zip(_list_forms(kind), fields, strict=False):
        if field:
            value = _parse_value(name, form, field)
            if value is None:
                sentence.bad.append(name)
            else:
                sentence.values[name] = value
    if kind == "GNS":
        sentence.values["quality"] = int(
            bool(set(sentence.values.get("posMode", "N")) - set(_NO_FIX))
        )
    if kind == "ZDA" and {"year", "month", "day"} <= sentence.values.keys():
        try:
            sentence.values["date"] = date(
                *(sentence.values[name] for name in ("year", "month", "day"))
            )
        except ValueError:
            sentence.bad.append("day")
    return sentence


def is_unchecked(text: bytes) -> bool:
    """Check whether a sentence of `DECODED` lacks only its checksum; its last two fields are newer.

    Args:
        text: Bytes between "$" and the line's end.

    Returns:
        True if it does.
    """
    address, *fields = text.split(b",")
    kind = address[2:].decode("ascii", "replace")
    return b"*" not in text and kind in DECODED and len(fields) >= len(_list_forms(kind)) - 2


def apply_sign(values: dict[str, Any], name: str, side: str, negative: str) -> float:
    """Apply the sign of its side to a latitude or longitude.

    Args:
        values: Fields of an epoch.
        name: Name of the field, "lat" or "lon" (degrees).
        side: Name of the side's field, "NS" or "EW".
        negative: Side that is negative, "S" or "W".

    Returns:
        Degrees; NaN where either field is missing.
    """
    if name not in values or side not in values:
        return math.nan
    return float(-values[name] if values[side] == negative else values[name])


@cache
def _list_forms(kind: str) -> tuple[tuple[str, str], ...]:
    """(name, form) of each field of a kind, groups written out."""

    def iterate_fields(table: dict[str, Any]) -> Iterator[tuple[str, str]]:
        for name, form in table.items():
            if isinstance(form, tuple):  # (count or "None", fields): GSV has up to 4 satellites
                yield from tuple(form[1].items()) * (form[0] if isinstance(form[0], int) else 4)
            else:
                yield name, form

    return tuple(iterate_fields(NMEA_PAYLOADS_GET[kind]))


def _parse_value(name: str, form: str, text: str) -> Any:
    """A field's value; None where the text is none."""
    try:
        value = _parse_time(text) if name == "time" else NMEAMessage.str2val(text, form)
    except ValueError:
        return None
    low, high = _RANGES.get(name, _ANY)
    bad = value == "" or (isinstance(value, int | float) and not low <= value <= high)
    return None if bad else value


def _parse_time(text: str) -> float:
    """s of the day of hhmmss.ss; 23:59:60 is a leap second, which pynmeagps refuses."""
    match = _TIME.fullmatch(text)
    hour, minute, second = map(float, match.groups()) if match else (24.0, 0.0, 0.0)
    if not (hour < 24.0 and minute < 60.0 and second < 61.0):
        raise ValueError(f"{text!r} is no time")
    return 3600.0 * hour + 60.0 * minute + second
