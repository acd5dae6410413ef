"""A log read from disk is the record that the car would have written, or refused by name."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sideslip.envs.record import FAST, PACKET
from sideslip.envs.recordings.log_file import read_parts
from sideslip.envs.recordings.tables import parse_mapping
from sideslip.envs.sensors.slow import GPS

from .drives import drive, read_log, saved

STANFORD = Path(__file__).parents[3] / "shared" / "data" / "stanford_250lm" / "log.csv"
DEG = np.pi / 180.0


def test_columns_become_the_record(tmp_path: Path) -> None:
    table = drive()
    log = read_log(saved(table, tmp_path))
    fast = log.record.fast
    assert log.name == f"{tmp_path.name}/drive"
    assert log.record.dt == pytest.approx(0.01, rel=1e-12)
    assert log.record.first == 300
    np.testing.assert_allclose(log.time, table["time_s"], atol=1e-9)
    np.testing.assert_array_equal(fast[:, FAST.gyro], table["yaw_rate_radps"])
    np.testing.assert_array_equal(fast[:, FAST.accel_y], table["accel_y_mps2"])
    np.testing.assert_array_equal(fast[:, FAST.accel_x], table["accel_x_mps2"])
    for wheel in (FAST.wheel_left, FAST.wheel_right):
        np.testing.assert_array_equal(fast[:, wheel], table["speed_x_mps"])
    np.testing.assert_array_equal(log.truth["beta"], table["sideslip_rad"])
    present = "gyro accel_y accel_x wheel_left wheel_right steer"
    assert log.record.present == tuple(present.split())
    assert len(log.record.packets) == 0
    assert log.slow == {}


def test_an_input_acts_from_its_own_row_on(tmp_path: Path) -> None:
    """Row k of a record holds what acted from k-1 to k, so a sampled input moves one row down."""
    table = drive()
    table["torque_left_nm"] = np.arange(50.0)
    fast = read_log(saved(table, tmp_path)).record.fast
    for column, name in ((FAST.steer, "steer_rad"), (FAST.torque_left, "torque_left_nm")):
        values = table[name].to_numpy()
        np.testing.assert_array_equal(fast[1:, column], values[:-1])
        assert fast[0, column] == values[0]


def test_units_are_converted(tmp_path: Path) -> None:
    table = drive()
    other = pd.DataFrame(
        {
            "time_ms": 1e3 * table["time_s"],
            "speed_x_kmh": 3.6 * table["speed_x_mps"],
            "yaw_rate_degps": table["yaw_rate_radps"] / DEG,
            "accel_y_g": table["accel_y_mps2"] / 9.81,
            "accel_x_mps2": table["accel_x_mps2"],
            "steer_deg": table["steer_rad"] / DEG,
            "sideslip_deg": table["sideslip_rad"] / DEG,
        }
    )
    one, two = read_log(saved(table, tmp_path)), read_log(saved(other, tmp_path, "other.csv"))
    np.testing.assert_allclose(two.record.fast, one.record.fast, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(two.truth["beta"], one.truth["beta"], rtol=1e-12)
    assert two.record.dt == pytest.approx(one.record.dt, rel=1e-9)


def test_a_mapping_renames_and_says_the_unit(tmp_path: Path) -> None:
    table = drive()
    table["GyroZ"] = table.pop("yaw_rate_radps") / DEG
    path = saved(table, tmp_path)
    log = read_log(path, parse_mapping(["yaw_rate_degps = GYROZ"]))
    np.testing.assert_allclose(log.record.fast[:, FAST.gyro], DEG * table["GyroZ"], rtol=1e-12)
    with pytest.raises(ValueError, match=r"no column 'Gyro' for yaw_rate_degps.*GyroZ"):
        read_log(path, {"yaw_rate_degps": "Gyro"})
    with pytest.raises(ValueError, match="yaw_rate is mapped twice"):
        read_log(path, {"yaw_rate_degps": "GyroZ", "yaw_rate_radps": "GyroZ"})


def test_logged_slow_sensors_become_packets(tmp_path: Path) -> None:
    table = drive(100)
    table["course_deg"] = np.nan
    table.loc[5::20, "course_deg"] = [179.0, 190.0, 30.0, 40.0, 50.0]
    table.loc[65, "course_deg"] = np.nan  # lost on the way
    table["gps_speed_mps"] = table["speed_x_mps"]
    table["roll_rate_degps"] = np.sin(table["time_s"])
    table["gps_hdop_count"] = 1.0 + 0.01 * np.arange(100)
    table["gps_satellites_count"] = np.arange(100) // 10
    table.loc[:10, "speed_x_mps"] = 0.5
    log = read_log(saved(table, tmp_path))
    rate = log.record.fast[:, FAST.roll_rate]
    np.testing.assert_allclose(rate, DEG * table["roll_rate_degps"], rtol=1e-15)
    assert "roll_rate" in log.record.present
    packets = log.record.select_packets("gps")
    np.testing.assert_array_equal(packets[:, PACKET.sensor], GPS)
    np.testing.assert_array_equal(packets[:, PACKET.captured], [305, 325, 345, 385])
    np.testing.assert_array_equal(packets[:, PACKET.arrived], packets[:, PACKET.captured])
    course = packets[:, PACKET.value]
    np.testing.assert_allclose(course / DEG, [179.0, -170.0, 30.0, 50.0])  # wrapped
    np.testing.assert_array_equal(packets[:, PACKET.quality], [0, 1, 1, 1])  # too slow at first
    rows = [5, 25, 45, 85]
    for place, name in ((1, "gps_speed_mps"), (4, "gps_hdop_count"), (5, "gps_satellites_count")):
        np.testing.assert_array_equal(packets[:, PACKET.value + place], table[name][rows])
    assert np.isnan(packets[:, PACKET.value + 2 : PACKET.value + 4]).all()
    gps = log.slow["gps"]
    assert gps.period == pytest.approx(0.2)
    assert gps.phase == pytest.approx(0.05)


def test_truth_is_optional_and_may_have_gaps(tmp_path: Path) -> None:
    table = drive()
    v_x, v_y = table["speed_x_mps"].to_numpy(), table["speed_y_mps"].to_numpy()
    table.loc[7, "sideslip_rad"] = np.nan
    beta = read_log(saved(table, tmp_path)).truth["beta"]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(beta)), [7])
    del table["sideslip_rad"]
    beta = read_log(saved(table, tmp_path)).truth["beta"]
    np.testing.assert_allclose(beta, np.arctan2(v_y, v_x))
    del table["speed_y_mps"]
    assert read_log(saved(table, tmp_path)).truth == {}


def test_the_sideslip_of_a_standing_car_is_zero(tmp_path: Path) -> None:
    table = drive().assign(sideslip_rad=3.0)
    table.loc[:9, ["speed_x_mps", "speed_y_mps"]] = 0.3
    beta = read_log(saved(table, tmp_path)).truth["beta"]
    np.testing.assert_array_equal(beta, np.where(np.arange(50) < 10, 0.0, 3.0))


def test_a_small_jitter_is_an_even_clock(tmp_path: Path) -> None:
    table = drive(500)
    table["time_s"] += np.random.default_rng(1).uniform(-4e-4, 4e-4, 500)
    assert read_log(saved(table, tmp_path)).record.dt == pytest.approx(0.01, rel=1e-3)
    table["time_s"] = np.round(np.arange(500) / 128.0, 3)  # 128 Hz in whole milliseconds
    assert read_log(saved(table, tmp_path)).record.dt == pytest.approx(1.0 / 128.0, rel=1e-3)


def test_time_from_below_zero_counts_from_the_first_row(tmp_path: Path) -> None:
    (log,), _ = read_parts(saved(drive(start=-1.0), tmp_path))
    assert log.record.first == 0


@pytest.mark.skipif(not STANFORD.exists(), reason="the shared recordings are not here")
def test_the_stanford_log() -> None:
    log = read_log(STANFORD)
    assert log.record.fast.shape[0] == 30001
    assert log.record.dt == pytest.approx(0.01, rel=1e-9)
    assert log.time[0] == pytest.approx(149.99)
    beta = log.truth["beta"] / DEG
    assert -5.5 < beta.min() < -5.0
    assert 3.5 < beta.max() < 4.5


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
KNOWN = "expected CSV, Parquet, MATLAB, MDF, a CAN trace, a bag or VBO"
GYRO, STEER, SPEED = "yaw_rate_radps", "steer_rad", "speed_x_mps"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without(GYRO), r"no column yaw_rate_radps; the log has time_s, .*--map yaw_rate_"),
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


def test_truth_values_as_categories_are_refused_too() -> None:
    table: Any = drive().assign(steer_rad=pd.Categorical([True, False] * 25))
    with pytest.raises(ValueError, match="'steer_rad' holds category; expected numbers"):
        read_log(table)


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


def test_slow_rows_have_the_mean_steering_of_both_ends(tmp_path: Path) -> None:
    table = drive().iloc[::5]
    fast = read_log(saved(table, tmp_path)).record.fast
    steer = table["steer_rad"].to_numpy()
    np.testing.assert_array_equal(fast[1:, FAST.steer], 0.5 * (steer[1:] + steer[:-1]))
