"""The README's table of the matrix is that of its file, line by line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks import readme
from sideslip.benchmarks.control.cells import Cell
from sideslip.benchmarks.control.contests import NOMINAL, STATE, TITLES, contests
from sideslip.benchmarks.control.episodes import Chunk, drive
from sideslip.benchmarks.control.scores import gains
from sideslip.benchmarks.control.seeds import seeds_of_contests
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


def test_a_policy_that_came_later_drives_the_seeds_of_the_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its rows take the place of older ones of its name; everybody else's stay."""
    contest = next(c for c in contests() if c.kind == "coms-model" and c.tier == "1")
    monkeypatch.setattr(readme, "contests", lambda: (contest,))
    state = Row("control", "tier 1", "cost_vs_nominal", 0.3, "", STATE, n=3, salt="5a17")
    old = replace(state, controller="raw-coms-steering")
    first, *new = readme.added([state, old], "raw-coms-steering", jobs=1)
    assert first is state and {row.metric for row in new} == set(readme.METRICS)
    assert {(row.n, row.salt, row.scenario) for row in new} == {(3, "5a17", "tier 1")}
    seeds = tuple(seeds_of_contests("5a17", 3)(contest))
    nominal, own = (
        drive(Chunk(Cell(contest, "", who), seeds)) for who in (NOMINAL, "raw-coms-steering")
    )
    cost = next(row.value for row in new if row.metric == "cost_vs_nominal")
    assert cost == pytest.approx(np.exp(-gains(nominal.costs, own).mean()))
    with pytest.raises(ValueError, match=r"the matrix's policies are .*, got 'lqr'"):
        readme.added([state], "lqr")
