"""`sideslip bench learned-outside`: a class's contest, and what its drives and ratios are."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("vehiclemodels")
from sideslip.agents import make_agent
from sideslip.agents.rollout import rollout
from sideslip.benchmarks.control.entries import (
    LEARNED,
    ControlCase,
    Entry,
)
from sideslip.benchmarks.control.run import NUMBERS, Chunk, DriveResult, make_storage, measure
from sideslip.benchmarks.control.tasks import NOMINAL, PARAMETERS, ControlTask
from sideslip.benchmarks.harness.drives import make_env
from sideslip.benchmarks.harness.results import Suite
from sideslip.benchmarks.report import study
from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.studies import learned_outside as outside_suite
from sideslip.benchmarks.studies.learned import TransferResult, list_entries
from sideslip.benchmarks.studies.learned_outside import (
    KINDS,
    MANOEUVRE,
    OUTSIDE_ID,
    _make_outside_task,
    _run_chunk,
)
from sideslip.envs.outside.plants import OUTSIDE_PLANTS, make_outside_vehicle
from sideslip.envs.scenarios.manoeuvres import make_scenario

FLAT = {"name", "road", "bank", "vehicle", "nominal"}


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_car_and_the_road_are_others(kind: str) -> None:
    contest = _make_outside_task(kind, "drift")
    like = ControlTask("", contest.like, "passenger-car", contest.reference, MANOEUVRE)
    assert contest.kind == kind == like.kind
    ours, theirs = (make_scenario(c.env_options["scenario"]) for c in (like, contest))
    for field in dataclasses.fields(ours):
        same = getattr(ours, field.name) == getattr(theirs, field.name)
        assert same or field.name in FLAT, field.name
    for entry in list_entries(kind):
        here, there = (ControlCase(each, entry).options for each in (contest, like))
        assert here == there or entry.agent == PARAMETERS  # a rung that was not measured here
        if entry.estimator:
            mine, those = (
                ControlCase(x, entry).estimate_options["options"] for x in (contest, like)
            )
            assert {**mine, "bank_sd": 0.0} == {**those, "bank_sd": 0.0}  # a flat road's levels


def test_designers_have_the_outside_car_and_its_actuators_are_the_class_s() -> None:
    for kind, width in zip(KINDS, (2, 1), strict=True):
        env: Any = make_env(OUTSIDE_ID, **_make_outside_task(kind, "single-track").env_options)
        assert env.action_space.shape == (width,)
        assert env.unwrapped.nominal.mass == make_outside_vehicle().mass
        assert env.unwrapped.nominal.friction == 0.65


def test_a_finished_case_is_found_again(tmp_path: Path) -> None:
    """Though it has neither series nor all numbers; by another driver it is another case."""
    cell, driven = (_make_outside_task("car-yaw", "drift"), Entry(NOMINAL)), list[Chunk]()

    def drive_it(chunk: Chunk) -> DriveResult:
        driven.append(chunk)
        numbers = np.full((len(chunk.seeds), len(NUMBERS)), np.nan)
        numbers[:, NUMBERS.index("cost")] = 0.5
        return DriveResult(numbers, 1.0)

    for _ in range(2):
        found = measure([cell], (3, 4), jobs=1, keep=tmp_path, runner=drive_it)[cell]
        assert found.costs.tolist() == [0.5, 0.5]
    assert len(driven) == 1
    chunk = Chunk(*cell, (3, 4))
    names = {make_storage(run).describe(chunk) for run in (drive_it, _run_chunk)}
    assert len(names) == 2


def test_a_drive_costs_what_the_single_car_s_costs() -> None:
    """On a road so narrow that the cars leave it one after the other: what follows is no cost."""
    contest, seeds = _make_outside_task("car-yaw", "drift"), (3, 5)
    narrow = {"scenario": contest.env_options["scenario"] | {"half_width": 0.5}}
    task = dataclasses.replace(contest, changes=narrow)
    driven = _run_chunk(Chunk(task, Entry("raw-car-yaw"), seeds))
    assert not driven.error
    env = make_env(OUTSIDE_ID, **contest.env_options | narrow)
    alone = [rollout(env, make_agent("raw-car-yaw", env), seed) for seed in seeds]
    assert alone[0].failed and len(alone[0]["t"]) != len(alone[1]["t"])
    assert driven.costs == pytest.approx([each.cost for each in alone], rel=1e-6)
    assert driven["failure"].tolist() == [each["failure"][-1] for each in alone]


def test_a_reason_is_the_drive_s_error() -> None:
    driven = _run_chunk(Chunk(_make_outside_task("car-yaw", "drift"), Entry("lqr"), (0,)))
    assert "beta_hat" in driven.error and np.isnan(driven.costs).all()


def driven_at(costs: Any, failed: Any = 0.0) -> DriveResult:
    numbers = np.zeros((len(costs), len(NUMBERS)))
    numbers[:, NUMBERS.index("cost")] = costs
    numbers[:, NUMBERS.index("failure")] = failed
    return DriveResult(numbers, 0.0)


def test_ratios_are_paired_over_each_rival_and_a_failure_counts() -> None:
    policy = LEARNED["car-yaw"][0].agent
    planner = "adaptive-nmpc"
    rng, found = np.random.default_rng(0), TransferResult("car-yaw")
    for model in OUTSIDE_PLANTS:
        nominal = rng.uniform(100.0, 200.0, 400)
        factors = dict.fromkeys((x.agent for x in list_entries("car-yaw")), 1.0)
        factors |= {planner: 0.5, policy: 2.0}
        mine = {who: driven_at(factor * nominal) for who, factor in factors.items()}
        gone = np.arange(400) < 100
        mine["two-dof"] = driven_at(nominal, gone)
        mine[planner] = driven_at(0.5 * nominal, gone)
        found.drives[model] = [mine]
    (_, names), *columns = outside_suite._make_ratio_table(found).split()
    rows = {name: [cells[i] for _, cells in columns] for i, name in enumerate(names)}
    assert [ratio.value for ratio in rows[policy]] == pytest.approx([2.0, 4.0] * 3, rel=1e-4)
    assert rows[NOMINAL][0] is rows[planner][1] is None
    fails = math.exp(0.25 * math.log(20.0))
    assert [ratio.value for ratio in rows["two-dof"]] == pytest.approx([fails, 2.0] * 3, rel=1e-4)
    said = outside_suite.STUDY.compose_verdict([found])
    assert f"{policy} costs 200 [200, 200] % of nominal's, 400 [400, 400] % of {planner}'s" in said
    assert "0 % fail" in said
    # the oracle costs what nominal does: there is no score, and every cost has its row
    suite = Suite("learned-outside", "", "")
    outside_suite.STUDY.add_tables(suite, [found])
    assert {row.metric for row in suite.rows} == {"cost_vs_nominal"}
    driven = [row.value for row in suite.rows if row.controller == policy]
    assert driven == pytest.approx([2.0] * 3, rel=1e-4) and suite.rows[0].n == 400


def test_without_the_extra_it_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "find_spec", lambda _: None)
    suite = outside_suite.STUDY.run(Request())
    assert not suite.tables and "sideslip[outside]" in suite.verdict
