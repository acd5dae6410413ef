"""A log with holes becomes whole drives, and what was done is said."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sideslip.envs.record import FAST, PACKET
from sideslip.envs.recordings.log_file import read_parts

from .drives import drive, read_log, saved


def without(table: pd.DataFrame, first: int, last: int) -> pd.DataFrame:
    return table.drop(index=range(first, last)).reset_index(drop=True)


def test_a_whole_log_is_read_as_it_is(tmp_path: Path) -> None:
    path = saved(drive(300), tmp_path)
    (log,), done = read_parts(path)
    np.testing.assert_array_equal(log.record.fast, read_log(path).record.fast)
    assert done == [] and log.name == read_log(path).name


def test_a_short_hole_is_filled(tmp_path: Path) -> None:
    whole = drive(600)
    whole["course_rad"] = np.where(np.arange(600) % 10 == 0, 0.1, np.nan)
    (log,), done = read_parts(saved(without(without(whole, 203, 208), 400, 405), tmp_path))
    assert done == ["2 holes up to 0.25 s were filled by interpolation."]
    assert len(log.record.fast) == 600
    np.testing.assert_allclose(log.record.fast[:, FAST.gyro], whole["yaw_rate_radps"], atol=3e-4)
    np.testing.assert_allclose(log.truth["beta"], whole["sideslip_rad"], atol=3e-4)
    captured = log.record.packets[:, PACKET.captured] - log.record.first
    assert captured.tolist() == list(range(0, 600, 10))


def test_a_long_hole_divides_and_a_short_part_is_left_out(tmp_path: Path) -> None:
    table = without(without(drive(1300), 1290, 1290), 400, 700)
    logs, done = read_parts(saved(without(table, 950, 990), tmp_path))
    assert [round(log.time[-1] - log.time[0], 2) for log in logs] == [3.99, 5.49]
    assert [log.name.rpartition(", ")[2] for log in logs] == ["part 1", "part 2"]
    assert logs[1].time[0] == pytest.approx(10.0)
    assert done == ["2 parts, between which rows are missing.", "1 parts under 2 s were left out."]


def test_a_clock_that_steps_back_is_mended_and_counted(tmp_path: Path) -> None:
    table = drive(600)
    table.loc[300:302, "time_s"] -= 0.05
    (log,), done = read_parts(saved(table, tmp_path))
    assert len(log.record.fast) == 600
    assert "3 rows whose time steps back or stands still were dropped." in done
    table = drive(600)
    table.loc[300:, "time_s"] -= 100.0
    logs, done = read_parts(saved(table, tmp_path))
    assert [len(log.record.fast) for log in logs] == [300, 300]
    assert "1 times the clock was set back: the log is divided there." in done


def test_rows_without_a_value_are_dropped_and_the_hole_filled(tmp_path: Path) -> None:
    table = drive(600)
    table.loc[100:104, "yaw_rate_radps"] = np.nan
    (log,), done = read_parts(saved(table, tmp_path))
    assert done[-1] == "5 rows lack a value and were dropped."
    assert len(log.record.fast) == 600 and np.isfinite(log.record.fast).all()


def test_a_stretch_of_the_log(tmp_path: Path) -> None:
    path = saved(drive(600), tmp_path)
    ((early,), _), ((late,), _) = read_parts(path, end=2.5), read_parts(path, start=2.5)
    assert len(early.record.fast) + len(late.record.fast) == 600
    assert late.time[0] == pytest.approx(early.time[-1] + 0.01)


def test_nothing_that_lasts(tmp_path: Path) -> None:
    table = drive(600)
    table["time_s"] += np.arange(600) // 100
    with pytest.raises(ValueError, match="no part of the log lasts 2 s without a hole"):
        read_parts(saved(table, tmp_path))
    with pytest.raises(ValueError, match="fewer than two rows"):
        read_parts(saved(drive(600), tmp_path), start=100.0)


def test_a_part_without_a_slow_sensors_sample_lacks_the_sensor(tmp_path: Path) -> None:
    table = drive(1200).assign(course_rad=np.nan, camera_psi_rad=np.nan, camera_y_l_m=0.0)
    table.loc[:500:20, "course_rad"] = 0.1
    table.loc[::10, "camera_psi_rad"] = 0.1
    logs, done = read_parts(saved(without(table, 550, 620), tmp_path))
    assert [sorted(log.slow) for log in logs] == [["camera", "gps"], ["camera"]]
    assert "Part 2 has no sample of gps." in done
    gps, camera = (logs[1].record.select_packets(name) for name in ("gps", "camera"))
    assert len(gps) == 0 < len(camera)


@pytest.mark.parametrize("late", [1e-7, 2e-3])
def test_all_parts_have_one_step(tmp_path: Path, late: float) -> None:
    """Clocks that differ by rounding, or truly, would be drives of several dt."""
    table = without(drive(1300), 700, 800)
    slower = table["time_s"] > 10.5
    table.loc[slower, "time_s"] += np.arange(slower.sum()) * late + 1e-8
    logs, _ = read_parts(saved(table, tmp_path))
    assert len(logs) == 2 and logs[0].record.dt == logs[1].record.dt == pytest.approx(0.01)
    assert logs[1].time[-1] == pytest.approx(table["time_s"].iloc[-1], abs=0.02)


def test_stamps_that_lost_digits_are_refused(tmp_path: Path) -> None:
    table = drive(600)
    table["time_s"] = [float(f"{time:.9g}") for time in 1.7e9 + table["time_s"]]
    with pytest.raises(ValueError, match=r"back in 598 of 600 rows: have its stamps lost digits"):
        read_parts(saved(table, tmp_path))


def test_a_large_share_of_rows_dropped_is_said_first_or_refused(tmp_path: Path) -> None:
    table = drive(600)
    late = table.assign(yaw_rate_radps=table["yaw_rate_radps"].where(table.index >= 350))
    (log,), done = read_parts(saved(late, tmp_path))
    assert done[0] == "WARNING: 350 of 600 rows lack a value of yaw_rate and were dropped."
    assert len(log.record.fast) == 250
    rare = table.assign(steer_rad=table["steer_rad"].where(table.index % 150 == 0))
    with pytest.raises(ValueError, match=r"596 of 600 rows lack a value of steer; regular gaps up"):
        read_parts(saved(rare, tmp_path))
