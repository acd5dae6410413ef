"""Tables on disk, as they stand there: CSV, Parquet, MATLAB and MDF."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..backend.extras import extra

if TYPE_CHECKING:
    import pandas as pd


def read_table(path: Path) -> "pd.DataFrame":
    """The file's columns as they stand there.

    CSV (comma, semicolon or tab), Parquet, MATLAB or MDF (needs `asammdf`), recognised by content.
    Raises ModuleNotFoundError without the extra, FileNotFoundError, and ValueError where the file
    is no table.
    """
    with extra("report", "reading a log needs pandas"):
        import pandas as pd
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
            table = pd.read_parquet(path)
        elif head.startswith(b"MATLAB"):
            table = _matlab(path, head)
        elif head.startswith(b"MDF "):
            table = _mdf(path)
        elif b"\0" in head:
            raise ValueError("it is a binary file")
        else:
            title = head.splitlines()[0].decode("utf-8-sig")
            table = pd.read_csv(
                path,
                sep=max(",;\t", key=title.count),
                encoding="utf-8-sig",
                index_col=False,
                skipinitialspace=True,
                low_memory=False,
                compression=None,
            )
    except (MemoryError, ImportError):
        raise
    except Exception as error:  # of scipy and asammdf anything, where a file is damaged
        reason = " ".join(str(error).split()) or type(error).__name__
        reason = "it is not text" if isinstance(error, UnicodeDecodeError) else reason
        raise ValueError(
            f"{path}: expected CSV, Parquet, MATLAB or MDF, but {reason:.300}"
        ) from None
    return table.rename(columns=lambda name: str(name).strip())


def _matlab(path: Path, head: bytes) -> "pd.DataFrame":
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
    most = max(set(lengths), key=lengths.count, default=0)
    return pd.DataFrame({name: each for name, each in columns.items() if len(each) == most})


def _mdf(path: Path) -> "pd.DataFrame":
    """All channels on the clock of the fastest, which becomes `time_s`."""
    with extra("mdf", "reading MDF needs asammdf"):
        from asammdf import MDF
    with MDF(path) as file:
        table: pd.DataFrame = file.to_dataframe()
    return table.rename_axis("time_s").reset_index()
