"""Tables in a Markdown page: between the marks and nowhere else."""

from pathlib import Path

import pytest

from sideslip.benchmarks.harness.results import ResultTable, Suite
from sideslip.benchmarks.report.html import _format_page_table, check_page, write_page

PAGE = """# Words before

<!-- tables of one -->
old
<!-- end -->

<!-- tables of other -->
of another run
<!-- end -->
Words behind, with a \\1 in them.
"""


def suite(name: str = "one") -> Suite:
    made = Suite(name, "", "")
    made.tables = [
        ResultTable("First", ("who", "cost"), [["a|b", "1 [0, 2]"], ["c", "-"]], "Of two."),
        ResultTable("Left out", ("who",), [["d"]], detail=True),
    ]
    return made


def test_a_table_is_markdown() -> None:
    text = "## First\n\n| who | cost |\n|---|---|\n| a\\|b | 1 [0, 2] |\n| c | - |\n\nOf two.\n"
    assert _format_page_table(suite().tables[0]) == text


def test_a_long_note_is_wrapped_between_words() -> None:
    words = ["a-long-name-" * 3, "no", "camera", "from", "2", "to", "7", "s;"] * 6
    table = ResultTable("First", ("who",), [["c"]], " ".join(words))
    lines = _format_page_table(table).splitlines()[5:]
    assert len(lines) > 2 and max(map(len, lines)) <= 120 and " ".join(lines).split() == words


def test_only_what_stands_between_the_marks_changes(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    check_page(page, ["one", "absent"])
    write_page(page, [suite(), suite("absent")])
    made = _format_page_table(suite().tables[0])
    assert page.read_text() == PAGE.replace("old\n", f"\n{made}\n")
    once = page.read_text()
    write_page(page, [suite()])
    assert page.read_text() == once


def test_a_page_without_marks_is_refused_before_the_work(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE.replace("<!-- end -->", ""))
    with pytest.raises(ValueError, match=r"page\.md: expected the lines <!-- tables of SUITE -->"):
        check_page(page, ["one"])
