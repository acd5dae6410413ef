"""`sideslip bench memory`: what it says is what was measured, and what is kept is found again."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
from sideslip.agents.training.recurrent import MEMORIES
from sideslip.benchmarks.harness.results import Suite
from sideslip.benchmarks.harness.verdict import LETTERS, LINES
from sideslip.benchmarks.report import study
from sideslip.benchmarks.report.study import Request, StoredFunction
from sideslip.benchmarks.studies import recurrent
from sideslip.benchmarks.studies.recurrent import (
    CONDITIONS,
    FILTER,
    LQG_FACTOR,
    PPO,
    REPEATED,
    Budget,
    MemoryCase,
    MemoryResult,
    _run_case,
)

TINY = Budget(cars=4, rounds=1, epochs=1, ppo=0, duration=1.0)


def test_a_quick_run_has_its_rows_and_nobody_beats_the_optimum(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(recurrent, "QUICK", TINY)
    request = Request(quick=True, episodes=4, jobs=1, keep=tmp_path)
    found = recurrent.STUDY.run(request)
    rows = {row.controller: row for row in found.rows}
    assert set(rows) == {FILTER, "mlp", "frames", "gru", "linear-rnn", "kalman", "transformer"}
    for who, row in rows.items():
        assert row.n == 4 * (LQG_FACTOR if who == FILTER else 1) and row.metric == "gap"
        assert row.low <= row.value <= row.high and (who == FILTER or row.low > 0.0)
    assert abs(rows[FILTER].value) < 0.5  # 32 short episodes scatter by 0.12
    assert [cells["memory"] for cells in found.tables[0].cells] == list(rows)
    assert found.verdict and not found.answers
    monkeypatch.setattr(recurrent, "_run_case", None)  # so that a second run trains nobody
    again = recurrent.STUDY.run(request)
    assert again.rows == found.rows and again.tables == found.tables


def test_what_is_kept_is_of_one_case_and_a_damaged_file_is_made_anew(tmp_path: Path) -> None:
    kept = StoredFunction(_run_case, tmp_path, recurrent._STORAGE)
    case = MemoryCase(FILTER, REPEATED, 0, TINY, 1)
    first = kept(case)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:100])
    assert np.array_equal(kept(case).costs, first.costs)
    other = kept(MemoryCase(FILTER, "0 ms", 0, TINY, 1))
    assert len(list(tmp_path.iterdir())) == 2 and other.best < first.best


def test_learning_from_rewards_is_judged_alike() -> None:
    found = _run_case(MemoryCase(PPO, REPEATED, 0, Budget(ppo=1000, duration=0.2), 2))
    assert found.steps == 1000 and found.seconds > 0.0 and (found.excess > 0.0).all()


def test_a_full_run_is_everybody_everywhere_and_some_seeds() -> None:
    full, quick = recurrent._make_cases(False), recurrent._make_cases(True, 5)
    learners = {each.learner for each in full} - {FILTER, PPO}
    for where in CONDITIONS:
        seeds = {(each.learner, each.seed) for each in full if each.condition == where}
        assert seeds >= {(who, 0) for who in (*learners, FILTER)}
        assert ((PPO, 0) in seeds) == (where == REPEATED)
        assert len(seeds) == 6 * (3 if where == REPEATED else 1) + 1 + (where == REPEATED)
    assert {each.condition for each in quick} == {REPEATED} and {e.episodes for e in quick} == {5}
    assert [MemoryCase("", where, 0, TINY, 1).delay_steps for where in CONDITIONS] == [
        10,
        30,
        0,
        10,
        30,
    ]


def made(gaps: Mapping[str, float]) -> dict[str, dict[str, list[MemoryResult]]]:
    """Results whose gaps are known."""
    rng, results = np.random.default_rng(0), dict[str, dict[str, list[MemoryResult]]]()
    for who, gap in gaps.items():
        count = 16 * (LQG_FACTOR if who == FILTER else 1)
        excess = gap * rng.uniform(0.9, 1.1, count)
        costs = 1.0 + excess + 0.05 * rng.standard_normal(count)
        numbers = (np.array(each) for each in (1.0, 12.0, 1e5))
        found = [MemoryResult(excess, costs, *numbers)]
        results[who] = {where: found for where in CONDITIONS}
    return results


def test_the_verdict_ranks_and_the_figure_has_a_line_each() -> None:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    results = made({FILTER: 0.0, "mlp": 2.0, "gru": 0.25, "kalman": 0.02, PPO: 4.0})
    long = made({FILTER: 0.0, PPO: 4.0, **dict.fromkeys(MEMORIES, 12.3)})
    results[PPO] = {REPEATED: results[PPO][REPEATED]}
    lines = recurrent._make_verdict(results).splitlines()
    assert len(lines) <= LINES
    assert max(map(len, [*lines, *recurrent._make_verdict(long).splitlines()])) <= LETTERS
    assert "kalman 2 %, gru 25 %, mlp 200 %" in lines[0] and "ppo" in lines[2]
    made_suite = Suite("", "", "", verdict="Who wins.")
    recurrent._add_figures(made_suite, results, figures)
    ((_, figure, said),) = made_suite.answers
    assert [trace.name for trace in figure.data] == ["mlp", "gru", "kalman"]
    assert list(figure.data[0].x) == [0.0, 100.0, 300.0] and said == "Who wins."
    plain = recurrent._compute_paired_gap(results["gru"][REPEATED][0], results[FILTER][REPEATED][0])
    assert plain.low < 0.25 < plain.high


def test_without_torch_nobody_is_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "find_spec", lambda name: None)
    found = recurrent.STUDY.run(Request(quick=True))
    assert not found.rows and "sideslip[train]" in found.verdict
