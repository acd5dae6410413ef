"""NMEA 0183, what satellite receivers send: bytes as they come, decoded into epochs.

Fields have the forms of pynmeagps (extra `wires`), whose parser of sentences would lose one for a
bad field ("0NaN" in a tunnel). Degrees from north and knots do not leave this file.
"""

import math
import re
from collections import Counter
from dataclasses import dataclass, field
from datetime import date
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ..numerics import require_extra
from ..sensors.slow import COURSE_SPEED

with require_extra("wires", "decoding NMEA needs pynmeagps"):
    from pynmeagps import NMEAMessage, calc_checksum, get_parts
    from pynmeagps.exceptions import NMEAMessageError
    from pynmeagps.nmeatypes_core import NMEA_TALKERS
    from pynmeagps.nmeatypes_get import NMEA_PAYLOADS_GET

DECODED = ("GLL", "GSA", "VTG", "RMC", "GNS", "GGA", "GSV", "ZDA")  # later ones overrule
_NO_FIX = "NEMS"  # modes: none, dead reckoning, typed in, simulated
_VENDOR, _OTHER = "of vendors", "other"
_RANGES = {
    "lat": (0.0, 90.0), "lon": (0.0, 180.0), "cog": (0.0, 360.0), "cogt": (0.0, 360.0),
    "spd": (0.0, 1e4), "sogn": (0.0, 1e4), "sogk": (0.0, 1e4), "HDOP": (0.0, 1e4),
    "numSV": (0, 999), "quality": (0, 9), "year": (1980, 9999), "month": (1, 12), "day": (1, 31),
}  # fmt: skip
_ANY = (-1e12, 1e12)
_DAY = ("year", "month", "day")
_TIME = re.compile(r"(\d\d)(\d\d)(\d\d(?:\.\d*)?)", re.ASCII)


class _Sentence(NamedTuple):
    """A sentence with a right checksum."""

    talker: str  # the system: GP, GL, GN, ...
    kind: str  # of `DECODED`, _VENDOR or _OTHER
    values: dict[str, Any]  # fields that hold something, by pynmeagps's names
    bad: list[str]  # the fields that hold no value of their range and form


def _read_sentence(text: bytes) -> _Sentence | None:
    """Read the bytes from "$" to the line's end; None for a wrong checksum, ValueError for none."""
    try:
        content, talker, kind, fields, checksum = get_parts(text)
    except NMEAMessageError:
        raise ValueError("the sentence is cut short or no text") from None
    if calc_checksum(content) != checksum.strip().upper():
        return None
    if talker == "P" or kind not in DECODED:
        return _Sentence("", _VENDOR if talker == "P" else _OTHER, {}, [])
    talker = talker if talker in NMEA_TALKERS else ""
    if kind == "GSV":  # a number of the signal may follow the satellites
        fields = fields[: 3 + (len(fields) - 3) // 4 * 4]
    initial_values = {"numSV": sum(map(bool, fields[2:14]))} if kind == "GSA" else {}
    sentence = _Sentence(talker, kind, initial_values, [])
    for (name, form), entry in zip(_list_forms(kind), fields, strict=False):
        if entry and (value := _parse_value(name, form, entry)) is None:
            sentence.bad.append(name)
        elif entry:
            sentence.values[name] = value
    modes = set(sentence.values.get("posMode", "N" if kind == "GNS" else ""))
    if kind == "GNS":
        sentence.values["quality"] = int(bool(modes - set(_NO_FIX)))
    elif modes and modes <= set(_NO_FIX):
        sentence.values["status"] = "V"
    day = [sentence.values[name] for name in _DAY if name in sentence.values]
    if kind == "ZDA" and len(day) == len(_DAY):
        try:
            sentence.values["date"] = date(*day)
        except ValueError:
            sentence.bad.append("day")
    return sentence


def _apply_sign(values: dict[str, Any], name: str, side: str, negative: str) -> float:
    """Sign a latitude or longitude (degrees) by its side; NaN where either is missing."""
    if name not in values or side not in values:
        return math.nan
    return float(-values[name] if values[side] == negative else values[name])


@cache
def _list_forms(kind: str) -> tuple[tuple[str, str], ...]:
    """List (name, form) of each field of a kind, groups written out."""
    forms: tuple[tuple[str, str], ...] = ()
    for name, form in NMEA_PAYLOADS_GET[kind].items():
        # a group is (count or "None", fields): GSV has up to 4 satellites
        count, group = form if isinstance(form, tuple) else (1, {name: form})
        forms += tuple(group.items()) * (count if isinstance(count, int) else 4)
    return forms


def _parse_value(name: str, form: str, text: str) -> Any:
    """Parse a field's value; None where the text has no value in range."""
    try:
        value = _parse_time(text) if name == "time" else NMEAMessage.str2val(text, form)
    except ValueError:
        return None
    low, high = _RANGES.get(name, _ANY)
    bad = value == "" or (isinstance(value, int | float) and not low <= value <= high)
    return None if bad else value


def _parse_time(text: str) -> float:
    """Convert hhmmss.ss to s of the day; 23:59:60 is a leap second, which pynmeagps refuses."""
    match = _TIME.fullmatch(text)
    hour, minute, second = map(float, match.groups()) if match else (24.0, 0.0, 0.0)
    if not (hour < 24.0 and minute < 60.0 and second < 61.0):
        raise ValueError(f"{text!r} is no time")
    return 3600.0 * hour + 60.0 * minute + second


LONGEST = 1024  # bytes of a sentence; the standard has 82, some vendors' are longer
_KNOT = 1852.0 / 3600.0  # m/s
DAY = 86_400.0  # s
HOUR = 3600.0  # s, from which a step forward is counted
_CONTINUOUS = 60.0  # s: a time of day within these is continuous, whatever its date
_ROLLOVER = 7 * 1024  # days, after which a receiver's count of weeks begins anew
_EPOCH = date(1970, 1, 1).toordinal()
_FIRST = DAY * (date(1980, 1, 6).toordinal() - _EPOCH)  # s: GPS has no earlier date
_NOT_MEASURED = (0, 6, 7)  # GGA's quality: no fix, dead reckoning, typed in; 8, simulated, counts
_TIMED = ("GLL", "RMC", "GNS", "GGA")  # with a position


class Epoch(NamedTuple):
    """A receiver's measurements at one time; NaN is unknown.

    t is UTC in s since 1970, since the first epoch's midnight where no date was sent. Leap seconds
    that were sent are counted: differences are elapsed time.
    """

    t: float  # s
    latitude: float  # degrees north, NaN without a fix
    longitude: float  # degrees east, NaN without a fix
    course: float  # rad counter-clockwise from east, in [-pi, pi]
    speed: float  # m/s
    hdop: float
    satellites: int  # used
    in_view: int  # satellites, of the newest GSV of each system
    quality: int  # of the course: 1 with a fix, from COURSE_SPEED on, if the course is sent; else 0
    age: float  # s since the newest fix, by t: 0 with a fix, NaN before the first or without a time

    @property
    def has_fix(self) -> bool:
        """Whether there is a position."""
        return math.isfinite(self.latitude)


_LABELS = (
    "bytes", "sentences {}", "sentences with a bad checksum", "sentences cut short",
    "sentences without a checksum", "sentences overlong", "sentences repeated in an epoch",
    "bytes outside sentences", "field {} emptied", "epochs", "epochs without a fix",
    "epochs without a time", "steps of time backward", "steps of time forward by an hour or more",
    "epochs dated by others",
)  # fmt: skip


@dataclass
class Counts:
    """Counts of received sentences and epochs, and of their faults; `_LABELS` describes them."""

    received: int = 0
    sentences: Counter[str] = field(default_factory=Counter)  # by type, with a right checksum
    bad_checksum: int = 0
    truncated: int = 0
    unchecked: int = 0
    overlong: int = 0  # longer than `LONGEST`
    repeated: int = 0
    garbage: int = 0  # bytes, line ends apart
    emptied: Counter[str] = field(default_factory=Counter)  # bad fields, by type and name
    epochs: int = 0
    without_fix: int = 0
    without_time: int = 0
    backward: int = 0
    forward: int = 0
    redated: int = 0

    def rows(self) -> list[tuple[str, int]]:
        """List names and counts for a table."""
        counts = zip(_LABELS, vars(self).values(), strict=True)
        named = [(label, n if isinstance(n, Counter) else {"": n}) for label, n in counts]
        return [(label.format(name), n[name]) for label, n in named for name in sorted(n)]


class Decoder:
    """Decodes a stream of bytes, cut anywhere, into epochs; never raises on bad input.

    An epoch is returned with the sentence that completes it: motion (RMC or VTG) and GGA or GNS,
    and GSA where these have no HDOP; an incomplete one when the next begins. Of several talkers the
    first makes the epoch. Held are `LONGEST` bytes at most, one epoch and a part of the next.
    """

    def __init__(self) -> None:
        self.counts = Counts()
        self._tail = b""  # a sentence that has not ended, from its "$"
        self._parts: dict[str, dict[str, Any]] = {}  # of the epoch, by type
        self._next: dict[str, dict[str, Any]] = {}  # of the next one, before its time is known
        self._time: float | None = None  # of the epoch, s of the day
        self._sent = False
        self._others: set[str] = set()  # talkers that repeat what the epoch has
        self._date = (0, math.nan)  # the newest day known, and the time of that day
        self._last, self._fix = math.nan, math.nan  # t of the newest epoch and the newest fix
        self._in_leap, self._leaps = False, 0
        self._view: dict[str, int] = {}  # satellites, by system

    def decode_chunk(self, chunk: bytes) -> list[Epoch]:
        """Decode some bytes.

        Args:
            chunk: The next bytes of the stream.
        """
        self.counts.received += len(chunk)
        outside, *pieces = (self._tail + chunk).split(b"$")
        self._tail = b""
        self._skip(outside)
        epochs: list[Epoch] = []
        for i, piece in enumerate(pieces):
            text = piece.replace(b"\r", b"\n").split(b"\n", 1)[0]
            is_ended = len(text) < len(piece)
            if len(text) > LONGEST:
                self.counts.overlong += 1
                self._skip(piece)
            elif is_ended:
                self._skip(piece[len(text) :])
                epochs += self._decode_sentence(text)
            elif i < len(pieces) - 1:  # the next one begins in its line
                self.counts.truncated += 1
            else:
                self._tail = b"$" + piece
        return epochs

    def finish(self) -> list[Epoch]:
        """Decode the last epoch, where the stream ended without completing it or its line."""
        tail, self._tail = self._tail, b""
        return (self._decode_sentence(tail[1:]) if tail else []) + self._close()

    def _skip(self, outside: bytes) -> None:
        self.counts.garbage += len(outside) - sum(map(outside.count, (b"\r", b"\n")))

    def _decode_sentence(self, text: bytes) -> list[Epoch]:
        try:
            sentence = _read_sentence(text)
        except ValueError:  # a known sentence may lack its checksum and its last two, newer fields
            kind, n_fields = text.split(b",")[0][2:].decode("ascii", "replace"), text.count(b",")
            is_known = b"*" not in text and kind in DECODED
            is_unchecked = is_known and n_fields >= len(_list_forms(kind)) - 2
            self.counts.unchecked += is_unchecked
            self.counts.truncated += not is_unchecked
            return []
        if sentence is None:
            self.counts.bad_checksum += 1
            return []
        self.counts.sentences[sentence.kind] += 1
        self.counts.emptied.update(f"{sentence.kind} {name}" for name in sentence.bad)
        return self._add_sentence(sentence)

    def _add_sentence(self, sentence: _Sentence) -> list[Epoch]:
        """Add a sentence to its epoch; a sentence without a time joins the epoch at hand."""
        talker, kind, values, _ = sentence
        time, existing = values.get("time"), self._parts.get(kind)
        if kind not in DECODED or (kind == "GLL" and time is None):
            return []
        if kind == "GSV":
            self._view[talker] = values.get("numSV", 0)
            return []
        values, done = values | {"talker": talker}, list[Epoch]()
        if kind in _TIMED:
            if existing and time is not None and time == self._time:
                self.counts.repeated += 1
                self._others |= {talker} - {existing["talker"]}
                return []
            if existing or (None not in (time, self._time) and time != self._time):
                done = self._close()
        elif existing and self._sent:
            if talker not in self._others:
                self._next[kind] = values
            return []
        if time is not None and "date" in values:
            self._date = values["date"].toordinal() - _EPOCH, time
        if kind == "ZDA":
            return done
        self._parts[kind] = values
        self._time = self._time if time is None else time
        kinds = self._parts.keys()
        has_hdop = "GSA" in kinds or any("HDOP" in part for part in self._parts.values())
        is_complete = kinds & {"RMC", "VTG"} and kinds & {"GGA", "GNS"} and has_hdop
        return [*done, self._make_epoch()] if is_complete and not self._sent else done

    def _close(self) -> list[Epoch]:
        """End the epoch at hand; return it unless it was handed out or has no position."""
        is_unsent = not self._sent and not self._parts.keys().isdisjoint(_TIMED)
        done = [self._make_epoch()] if is_unsent else []
        self._parts, self._next, self._time, self._sent = self._next, {}, None, False
        self._others.clear()
        return done

    def _make_epoch(self) -> Epoch:
        self._sent = True
        t = math.nan if self._time is None else self._convert_time(self._time)
        known = {k: v for kind in DECODED for k, v in self._parts.get(kind, {}).items()}
        flags = [known["status"] == "A"] if "status" in known else []
        flags += [known["quality"] not in _NOT_MEASURED] if "quality" in known else []
        place = _apply_sign(known, "lat", "NS", "S"), _apply_sign(known, "lon", "EW", "W")
        has_fix = bool(flags) and all(flags) and math.isfinite(sum(place))
        knots = known.get("spd", known.get("sogn", known.get("sogk", math.nan) / 1.852))
        speed = _KNOT * knots if has_fix else math.nan
        north = known.get("cog", known.get("cogt", math.nan)) if has_fix else math.nan
        self._fix = t if has_fix else self._fix
        self.counts.epochs += 1
        self.counts.without_fix += not has_fix
        self.counts.without_time += math.isnan(t)
        return Epoch(
            t,
            *(place if has_fix else (math.nan, math.nan)),
            math.radians(math.remainder(90.0 - north, 360.0)),
            speed,
            known["HDOP"] if known.get("HDOP", 0.0) > 0.0 else math.nan,
            known.get("numSV", 0),
            sum(self._view.values()),
            int(speed >= COURSE_SPEED and math.isfinite(north)),
            max(t - self._fix, 0.0),
        )

    def _convert_time(self, time: float) -> float:
        day, newest = self._date
        day += (time < newest - DAY / 2) - (time > newest + DAY / 2)  # midnight, without a date
        self._date = day, time
        self._leaps += self._in_leap and time < DAY
        self._in_leap = time >= DAY
        t = day * DAY + time + self._leaps
        last, self._last = self._last, t
        self.counts.backward += t < last
        self.counts.forward += t >= last + HOUR and (last >= _FIRST or t < _FIRST)
        return t


def correct_dates(epochs: list[Epoch]) -> list[Epoch]:
    """Date a log's epochs alike where the day jumps while the time of day continues.

    Args:
        epochs: Epochs of a whole log, as `Decoder` returns them.

    Returns:
        Epochs dated by the last date, or by a date newer by whole rollovers; real pauses remain.
    """
    t = np.array([epoch.t for epoch in epochs])
    rows = np.flatnonzero(np.isfinite(t))
    step = np.diff(t[rows])
    jump = np.rint(step / DAY)
    dated = t[rows[:-1]] >= _FIRST
    pause = dated & (jump != 0.0) & (np.abs(step - jump * DAY) > _CONTINUOUS)
    days = np.append(0.0, np.cumsum(np.where(pause, 0.0, jump)))
    for part in np.split(np.arange(len(rows)), np.flatnonzero(pause) + 1):
        later = days[part[-1:]] - days[part]
        later += max(-later[later % _ROLLOVER == 0.0], default=0.0)
        t[rows[part]] += later * DAY
    return [epoch._replace(t=float(new)) for epoch, new in zip(epochs, t, strict=True)]
