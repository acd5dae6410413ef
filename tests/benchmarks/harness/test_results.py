"""Rows survive the disk, and nothing is left half-written."""

import math
import os
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from sideslip.benchmarks.harness.results import (
    Row,
    read_json,
    write_json,
    write_parquet,
    write_text,
)

ROWS = [
    Row("estimation", "tie-vision-fig7", "rmse", 0.005, "dakf", low=0.004, high=0.006, n=100),
    Row("speed", "x", "us_per_step", 2.5, verdict="report only"),
]


def test_rows_round_trip_through_json(tmp_path: Path) -> None:
    path = tmp_path / "rows.json"
    write_json(path, ROWS)
    first, second = read_json(path)
    assert first == ROWS[0]
    assert math.isnan(second.low) and second.value == 2.5 and second.verdict == "report only"
    assert "NaN" not in path.read_text()
    assert os.listdir(tmp_path) == ["rows.json"]


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
        Row("a", "b", "swiftness", 1.0)
    with pytest.raises(ValueError, match="unknown verdict 'good'"):
        Row("a", "b", "rmse", 1.0, verdict="good")
    path = tmp_path / "rows.json"
    path.write_text('[{"suite": "a", "colour": "red"}]')
    with pytest.raises(ValueError, match=r"rows\.json: unknown column colour"):
        read_json(path)
