"""Files of loggers as tables: MATLAB, MDF, CAN traces, ROS 2 bags and MCAP, VBOX.

Each channel keeps the stamps that it has: rows stand at the stamps of all, NaN where one has none.
Nothing is interpolated or held here.
"""

import io
import re
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..numerics import require_extra
from ..validation import join_names, short_repr
from .dialect import LATENCIES, SENSORS, find_unit, read_text, to_metres

if TYPE_CHECKING:
    import pandas as pd
    from cantools.database.can import Database
    from rosbags.interfaces import Connection

    LogSource = str | Path | pd.DataFrame
    """File of a recorded drive, or its table in memory."""

_TRACES = {  # reader of python-can, by what its files begin with
    "BLFReader": rb"LOGG",
    "ASCReader": rb"date [^\n]*\n\s*base +(hex|dec)",
    "CanutilsLogReader": rb"\s*\(\d+\.\d+\) +\S+ +[0-9A-Fa-f]+#",
    "TRCReader": rb";\$FILEVERSION",
}
_BAG = re.compile(rb"\x89MCAP|SQLite format 3")
_LONGEST_STEP_BACK = 0.25  # s, by which frames of a bus may come out of order
_LONGEST_LATENCY = 5.0  # s; beyond it a bag's log has another clock than its headers
_NO_VALUE = re.compile(
    r"(?<!no[ _-])(?<![a-z])(sna|n/?a|err(or)?|fault|init)(?![a-z])|(un|not[ _-]?)avail|"
    r"invalid|not.?valid",
    re.I,
)
_ARITHMETIC = re.compile(
    r"(?:[\d\s.+\-*/^(),]|\bX1?\b|(?<=\d)e|\b(?:sin|cos|tan|exp|log|sqrt|abs)\b)*", re.I
)
_DBC_NEEDED = "a CAN trace needs its description: --map dbc=FILE"
_CONTAINERS = "CSV, Parquet, MATLAB, MDF, a CAN trace, a bag or VBO"
_HEAD_BYTES = 1 << 16  # in which a file shows what it is


class LogTable(NamedTuple):
    """A file's columns as they stand there."""

    frame: "pd.DataFrame"  # names may repeat
    units: list[str]  # "" for unknown
    names: list[str]  # of all columns; a frame may have only the wanted ones
    remarks: list[str]  # sentences on how the file was read


@dataclass
class _Channel:
    """Samples of a channel; a long trace costs 16 or 24 bytes a sample."""

    stamps: "array[float]" = field(default_factory=lambda: array("d"))  # s
    values: "array[float]" = field(default_factory=lambda: array("d"))
    late: "array[float]" = field(default_factory=lambda: array("d"))  # s, where that is known


def _join_channels(
    channels: Mapping[str, tuple[ArrayLike, ArrayLike]], units: Mapping[str, str], names: list[str]
) -> LogTable:
    """Join channels of (stamps, values) to rows at the stamps of all; of equal stamps the first."""
    import pandas as pd

    columns = {}
    for name, (stamps, values) in channels.items():
        stamps = np.asarray(stamps, np.float64)
        if (is_back := np.diff(stamps) < -_LONGEST_STEP_BACK).any():
            row = int(np.argmax(is_back))
            times = f"{stamps[row + 1]:.12g} s after {stamps[row]:.12g} s"
            raise ValueError(f"{name}: the clock is set back, {times}; cut the file there")
        column = pd.Series(np.asarray(values, np.float64), stamps)
        columns[name] = column[~column.index.duplicated()]
    frame = pd.concat(columns, axis=1, sort=True) if columns else pd.DataFrame()
    known = ["s", *(units.get(name, "") for name in columns)]
    return LogTable(frame.rename_axis("time_s").reset_index(), known, names, [])


def read_table(
    source: "LogSource", is_wanted: Callable[[str], bool], mapping: Mapping[str, str], dbc: str
) -> LogTable:
    """Read a log's columns, a file's kind recognised by its beginning.

    Raises FileNotFoundError, ImportError without an extra, and ValueError, which does not name the
    file, for one that is no table.

    Args:
        source: Path of a file or of a ROS 2 bag's folder, or the table itself.
        is_wanted: Whether a column's name is looked for.
        mapping: Our column names to the file's.
        dbc: Path of the description of CAN frames, "" for none.
    """
    if not isinstance(source, str | Path):
        return _make_table(source)
    with require_extra("report", "reading a log needs pandas"):
        import pandas as pd
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    is_folder, head = path.is_dir(), b""
    if is_folder and not (path / "metadata.yaml").is_file():
        raise ValueError("expected a file, found a folder")
    if not is_folder:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
        if not head.strip():
            raise ValueError("the file is empty")
    try:
        if head.startswith(b"MDF "):
            return _read_mdf(path, is_wanted, dbc)
        if reader := next((name for name, text in _TRACES.items() if re.match(text, head)), ""):
            return _read_can(path, reader, is_wanted, dbc)
        if is_folder or _BAG.match(head):
            return _read_bag(path, mapping)
        if head.startswith(b"PAR1"):
            return _make_table(pd.read_parquet(path))
        if head.startswith(b"MATLAB"):
            return _make_table(_read_matlab(path, head))
        if head.startswith(b"File created") and b"[column names]" in head:
            return _make_table(_read_vbo(path.read_bytes()))
        return _make_table(*read_text(path.read_bytes(), is_wanted))
    except (MemoryError, ImportError, FileNotFoundError):
        raise
    except Exception as error:  # of a library anything, where a file is damaged
        reason = " ".join(str(error).split()) or type(error).__name__
        reason = "it is not text" if isinstance(error, UnicodeDecodeError) else reason
        raise ValueError(f"expected {_CONTAINERS}, but {reason:.300}") from None


def _make_table(
    frame: "pd.DataFrame", units: Sequence[str] = (), remarks: Sequence[str] = ()
) -> LogTable:
    """Make a table of all columns, whose names lose spaces at their ends."""
    names = [str(name).strip() for name in frame.columns]
    return LogTable(frame.set_axis(names, axis=1), [*units] or [""] * len(names), names, [*remarks])


def _read_matlab(path: Path, head: bytes) -> "pd.DataFrame":
    """Read the numeric vectors of the commonest length from a MATLAB file of any version."""
    import pandas as pd

    if head.startswith(b"MATLAB 7.3"):
        with require_extra("mat", "reading MATLAB 7.3 needs h5py"):
            import h5py

        with h5py.File(path) as file:
            vectors = {n: np.asarray(x).squeeze() for n, x in file.items() if hasattr(x, "dtype")}
    else:
        from scipy.io import loadmat

        vectors = loadmat(path, squeeze_me=True, simplify_cells=True)
    arrays = {name: x for name, x in vectors.items() if isinstance(x, np.ndarray)}
    columns = {n: x for n, x in arrays.items() if x.ndim == 1 and x.dtype.kind in "fiub"}
    lengths = list(map(len, columns.values()))
    common_length = max(set(lengths), key=lengths.count, default=0)
    return pd.DataFrame({name: x for name, x in columns.items() if len(x) == common_length})


def _read_mdf(path: Path, is_wanted: Callable[[str], bool], dbc: str) -> LogTable:
    """Read the wanted channels of an MDF file; of one with CAN frames those of its description."""
    with require_extra("mdf", "reading MDF needs asammdf"):
        from asammdf import MDF

    chosen: dict[str, tuple[int, int]] = {}
    with MDF(path) as recorded:
        for group in recorded.groups:
            for channel in group.channels:
                _check_formula(channel.name, channel.conversion)
        has_frames = any("CAN_DataFrame" in name for name in recorded.channels_db)
        if has_frames and not dbc:
            raise ValueError(_DBC_NEEDED)
        file = recorded.extract_bus_logging({"CAN": [(dbc, 0)]}) if has_frames else recorded
        for name, entries in file.channels_db.items():
            places = [place for place in entries if file.masters_db.get(place[0]) != place[1]]
            labels = [f"{name} (group {g})" if len(places) > 1 else name for g, _ in places]
            wanted = [item for item in zip(labels, places, strict=True) if is_wanted(item[0])]
            if not wanted and len(places) > 1 and is_wanted(name):
                raise ValueError(f"channels share a name; --map one of {', '.join(labels)}")
            chosen.update(wanted)
        channels = [(None, *place) for place in chosen.values()]
        signals = file.select(channels, ignore_value2text_conversions=True, validate=True)
        names = list(file.channels_db)
    columns, units = {}, {}
    for name, signal in zip(chosen, signals, strict=True):
        if signal.samples.ndim == 1 and signal.samples.dtype.kind in "fiub" and name != "time_s":
            columns[name] = signal.timestamps, signal.samples
            units[name] = find_unit(signal.unit)
    return _join_channels(columns, units, names)


def _check_formula(name: str, conversion: object) -> None:
    """Check a channel's conversion: asammdf gives a formula beyond arithmetic to Python's eval."""
    formula = getattr(conversion, "formula", "") or ""
    if not _ARITHMETIC.fullmatch(formula):
        raise ValueError(f"{name} has a formula that is no arithmetic: {short_repr(formula)}")
    for nested in (getattr(conversion, "referenced_blocks", None) or {}).values():
        _check_formula(name, nested)


def _read_can(path: Path, reader: str, is_wanted: Callable[[str], bool], dbc: str) -> LogTable:
    """Read the wanted signals of a CAN trace (BLF, ASC, candump, TRC), a stamp a frame.

    A signal is called as in its description (DBC, ARXML, KCD, SYM), or MESSAGE.SIGNAL, which is
    needed where two messages share its name. Memory holds the wanted samples alone.
    """
    with require_extra("can", "reading a CAN trace needs python-can and cantools"):
        import can
        from cantools.database import DecodeError

    database = _load_database(dbc)
    messages: dict[tuple[int, bool], tuple[Any, dict[str, str]]] = {}
    channels, units = dict[str, _Channel](), dict[str, str]()
    absent: dict[str, set[Any]] = {}  # values that say there is none, by label
    for label, (message, signal) in _choose_signals(database, is_wanted).items():
        key = message.frame_id, message.is_extended_frame
        known, wanted = messages.setdefault(key, (message, {}))
        if known is not message:
            text = f"{known.name} and {message.name} have one id, 0x{message.frame_id:x}"
            raise ValueError(f"{dbc}: {text}")
        wanted[signal.name] = label
        choices, scale = signal.choices or {}, signal.conversion.raw_to_scaled
        raws = [raw for raw, text in choices.items() if _NO_VALUE.search(str(text))]
        absent[label] = {scale(raw, decode_choices=False) for raw in raws}
        units[label], channels[label] = find_unit(signal.unit or ""), _Channel()
    seen_ids, n_short, n_absent, damage = set[int](), 0, 0, ""
    buses: dict[tuple[int, bool], set[str]] = {}
    try:
        frames = getattr(can, reader)(path)
        if getattr(frames, "file_size", 0) > path.stat().st_size:
            damage = "it is shorter than it says"
        for frame in frames:
            seen_ids.add(frame.arbitration_id)
            key = frame.arbitration_id, frame.is_extended_id
            if key not in messages or frame.is_error_frame or frame.is_remote_frame:
                continue
            message, labels = messages[key]
            buses.setdefault(key, set()).add(str(frame.channel))
            try:
                decoded = message.decode(bytes(frame.data), decode_choices=False)
            except DecodeError:
                decoded = {}
            if not decoded or len(frame.data) != frame.dlc:
                n_short += 1
                continue
            for name in labels.keys() & decoded.keys():  # a multiplexed one is not in every frame
                label, value = labels[name], decoded[name]
                if value in absent[label]:
                    n_absent += 1
                else:
                    channels[label].stamps.append(frame.timestamp)
                    channels[label].values.append(float(value))
    except Exception as error:  # of python-can anything, where a file is damaged
        if not any(channel.stamps for channel in channels.values()):
            raise
        damage = str(error) or type(error).__name__
    for (number, _), bus_names in buses.items():
        if len(bus_names) > 1:
            text = join_names(sorted(bus_names))
            raise ValueError(f"0x{number:x} is on several buses: {text}; write a trace of one")
    sent = [message for message in database.messages if message.frame_id in seen_ids]
    if seen_ids and not sent:
        ids = ", ".join(f"0x{x:x}" for x in sorted(seen_ids)[:4])
        raise ValueError(f"none of its {len(seen_ids)} ids ({ids}, ...) is in {dbc}")
    remarks = {
        f"WARNING: the trace is cut or damaged, and read up to there: {damage}.": damage,
        f"WARNING: {n_short} frames are shorter than {dbc} says, and left out.": n_short,
        f"{n_absent} values that {dbc} calls not available are left out.": n_absent,
    }
    columns = {name: (x.stamps, x.values) for name, x in channels.items() if x.stamps}
    names = [f"{message.name}.{signal.name}" for message in sent for signal in message.signals]
    said = [text for text, is_so in remarks.items() if is_so]
    return _join_channels(columns, units, names)._replace(remarks=said)


def _choose_signals(
    database: "Database", is_wanted: Callable[[str], bool]
) -> dict[str, tuple[Any, Any]]:
    """Choose the wanted (message, signal) by MESSAGE.SIGNAL, which decides, or by the name."""
    signals = {f"{m.name}.{s.name}": (m, s) for m in database.messages for s in m.signals}
    chosen = {label: pair for label, pair in signals.items() if is_wanted(label)}
    decided = {signal.name for _, signal in chosen.values()}
    for message, signal in signals.values():
        if signal.name in decided or not is_wanted(signal.name):
            continue
        if signal.name in chosen:
            both = [label for label in signals if label.endswith(f".{signal.name}")]
            raise ValueError(f"signals share a name; --map one of {', '.join(both)}")
        chosen[signal.name] = message, signal
    return chosen


def _load_database(dbc: str) -> "Database":
    """Load the description of frames; ValueError for none and for a file that is none."""
    from cantools.database import errors, load_file
    from cantools.database.can import Database

    if not dbc:
        raise ValueError(_DBC_NEEDED)
    try:
        database = load_file(dbc, strict=False)
    except (errors.Error, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{dbc} describes no CAN frames: {reason:.150}") from None
    if not isinstance(database, Database):
        raise ValueError(f"{dbc} describes diagnostics, no CAN frames")
    return database


def _read_bag(path: Path, mapping: Mapping[str, str]) -> LogTable:
    """Read the mapped fields of a ROS 2 bag, a folder or a file, or of MCAP with ROS 2 messages.

    A field is /TOPIC:FIELD.PART, as /imu:angular_velocity.z. A sample is captured at its header's
    stamp and arrives at the log's time, where there is a header; else both are the log's. rosbags
    hands out bytes alone: its own decoder runs text that it makes of the file's definitions.
    A column gps_latency_s or camera_latency_s says how late that sensor's samples came.
    """
    with require_extra("bags", "reading a bag needs rosbags and mcap-ros2-support"):
        import mcap_ros2.decoder  # noqa: F401
        from rosbags.rosbag2 import Reader

    channels = {label: _Channel() for label in mapping.values()}
    fields: dict[str, list[str]] = {}
    for label in channels:
        topic, _, name = label.partition(":")
        fields.setdefault(topic, []).append(name)
    with Reader(path) as reader:
        topics = sorted({connection.topic for connection in reader.connections})
        if missing := [topic for topic in fields if topic not in topics]:
            raise ValueError(f"no topic {missing[0]!r}; the bag has {join_names(topics)}")
        used = [connection for connection in reader.connections if connection.topic in fields]
        decoders = {x.id: _make_decoder(x) for x in used if x.msgcount}  # the others define nothing
        for connection, logged, data in reader.messages(used) if used else ():
            message = decoders[connection.id](data)
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            captured = 0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec
            captured = captured or logged  # a stamp of zero was never set
            for name in fields[connection.topic]:
                channel = channels[f"{connection.topic}:{name}"]
                channel.values.append(_read_field(message, connection.topic, name))
                channel.stamps.append(1e-9 * captured)
                channel.late.append(1e-9 * (logged - captured))
    columns = {label: (x.stamps, x.values) for label, x in channels.items()}
    longest = max((max(map(abs, x.late)) for x in channels.values() if x.late), default=0.0)
    is_live = longest <= _LONGEST_LATENCY  # no copy of a log, whose clock is another
    for name, label in mapping.items() if is_live else ():
        stamps, late = channels[label].stamps, channels[label].late
        for sensor, (first, *_) in SENSORS.items():
            if name.startswith(f"{first}_") and any(late):
                columns.setdefault(f"{LATENCIES[sensor]}_s", (stamps, late))
    table = _join_channels(columns, {}, [f"{topic}:..." for topic in topics])
    remark = f"The log's time is up to {longest:.6g} s beside the headers': samples are punctual."
    return table if is_live else table._replace(remarks=[remark])


def _make_decoder(connection: "Connection") -> Callable[[bytes], Any]:
    """Make the decoder of a topic from the bag's definition, or ROS 2's of a common type."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_typestore

    kind, text = connection.msgtype, connection.msgdef.data
    if connection.msgdef.format == MessageDefinitionFormat.NONE:
        text = get_typestore(Stores.ROS2_HUMBLE).generate_msgdef(kind, ros_version=2)[0]
    elif connection.msgdef.format == MessageDefinitionFormat.IDL:
        raise ValueError(f"{kind} is defined in IDL; expected msg")
    schema = Schema(id=1, name=kind, encoding="ros2msg", data=text.encode())
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None  # of this encoding there is one
    return decoder


def _read_field(message: object, topic: str, field: str) -> float:
    """Read a number from a message by the names and places of its parts."""
    value: Any = message
    for part in field.split("."):
        try:
            value = value[int(part)] if part.isdecimal() else getattr(value, part)
        except (AttributeError, IndexError, TypeError):
            parts = [x for x in getattr(value, "__slots__", ()) if not x.startswith("_")]
            text = f"{topic} has no field {field!r}: {part!r} is none of {join_names(parts)}"
            raise ValueError(text) from None
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{topic}:{field} is no number, but {type(value).__name__}") from None


_VBO_NAMES = {"time": "time_s", "velocity": "speed_x_kmh", "heading": "course_degnorth"}


def _read_vbo(data: bytes) -> "pd.DataFrame":
    """Read a VBOX file: its time of day in s, its speed, heading and place by our names."""
    import pandas as pd

    sections = re.split(r"^\[([^\]\n]+)\]\s*$", data.decode("cp1252"), flags=re.M)
    parts = dict(zip(map(str.casefold, sections[1::2]), sections[2::2], strict=True))
    if missing := [name for name in ("column names", "data") if not parts.get(name, "").strip()]:
        raise ValueError(f"a VBOX file has the sections [column names] and [data]; no {missing[0]}")
    names = [_VBO_NAMES.get(name.casefold(), name) for name in parts["column names"].split()]
    frame = pd.read_csv(io.StringIO(parts["data"]), sep=r"\s+", names=names, index_col=False)
    clock = frame["time_s"].to_numpy(np.float64)  # HHMMSS.sss
    hours, minutes = clock // 10_000, clock // 100 % 100
    frame["time_s"] = 3600.0 * hours + 60.0 * minutes + np.round(clock % 100.0, 6)
    if {"lat", "long"} <= set(names):  # minutes north and west
        north, east = frame["lat"].to_numpy() / 60.0, frame["long"].to_numpy() / -60.0
        frame["gps_x_m"], frame["gps_y_m"] = to_metres(north, east, (north[0], east[0]))
    return frame
