"""What a suite prints: every column of every row, on a narrow screen too."""

import io
import re
from typing import Any

import pytest
from rich.console import Console

from sideslip.benchmarks.harness.results import Column, ResultTable, Suite
from sideslip.benchmarks.report.tables import print_run, print_suite
from sideslip.estimators.make import ESTIMATORS

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
