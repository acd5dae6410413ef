"""The suite of unknown tyres: its bound knows what acted, errors and intervals are joint's."""

from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks import unknown


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> Any:
    names = ("camera and GPS", "twice the disturbances it was told", "Fiala tyres, friction 0.9")
    few = tuple(each for each in unknown.CONDITIONS if each.name in names)
    few += tuple(each for each in unknown.CONDITIONS if each.name.startswith(("tyres", "the same")))
    monkeypatch.setattr(unknown, "CONDITIONS", few)
    return unknown.run(3, jobs=1)


def test_every_condition_has_its_numbers_and_the_bound_holds(few: Any) -> None:
    numbers = {(row.scenario, row.metric): row.value for row in few.rows}
    assert numbers["camera and GPS", "rmse_over_bound"] > 0.9
    assert numbers["camera and GPS", "rmse_over_exact_kf"] < 0.5
    double = "twice the disturbances it was told"
    assert 0.9 < numbers[double, "rmse_over_bound"] < 1.6 and numbers[double, "nees"] > 2.0
    assert ("Fiala tyres, friction 0.9", "rmse_over_bound") not in numbers
    table = few.tables[0]
    assert [line[0] for line in table.cells] == [each.name for each in unknown.CONDITIONS]
    assert few.verdict.splitlines()[1].startswith("joint, which estimates them, is")


def test_an_episode_that_ends_early_is_left_out_and_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spinning = unknown.Condition("fast", unknown.CAMERA, {"speed": 25.0, "rear_stiffness": 0.3})
    monkeypatch.setattr(unknown, "CONDITIONS", (spinning,))
    found = unknown.measure((0, (0, 1)))
    assert found.left_out == 2 and np.shape(found.squares) == (0, 2)
