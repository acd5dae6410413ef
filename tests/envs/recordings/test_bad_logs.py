"""What is no log is refused with one clear error that names the thing."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sideslip.envs.recordings.log_file import read_log
from sideslip.envs.recordings.tables import parse_mapping

from .drives import drive, saved


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steer_rad", "expected NAME=COLUMN"),
        ("steer_rad=", "expected NAME=COLUMN"),
        ("steer=Delta", "expected one of steer_rad, steer_deg"),
        ("steer_furlongs=Delta", "expected one of steer_rad, steer_deg"),
        ("wheel=Delta", "unknown column name 'wheel'"),
    ],
)
def test_a_bad_mapping_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_mapping([text])
    with pytest.raises(ValueError, match="steer_rad is mapped twice"):
        parse_mapping(["steer_rad=a", "steer_rad=b"])


Spoiler = Callable[[pd.DataFrame], pd.DataFrame]


def holding(column: str, rows: list[int], value: object) -> Spoiler:
    """A table whose column holds the value in these rows."""

    def spoil(table: pd.DataFrame) -> pd.DataFrame:
        values = table[column].astype(object)
        values.iloc[rows] = value
        return table.assign(**{column: values})

    return spoil


def later(by: float, since: int = 20) -> Spoiler:
    """A table whose time is later by so many seconds from a row on."""
    return lambda table: table.assign(time_s=table["time_s"] + by * (np.arange(50) >= since))


def assigned(**columns: Any) -> Spoiler:
    return lambda table: table.assign(**columns)


def without(column: str) -> Spoiler:
    return lambda table: table.drop(columns=column)


UNEVEN = np.cumsum(np.where(np.arange(50) < 25, 0.01, 0.014))
WIDE = {f"column_{i}": i for i in range(60)}
KNOWN = "expected CSV, Parquet, MATLAB or MDF"
GYRO, STEER, SPEED = "yaw_rate_radps", "steer_rad", "speed_x_mps"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without(GYRO), r"no column yaw_rate_radps; the log has time_s, .*sideslip_rad"),
        (holding(GYRO, [11, 30], np.nan), rf"column '{GYRO}' has no value \(NaN\) in row 12"),
        (later(-0.05), r"time runs backward at row 21: 3\.15 s after 3\.19 s"),
        (later(-0.01), r"time stands still at row 21"),
        (later(0.02), r"time jumps \(a step is 0\.01 s\) at row 21: 3\.22 s after 3\.19 s"),
        (assigned(time_s=UNEVEN), r"time is uneven: row \d+ is"),
        (holding(STEER, [4], "left"), rf"column '{STEER}', row 5: expected a number, got 'left'"),
        (holding(SPEED, [4], np.inf), rf"column '{SPEED}', row 5: expected a number, got 'inf'"),
        (assigned(steer_deg=0.0), r"steer is given twice, as steer_rad and steer_deg"),
        (holding(STEER, list(range(50)), str(10**400)), r"steer_rad'.*: expected a?"),
        (assigned(steer_rad=True), r"'steer_rad' holds bool; expected numbers"),
        (
            lambda table: table.assign(time_s=1e300 * table["time_s"]),
            r"column 'time_s', row \d+: expected a number up to 1e\+15, got '\d.*e\+\d+'",
        ),
        (holding(STEER, [4], "left" * 999), r"'steer_rad', row 5: expected a number"),
        (
            lambda table: table.drop(columns=STEER).assign(**WIDE),
            r"no column steer_rad; the log has time_s, .* column_1",
        ),
        (lambda table: table.iloc[:1], r"the log has one row; a drive needs two or more"),
        (lambda table: table.iloc[:0], r"the log has no rows"),
        (b"", "the file is empty"),
        (b" \n\n", "the file is empty"),
        (bytes(range(256)) * 8, "it is a binary file"),
        (b"\x89PNG\r\n\x1a\n" + b"\xfe\xfd" * 99, "it is not text"),
        (b"PAR1 but not for long", KNOWN),
        (b"MATLAB 5.0 MAT-file" + b" " * 81, KNOWN),
        (b"time_s,steer_rad\n1,2\n1,2,3,4\n", KNOWN),
    ],
)
def test_a_bad_table_gets_one_clear_error(
    tmp_path: Path, spoil: Spoiler | bytes, message: str
) -> None:
    path = tmp_path / "drive.csv"
    if isinstance(spoil, bytes):
        path.write_bytes(spoil)
    else:
        saved(spoil(drive()), tmp_path)
    with pytest.raises(ValueError, match=message) as caught:
        read_log(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_nothing_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.csv: there is no such file"):
        read_log(tmp_path / "nowhere.csv")
    with pytest.raises(ValueError, match="found a folder"):
        read_log(tmp_path)


def test_pandas_is_loaded_late_and_its_extra_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "import sys, sideslip.envs.recordings.log_file; sys.exit('pandas' in sys.modules)"
    env_path = {"PYTHONPATH": ":".join(sys.path)}
    subprocess.run([sys.executable, "-c", code], check=True, env=env_path)
    path = saved(drive(), tmp_path)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sideslip\[report\]'"):
        read_log(path)
