"""The README's table of the matrix is that of its file, line by line."""

from dataclasses import replace
from pathlib import Path

import pytest

from sideslip.benchmarks import readme
from sideslip.benchmarks.control.contests import STATE, TITLES
from sideslip.benchmarks.harness.results import Row

ROOT = Path(readme.__file__ or "").resolve().parents[1]


def test_the_table_in_the_readme_is_made_from_the_file() -> None:
    text, rows = (ROOT / readme.README).read_text(), readme.tier_rows(ROOT / readme.ROWS)
    assert readme.put(text, readme.table(rows)) == text
    other = [replace(row, value=1.5 * row.value) for row in rows]
    assert readme.put(text, readme.table(other)) != text
    kept = {row.scenario: row.n for row in rows if row.controller == STATE}
    assert all(f" {n}" in text for n in kept.values()), kept  # what its prose says of the episodes


def test_a_line_has_every_tier_with_cost_interval_and_failures() -> None:
    assert set(readme.HEADS) == set(TITLES)
    cost = Row("control", "tier 2a", "cost_vs_nominal", 0.5, "", "none", 0.4, 0.6, 12)
    rows = [cost, replace(cost, metric="failure_rate", value=0.07)]
    (line,) = (line for line in readme.table(rows).splitlines() if line.startswith("| no control"))
    assert line == "| no control |  | 50 [40, 60] (7) |  |  |"
    with pytest.raises(ValueError, match="no table that begins with the tiers"):
        readme.put("# a README", line)
