"""The suite of unknown tyres: its bound knows what acted, errors and intervals are joint's."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.studies import unknown, unknown_conditions
from sideslip.benchmarks.studies.unknown_conditions import (
    CAMERA,
    CONDITIONS,
    CURVES,
    LINEAR,
    MIX,
    PARTS,
    WITHOUT,
)

NAMED = {each.name: each for each in CONDITIONS}
FIALA = "Fiala tyres, friction 0.9"
LATE, CAR = "camera, gyro 60 ms late", "camera, passenger car, 80 km/h"
FEW = tuple(
    each
    for each in CONDITIONS
    if each.name in ("camera and GPS", "twice the disturbances it was told", FIALA, LATE, CAR)
    or "change" in each.name
)


EVERY = [*CONDITIONS, *(each for curve in CURVES for each in curve.conditions())]


@pytest.mark.parametrize("condition", EVERY, ids=lambda each: each.name)
def test_a_condition_is_a_drive_and_bounded_where_its_car_is_linear(condition: Any) -> None:
    """The bound is of linear tyres on a body that does not roll."""
    scenario = LINEAR | dict(condition.scenario)
    env: Any = gym.make(condition.env_id, scenario=scenario, vehicle=condition.vehicle)
    drawn = env.unwrapped.config.scenario
    assert condition.bounded == (drawn.tyres == "linear" and not drawn.roll)


def test_a_curve_changes_what_it_says() -> None:
    late, *_ = (each for each in CURVES if "late" in each.make_condition(1.0).name)
    for ms, condition in zip(late.values, late.conditions(), strict=True):
        assert condition.scenario == MIX | {"camera_delays": (pytest.approx(1e-3 * ms),)}
        assert condition.name == f"camera {ms:g} ms late"


@pytest.fixture(scope="module")
def few() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unknown, "CONDITIONS", FEW)
        patch.setattr(unknown, "CURVES", CURVES[3:4])
        patch.setattr(unknown, "PARTS", PARTS[2:3])
        yield unknown.STUDY.run(Request(episodes=4, jobs=1))


def test_every_condition_has_its_numbers_and_the_bound_holds(few: Any) -> None:
    numbers = {
        (row.scenario, row.metric): row.value for row in few.rows if row.estimator == "joint"
    }
    assert numbers["camera and GPS", "rmse_over_bound"] > 0.9
    assert numbers["camera and GPS", "rmse_over_exact_kf"] < 0.5
    double = "twice the disturbances it was told"
    assert 0.9 < numbers[double, "rmse_over_bound"] < 1.6 and numbers[double, "nees"] > 2.0
    assert (FIALA, "rmse_over_bound") not in numbers
    assert 0.9 < numbers[CAR, "rmse_over_bound"] < 2.0
    own = numbers[CAR, "rmse_over_own"] ** 2  # a ratio of means beside the mean of ratios
    assert own == pytest.approx(numbers[CAR, "nees"], rel=0.5)
    assert numbers[LATE, "rmse_over_bound"] > 1.5  # a delay that filters do not know harms
    table = few.tables[0]
    assert [line["condition"] for line in table.cells] == [each.name for each in FEW]
    assert few.verdict.splitlines()[1].startswith("joint, which estimates them, has")


def test_no_verdict_line_is_longer_than_a_screen(few: Any) -> None:
    assert max(map(len, few.verdict.splitlines())) <= 110


def test_a_bank_is_nearer_to_the_bound_of_changing_tyres_than_one_filter(few: Any) -> None:
    over = {row.scenario: row.value for row in few.rows if row.metric == "rmse_over_bound"}
    four, one = (f"from the change on, {each}" for each in ("four members", "one filter"))
    assert 0.9 < over[four] < over[one]


def test_a_curve_has_a_point_for_every_value_and_its_bound_below(few: Any) -> None:
    curve = CURVES[3]
    names = [what.name for what in curve.conditions()]
    rmse = {(r.scenario, r.estimator): r.value for r in few.rows if r.metric == "rmse"}
    bound = [rmse[name, unknown.BOUND] for name in names]
    assert bound == sorted(bound)  # a slower GPS sees less
    assert all(rmse[name, "joint"] > 0.9 * rmse[name, unknown.BOUND] for name in names)
    titles = [question for question, _, _ in few.answers]
    assert few.answers[0][2] == few.verdict.splitlines()[1]  # beneath the first picture
    assert titles[1:] == ["Do the intervals hold what they promise?", curve.question]


def test_intervals_hold_what_they_promise(few: Any) -> None:
    """Of joint; exact-kf, which believes in other tyres, has far too few errors within."""
    ours, theirs = (
        {row.metric: row for row in few.rows if row.estimator == name and row.scenario == every}
        for every in ("all with linear tyres",)
        for name in ("joint", "exact-kf")
    )
    assert len(ours) == len(unknown_conditions.LEVELS)
    assert ours["covered_50"].value == pytest.approx(0.5, abs=0.1)
    assert ours["covered_95"].value == pytest.approx(0.95, abs=0.06)
    assert theirs["covered_95"].value < 0.7


def test_an_interval_of_coverage_counts_each_seed_once(few: Any) -> None:
    """Conditions share their seeds: more conditions are no more evidence."""
    assert {row.n for row in few.rows if row.scenario == "all with linear tyres"} == {4}


def test_a_filter_without_bias_states_pays_for_the_bias(few: Any) -> None:
    ratio = {r.estimator: r.value for r in few.rows if r.metric == "ratio"}
    assert list(ratio) == list(WITHOUT)
    assert ratio["without biases"] > 3.0


def test_a_gust_has_the_bound_of_a_filter_that_does_not_know_its_strength() -> None:
    """The bound that knows it is that of the same drives without wind."""
    conditions = (NAMED["a gust of unknown strength"], NAMED["camera"])
    gust, calm = unknown_conditions.measure_all(Request(jobs=1), conditions, 2, "")
    assert (gust.best > 1.02 * calm.best).all()


def test_an_episode_that_ends_early_is_left_out_and_counted() -> None:
    spinning = unknown_conditions.Condition("fast", CAMERA, {"speed": 25.0, "rear_stiffness": 0.3})
    (found,) = unknown_conditions.measure_all(Request(jobs=1), [spinning], 2, "")
    assert found.left_out == 2 and list(map(len, found.squares.values())) == [0, 0]


def test_filterpys_filter_errs_as_ours_where_the_camera_is_at_once() -> None:
    """The same model and noise; where frames are late, which it does not know, it errs more."""
    pytest.importorskip("filterpy")
    from sideslip.benchmarks.studies.unknown import _compare_filters

    for late in (0.0, 0.03):
        (ours, _), (theirs, _), _ = _compare_filters((late, 1))
        assert np.sqrt(theirs / ours) > 1.5 if late else theirs == pytest.approx(ours, rel=0.1)
