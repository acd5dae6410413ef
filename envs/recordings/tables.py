"""Tables on disk, as they stand there: CSV, Parquet, MATLAB and MDF."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..backend.extras import require_extra
from .dialect import find_unit, read_text

if TYPE_CHECKING:
    import pandas as pd


class LogTable(NamedTuple):
    """A file's columns as they stand there.

    Attributes:
        frame: Values; names may repeat.
        units: Unit of each column, "" for unknown.
        names: Names of all columns; an MDF's frame has only the wanted ones.
        remarks: Sentences on how the file was read.
    """

    frame: "pd.DataFrame"
    units: list[str]
    names: list[str]
    remarks: list[str]


def read_table(path: Path, is_wanted: Callable[[str], bool]) -> LogTable:
    """Read a file's columns: text of any dialect, Parquet, MATLAB or MDF, recognised by content.

    MDF needs `asammdf`.

    Args:
        path: Path of the file.
        is_wanted: Whether a column's name is looked for.

    Returns:
        The table.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no table.
        ImportError: If an extra is missing.
        MemoryError: If it does not fit into memory.
    """
    with require_extra("report", "reading a log needs pandas"):
        import pandas as pd
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, found a folder")
    data = path.read_bytes()
    if not data[:65536].strip():
        raise ValueError(f"{path}: the file is empty")
    units: list[str] = []
    remarks: list[str] = []
    try:
        if data.startswith(b"MDF "):
            return _read_mdf(path, is_wanted)
        if data.startswith(b"PAR1"):
            frame = pd.read_parquet(path)
        elif data.startswith(b"MATLAB"):
            frame = _read_matlab(path, data)
        else:
            frame, units, remarks = read_text(data, is_wanted)
    except (MemoryError, ImportError):
        raise
    except Exception as error:  # of scipy and asammdf anything, where a file is damaged
        reason = " ".join(str(error).split()) or type(error).__name__
        reason = "it is not text" if isinstance(error, UnicodeDecodeError) else reason
        raise ValueError(
            f"{path}: expected CSV, Parquet, MATLAB or MDF, but {reason:.300}"
        ) from None
    names = [str(name).strip() for name in frame.columns]
    return LogTable(frame.set_axis(names, axis=1), units or [""] * len(names), names, remarks)


def _read_matlab(path: Path, head: bytes) -> "pd.DataFrame":
    """The numeric vectors of the length that most have; ValueError for a file of version 7.3."""
    import pandas as pd
    from scipy.io import loadmat

    if head.startswith(b"MATLAB 7.3"):
        raise ValueError("it is MATLAB 7.3 (HDF5); save it with -v7")
    columns = {
        name: np.ravel(values)
        for name, values in loadmat(path, squeeze_me=True, simplify_cells=True).items()
        if isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype.kind in "fiub"
    }
    lengths = [len(values) for values in columns.values()]
    common_length = max(set(lengths), key=lengths.count, default=0)
    return pd.DataFrame(
        {name: column for name, column in columns.items() if len(column) == common_length}
    )


def _read_mdf(path: Path, is_wanted: Callable[[str], bool]) -> LogTable:
    """The wanted channels in rows at the stamps of all their groups, NaN where a group has none."""
    with require_extra("mdf", "reading MDF needs asammdf"):
        from asammdf import MDF
    import pandas as pd

    chosen: dict[str, tuple[int, int]] = {}
    columns, units = {}, ["s"]
    with MDF(path) as file:
        for name, entries in file.channels_db.items():
            places = [place for place in entries if file.masters_db.get(place[0]) != place[1]]
            labels = [f"{name} (group {g})" if len(places) > 1 else name for g, _ in places]
            wanted = [item for item in zip(labels, places, strict=True) if is_wanted(item[0])]
            if not wanted and len(places) > 1 and is_wanted(name):
                raise ValueError(f"channels share a name; --map one of {', '.join(labels)}")
            chosen.update(wanted)
        signals = file.select(
            [(None, *place) for place in chosen.values()],
            ignore_value2text_conversions=True,
            validate=True,
        )
        names = list(file.channels_db)
    for name, signal in zip(chosen, signals, strict=True):
        if signal.samples.ndim == 1 and signal.samples.dtype.kind in "fiub" and name != "time_s":
            column = pd.Series(signal.samples, signal.timestamps)
            columns[name] = column[~column.index.duplicated()]
            units.append(find_unit(signal.unit))
    frame = pd.concat(columns, axis=1, sort=True) if columns else pd.DataFrame()
    return LogTable(frame.rename_axis("time_s").reset_index(), units, names, [])
