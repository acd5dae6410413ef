"""Standings: failures first, the best first, findings and the answer; what went wrong is said."""

from dataclasses import replace

import numpy as np
import pytest

from sideslip.benchmarks.control.entries import REFERENCE_FILTER, Entry
from sideslip.benchmarks.control.run import NUMBERS, DriveResult, Results
from sideslip.benchmarks.control.score import Matrix, Standing, rank_entries
from sideslip.benchmarks.control.suite import _compose_verdict, _name_agent, _rank
from sideslip.benchmarks.control.tables import (
    _LINE,
    _list_upsets,
    _make_motion_table,
    _make_oracle_table,
    make_failure_tables,
    make_main_table,
    make_task_table,
)
from sideslip.benchmarks.control.tasks import NOMINAL, PARAMETERS, STATE, ControlTask
from sideslip.benchmarks.harness.metrics import EPISODE
from sideslip.benchmarks.harness.results import ResultRow, ResultTable, Suite
from sideslip.benchmarks.report.tables import format_columns
from sideslip.envs import FAILURES

ONE, TWO = ControlTask("road", scenario="gust"), ControlTask("road", scenario="straight")
BEST = {NOMINAL: 80.0, PARAMETERS: 40.0, STATE: 10.0, "lqr": 20.0, "esc": 60.0, "none": 120.0}
COST, FAILURE = NUMBERS.index("cost"), NUMBERS.index("failure")


def episodes(level: float, failed: int = 0, code: str = "spin", n: int = 40) -> DriveResult:
    """Costs about a level on common seeds, the first of which failed."""
    seeds, own = np.random.default_rng(0), np.random.default_rng(int(10 * level))
    numbers = np.ones((n, len(NUMBERS)))
    numbers[:, COST] = 10.0 * level * seeds.lognormal(0.0, 1.0, n) * own.lognormal(0.0, 0.1, n)
    numbers[:, FAILURE] = np.where(np.arange(n) < failed, FAILURES.index(code), 0)
    return DriveResult(numbers)


def undriven(error: str) -> DriveResult:
    return DriveResult(np.full((40, len(NUMBERS)), np.nan), error=error)


def results(*contests: ControlTask, **failed: int) -> Results:
    found: Results = {}
    for contest in contests or (ONE, TWO):
        for who, level in BEST.items():
            filter_ = REFERENCE_FILTER if who in ("lqr", "esc") else ""
            found[contest, Entry(who, filter_)] = episodes(level, failed.get(who, 0))
        found[contest, Entry("lqr", "dakf")] = episodes(30.0)
    return found


def table(found: Results) -> list[Standing]:
    return rank_entries(found, "road")


def rows(standing: Standing) -> list[ResultRow]:
    suite = Suite("control", "", "")
    standing.add_rows(suite, "ab")
    return suite.rows


def texts(shown: ResultTable) -> list[tuple[str, ...]]:
    """Lines as people read them."""
    return list(zip(*(column.texts for column in format_columns(shown)), strict=True))


def wrong(found: Results) -> list[list[str]]:
    return [line for shown in make_failure_tables(found) for line in shown.cells]


def test_the_best_come_first_with_their_numbers() -> None:
    standing = table(results())
    labels = [each.entry.agent for each in standing]
    assert labels == [STATE, "lqr", "lqr", PARAMETERS, "esc", NOMINAL, "none"]
    lqr = standing[1].overall
    assert lqr["score"].value == pytest.approx(np.log(4.0), abs=0.08)  # less for J_0, of 0.55
    assert lqr["cost_vs_nominal"].value == pytest.approx(0.25, rel=0.05)
    assert lqr["share_won"].value == 1.0
    assert standing[5].overall["score"] == pytest.approx((0.0, 0.0, 0.0))
    assert standing[1].n == 80


def test_the_line_stands_above_those_alone_who_lose_more_cars() -> None:
    """Who leaves out a task stood below it, and who loses cars, but scores more, above."""
    found = results(nominal=2, lqr=20)
    found[TWO, Entry("none")] = undriven("no")
    labels = [line["label"] for line in make_main_table("", table(found)).cells]
    assert labels[-3:] == ["none", _LINE, f"lqr on {REFERENCE_FILTER}"]


def test_the_better_of_two_default_entries_of_a_name_speaks_for_it() -> None:
    found = results() | {(task, Entry("lqr")): episodes(90.0) for task in (ONE, TWO)}
    (best,) = (x for x in table(found) if x.entry == Entry("lqr", REFERENCE_FILTER))
    gains = _rank(table(found), _name_agent).gains["lqr"]
    assert all((gains[task] == best.scores[task]).all() for task in (ONE, TWO))


def test_won_are_episodes_that_both_finish() -> None:
    """Who finishes a drive that nominal loses has two points for it, whatever it costs."""
    found = results(nominal=8)
    for (_, entry), driven in found.items():
        if entry.agent == "lqr":
            driven.numbers[:8, COST] = 1e3
    lqr = next(each for each in table(found) if each.entry.agent == "lqr")
    assert lqr.n == 80 and lqr.overall["share_won"].value == 1.0
    assert all(each["share_won"].value == 1.0 for each in lqr.by_task.values())
    assert (lqr.scores[ONE][:8] == 2.0).all() and (lqr.scores[ONE][8:] < 2.0).all()


def test_who_loses_a_few_cars_more_stands_above_the_line() -> None:
    some = results(nominal=2, lqr=3)
    standing = {each.entry.label: each for each in table(some)}
    lqr = standing[f"lqr on {REFERENCE_FILTER}"]
    assert lqr.overall["failure_rate"].value == 3 / 40 and lqr.n == 80
    assert [each.entry.agent for each in table(some)][:2] == [STATE, "lqr"]
    assert _LINE not in [line["label"] for line in make_main_table("", table(some)).cells]


@pytest.mark.parametrize("filter_, best", [("joint", "adaptive-lqr"), ("dakf", "lqr")])
def test_an_adaptive_controller_is_compared_on_the_filter_it_follows(
    filter_: str, best: str
) -> None:
    found = results()
    for contest in (ONE, TWO):
        found[contest, Entry("adaptive-lqr", filter_)] = episodes(15.0)
    assert _rank(table(found), _name_agent).find_best() == best


def test_a_cell_that_was_not_driven_says_so_and_the_rest_goes_on() -> None:
    found = results()
    cell = (TWO, Entry("lqr", "dakf"))
    found[cell] = undriven("no GPS")
    standing = next(each for each in table(found) if each.entry.estimator == "dakf")
    assert np.isfinite(standing.overall["score"].value)
    assert texts(make_main_table("", [standing]))[0][6] == "1 of 2"
    assert texts(make_task_table("", [standing], [ONE, TWO]))[0][2] == "not driven"
    assert ["road", TWO.name, "lqr on dakf", "not driven: no GPS"] in wrong(found)
    assert all(np.isfinite(row.value) for row in rows(standing))


def test_a_contest_that_nominal_alone_loses_counts_for_the_others() -> None:
    found = results()
    found[TWO, Entry(NOMINAL)] = episodes(9.0, 40)
    standing = {each.entry.label: each for each in table(found)}
    assert all(len(each.pairs) == 2 for each in standing.values())
    assert standing["none"].by_task[TWO]["score"].value == 2.0
    assert "cost_vs_nominal" not in standing["none"].by_task[TWO]
    shown = texts(make_task_table("", list(standing.values()), [TWO]))
    assert (NOMINAL, "0.00 (100)") in shown and ("none", "2.00 (0)") in shown
    assert ["road", TWO.name, NOMINAL, "every car fails"] in wrong(found)
    assert all(np.isfinite(row.value) for each in standing.values() for row in rows(each))


def test_a_nominal_that_cannot_be_computed_leaves_its_contest_without_score() -> None:
    found = results()
    found[TWO, Entry(NOMINAL)] = undriven("no plant")
    standing = table(found)
    lqr = next(each for each in standing if each.entry.agent == "lqr")
    assert list(lqr.pairs) == [ONE] and np.isfinite(lqr.overall["score"].value)
    assert texts(make_task_table("", [lqr], [TWO]))[0][1].startswith("no nominal")
    assert texts(_make_oracle_table(Matrix(found)))[1][3] == "no plant"


def test_a_nan_of_a_contestant_is_a_failure_that_is_not_the_cars() -> None:
    found = results()
    found[ONE, Entry("lqr", "dakf")] = episodes(30.0, 10, "bad-action")
    assert ["road", ONE.name, "lqr on dakf", "bad-action 25.0 %"] in wrong(found)
    standing = next(each for each in table(found) if each.entry.estimator == "dakf")
    assert standing.by_task[ONE]["bad_action_rate"].value == 0.25
    assert standing.scores[ONE][:10].tolist() == [-2.0] * 10


def test_what_is_too_close_is_said() -> None:
    found = results()
    assert "saves less than 0.2 deg" in _compose_verdict(Matrix(found))  # all errors are equal
    slip = NUMBERS.index("rms_slip_error")
    for contest in (ONE, TWO):
        found[contest, Entry(NOMINAL)].numbers[:, slip] += np.radians(0.3)
    line = texts(_make_oracle_table(Matrix(found)))[0]
    assert line[4] == "0.30" and "less than" not in _compose_verdict(Matrix(found))


def test_who_is_surely_above_what_knows_more_is_a_finding() -> None:
    rng, found = np.random.default_rng(0), results()
    level = {ONE: rng.normal(0.0, 0.3, 64), TWO: rng.normal(0.3, 0.3, 64)}
    assert _list_upsets(Matrix(found, foresight=level)) == []
    for contest in (ONE, TWO):
        found[contest, Entry("lqr", "dakf")] = episodes(5.0)
    beaten = Matrix(found, foresight={ONE: -level[TWO], TWO: level[TWO]})
    upsets = [f"oracle-state in {ONE.name}", "lqr on dakf in tier road"]
    assert _list_upsets(beaten) == upsets
    assert f"Surely above what knows more: {'; '.join(upsets)}." in _make_oracle_table(beaten).note


def test_chance_upsets_no_reference_in_19_of_20_tables() -> None:
    rng = np.random.default_rng(1)
    tasks = [replace(ONE, scenario=str(k)) for k in range(40)]
    tables = [
        Matrix({}, foresight={x: rng.normal(0.0, 0.3, 64) for x in tasks}) for _ in range(100)
    ]
    assert sum(bool(_list_upsets(one)) for one in tables) <= 10  # 5 of 100 expected; P(> 10) = 1 %


def test_the_answer_names_the_best_and_by_how_much() -> None:
    measured = Matrix(results(), foresight={ONE: np.full(8, np.log(1.5))})
    _, controller, estimator, why, rest = _compose_verdict(measured).splitlines()
    best = REFERENCE_FILTER.replace(", ", " with ")
    assert f"controller, {best} costs least, 6" in estimator and "as much as dakf" in estimator
    assert "controllers lqr costs least, 33 % [" in controller and "as much as esc" in controller
    assert ", and 16 % as much as no control." in controller  # 2 / 12
    assert "true car and road saves 50 %, then its exact motion saves 7" in why
    assert "then what is ahead saves 33 %" in why
    assert "40 episodes a task" in rest


def test_the_answer_calls_a_tie_a_tie_and_names_who_leads_elsewhere() -> None:
    found, other = results(), results()
    for contest in (ONE, TWO):
        found[contest, Entry("lqr", "dakf")] = episodes(20.0)
        other[contest, Entry("esc", REFERENCE_FILTER)] = episodes(15.0)
        found[contest, Entry("esc", REFERENCE_FILTER)] = episodes(600.0)
    _, _, estimator, *_ = _compose_verdict(Matrix(found)).splitlines()
    assert "cost least, too close to tell apart" in estimator and "dakf" in estimator
    elsewhere: Results = {}
    for (task, entry), driven in other.items():
        elsewhere[replace(task, tier="limit"), entry] = driven
    *_, rest = _compose_verdict(Matrix(found | elsewhere)).splitlines()
    assert rest.startswith("It costs less with esc in tier limit. ")


def test_who_drives_a_part_of_the_contests_is_not_the_best_but_is_named() -> None:
    """A policy of one class of contests, however little it costs there."""
    found = results()
    found[TWO, Entry("distill-car-yaw", "joint")] = episodes(12.0)
    _, controller, *_, rest = _compose_verdict(Matrix(found)).splitlines()
    assert "controllers lqr costs least, 33 % [" in controller
    assert rest.startswith("It costs less with distill-car-yaw on its own manoeuvres. ")
    found[ONE, Entry("distill-car-yaw", "joint")] = episodes(12.0)
    _, controller, *_, rest = _compose_verdict(Matrix(found)).splitlines()
    assert "controllers distill-car-yaw costs" in controller and "own manoeuvres" not in rest


def test_without_nominal_nobody_wins() -> None:
    found = results()
    for contest in (ONE, TWO):
        found[contest, Entry(NOMINAL)] = undriven("no plant")
    _, controller, estimator, *_ = _compose_verdict(Matrix(found)).splitlines()
    assert "nobody has a score" in estimator and "nobody has a score" in controller


def test_a_metric_of_the_table_has_its_rows_and_its_column() -> None:
    standing = table(results())
    metrics = {row.metric for row in rows(standing[0])}
    assert {metric.name for metric in EPISODE} - {"failure"} <= metrics
    shown = _make_motion_table("", standing)
    for metric in EPISODE:
        if metric.heading:
            column = [x.heading for x in format_columns(shown)].index(metric.heading)
            value = float(texts(shown)[0][column]) / metric.scale
            assert value == pytest.approx(standing[0].mean(metric.name), abs=0.5 / metric.scale)
