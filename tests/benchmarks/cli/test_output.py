"""What commands print: every column of every row, on a narrow screen too."""

import io

import pytest
from rich.console import Console

from sideslip.benchmarks.cli.output import print_suite
from sideslip.benchmarks.harness.results import Suite, Table

HEADER = ("controller and estimator", *(f"column {i} / %" for i in range(12)))
ROWS = [[f"contestant {k} on a filter", *(f"{100 * k + i}.5" for i in range(12))] for k in (1, 2)]


@pytest.mark.parametrize("width", [80, 120, 400])
def test_nothing_of_a_wide_table_is_cut(width: int) -> None:
    """It is printed in parts, each with the names."""
    suite = Suite("wide", "A wide table", "")
    suite.tables.append(Table("Numbers", HEADER, ROWS))
    written = io.StringIO()
    print_suite(Console(file=written, width=width), suite)
    text = written.getvalue()
    assert max(map(len, text.splitlines())) <= width
    parts = text.count("contestant 1 on a filter")
    assert parts == text.count("contestant 2 on a filter") == 1 + text.count("(continued)")
    assert (parts == 1) == (width == 400)
    for entry in (*HEADER[1:], *ROWS[0][1:], *ROWS[1][1:]):
        assert entry in text


def test_long_texts_wrap_and_are_no_part_of_their_own() -> None:
    suite = Suite("wordy", "Words", "")
    suite.tables.append(Table("Errors", ("tier", "what"), [["1", "its error grows " * 9]]))
    written = io.StringIO()
    print_suite(Console(file=written, width=80), suite)
    assert "(continued)" not in written.getvalue()
    assert written.getvalue().count("grows") == 9
