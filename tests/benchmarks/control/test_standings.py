"""Standings: failures first, the best first, findings and the answer; what went wrong is said."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.control.entries import REFERENCE_FILTER, Entry
from sideslip.benchmarks.control.report import _group_agents, compose_verdict
from sideslip.benchmarks.control.run import NUMBERS, DriveResult, Results
from sideslip.benchmarks.control.score import Standing, make_score_scales, rank_entries
from sideslip.benchmarks.control.tables import (
    Matrix,
    _describe_findings,
    _make_knowledge_table,
    _make_main_table,
    _make_motion_table,
    _make_oracle_table,
    _select_cheaper,
    list_failures,
    make_task_table,
)
from sideslip.benchmarks.control.tasks import NOMINAL, PARAMETERS, STATE, ControlTask
from sideslip.benchmarks.harness.metrics import EPISODE
from sideslip.benchmarks.harness.results import ResultRow, ResultTable, Suite
from sideslip.benchmarks.report.tables import format_columns
from sideslip.envs import FAILURES

ONE, TWO = ControlTask("1", scenario="gust"), ControlTask("1", scenario="straight")
BEST = {NOMINAL: 8.0, PARAMETERS: 4.0, STATE: 1.0, "lqr": 2.0, "esc": 6.0, "none": 12.0}
COST, FAILURE = NUMBERS.index("cost"), NUMBERS.index("failure")


def episodes(level: float, failed: int = 0, code: str = "spin", n: int = 40) -> DriveResult:
    """Costs about a level on common seeds, the first of which failed."""
    seeds, own = np.random.default_rng(0), np.random.default_rng(int(100 * level))
    numbers = np.ones((n, len(NUMBERS)))
    numbers[:, COST] = level * seeds.lognormal(0.0, 1.0, n) * own.lognormal(0.0, 0.1, n)
    numbers[:, FAILURE] = np.where(np.arange(n) < failed, FAILURES.index(code), 0)
    return DriveResult(numbers, 1.0)


def undriven(error: str) -> DriveResult:
    return DriveResult(np.full((40, len(NUMBERS)), np.nan), np.nan, error=error)


def results(*contests: ControlTask, **failed: int) -> Results:
    found: Results = {}
    for contest in contests or (ONE, TWO):
        for who, level in BEST.items():
            filter_ = REFERENCE_FILTER if who in ("lqr", "esc") else ""
            found[contest, Entry(who, filter_)] = episodes(level, failed.get(who, 0))
        found[contest, Entry("lqr", "dakf")] = episodes(3.0)
    return found


def table(found: Results, *contests: ControlTask) -> list[Standing]:
    return rank_entries(found, "1", make_score_scales(found, contests or (ONE, TWO)))


def rows(standing: Standing) -> list[ResultRow]:
    suite = Suite("control", "", "")
    standing.add_rows(suite, "ab")
    return suite.rows


def texts(shown: ResultTable) -> list[tuple[str, ...]]:
    """Lines as people read them."""
    return list(zip(*(column.texts for column in format_columns(shown)), strict=True))


def matrix(found: Results, **more: Any) -> Matrix:
    return Matrix(found, {"1": table(found)}, **more)


def test_the_best_come_first_with_their_numbers() -> None:
    standing = table(results())
    labels = [each.entry.agent for each in standing]
    assert labels == [STATE, "lqr", "lqr", PARAMETERS, "esc", NOMINAL, "none"]
    lqr = standing[1].overall
    assert lqr["score"].value == pytest.approx(2.0 / 3.0, abs=0.02)  # log 4 / log 8
    assert lqr["cost_vs_nominal"].value == pytest.approx(0.25, rel=0.05)
    assert lqr["share_won"].value == 1.0
    assert standing[5].overall["score"] == pytest.approx((0.0, 0.0, 0.0))
    assert standing[1].n == 80 and standing[1].excluded == 0


def test_won_are_episodes_that_count() -> None:
    """Of those that nominal fails nothing is compared, cheap as they may be."""
    found = results(nominal=8)
    for (_, entry), driven in found.items():
        if entry.agent == "lqr":
            driven.numbers[:8, COST] = 1e3  # lost, where nominal fails
    lqr = next(each for each in table(found) if each.entry.agent == "lqr")
    assert lqr.n == 64 and lqr.overall["share_won"].value == 1.0
    assert all(each["share_won"].value == 1.0 for each in lqr.by_task.values())


def test_failures_are_of_all_episodes_and_rank_where_nominal_fails_often() -> None:
    some = results(nominal=2, lqr=3)
    standing = {each.label: each for each in table(some)}
    lqr = standing[f"lqr on {REFERENCE_FILTER}"]
    assert lqr.overall["failure_rate"].value == 3 / 40
    assert (lqr.n, lqr.excluded) == (76, 4)
    assert [each.entry.agent for each in table(some)][:2] == [STATE, "lqr"]
    often = results(nominal=6, lqr=30)
    assert [each.entry.agent for each in table(often)][-1] == "lqr"  # the one that failed
    found = _make_main_table("", table(often))
    assert found.header[1] == "fails / %"
    rates = [line["failure_rate"].value for line in found.cells]
    assert rates == sorted(rates)


@pytest.mark.parametrize("filter_, best", [("joint", "adaptive-lqr"), ("dakf", "lqr")])
def test_an_adaptive_controller_is_compared_on_the_filter_it_follows(
    filter_: str, best: str
) -> None:
    found = results()
    for contest in (ONE, TWO):
        found[contest, Entry("adaptive-lqr", filter_)] = episodes(1.5)
    assert _group_agents({"1": table(found)}).find_best() == best


def test_a_cell_that_was_not_driven_says_so_and_the_rest_goes_on() -> None:
    found = results()
    cell = (TWO, Entry("lqr", "dakf"))
    found[cell] = undriven("no GPS")
    standing = next(each for each in table(found) if each.entry.estimator == "dakf")
    assert np.isfinite(standing.overall["score"].value)
    assert texts(_make_main_table("", [standing]))[0][6] == "1 of 2"
    assert texts(make_task_table("", [standing], [ONE, TWO]))[0][2] == "not driven"
    assert ["1", TWO.name, "lqr on dakf", "not driven: no GPS"] in list_failures(found)
    assert all(np.isfinite(row.value) for row in rows(standing))


def test_a_contest_in_which_every_car_fails_counts_nowhere_and_says_so() -> None:
    found = results()
    for who in (NOMINAL, STATE):
        found[TWO, Entry(who)] = episodes(9.0, 40)
    standing = table(found)
    assert all(len(each.pairs) == 1 for each in standing)
    shown = texts(make_task_table("", standing, [TWO]))
    assert (NOMINAL, "no episode counts (100)") in shown
    assert ("none", "no episode counts (0)") in shown
    lines = texts(_make_oracle_table(matrix(found)))
    none = "no episode that nominal and oracle-state survive"
    assert [line[-1] for line in lines] == ["yes", none]
    assert ["1", TWO.name, NOMINAL, "every car fails"] in list_failures(found)
    assert all(np.isfinite(each.overall["score"].value) for each in standing)


def test_a_rung_that_cannot_be_computed_leaves_its_contest_without_score() -> None:
    found = results()
    found[TWO, Entry(STATE)] = undriven("no plant")
    standing = table(found)
    lqr = next(each for each in standing if each.entry.agent == "lqr")
    assert list(lqr.pairs) == [ONE] and np.isfinite(lqr.overall["score"].value)
    assert texts(make_task_table("", [lqr], [TWO]))[0][1].startswith("no yardstick")
    assert texts(_make_oracle_table(matrix(found)))[1][-1] == "no plant"


def test_a_nan_of_a_contestant_is_a_failure_that_is_not_the_cars() -> None:
    found = results()
    found[ONE, Entry("lqr", "dakf")] = episodes(3.0, 10, "bad-action")
    assert ["1", ONE.name, "lqr on dakf", "bad-action 25.0 %"] in list_failures(found)
    standing = next(each for each in table(found) if each.entry.estimator == "dakf")
    assert standing.by_task[ONE]["bad_action_rate"].value == 0.25
    assert standing.overall["score"].value < 0.35


def test_nothing_to_win_is_said() -> None:
    found = results()
    for who in (NOMINAL, STATE):
        found[TWO, Entry(who)] = episodes(5.0)
    (cells,) = texts(make_task_table("", table(found)[:1], [TWO]))
    assert cells[1].startswith("nothing to win here")
    assert texts(_make_oracle_table(matrix(found)))[1][-1] == "nothing to win here"


def test_who_is_above_the_oracle_is_a_finding() -> None:
    assert _describe_findings(table(results())) == []
    found = results()
    for contest in (ONE, TWO):
        found[contest, Entry("lqr", "dakf")] = episodes(0.5)
    (said,) = _describe_findings(table(found))
    assert "lqr on dakf costs less than oracle-state in tier 1" in said


def test_who_is_surely_below_the_clairvoyant_is_named() -> None:
    rng = np.random.default_rng(0)
    leads = [rng.normal(0.3, 0.3, 64), rng.normal(-0.3, 0.3, 64), rng.normal(0.0, 0.3, 64)]
    assert _select_cheaper(["above", "below", "level"], leads) == ["below"]
    many = [rng.normal(0.0, 0.3, 64) for _ in range(40)]
    assert _select_cheaper([str(k) for k in range(40)], many) == []


def test_the_ladders_steps_are_ratios_of_costs() -> None:
    ahead = {(ONE, Entry(STATE)): np.full(8, np.log(1.5))}
    made = _make_knowledge_table(matrix(results(), regrets=ahead))
    numbers = [float(text.split(" ")[0]) for text in texts(made)[0][1:]]
    assert numbers == pytest.approx([2.0, 4.0, 1.5], rel=0.05)
    assert texts(_make_knowledge_table(matrix(results())))[0][3] == ""


def test_the_answer_names_the_best_and_by_how_much() -> None:
    _, controller, estimator, why, rest = compose_verdict(matrix(results())).splitlines()
    best = REFERENCE_FILTER.replace(", ", " with ")
    assert f"controller, {best} costs least, 6" in estimator and "as much as dakf" in estimator
    assert "controllers lqr costs least, 33 % [" in controller and "as much as esc" in controller
    assert ", and 16 % as much as no control." in controller  # 2 / 12
    assert "true car and road saves 50 %, then its exact motion saves 7" in why
    assert "40 episodes a contest" in rest


def test_the_answer_calls_a_tie_a_tie_and_names_who_leads_elsewhere() -> None:
    found, other = results(), results()
    for contest in (ONE, TWO):
        found[contest, Entry("lqr", "dakf")] = episodes(2.0)
        other[contest, Entry("esc", REFERENCE_FILTER)] = episodes(1.5)
        found[contest, Entry("esc", REFERENCE_FILTER)] = episodes(60.0)
    _, _, estimator, *_ = compose_verdict(matrix(found)).splitlines()
    assert "cost least, too close to tell apart" in estimator and "dakf" in estimator
    two = [replace(each, scales=table(found)[0].scales) for each in table(found)]
    elsewhere = {ControlTask("2", scenario=c.scenario): c for c in (ONE, TWO)}
    for each, there in zip(two, [{e.label: e for e in table(other)}] * len(two), strict=True):
        each.__dict__["pairs"] = {k: there[each.label].pairs[c] for k, c in elsewhere.items()}
    *_, rest = compose_verdict(Matrix(found, {"1": table(found), "2": two})).splitlines()
    assert rest.startswith("It costs less with esc in tier 2. ")


def test_who_drives_a_part_of_the_contests_is_not_the_best_but_is_named() -> None:
    """A policy of one class of contests, however little it costs there."""
    found = results()
    found[TWO, Entry("distill-car-yaw", "joint")] = episodes(1.2)
    _, controller, *_, rest = compose_verdict(matrix(found)).splitlines()
    assert "controllers lqr costs least, 33 % [" in controller
    assert rest.startswith("It costs less with distill-car-yaw on its own manoeuvres. ")
    found[ONE, Entry("distill-car-yaw", "joint")] = episodes(1.2)
    _, controller, *_, rest = compose_verdict(matrix(found)).splitlines()
    assert "controllers distill-car-yaw costs" in controller and rest.startswith("Not covered")


def test_without_an_episode_that_counts_nobody_wins() -> None:
    found = results()
    for contest in (ONE, TWO):
        found[contest, Entry(STATE)] = episodes(9.0, 40)
    _, controller, estimator, *_ = compose_verdict(matrix(found)).splitlines()
    assert "nobody has a score" in estimator and "nobody has a score" in controller


def test_a_metric_of_the_table_has_its_rows_and_its_column() -> None:
    standing = table(results())
    metrics = {row.metric for row in rows(standing[0])}
    assert {metric.name for metric in EPISODE} - {"failure"} <= metrics
    shown = _make_motion_table("", standing)
    for metric in EPISODE:
        if metric.heading:
            column = list(shown.header).index(metric.heading)
            value = float(texts(shown)[0][column]) / metric.scale
            assert value == pytest.approx(standing[0].mean(metric.name), abs=0.5 / metric.scale)
