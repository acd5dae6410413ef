"""A text table is read in the dialect of whoever wrote it; metres on the ellipsoid."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sideslip.envs.record import Log
from sideslip.envs.recordings.dialect import _UNITS, find_unit, to_degrees, to_metres
from sideslip.envs.recordings.log_file import read_parts
from sideslip.envs.recordings.tables import COLUMNS, read_quantities

from .drives import drive, read_log, saved

DEG = np.pi / 180.0
BARE = ["Time", "Speed X", "speed_y", "Yaw rate", "Accel X", "Accel Y", "STEER", "Sideslip"]


def same(one: Log, other: Log) -> None:
    np.testing.assert_allclose(one.record.fast, other.record.fast, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(one.truth["beta"], other.truth["beta"], rtol=1e-12)


def csv_of(table: pd.DataFrame, sep: str = ",", decimal: str = ",", end: str = "\n") -> str:
    return table.to_csv(index=False, sep=sep, decimal=decimal, lineterminator=end)


PLAIN = csv_of(drive(300), decimal=".")
GERMAN = csv_of(drive(300), ";")
QUOTED = drive(300).to_csv(index=False, decimal=",", quoting=csv.QUOTE_ALL)
SPACED = "# " + csv_of(drive(300), " ", ".")
PADDED = "Export,,,,,,,\nDriver: M. Å.,,,,,,,\n,,,,,,,\n" + PLAIN
SECTIONS = f"made by hand\n\n[column names]\n{SPACED[2:]}".replace("rad\n", "rad\n\n[data]\n", 1)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (PLAIN.encode(), ""),
        (PLAIN.replace("\n", "\r").encode(), ""),
        (PLAIN.upper().encode(), ""),
        (PLAIN.encode("utf-16"), "UTF-16 text"),
        (PLAIN.encode("utf-16-le"), "UTF-16-LE text"),
        (PLAIN.encode("utf-16-be"), "UTF-16-BE text"),
        (PADDED.encode("cp1252"), "CP1252 text, the header in line 4"),
        (PADDED.encode(), "the header in line 4"),
        (GERMAN.encode(), "columns between semicolons, decimal commas"),
        (QUOTED.encode(), "decimal commas"),
        (
            f"sep=;\r\n{GERMAN}".encode("utf-8-sig"),
            "columns between semicolons, decimal commas, the header in line 2",
        ),
        (f"sep=\t\n{csv_of(drive(300), chr(9), '.')}".encode(), "columns between tabs"),
        (SPACED.encode(), "columns between spaces"),
        (SECTIONS.encode(), "columns between spaces, the header in line 4"),
        (PLAIN.replace("\n", ",\n").encode(), ""),
        (PLAIN.replace(",", ", ").encode(), ""),
        (f"Hello, world\n{60 * chr(10)}{SECTIONS}".encode(), "the header in line 65"),
        ("".join(f"note {i}\n" for i in range(60)).encode() + PLAIN.encode(), "line 61"),
    ],
)
def test_a_dialect_is_recognised_and_said(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "other.csv"
    path.write_bytes(content)
    (log,), remarks = read_parts(path)
    same(log, read_log(saved(drive(300), tmp_path)))
    same(read_log(path), log)
    assert len(remarks) == bool(said) and said in "".join(remarks)


@pytest.mark.parametrize(
    "units", ["s,km/h,m/s,°/s,m/s²,g,deg,[°]", "[s],kph,(mps),dps,m/s^2,G,°,Grad"]
)
def test_a_row_of_units_is_used(tmp_path: Path, units: str) -> None:
    table = drive(300)
    factors = [1.0, 3.6, 1.0, 1.0 / DEG, 1.0, 1.0 / 9.81, 1.0 / DEG, 1.0 / DEG]
    rows = csv_of(table * factors, decimal=".").partition("\n")[2]
    path = tmp_path / "units.csv"
    path.write_text(f"{','.join(BARE)}\n{units}\n{rows}", encoding="utf-8")
    same(read_log(path), read_log(saved(table, tmp_path)))
    named = [f"{name} [{unit}]" for name, unit in zip(BARE, units.split(","), strict=True)]
    path.write_text(f"{','.join(named)}\n{rows}", encoding="utf-8")
    same(read_log(path), read_log(saved(table, tmp_path)))


def test_units_that_contradict_a_name_are_refused_unless_mapped(tmp_path: Path) -> None:
    table, path = drive(300), tmp_path / "units.csv"
    path.write_text(PLAIN.replace("\n", "\ns,m/s,m/s,rad/s,m/s2,m/s2,deg,rad\n", 1))
    with pytest.raises(ValueError, match=r"steer_rad has the unit deg .*--map steer_deg=steer_rad"):
        read_log(path)
    (log,), remarks = read_parts(path, {"steer_rad": "steer_rad"})
    same(log, read_log(saved(table, tmp_path)))
    assert "steer_rad is read as steer_rad, though its unit in the file is deg." in remarks


def test_every_unit_of_a_column_is_known_in_units_rows() -> None:
    units = {unit for units in COLUMNS.values() for unit in units} - {"degnorth"}
    assert units == set(_UNITS.values())
    assert all(find_unit(unit) == unit for unit in units) and find_unit("furlongs") == ""


def test_a_decimal_comma_is_not_guessed(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_text(PLAIN.replace(",", ";").replace("0.", "0,").replace("20,", "20."))
    with pytest.raises(ValueError, match=r"a number with a decimal point alone, got '-?0,"):
        read_log(path)
    table = drive(300).assign(speed_x_mps=drive(300)["speed_x_mps"].map(str).str.replace(".", ","))
    with pytest.raises(ValueError, match=r"speed_x_mps', row 1: .* point alone, got '20,1"):
        read_log(saved(table, tmp_path, sep=";"))
    path.write_text(PLAIN.replace(".", ","))
    with pytest.raises(ValueError, match=r"header in line 1 has 8 names, and rows have 1\d fields"):
        read_log(path)
    thousands = drive(300).assign(speed_x_mps="20,123", time_s=np.arange(300))
    thousands = thousands.astype(object).map(lambda x: x if isinstance(x, str) else round(x))
    with pytest.raises(ValueError, match=r"speed_x_mps', row 1: .* point alone, got '20,1"):
        read_log(saved(thousands, tmp_path, sep=";"))


@pytest.mark.parametrize("change", [str, str.upper])
def test_a_column_that_is_given_twice(tmp_path: Path, change: Callable[[str], str]) -> None:
    table = drive(300)
    table.insert(2, "again", table["steer_rad"])
    path = tmp_path / "drive.csv"
    path.write_text(csv_of(table, decimal=".").replace("again", change("steer_rad")))
    (log,), remarks = read_parts(path)
    same(log, read_log(saved(drive(300), tmp_path, "other.csv")))
    (remark,) = remarks
    assert remark.casefold() == "steer_rad is given twice, with the same values."
    table["again"] *= 2.0
    path.write_text(csv_of(table, decimal=".").replace("again", change("steer_rad")))
    with pytest.raises(ValueError, match=r"(?i)steer_rad is given twice, in columns 3 and 8"):
        read_log(path)


@pytest.mark.parametrize(("unit", "scale"), [("us", 10**6), ("ns", 10**9), ("ms", 10**3)])
def test_stamps_since_1970(tmp_path: Path, unit: str, scale: int) -> None:
    table = drive(300)
    stamps = (1_716_990_839 * scale + np.rint(table.pop("time_s") * scale)).astype(np.int64)
    expected = read_log(saved(drive(300), tmp_path)).record.fast
    (log,), remarks = read_parts(saved(table.assign(**{f"time_{unit}": stamps}), tmp_path))
    np.testing.assert_array_equal(log.record.fast, expected)
    assert log.record.dt == pytest.approx(0.01, rel=1e-6) and not remarks
    (log,), remarks = read_parts(saved(table.assign(time_s=stamps), tmp_path))
    np.testing.assert_array_equal(log.record.fast, expected)
    assert remarks == [f"time_s is read in {unit} since 1970; no other unit fits."]


def test_a_compass_course_is_read_as_one(tmp_path: Path) -> None:
    table = drive(300).assign(heading=np.nan)
    table.loc[::20, "heading"] = (350.0 + 2.0 * np.arange(15)) % 360.0
    mapping = {"course_degnorth": "heading"}
    values, _ = read_quantities(saved(table, tmp_path), mapping, ("time", "steer"), None)
    course = values["course"][::20]
    expected = (90.0 - table["heading"][::20]) * DEG
    np.testing.assert_allclose(np.sin(course), np.sin(expected), atol=1e-12)
    np.testing.assert_allclose(np.cos(course), np.cos(expected), atol=1e-12)


def test_degrees_agree_with_the_earths_own_measures() -> None:
    """At the equator a degree of longitude is 111.3195 km, one of latitude 110.574 km; at 45
    degrees of latitude they are 78.847 km and 111.132 km (WGS 84)."""
    for latitude, east, north in ((0.0, 111_319.5, 110_574.3), (45.0, 78_846.8, 111_131.8)):
        up, right = to_degrees(np.array([east]), np.array([north]), (latitude, 0.0))
        assert up[0] - latitude == pytest.approx(1.0, rel=1e-5)
        assert right[0] == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("origin", [(48.0, 11.0), (-33.9, 18.4), (64.1, 179.999)])
def test_metres_are_the_inverse_of_degrees_over_the_date_line_too(
    origin: tuple[float, float],
) -> None:
    X, Y = np.random.default_rng(0).uniform(-1000.0, 1000.0, (2, 50))
    latitude, longitude = to_degrees(X, Y, origin)
    longitude = np.where(longitude > 180.0, longitude - 360.0, longitude)
    east, north = to_metres(latitude, longitude, origin)
    assert east == pytest.approx(X, abs=1e-6) and north == pytest.approx(Y, abs=1e-6)
