"""A suite is its study, and prints every column of every row, on a narrow screen too."""

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from sideslip.benchmarks.harness.results import Column, ResultTable, Suite
from sideslip.benchmarks.harness.stats import Estimate
from sideslip.benchmarks.report.study import Request, Study
from sideslip.benchmarks.report.tables import print_run, print_suite
from sideslip.estimators.make import ESTIMATORS

pytest.importorskip("plotly")
pytest.importorskip("moviepy")
from sideslip.benchmarks.report.film import check_film
from sideslip.benchmarks.report.html import check_page

HEADER = ("controller and estimator", *(f"column {i} / %" for i in range(12)))
ROWS = [[f"contestant {k} on a filter", *(100 * k + i + 0.5 for i in range(12))] for k in (1, 2)]


def printed(suite: Suite, width: int = 80) -> str:
    written = io.StringIO()
    print_suite(Console(file=written, width=width), suite)
    return written.getvalue()


@pytest.mark.parametrize("width", [80, 100, 120, 400])
def test_nothing_of_a_wide_table_is_cut(width: int) -> None:
    """It is printed in parts, each with the names."""
    tables = [ResultTable("Numbers", HEADER, ROWS)]
    text = printed(Suite("wide", "A wide table", "", tables=tables), width)
    assert max(map(len, text.splitlines())) <= width
    parts = text.count("contestant 1 on a filter")
    assert parts == text.count("contestant 2 on a filter") == 1 + text.count("(continued)")
    assert (parts == 1) == (width == 400)
    for entry in (*HEADER[1:], *ROWS[0][1:], *ROWS[1][1:]):
        assert str(entry) in text


def test_long_texts_wrap_and_are_no_part_of_their_own() -> None:
    tables = [ResultTable("Errors", ("tier", "what"), [["1", "its error grows " * 9]])]
    text = printed(Suite("wordy", "Words", "", tables=tables))
    assert "(continued)" not in text and text.count("grows") == 9


def test_details_are_in_the_report_alone() -> None:
    tables = [ResultTable("Main", ("who", "cost"), [["a", "1"]])]
    tables += [ResultTable("Contests", ("who", "cost"), [["b", "2"]], detail=True)]
    text = printed(Suite("long", "Details", "", tables=tables))
    assert "Main" in text and "Contests" not in text and "1 table more is in the report" in text


LONG = "Fig. 9 (twin): multirate-residual-kf/constant-delay-kf"


@pytest.mark.parametrize("width", [40, 80, 100, 120])
@pytest.mark.parametrize("colour", ["truecolor", None])
def test_no_name_is_lost_on_a_narrow_screen(width: int, colour: Any) -> None:
    """However narrow, with and without colour: words wrap, and go on where they are too long."""
    names = [*ESTIMATORS, "model-following on exact-kf, all sensors", LONG]
    cells = [[name, 0.31, (0.29, 0.33), "why it is so, in a few words"] for name in names]
    interval = Column("95 % interval", form="{:.2f} .. {:.2f}")
    header = ("controller and estimator", "score", interval, "remark")
    title = "A title that is longer than a narrow screen"
    suite = Suite("names", title, "Text.", verdict="Best: `a`.\nNot covered: [b].")
    suite.tables.append(ResultTable("Numbers", header, cells))
    written = io.StringIO()
    print_suite(
        Console(file=written, width=width, force_terminal=bool(colour), color_system=colour), suite
    )
    text = re.sub(r"\x1b\[[0-9;]*m", "", written.getvalue())
    assert ("\x1b" in written.getvalue()) == bool(colour)
    lines = text.splitlines()
    assert max(map(len, lines)) <= width
    assert "\u2026" not in text
    start = lines.index("Best: `a`.")
    assert lines[start + 1] == "Not covered: [b]." and start <= 3  # first of all
    assert title in " ".join(" ".join(lines[:start]).split())
    first = "".join(re.sub(r"\s", "", line[: line_end(text, width)]) for line in lines)
    for name in names:
        assert re.sub(r"\s", "", name) in first


def line_end(text: str, width: int) -> int:
    """Where the first column ends: at the gap before the second one's header."""
    head = next(line for line in text.splitlines() if "score" in line)
    return head.index("score") - 1


@pytest.mark.parametrize("count", [1, 2, 12])
def test_a_run_fits_on_a_screen_and_says_where_the_rest_is(count: int) -> None:
    """At 80 columns, whatever the tables hold; the verdicts stand there."""
    cells = [[f"filter-{i}", *[0.123456] * 12] for i in range(50)]
    table = ResultTable("errors", ("estimator", *"abcdefghijkl"), cells, "a note " * 40)
    verdict = "\n".join(["It is so. " * 9, "And so. " * 9, *["More of it. " * 9] * 3])
    suites = [Suite(f"s{i}", f"Suite {i}", "a text", tables=[table] * 3) for i in range(count)]
    for suite in suites:
        suite.verdict = verdict
    written = io.StringIO()
    print_run(Console(file=written, width=80), suites, reported=False)
    lines = written.getvalue().splitlines()
    assert len(lines) <= 60 and max(map(len, lines)) <= 80
    assert written.getvalue().count("And so.") == 9 * count
    rest = "tables, with notes and figures, are in a report: --html FILE."
    assert lines[-1] == f"All {3 * count} {rest}"
    assert ("filter-0" in written.getvalue()) == (count <= 2)


def run(request: Request, **options: Any) -> Suite:
    def add_tables(suite: Suite, seeds: int) -> None:
        suite.add_rows([{"controller": "lqr", "cost": float(seeds)}], scenario="gust")

    study = Study("s", "S?", "Text.", (8, 2), lambda r: r.episodes, add_tables, str, **options)
    return study.run(request)


@pytest.mark.parametrize(
    ("request_", "seeds"),
    [(Request(), "8"), (Request(quick=True), "2"), (Request(quick=True, episodes=5), "5")],
)
def test_a_study_runs_the_seeds_that_are_asked_for(request_: Request, seeds: str) -> None:
    suite = run(request_)
    assert suite.verdict == seeds and suite.rows[0].value == float(seeds)


def test_a_study_without_its_module_says_so() -> None:
    suite = run(Request(), needs=("no_such_module", "Not run."))
    assert suite.verdict == "Not run." and suite.rows == []


def test_pictures_are_drawn_where_plotly_is(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    run(Request(), add_figures=lambda *arguments: drawn.append(arguments))
    assert drawn[0][1] == 8 and drawn[0][2].draw_groups
    monkeypatch.setattr("sideslip.benchmarks.report.study.find_spec", lambda _: None)
    run(Request(), add_figures=lambda *arguments: drawn.append(arguments))
    assert len(drawn) == 1


def test_metrics_of_a_record_become_rows() -> None:
    """What is no metric is for tables alone; a number that is not finite has no row."""
    suite = Suite("s", "S", "")
    record = {"estimator": "dakf", "rmse": Estimate(1.0, 0.5, 2.0), "note": "none", "rank": None}
    suite.add_rows([record | {"cost": np.float64(3), "gap": np.nan}], "Id-v0", scenario="a", n=7)
    rmse, cost = suite.rows
    assert (rmse.suite, rmse.estimator, rmse.scenario, rmse.n) == ("s", "dakf", "a", 7)
    assert (rmse.metric, rmse.value, rmse.low, rmse.high) == ("rmse", 1.0, 0.5, 2.0)
    assert (cost.metric, cost.value, cost.salt) == ("cost", 3.0, "fixed")
    assert cost.env_version.startswith("Id-v0 ")


def test_seeds_are_run_in_chunks_of_each_condition() -> None:
    def square(case: tuple[int, Any]) -> list[dict[str, tuple[float, float]]]:
        assert len(case[1]) <= 2
        return [{"a": (case[0], seed), "b": (0.0, 1.0)} for seed in case[1]]

    one, other = Request(jobs=1).run_seeds(square, (3, 4), 5, 2, "")
    assert [drive["a"] for drive in one] == [(3, 0), (3, 1), (3, 2), (3, 3), (3, 4)]
    assert [drive["a"][0] for drive in other] == [4] * 5 and other[0]["b"] == (0.0, 1.0)


def write_unmarked_page(folder: Path) -> None:
    (folder / "page.md").write_text("<!-- tables of one -->\nold\n")
    check_page(folder / "page.md", ["one"])


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda at: check_film(at / "film.avi"), ValueError,
         r"a film ends in .mp4 or .gif, got '.*film.avi'"),
        (lambda at: check_film(at / "a"), ValueError, "a film ends in .mp4 or .gif"),
        (lambda at: check_film(at / "none/a.mp4"), FileNotFoundError, "no such folder"),
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
