"""Rows survive the disk, and nothing is left half-written."""

import math
import os
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from sideslip.benchmarks.harness.results import (
    Column,
    ResultRow,
    ResultTable,
    Suite,
    check_writable,
    read_json,
    write_json,
    write_parquet,
    write_text,
)

ROWS = [
    ResultRow("estimation", "tie-vision-fig7", "rmse", 0.005, "dakf", low=0.004, high=0.006, n=100),
    ResultRow("speed", "x", "us_per_step", 2.5, verdict="report only"),
]


def test_rows_round_trip_through_json(tmp_path: Path) -> None:
    path = tmp_path / "rows.json"
    write_json(path, ROWS)
    first, second = read_json(path)
    assert first == ROWS[0]
    assert math.isnan(second.low) and second.value == 2.5 and second.verdict == "report only"
    assert "NaN" not in path.read_text()
    assert os.listdir(tmp_path) == ["rows.json"]


def test_a_notebook_shows_verdict_and_table_and_pandas_has_the_rows() -> None:
    columns = ("who", Column("cost", "cost / %", 100.0))
    table = ResultTable("Costs", columns, [{"who": "a < b", "cost": 0.5}], "n = 3")
    suite = Suite("s", "A suite", "", ROWS, [table], verdict="a wins.\nb does not.")
    html = suite._repr_html_()
    for text in ("<p>a wins.</p>", "A suite", "a &lt; b", "n = 3"):
        assert text in html
    assert suite.to_pandas().to_dict("records")[0]["metric"] == ROWS[0].metric
    assert table.to_pandas()["cost / %"].tolist() == [50.0]


def test_rows_as_parquet(tmp_path: Path) -> None:
    write_parquet(tmp_path / "rows.parquet", ROWS)
    assert pq.read_table(tmp_path / "rows.parquet")["metric"].to_pylist() == ["rmse", "us_per_step"]
    assert os.listdir(tmp_path) == ["rows.parquet"]


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rows.json"
    path.write_text("old")

    def full_disk(_: int) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_text(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["rows.json"]


def test_words_outside_the_vocabulary_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown metric 'swiftness'"):
        ResultRow("a", "b", "swiftness", 1.0)
    with pytest.raises(ValueError, match="unknown verdict 'good'"):
        ResultRow("a", "b", "rmse", 1.0, verdict="good")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is no JSON, or is cut short"),
        ('[{"suite": "a", ', "is no JSON, or is cut short"),
        ("[" * 99999, "is no JSON, or is cut short"),
        ("\0", "is no JSON"),
        ('{"suite": "a"}', "expected a JSON list of objects"),
        ('[{"suite": "a"}, 3]', "expected a JSON list of objects"),
        ('[{"suite": "a", "colour": "red"}]', "row 1: unknown colour"),
        ("[GOOD, {}]", "row 2: missing metric, scenario, suite, value"),
        ('[GOOD, {"suite": "a", "scenario": "b", "metric": "rmse"}]', "row 2: missing value"),
        ('[GOOD, {"suite": null, "scenario": "b", "metric": "rmse", "value": 1}]', "suite is nan"),
        ('[{"suite": "a", "scenario": "b", "metric": "rmse", "value": "1"}]', "value is '1', not"),
        ('[{"suite": "a", "scenario": "b", "metric": "rmse", "value": true}]', "value is True"),
        ('[{"suite": "a", "scenario": "b", "metric": "rmse", "value": HUGE}]', "value is 1111"),
        ('[{"suite": "a", "scenario": "b", "metric": "fun", "value": 1}]', "row 1: unknown metric"),
    ],
)
def test_rows_that_are_none_are_refused_with_their_file(
    content: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "rows.json"
    write_json(path, ROWS[:1])
    good = path.read_text()[1:-2]
    path.write_text(content.replace("GOOD", good).replace("HUGE", "1" * 400))
    with pytest.raises(ValueError, match=message) as caught:
        read_json(path)
    assert str(caught.value).startswith(str(path)) and len(str(caught.value)) < 500


def test_what_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere" / "file")
    check_writable(None, tmp_path / "file", tmp_path / "pipe", Path("/dev/null"))
    with pytest.raises(IsADirectoryError, match="it is a folder"):
        check_writable(tmp_path)
    for path in (tmp_path / "nowhere" / "file", tmp_path / "link"):
        with pytest.raises(FileNotFoundError, match="there is no such folder"):
            check_writable(path)
    writable = {tmp_path / "pipe"}
    monkeypatch.setattr(os, "access", lambda path, mode: path in writable)
    check_writable(tmp_path / "pipe")  # whatever its folder is
    with pytest.raises(PermissionError, match="read-only"):
        check_writable(tmp_path / "file")
