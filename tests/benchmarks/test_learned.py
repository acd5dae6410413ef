"""`sideslip bench learned`: conditions that change the car alone, and what the shares are of."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.learned.policy import load_policy
from sideslip.benchmarks.control.entries import LEARNED, ControlCase
from sideslip.benchmarks.control.run import NUMBERS, DriveResult
from sideslip.benchmarks.control.tasks import (
    NOMINAL,
    PARAMETERS,
    list_scored_tasks,
    vary_scenario,
)
from sideslip.benchmarks.studies import learned
from sideslip.benchmarks.studies.learned import (
    CONDITIONS,
    LATELY_MET,
    NEVER_MET,
    TRAINED,
    TransferResult,
    _select_tasks,
)
from sideslip.benchmarks.studies.policies import VARIED, _draw_changes
from sideslip.envs.scenarios.manoeuvres import make_scenario


@pytest.mark.parametrize("kind", LEARNED)
@pytest.mark.parametrize("condition", CONDITIONS)
def test_a_condition_changes_the_drive_and_no_filter_hears_of_it(kind: str, condition: str) -> None:
    for contest in _select_tasks(kind):
        scenario = vary_scenario(contest, CONDITIONS[condition])
        same = make_scenario(scenario) == make_scenario(contest.scenario)
        assert same == (condition == TRAINED)
        changed = replace(contest, changes={"scenario": scenario})
        for entry in learned.list_entries(kind):
            if entry.estimator:
                plain, now = (
                    ControlCase(each, entry).estimate_options for each in (contest, changed)
                )
                assert plain == now


def test_the_heavier_car_is_heavier_than_controllers_know() -> None:
    contest = _select_tasks("car-yaw")[0]
    scenario = vary_scenario(contest, CONDITIONS["a quarter heavier"])
    env: Any = gym.make(contest.env_id, **contest.env_options | {"scenario": scenario}).unwrapped
    assert env.vehicle.mass == pytest.approx(1.25 * env.nominal.mass)
    assert env.scenario.front_stiffness == make_scenario(contest.scenario).front_stiffness


def test_what_training_met_is_what_varied_lessons_vary() -> None:
    """Else the verdict calls new what is not, or known what is new."""
    kept = {name: change for name, change in CONDITIONS.items() if name not in NEVER_MET}
    low, high = VARIED["tyres"]
    for change in kept.values():
        tyres = change.get("front_stiffness", (1.0, 1.0))
        assert low <= tyres[0] and tyres[1] <= high
        assert VARIED["mass"][0] <= change.get("mass", 1.0) <= VARIED["mass"][1]
        assert max(change.get("camera_delays", [0.0])) <= VARIED["camera"][1]
        assert change.get("wind_force", 0.0) <= VARIED["wind"][1]
        for sensor in ("gps", "camera"):
            begins, ends = change.get(f"{sensor}_outage", (0.0, VARIED["out"][0]))
            assert VARIED["out"][0] <= ends - begins <= VARIED["out"][1]
    assert {*NEVER_MET, *LATELY_MET} <= set(CONDITIONS) and not set(NEVER_MET) & set(LATELY_MET)
    lately = {"camera_outage", "wind_force", "wind_start", "wind_length"}
    assert {key for name in LATELY_MET for key in CONDITIONS[name]} == lately
    for policies in LEARNED.values():
        for entry in policies:
            name = entry.agent
            met = str(load_policy(name).card.algorithm_options.get("scenarios"))
            new = name in ("raw-coms-steering", "raw-coms-yaw")
            assert new == ("camera_outage" in met) == ("wind_force" in met)
            assert not (new and entry == policies[0])  # of whom the verdict speaks
    rng = np.random.default_rng(0)
    varied = {key for change in _draw_changes(20, rng) for key in change}
    for name in NEVER_MET:
        assert not varied & set(CONDITIONS[name])
    assert {key for each in kept.values() for key in each} == varied | {"camera_jitter"}


def driven(costs: Any, failed: Any = 0.0) -> DriveResult:
    numbers = np.zeros((len(costs), len(NUMBERS)))
    numbers[:, NUMBERS.index("cost")] = costs
    numbers[:, NUMBERS.index("failure")] = failed
    return DriveResult(numbers, 0.0)


def test_the_share_is_of_the_gap_between_nominal_and_the_car_that_is_known() -> None:
    rng = np.random.default_rng(0)
    nominal = rng.uniform(1.0, 2.0, 400)
    cases = {NOMINAL: 1.0, PARAMETERS: 0.25, "half": 0.5, "dearer": 2.0}
    mine = {name: driven(factor * nominal) for name, factor in cases.items()}
    mine["fails"] = driven(0.25 * nominal, rng.random(400) < 0.1)
    small = mine | {PARAMETERS: driven(0.95 * nominal)}
    found = TransferResult("car-yaw", {TRAINED: [mine], "a quarter heavier": [small]})
    assert np.isnan(found._score("half", "a quarter heavier").value)
    expected = {NOMINAL: 0.0, PARAMETERS: 1.0, "half": 0.5, "dearer": -0.5}
    for name, share in expected.items():
        assert found._score(name, TRAINED).value == pytest.approx(share, abs=2e-3)
    assert found._score("fails", TRAINED).high < 0.9
    gone = {name: driven(nominal, 1.0) for name in mine}
    assert TransferResult("car-yaw", {TRAINED: [mine, gone]})._score(
        "half", TRAINED
    ) == found._score("half", TRAINED)
    assert np.isnan(TransferResult("car-yaw", {TRAINED: [gone]})._score("half", TRAINED).value)
    found.drives.pop("a quarter heavier")
    assert (found.select("failure", "fails") != 0.0).mean() == pytest.approx(0.1, abs=0.05)
    ratios = found._compute_ratios("fails")
    assert np.isinf(ratios).mean() == (found.select("failure", "fails") != 0.0).mean()
    assert ratios[np.isfinite(ratios)] == pytest.approx(0.25, abs=1e-3)


def test_the_verdict_tells_what_training_met_from_what_it_never_did() -> None:
    nominal = np.random.default_rng(0).uniform(1.0, 2.0, 400)
    policy = LEARNED["car-yaw"][0].agent
    costs = {TRAINED: 0.25, "a quarter heavier": 0.5, "no camera from 2 to 7 s": 2.0}
    found = TransferResult("car-yaw")
    for condition, factor in costs.items():
        cases = {NOMINAL: 1.0, PARAMETERS: 0.25, policy: factor, learned.RIVALS[0]: 0.3}
        found.drives[condition] = [{who: driven(each * nominal) for who, each in cases.items()}]
    said = learned.STUDY.compose_verdict([found])
    assert f"{policy} closes 1.00 of the gap; at worst 0.50 where it trained, -0.50 where" in said
    assert "beats adaptive-lqr in 33 %" in said
    found.drives.pop("no camera from 2 to 7 s")
    assert "at worst 0.50 where it trained, - where never" in learned.STUDY.compose_verdict([found])


@pytest.mark.parametrize("kind", LEARNED)
def test_three_contests_of_a_class_are_driven(kind: str) -> None:
    """Evenly apart, none twice."""
    there, found = [each for each in list_scored_tasks() if each.kind == kind], _select_tasks(kind)
    assert len(set(found)) == len(found) == 3 and set(found) <= set(there)
    first, middle, last = (there.index(each) for each in found)
    assert abs((middle - first) - (last - middle)) <= 1 and middle == len(there) // 2
