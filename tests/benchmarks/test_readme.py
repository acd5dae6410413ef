"""The tables and numbers of README and docs/benchmark.md are those of their files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sideslip import __version__
from sideslip.benchmarks import readme
from sideslip.benchmarks.control.entries import ControlCase, Entry
from sideslip.benchmarks.control.run import NUMBERS, Chunk, DriveResult, Results, run_chunk
from sideslip.benchmarks.control.score import compute_log_ratios
from sideslip.benchmarks.control.tasks import (
    NOMINAL,
    STATE,
    TITLES,
    list_scored_tasks,
    make_task_seeds,
)
from sideslip.benchmarks.harness.results import ResultRow, read_json, write_json

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


def test_a_line_has_every_tier_with_cost_interval_and_failures() -> None:
    assert set(readme.HEADS) == set(TITLES)
    cost = ResultRow("control", "tier 2a", "cost_vs_nominal", 0.5, "", "none", 0.4, 0.6, 12)
    rows = [cost, replace(cost, metric="failure_rate", value=0.07)]
    lines = readme.make_table(rows).splitlines()
    (line,) = (line for line in lines if line.startswith("| no control"))
    assert line == "| no control |  | 50 [40, 60] (7) |  |  |"
    with pytest.raises(ValueError, match="no table that begins with the tiers"):
        readme._replace_table("# a README", line)


STATE_ROW = ResultRow("control", "tier 1", "cost_vs_nominal", 0.3, "", STATE, n=41, salt="5a17")
STATE_ROW = replace(STATE_ROW, env_version=__version__)
"""Of 14 contests with three seeds each, one of which a rung did not survive."""


def test_a_policy_that_came_later_drives_the_seeds_of_the_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its rows take the place of older ones of its name; everybody else's stay."""
    contest = next(c for c in list_scored_tasks() if c.kind == "coms-model" and c.tier == "1")
    monkeypatch.setattr(readme, "list_scored_tasks", lambda: (contest,))
    state = replace(STATE_ROW, n=3)
    old = replace(state, controller="raw-coms-steering")
    first, *new = readme._add_policy([state, old], "raw-coms-steering", jobs=1)
    assert first is state and {row.metric for row in new} == set(readme.METRICS)
    assert {(row.n, row.salt, row.scenario) for row in new} == {(3, "5a17", "tier 1")}
    seeds = tuple(make_task_seeds("5a17", 3)(contest))
    nominal, own = (
        run_chunk(Chunk(contest, Entry(who), seeds)) for who in (NOMINAL, "raw-coms-steering")
    )
    cost = next(row.value for row in new if row.metric == "cost_vs_nominal")
    assert cost == pytest.approx(np.exp(-compute_log_ratios(nominal.costs, own).mean()))


@pytest.mark.parametrize(
    ("name", "reads", "tiers"),
    [
        ("raw-coms-steering", "", {"tier 1"}),
        ("ppo-coms-yaw", "joint", {"tier 1"}),
        ("raw-car-yaw", "", {"tier 2a", "tier 2b", "tier 2c"}),
    ],
)
def test_it_is_in_every_tier_of_its_class_on_what_it_reads(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, reads: str, tiers: set[str]
) -> None:
    """By the command, with drives that are made up."""

    def measured(asked: list[ControlCase], seeds: Any, **_: Any) -> Results:
        rng = np.random.default_rng(0)
        drives = [rng.uniform(0.5, 1.0, (len(seeds(task)), len(NUMBERS))) for task, _ in asked]
        for numbers in drives:
            numbers[:, NUMBERS.index("failure")] = 0.0
        return {c: DriveResult(each, 0.0) for c, each in zip(asked, drives, strict=True)}

    monkeypatch.setattr(readme, "measure", measured)
    monkeypatch.chdir(tmp_path)
    Path("docs").mkdir()
    readme.PAGE.write_text((ROOT / readme.PAGE).read_text())
    write_json(tmp_path / "rows.json", [STATE_ROW])
    readme._main(tmp_path / "rows.json", [name])
    new = [row for row in readme._read_tier_rows(readme.ROWS) if row.controller == name]
    assert {row.scenario for row in new} == tiers and len(new) == 2 * len(tiers)
    assert {row.estimator for row in new} == {reads}
    if tiers == {"tier 1"}:
        assert {row.n for row in new} == {7 * 3}


def test_rows_that_nobody_can_be_added_to_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"the matrix's policies are .*, got 'lqr'"):
        readme._add_policy([STATE_ROW], "lqr")
    for rows, got in (([], "none"), ([replace(STATE_ROW, env_version="0.1.0")], r"0\.1\.0")):
        message = f"of oracle-state in tier 1, of version .*, got {got}"
        with pytest.raises(ValueError, match=message):
            readme._add_policy(rows, "raw-coms-yaw")
    wrong = DriveResult(np.zeros((0, len(NUMBERS))), 0.0, error="no action")
    monkeypatch.setattr(readme, "measure", lambda x, *_, **__: dict.fromkeys(x, wrong))
    with pytest.raises(ValueError, match=r"in .*: no action"):
        readme._add_policy([STATE_ROW], "raw-coms-yaw")
