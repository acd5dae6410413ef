"""The report: complete, escaped, self-contained, sortable, never half-written."""

import os
import re
import sys
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.harness.results import Suite, Table
from sideslip.benchmarks.report import html as report
from sideslip.benchmarks.report.html import number, write_report

from .demo import COMMAND, HOSTILE, VERSIONS, control, drawn, estimation


def written(path: Path, suites: list[Suite] | None = None) -> str:
    target = path / "report.html"
    write_report(target, suites or [estimation(), control()], COMMAND, VERSIONS)
    assert [p.name for p in path.iterdir()] == ["report.html"]
    return target.read_text(encoding="utf-8")


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
            texts += [table.title, table.note, *table.header]
            for row in table.cells:
                texts += row
        texts += [text for title, _, caption in suite.figures for text in (title, caption)]
        for text in texts:
            assert text in plain
    assert COMMAND in plain
    for name, version in VERSIONS.items():
        assert f"{name} {version}" in plain
    assert "<code>exact-kf</code>" in page


def test_summary_is_the_first_two_tables_of_each_suite(tmp_path: Path) -> None:
    suites = [estimation(figures=False), control()]
    page = written(tmp_path, suites)
    summary = page.split('<section id="summary">')[1].split("</section>")[0]
    assert re.findall('<p class="caption">(.*?)</p>', summary) == [
        table.title for suite in suites for table in suite.tables[:2]
    ]
    assert max(len(suite.tables) for suite in suites) > 1
    for link in re.findall('href="#(.*?)"', page):
        assert page.count(f'id="{link}"') == 1


def test_plotly_is_there_once_and_only_for_figures(tmp_path: Path) -> None:
    suites = [estimation(), estimation()]
    page = written(tmp_path, suites)
    assert page.count("plotly.js v") == 1
    plain = re.findall(r"<script>", page)
    assert len(plain) == 2
    assert page.count('<script type="application/json">') == 2 * len(suites[0].figures)
    assert "plotly.js v" not in written(tmp_path, [estimation(figures=False)])


def test_a_report_without_figures_needs_no_plotly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    assert "multirate-kf" in written(tmp_path, [control(), estimation(figures=False)])


def test_nothing_comes_from_the_network(tmp_path: Path) -> None:
    page = written(tmp_path)
    assert "default-src 'none'" in page
    outside = without_scripts(page)
    assert re.findall(r"https?://", outside) == []
    assert set(re.findall(r'(?:src|href)="([^"#][^"]*)"', outside)) == {"data:,"}
    assert "@import" not in outside
    assert "url(" not in outside


def test_figures_are_small(tmp_path: Path) -> None:
    figures = drawn()
    page = written(tmp_path, [estimation()])
    datas = re.findall(r'<script type="application/json">(.*?)</script>', page)
    assert len(datas) == len(figures)
    assert max(map(len, datas)) < 7 * 2 * 2000 * 4 * 1.4
    assert '"template"' not in "".join(datas)


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ("0.31", 0.31),
        ("-2", -2.0),
        ("\u22122.5 N m", -2.5),
        ("1,250.5", 1250.5),
        ("12 %", 12.0),
        ("0.60x", 0.6),
        ("3e-2", 0.03),
        ("< .5", 0.5),
        ("[0.29, 0.33]", 0.29),
        ("0.29 .. 0.33", 0.29),
        ("inf", np.inf),
        ("-inf", -np.inf),
        ("", None),
        ("nan", None),
        ("-", None),
        ("multirate-kf", None),
        ("2-dof", None),
        ("information", None),
    ],
)
def test_number_of_a_cell(cell: str, expected: float | None) -> None:
    assert number(cell) == expected


def test_columns_of_numbers_are_marked_for_sorting(tmp_path: Path) -> None:
    cells = [["b", "9.5", "1"], ["a", "10 [9, 11]", "x"], ["c", "-", "2"], ["d", "inf", ""]]
    page = written(tmp_path, [Suite("s", "S", "", tables=[Table("t", ("n", "v", "m"), cells)])])
    heads = re.findall(r'<th scope="col" aria-sort="none"(.*?)><button', page)[:3]
    assert heads == ["", ' class="number"', ""]
    assert re.findall('data-value="(.*?)"', page)[:3] == ["9.5", "10.0", "Infinity"]


def test_wrong_tables_and_empty_reports_are_refused(tmp_path: Path) -> None:
    wrong = Suite("s", "S", "", tables=[Table("short row", ("a", "b"), [["1"]])])
    with pytest.raises(ValueError, match=r"short row.*1 cells under 2 headers"):
        written(tmp_path, [wrong])
    with pytest.raises(ValueError, match="at least one suite"):
        write_report(tmp_path / "report.html", [], COMMAND, VERSIONS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("failing", ["drawing", "disk"])
def test_failure_leaves_the_old_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    before = written(tmp_path, [control()])

    def fail(*_: Any, **__: Any) -> Any:
        raise OSError("No space left on device")

    if failing == "drawing":
        monkeypatch.setattr(report, "_json", fail)
    else:
        monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        write_report(tmp_path / "report.html", [estimation()], COMMAND, VERSIONS)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == before
