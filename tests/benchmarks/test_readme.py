"""The tables and numbers of README and docs/benchmark.md are those of their files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks import readme
from sideslip.benchmarks.control.run import NUMBERS, DriveResult
from sideslip.benchmarks.control.tasks import (
    NOMINAL,
    STATE,
    TITLES,
)
from sideslip.benchmarks.harness.results import ResultRow, read_json

ROOT = Path(readme.__file__ or "").resolve().parents[1]


def test_the_page_of_the_benchmark_is_made_from_its_file() -> None:
    text, rows = (ROOT / readme.PAGE).read_text(), readme._read_tier_rows(ROOT / readme.ROWS)
    assert readme._replace_table(text, readme.make_table(rows)) == text
    other = [replace(row, value=1.5 * row.value) for row in rows]
    assert readme._replace_table(text, readme.make_table(other)) != text
    kept = {row.scenario: row.n for row in rows if row.controller == STATE}
    assert all(f" {n}" in text for n in kept.values()), kept  # what its prose says of the episodes


def test_the_readme_is_a_door() -> None:
    """At most 900 words; its table is its file's, of nine rows at most."""
    text, rows = (ROOT / readme.README).read_text(), read_json(ROOT / readme.FIRST_ROWS)
    assert len(text.split()) <= 900
    made = readme._make_first_table(rows)
    assert readme._replace_table(text, made) == text and len(made.splitlines()) <= 2 + 9
    episodes = {row.n for row in rows if row.controller == NOMINAL}
    assert f"{readme.EPISODES} drives of each of 21 manoeuvres" in text and len(episodes) > 1


def test_the_headline_numbers_of_the_readme_are_their_files() -> None:
    text = " ".join((ROOT / readme.README).read_text().split())
    assert readme._make_headlines(ROOT) and all(
        line in text for line in readme._make_headlines(ROOT)
    )


def test_a_line_has_every_driven_tier_with_cost_interval_and_failures() -> None:
    assert set(readme.HEADS) > set(TITLES)
    cost = ResultRow("control", "tier road", "cost_vs_nominal", 0.5, "", "none", 0.4, 0.6, 12)
    rows = [cost, replace(cost, metric="failure_rate", value=0.07)]
    rows += [replace(row, scenario="tier limit", controller="esc") for row in rows]
    lines = readme.make_table(rows).splitlines()
    assert lines[0] == "| | road: 60-90 km/h | limit: 70-110 km/h |"
    (line,) = (line for line in lines if line.startswith("| no control"))
    assert line == "| no control | 50 [40, 60] (7) |  |"
    with pytest.raises(ValueError, match="no table that begins with the tiers"):
        readme._replace_table("# a README", line)


def test_an_entry_that_cannot_drive_makes_no_table(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = DriveResult(np.zeros((0, len(NUMBERS))), 0.0, error="no action")
    monkeypatch.setattr(readme, "measure", lambda x, *_, **__: dict.fromkeys(x, wrong))
    with pytest.raises(ValueError, match=r"in .*: no action"):
        readme._measure_first()
