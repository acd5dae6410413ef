"""The report: complete, escaped, self-contained, sortable, never half-written; tables of pages."""

import base64
import gzip
import hashlib
import json
import re
import sys
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.harness.results import Column, ResultTable, Suite
from sideslip.benchmarks.harness.stats import Estimate
from sideslip.benchmarks.report import figures
from sideslip.benchmarks.report import html as report
from sideslip.benchmarks.report.html import (
    _encode_figure,
    _encode_steps,
    _format_page_table,
    _mark_code,
    check_page,
    write_page,
    write_report,
)
from sideslip.benchmarks.report.tables import _format_cell, format_columns

from .demo import COMMAND, HOSTILE, VERSIONS, answered, control, estimation, matrix


def written(path: Path, suites: list[Suite] | None = None) -> str:
    target = path / "report.html"
    write_report(target, suites or [estimation(), control()], COMMAND, VERSIONS)
    assert [p.name for p in path.iterdir()] == ["report.html"]
    return target.read_text(encoding="utf-8")


def unpacked(page: str, name: str) -> list[str]:
    """The packed texts of a name."""
    found = re.findall(f'data-name="{name}">(.*?)<', page)
    return [gzip.decompress(base64.b64decode(each)).decode() for each in found]


def without_scripts(page: str) -> str:
    return re.sub(r"<script[^>]*>.*?</script>", "", page, flags=re.DOTALL)


def test_every_text_is_there_and_escaped(tmp_path: Path) -> None:
    suites = [estimation(), control()]
    page = without_scripts(written(tmp_path, suites))
    assert HOSTILE not in page
    assert "<b>1 & 2" not in page
    plain = unescape(re.sub(r"<(?!/script|b>1)[^>]*>", "", page.replace("&lt;", "\0")))
    plain = plain.replace("\0", "<")
    for suite in suites:
        texts = [suite.title, *suite.text.replace("`", "").split("\n\n")]
        for table in suite.tables:
            texts += [table.title, table.note]
            texts += [x for y in format_columns(table) for x in (y.heading, *y.texts)]
        shown = [*suite.answers, *suite.figures]
        texts += [text.replace("`", "") for title, _, caption in shown for text in (title, caption)]
        texts += suite.verdict.replace("`", "").splitlines()
        for text in texts:
            assert text in plain
    assert COMMAND in plain
    for name, version in VERSIONS.items():
        assert f"{name} {version}" in plain
    assert "<code>exact-kf</code>" in page


def test_one_answer_comes_first_and_each_verdict_with_its_suite(tmp_path: Path) -> None:
    """The matrix's answer where it was run, in three sentences, though another suite was first."""
    suites = [estimation(), control()]
    suites[1].verdict = "First. It is so. \nSecond, `lqr`.\nThird.\nFourth."
    suites[1].answers = [answered(), answered()]
    page = written(tmp_path, suites)
    marks = ['<section id="answer">', "<nav", '<section id="suite-1">', '<section id="suite-2">']
    places = [page.index(text) for text in marks]
    assert places == sorted(places)
    opening, _, first, second = (
        page[start:end] for start, end in zip(places, [*places[1:], None], strict=True)
    )
    assert re.findall("<p class=.lead.>(.*?)</p>", opening) == [
        "First. It is so.  Second, <code>lqr</code>. Third."
    ]
    assert opening.count("<figure") == 1 and "Fourth." not in opening
    assert all(_mark_code(line) in first for line in suites[0].verdict.splitlines())
    assert all(_mark_code(line) in second for line in suites[1].verdict.splitlines())
    assert second.count("<figure") == 1  # the other one
    asked = [title for title, *_ in suites[0].answers]
    assert asked == re.findall("<h3>(.*?)</h3>", first)[: len(asked)]
    for link in re.findall('href="#(.*?)"', page):
        assert page.count(f'id="{link}"') == 1


def test_tables_are_folded_and_scroll_and_many_figures_are_folded_too(tmp_path: Path) -> None:
    suites = [estimation(), control()]
    page = written(tmp_path, suites)
    tables = sum(len(suite.tables) for suite in suites)
    folded = re.findall(r'<details><summary>.*?</summary>\n<div class="scroll"', page)
    assert len(folded) == page.count("<table") == tables
    assert f"<summary>{len(suites[0].figures)} figures</summary>" in page
    assert "<details open" not in page


def test_plotly_is_there_once_and_packed(tmp_path: Path) -> None:
    suites = [estimation(), estimation()]
    page = written(tmp_path, suites)
    assert page.count('data-name="plotly"') == 1
    assert len(re.findall(r"<script>", page)) == 1
    figures = sum(len(suite.figures) + len(suite.answers) for suite in suites)
    assert page.count('data-name="figure"') == figures
    library = unpacked(page, "plotly")[0]
    assert library.count("plotly.js v") == 1


def test_only_our_scripts_may_run(tmp_path: Path) -> None:
    """By their hashes: a text that got past the escaping could not run."""
    page = written(tmp_path)
    policy = re.search('Content-Security-Policy" content="(.*?)"', page)
    assert policy is not None
    allowed = re.search("script-src (.*?);", policy[1])
    assert allowed is not None and "unsafe" not in allowed[1]
    (script,) = re.findall("<script>(.*?)</script>", page, flags=re.DOTALL)
    for text in (script, *unpacked(page, "plotly")):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in allowed[1]
    assert "default-src 'none'" in policy[1] and "connect-src" not in policy[1]


def test_without_figures_plotly_is_not_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    page = written(tmp_path, [control(), estimation(figures=False)])
    assert "multirate-kf" in page and 'data-name="plotly"' not in page


def test_nothing_comes_from_the_network(tmp_path: Path) -> None:
    page = written(tmp_path)
    assert "default-src 'none'" in page
    outside = without_scripts(page)
    assert re.findall(r"https?://", outside) == []
    assert set(re.findall(r'(?:src|href)="([^"#][^"]*)"', outside)) == {"data:,"}
    assert "@import" not in outside
    assert "url(" not in outside


def test_a_report_of_sixty_figures_is_below_four_megabytes(tmp_path: Path) -> None:
    """As many as a quick run of all suites has, and noisier; plotly.js is half of it."""
    suite = estimation()
    suite.figures = suite.figures * 12
    page = written(tmp_path, [suite, matrix()])
    assert len(page.encode()) < 4e6
    assert max(map(len, unpacked(page, "figure"))) < 7 * 2 * 1000 * 6
    assert '"template"' not in "".join(unpacked(page, "figure"))


def test_every_cell_is_there_thinned(tmp_path: Path) -> None:
    suite = matrix()
    (text,) = unpacked(written(tmp_path, [suite]), "explorer")
    found = json.loads(text)
    assert [tuple(key) for key, _ in found["cells"]] == list(suite.explorers[0].cells)
    assert found["pair"] == ["none", HOSTILE]
    assert set(found["colours"]) == {"none", "lqr", HOSTILE}
    signals = found["cells"][0][1]
    assert len(signals["t"]["steps"]) == len(signals["beta"]["steps"]) == report.POINTS


def test_columns_of_numbers_are_marked_for_sorting(tmp_path: Path) -> None:
    cells: list[Any] = [
        ["b", 9.5, (1.0, 4.0)],
        ["a", Estimate(1e3, 9.0, 1.1e4), "x"],
        ["c", None, (2.0, 3.0)],
    ]
    cells.append(["d", np.inf, np.nan])
    columns = ("n", Column("v", scale=0.01), Column("m", form="{:.0f} of {:.0f}"))
    page = written(tmp_path, [Suite("s", "S", "", tables=[ResultTable("t", columns, cells)])])
    heads = re.findall(r'<th scope="col" aria-sort="none"(.*?)><button', page)[:3]
    assert heads == ["", ' class="number"', ""]
    assert re.findall('data-value="(.*?)"', page)[:3] == ["0.095", "10.0", "Infinity"]


@pytest.mark.parametrize(
    ("cell", "column", "text"),
    [
        ("a text", Column("x"), "a text"),
        (0.0125, Column("x", scale=1e3, form=".1f"), "12.5"),
        (3, Column("x"), "3"),
        (np.float64(-np.inf), Column("x"), "-inf"),
        (Estimate(0.5, 0.25, 1.0), Column("x", scale=100.0, form=".0f"), "50 [25, 100]"),
        (Estimate(0.5, 0.25, 1.0), Column("x", interval=False), "0.5"),
        (Estimate(0.5), Column("x", form=".2f"), "0.50"),
        ((0.5, 7), Column("x", form="{:.1f} ({:.0f})"), "0.5 (7)"),
        (None, Column("x"), ""),
        (np.nan, Column("x"), ""),
        (Estimate(np.nan), Column("x"), ""),
    ],
)
def test_a_cell_is_formatted_as_its_column_says(cell: Any, column: Column, text: str) -> None:
    assert _format_cell(cell, column) == text


def test_failure_leaves_the_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = written(tmp_path, [control()])
    monkeypatch.setattr(report, "_encode_figure", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_report(tmp_path / "report.html", [estimation()], COMMAND, VERSIONS)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == before


def values_of(entry: dict[str, Any]) -> np.ndarray:
    """As the page reads steps."""
    at, found = 0, []
    for step in entry["steps"]:
        at += step or 0
        found.append(np.nan if step is None else entry["from"] + entry["by"] * at)
    return np.array(found)


@pytest.mark.parametrize("offset", [0.0, 1.6e9])
def test_a_line_comes_back_within_half_a_quantum(offset: float) -> None:
    y = offset + np.random.default_rng(0).normal(size=1000)
    y[100:200] = np.nan
    found = values_of(_encode_steps(y, levels=2048))
    half = 0.51 * np.ptp(y[~np.isnan(y)]) / 2047
    np.testing.assert_allclose(found, y, rtol=0.0, atol=half)
    assert _encode_steps([])["steps"] == []
    np.testing.assert_array_equal(values_of(_encode_steps([2.0, 2.0])), [2.0, 2.0])
    assert _encode_steps([np.nan, np.nan])["steps"] == [None, None]


def test_a_figure_is_steps_where_its_lines_are_long() -> None:
    t: np.ndarray = np.arange(2000) * 0.01
    text = _encode_figure(figures.draw_time_series(t, {"dakf": np.sin(t)}, "angle / rad"))
    found = json.loads(text)
    assert "template" not in found["layout"] and "title" not in found["layout"]
    x, y = (values_of(found["data"][0][axis]) for axis in "xy")
    np.testing.assert_allclose(y, np.sin(x), atol=0.01)
    assert len(text) < 10_000
    short = json.loads(_encode_figure(figures.draw_curves(t[:5], {"dakf": t[:5]}, "x", "y")))
    assert "steps" not in short["data"][0]["x"]


COST = Column("cost", form=".0f")
PAGE = """# Words before

<!-- tables of one -->
old
<!-- end -->

<!-- tables of other -->
of another run
<!-- end -->
Words behind, with a \\1 in them.
"""


def page_suite(name: str = "one") -> Suite:
    made = Suite(name, "", "")
    made.tables = [
        ResultTable("First", ("who", COST), [["a|b", Estimate(1, 0, 2)], ["c", "-"]], "Of two."),
        ResultTable("Left out", ("who",), [["d"]], detail=True),
    ]
    return made


def test_a_table_is_markdown() -> None:
    text = "## First\n\n| who | cost |\n|---|---|\n| a\\|b | 1 [0, 2] |\n| c | - |\n\nOf two.\n"
    assert _format_page_table(page_suite().tables[0]) == text


def test_a_long_note_is_wrapped_between_words() -> None:
    words = ["a-long-name-" * 3, "no", "camera", "from", "2", "to", "7", "s;"] * 6
    table = ResultTable("First", ("who",), [["c"]], " ".join(words))
    lines = _format_page_table(table).splitlines()[5:]
    assert len(lines) > 2 and max(map(len, lines)) <= 120 and " ".join(lines).split() == words


def test_only_what_stands_between_the_marks_changes(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    check_page(page, ["one", "absent"])
    write_page(page, [page_suite(), page_suite("absent")])
    made = _format_page_table(page_suite().tables[0])
    assert page.read_text() == PAGE.replace("old\n", f"\n{made}\n")
    once = page.read_text()
    write_page(page, [page_suite()])
    assert page.read_text() == once
