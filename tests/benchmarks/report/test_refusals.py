"""What reports, figures, films and pages refuse, and in which words."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("plotly")
pytest.importorskip("moviepy")
from sideslip.benchmarks.harness.results import ResultTable, Suite
from sideslip.benchmarks.report import figures
from sideslip.benchmarks.report.film import check_film, make_track_kml
from sideslip.benchmarks.report.html import check_page, write_report

FEW, MANY, NAN = np.arange(2.0), np.arange(3.0), np.array([0.0, np.nan])
SHORT_ROW = Suite("s", "S", "", tables=[ResultTable("short row", ("a", "b"), [["1"]])])


def write_unmarked_page(folder: Path) -> None:
    (folder / "page.md").write_text("<!-- tables of one -->\nold\n")
    check_page(folder / "page.md", ["one"])


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda _: figures.draw_time_series(MANY, {"dakf": FEW}, "x"), ValueError,
         "'dakf' has shape"),
        (lambda _: figures.draw_track({"truth": (MANY, FEW)}), ValueError, "track 'truth'"),
        (lambda _: figures.draw_curves(FEW, {"a": MANY}, "x", "y"), ValueError,
         "has 3 values, x 2"),
        (lambda at: write_report(at / "a.html", [SHORT_ROW], "", {}), ValueError,
         r"short row.*1 cells under 2 headers"),
        (lambda at: write_report(at / "a.html", [], "", {}), ValueError, "at least one suite"),
        (lambda at: check_film(at / "film.avi"), ValueError,
         r"a film ends in .mp4 or .gif, got '.*film.avi'"),
        (lambda at: check_film(at / "a"), ValueError, "a film ends in .mp4 or .gif"),
        (lambda at: check_film(at / "none/a.mp4"), FileNotFoundError, "no such folder"),
        (lambda _: make_track_kml("x", {}), ValueError, "track"),
        (lambda _: make_track_kml("x", {"short": (MANY, FEW)}), ValueError, "track"),
        (lambda _: make_track_kml("x", {"lost": (NAN, FEW)}), ValueError, "track"),
        (write_unmarked_page, ValueError,
         r"page\.md: expected the lines <!-- tables of SUITE -->"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused(
    call: Callable[[Path], Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        call(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] in ([], ["page.md"])
