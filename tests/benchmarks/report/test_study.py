"""The skeleton of suites: numbers of seeds, optional modules, finished cases, rows of records."""

from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.harness.results import Suite
from sideslip.benchmarks.harness.stats import Estimate
from sideslip.benchmarks.report.study import Request, Study


def run(request: Request, **options: Any) -> Suite:
    def add_tables(suite: Suite, seeds: int) -> None:
        suite.add_rows([{"controller": "lqr", "cost": float(seeds)}], scenario="gust")

    study = Study("s", "S?", "Text.", (8, 2), lambda r: r.episodes, add_tables, str, **options)
    return study.run(request)


@pytest.mark.parametrize(
    ("request_", "seeds"),
    [(Request(), "8"), (Request(quick=True), "2"), (Request(quick=True, episodes=5), "5")],
)
def test_a_study_runs_the_seeds_that_are_asked_for(request_: Request, seeds: str) -> None:
    suite = run(request_)
    assert suite.verdict == seeds and suite.rows[0].value == float(seeds)


def test_a_study_without_its_module_says_so() -> None:
    suite = run(Request(), needs=("no_such_module", "Not run."))
    assert suite.verdict == "Not run." and suite.rows == []


def test_pictures_are_drawn_where_plotly_is(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    run(Request(), add_figures=lambda *arguments: drawn.append(arguments))
    assert drawn[0][1] == 8 and drawn[0][2].draw_groups
    monkeypatch.setattr("sideslip.benchmarks.report.study.import_figures", lambda: None)
    run(Request(), add_figures=lambda *arguments: drawn.append(arguments))
    assert len(drawn) == 1


def test_metrics_of_a_record_become_rows() -> None:
    """What is no metric is for tables alone; a number that is not finite has no row."""
    suite = Suite("s", "S", "")
    record = {"estimator": "dakf", "rmse": Estimate(1.0, 0.5, 2.0), "note": "none", "rank": None}
    suite.add_rows([record | {"cost": np.float64(3), "gap": np.nan}], "Id-v0", scenario="a", n=7)
    rmse, cost = suite.rows
    assert (rmse.suite, rmse.estimator, rmse.scenario, rmse.n) == ("s", "dakf", "a", 7)
    assert (rmse.metric, rmse.value, rmse.low, rmse.high) == ("rmse", 1.0, 0.5, 2.0)
    assert (cost.metric, cost.value, cost.salt) == ("cost", 3.0, "fixed")
    assert cost.env_version.startswith("Id-v0 ")


def test_seeds_are_run_in_chunks_of_each_condition() -> None:
    def square(case: tuple[int, Any]) -> list[dict[str, tuple[float, float]]]:
        assert len(case[1]) <= 2
        return [{"a": (case[0], seed), "b": (0.0, 1.0)} for seed in case[1]]

    one, other = Request(jobs=1).run_seeds(square, (3, 4), 5, 2, "")
    assert [drive["a"] for drive in one] == [(3, 0), (3, 1), (3, 2), (3, 3), (3, 4)]
    assert [drive["a"][0] for drive in other] == [4] * 5 and other[0]["b"] == (0.0, 1.0)
