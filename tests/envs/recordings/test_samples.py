"""A value is a sample only where a sensor has sampled it; what was made of samples is undone."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sideslip.envs.record import FAST, PACKET, Log
from sideslip.envs.recordings.log_file import read_parts

from .drives import drive, read_log, saved

DEG = np.pi / 180.0
ROWS, EVERY = 1200, 20


def with_course(every: float = EVERY, first: int = 0, wrap: bool = False) -> pd.DataFrame:
    """A drive with a course in deg in some rows; wrap: over +-180 deg."""
    table = drive(ROWS).assign(course_deg=np.nan)
    rows = np.unique(np.ceil(np.arange(first, ROWS, every)).astype(int))
    noise = np.random.default_rng(1).normal(0.0, 0.3, len(rows))
    course = 8.0 * np.sin(0.9 * table["time_s"].to_numpy()[rows]) + noise + (178.0 if wrap else 5.0)
    table.loc[rows, "course_deg"] = np.round((course + 180.0) % 360.0 - 180.0, 4)
    return table


def samples(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """(rows, courses in deg) of the packets."""
    packets = log.record.select_packets("gps")
    np.testing.assert_array_equal(packets[:, PACKET.captured], packets[:, PACKET.arrived])
    return packets[:, PACKET.captured] - log.record.first, packets[:, PACKET.value] / DEG


def expect(table: pd.DataFrame, path: Path, said: str, **mapping: str) -> None:
    """The file has the samples of the table, and this is said first."""
    rows = np.flatnonzero(table["course_deg"].notna())
    (log,), remarks = read_parts(path, mapping)
    for read in (log, read_log(path, mapping)):
        np.testing.assert_array_equal(samples(read)[0], rows)
        np.testing.assert_allclose(samples(read)[1], table["course_deg"].iloc[rows], atol=2e-4)
    assert said in "".join(remarks) and bool(said) == bool(remarks)


def held(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(course_deg=table["course_deg"].ffill())


@pytest.mark.parametrize("every", [2, 2.5, 10, 20, 100])
@pytest.mark.parametrize("first", [0, 300])
def test_a_held_course_counts_its_changes(tmp_path: Path, every: float, first: int) -> None:
    table = with_course(every, first)
    is_new = table["course_deg"] != held(table)["course_deg"].shift()  # no sample repeats
    table["course_deg"] = table["course_deg"].where(is_new)
    expect(table, saved(held(table), tmp_path), "course is held between its samples")


def test_all_columns_of_a_sensor_share_their_rows(tmp_path: Path) -> None:
    table = with_course()
    rows = np.flatnonzero(table["course_deg"].notna())
    table.loc[rows[5:9], "course_deg"] = 3.0  # truly repeated: the speed tells the samples
    table["gps_speed_mps"] = np.where(table["course_deg"].notna(), 20.0 + table.index / 1e3, np.nan)
    whole = held(table).assign(gps_speed_mps=table["gps_speed_mps"].ffill())
    expect(table, saved(whole, tmp_path), f"{len(rows)} of 1200 values")
    late = whole.assign(gps_speed_mps=whole["gps_speed_mps"].shift(1).bfill())
    late["course_deg"] = held(with_course())["course_deg"]  # columns that change in other rows
    expect(with_course(), saved(late, tmp_path), f"{len(rows)} of 1200 values")


def test_a_held_value_from_before_the_first_sample_is_none(tmp_path: Path) -> None:
    table = with_course(first=310)
    path = saved(held(table).fillna({"course_deg": 0.0}), tmp_path)
    expect(table, path, "course is held")


def test_late_arrivals_do_not_hide_that_a_course_is_held(tmp_path: Path) -> None:
    table, late = with_course(), np.random.default_rng(2).integers(0, 5, ROWS // EVERY)
    moved = table.assign(course_deg=np.nan)
    moved.loc[np.arange(0, ROWS, EVERY) + late, "course_deg"] = table["course_deg"].dropna().values
    moved.loc[: EVERY - 1, "course_deg"] = np.nan
    expect(moved, saved(held(moved), tmp_path), "course is held")


@pytest.mark.parametrize("unwrapped", [False, True])
@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("kind", ["float64", "float32"])
def test_an_interpolated_course_keeps_its_knots(
    tmp_path: Path, unwrapped: bool, wrap: bool, kind: str
) -> None:
    table = with_course(first=200, wrap=wrap)
    known = table["course_deg"].dropna()
    angles = np.rad2deg(np.unwrap(known * DEG)) if unwrapped else known
    line = np.interp(table.index, known.index, angles)  # the first one is repeated before it
    table["course_deg"] = table["course_deg"].where(table.index <= known.index[-1])
    path = tmp_path / "drive.parquet"
    table.assign(course_deg=((line + 180.0) % 360.0 - 180.0).astype(kind)).to_parquet(path)
    expect(table, path, "course is interpolated between its samples")


@pytest.mark.parametrize("resolution", [0.0, 1e-3, 0.1, 1.0])
@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_fast_course_is_not_thinned_out(tmp_path: Path, resolution: float, noise: float) -> None:
    t = drive(ROWS)["time_s"].to_numpy()
    course = 8.0 * np.sin(0.9 * t) + noise * np.random.default_rng(3).standard_normal(ROWS)
    course = np.round(course / resolution) * resolution if resolution else course
    table = drive(ROWS).assign(course_deg=course)
    expect(table, saved(table, tmp_path), "")


def test_what_never_changes_is_left_alone(tmp_path: Path) -> None:
    table = drive(ROWS).assign(course_deg=7.0)
    expect(table, saved(table, tmp_path), "")
    camera = np.random.default_rng(4).normal(0.0, 0.01, ROWS)
    table = drive(ROWS).assign(camera_psi_rad=0.0, camera_y_l_m=camera)
    (log,), remarks = read_parts(saved(table, tmp_path))
    assert len(log.record.select_packets("camera")) == ROWS and not remarks


def test_the_kind_of_samples_by_hand(tmp_path: Path) -> None:
    table = with_course()
    path = saved(held(table), tmp_path)
    expect(held(table), path, "", course_deg_fresh="course_deg")
    rare = table.assign(course_deg=table["course_deg"].where(table.index % 400 == 0))
    path = saved(held(rare), tmp_path)
    expect(held(rare), path, "")  # three samples are no evidence
    expect(rare, path, "course is held", course_deg_held="course_deg")
    named = held(rare).rename(columns={"course_deg": "course_deg_held"})
    expect(rare, saved(named, tmp_path), "held")
    with pytest.raises(ValueError, match="unknown column name 'steer_rad_held'"):
        read_log(path, {"steer_rad_held": "steer_rad"})


@pytest.mark.parametrize(("name", "every"), [("speed_x", 10), ("steer", 5), ("speed_x", 100)])
def test_a_slow_column_is_no_hole(tmp_path: Path, name: str, every: int) -> None:
    table, place = drive(ROWS), {"speed_x": FAST.wheel_left, "steer": FAST.steer}[name]
    column = next(c for c in map(str, table) if c.startswith(name))
    path = saved(table.assign(**{column: table[column].where(table.index % every == 0)}), tmp_path)
    (log,), remarks = read_parts(path)
    assert len(log.record.fast) == ROWS - every + 1 and log.record.dt == pytest.approx(0.01)
    line = np.interp(np.arange(ROWS), np.arange(0, ROWS, every), table[column][::every])
    line = np.append(line[:1], line) if name == "steer" else line  # an input acts one row later
    np.testing.assert_allclose(log.record.fast[:, place], line[: len(log.record.fast)], rtol=1e-9)
    assert f"{name} (every {every / 100:g} s)" in remarks[0] and len(remarks) == 2
    np.testing.assert_array_equal(read_log(path).record.fast, log.record.fast)


def topics(table: pd.DataFrame) -> list[pd.DataFrame]:
    """Rows of one sensor each, most cells empty, the slower ones between the rows."""
    cells = [
        ("imu", ["yaw_rate_radps", "accel_y_mps2", "accel_x_mps2"], 1, 0.0),
        ("steer", ["steer_rad", "sideslip_rad", "speed_y_mps"], 1, 0.003),
        ("speed", ["speed_x_mps"], 2, 0.006),
        ("gps", ["course_deg"], 20, 0.004),
    ]
    parts = []
    for name, names, every, late in cells:
        part = table.iloc[::every][["time_s", *names]].assign(topic=name)
        parts.append(part.assign(time_s=part["time_s"] + late))
    return parts


@pytest.mark.parametrize("stacked", [False, True])
def test_merged_topics_become_one_drive(tmp_path: Path, stacked: bool) -> None:
    table = with_course()
    merged = pd.concat(topics(table))
    merged = merged if stacked else merged.sort_values("time_s")
    (log,), remarks = read_parts(saved(merged, tmp_path))
    first = int(np.argmin(np.abs(table["time_s"] - log.time[0])))
    same = table.iloc[first : first + len(log.record.fast)]
    assert len(same) >= ROWS - 3 and log.record.dt == pytest.approx(0.01)
    np.testing.assert_array_equal(log.record.fast[:, FAST.gyro], same["yaw_rate_radps"])
    late = same["speed_x_mps"] - 0.006 * np.cos(same["time_s"])
    np.testing.assert_allclose(log.record.fast[:, FAST.wheel_left], late, atol=1e-4)
    rows, course = samples(log)
    expected = table["course_deg"].dropna()
    expected = expected[expected.index + 1 >= first]
    np.testing.assert_array_equal(rows + first, expected.index + 1)
    np.testing.assert_allclose(course, expected, atol=1e-9)
    assert "Interpolated in the rows of yaw_rate" in "".join(remarks)


def test_a_sample_never_stands_before_it_was_captured(tmp_path: Path) -> None:
    for late in (0.0, 1e-5, 0.002, 0.008):
        parts = [with_course().drop(columns="course_deg"), topics(with_course())[3]]
        parts[1]["time_s"] += late - 0.004
        (log,), _ = read_parts(saved(pd.concat(parts).sort_values("time_s"), tmp_path))
        stands = log.time[samples(log)[0].astype(int)] - parts[1]["time_s"].to_numpy()
        assert stands.min() > -1.01e-4 and stands.max() < 0.01


def test_shuffled_rows_are_sorted_but_not_by_the_strict_reader(tmp_path: Path) -> None:
    table = with_course()
    path = saved(table.sample(frac=1.0, random_state=1), tmp_path)
    (log,), remarks = read_parts(path)
    np.testing.assert_array_equal(log.record.fast[:, FAST.gyro], table["yaw_rate_radps"])
    np.testing.assert_array_equal(samples(log)[0], np.flatnonzero(table["course_deg"].notna()))
    assert "they were sorted by it" in remarks[0] and len(remarks) == 1
    with pytest.raises(ValueError, match="time runs backward"):
        read_log(path)


def test_columns_that_are_never_known_together(tmp_path: Path) -> None:
    table = drive(ROWS)
    table["speed_x_mps"] = table["speed_x_mps"].where((table.index % 10 == 0) & (table.index < 500))
    table["steer_rad"] = table["steer_rad"].where((table.index % 10 == 0) & (table.index > 600))
    with pytest.raises(ValueError, match="are not known at the same time"):
        read_parts(saved(table, tmp_path))


def test_a_clock_that_wraps_in_merged_topics_is_refused(tmp_path: Path) -> None:
    merged = pd.concat(topics(with_course())).sort_values("time_s")
    half = 0.5 * merged["time_s"].max()
    merged["time_s"] = merged["time_s"] % half
    with pytest.raises(ValueError, match=r"time steps back by .* within .*: the clock wrapped"):
        read_parts(saved(merged, tmp_path))
