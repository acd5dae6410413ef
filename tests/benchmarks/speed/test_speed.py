"""The speed suite: contestants that do the same work, and a row for each. No time is asserted."""

import shutil
import sys
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.harness.results import Suite
from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.speed import env_steps, plant, suite, timing
from sideslip.envs.numerics.simd import LANES
from sideslip.estimators import FILTERS
from sideslip.estimators.make import ESTIMATORS

SHORT = timing.Effort(rounds=1, seconds=0.0)
compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("gcc", "clang", "cc"))), reason="there is no C compiler"
)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_steps, "COUNT", 3)
    monkeypatch.setattr(env_steps, "EPISODE", 5)
    monkeypatch.setattr(env_steps, "FEWER", 2)
    monkeypatch.setattr(plant, "CARS", 32)


def measure(workloads: Any) -> tuple[Suite, dict[str, Any], dict[str, str]]:
    """The suite, the times taken and the reasons of the absent ones of some workloads."""
    measured = Suite("speed", "", "")
    return measured, workloads.measure(measured, SHORT), workloads.absent


def without(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    for name in packages:
        monkeypatch.setitem(sys.modules, name, None)


def test_env_steps_are_measured_and_the_absent_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the optional packages: the suite needs none of them."""
    without(monkeypatch, "highway_env")
    measured, taken, absent = measure(env_steps.make_workloads())
    assert {env_steps.FUSION_V1, env_steps.V1_AT_ONCE, env_steps.FILTERED} <= set(taken)
    assert {env_steps.CARTPOLE, env_steps.CARTPOLES, env_steps.PENDULUMS} <= set(taken)
    assert absent == {env_steps.LANE: "highway-env is not installed"}
    rows = {(row.scenario, row.metric) for row in measured.rows}
    assert rows == {(name, "us_per_step") for name in taken}
    assert all(0.0 < row.low <= row.value <= row.high for row in measured.rows)
    (table,) = measured.tables
    assert all(f"{name} ({why})" in table.note for name, why in absent.items())


def test_every_filter_of_the_catalogue_has_its_line() -> None:
    """All names that make a filter, in one environment and in several."""
    measured = Suite("speed", "", "")
    env_steps.add_filters(measured, SHORT)
    names = set(ESTIMATORS)
    assert set(FILTERS) <= names
    envs = env_steps.FUSION, f"{env_steps.FUSION} x 2"
    rows = [(row.scenario, row.metric) for row in measured.rows]
    assert sorted(rows) == sorted((f"{e} + {name}", "us_added") for e in envs for name in names)
    (table,) = measured.tables
    assert {cells[0] for cells in table.cells} == names
    assert {len(cells) for cells in table.cells} == {len(table.columns)}


def test_the_lane_keeping_environment_runs() -> None:
    pytest.importorskip("highway_env")
    contestants = timing.WorkloadSet("", "step", "")
    contestants.add(env_steps.LANE, env_steps._make_lane_keeping, "highway-env")
    contestants.workloads[env_steps.LANE].work()
    assert contestants.absent == {}


def test_poles_stay_up_so_that_no_reset_is_measured() -> None:
    """The rival's episodes are long: its resets are dear."""
    import gymnasium as gym

    env: Any = gym.make("CartPole-v1")
    obs, _ = env.reset(seed=0)
    for _ in range(400):
        obs, _, terminated, _, _ = env.step(int(env_steps._choose_upright_action(obs)))
        assert not terminated


@compiler
def test_the_plant_in_c_is_ours() -> None:
    """To rounding, over half a second of cars that slide, roll, brake and turn."""
    mine = plant._make_cars(32, seed=3)
    mine.motions[:, 1] += np.linspace(-3.0, 3.0, 32).reshape(-1, LANES)  # m/s of v_y: tyres slide
    bend = [0.01, 0.5, 2.0, 0.3, 0.2]  # the other roads are straight and flat
    mine.roads[0] = np.array([*bend, *[0.0] * (mine.roads.shape[1] - len(bend))])[:, None]
    theirs = mine.clone()
    plant._advance(mine, 500)
    plant.make_c_advance()(theirs, 500)
    assert np.isfinite(mine.motions).all()
    scale = np.abs(mine.motions).max(axis=(0, 2), keepdims=True)
    np.testing.assert_allclose(theirs.motions / scale, mine.motions / scale, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(theirs.acting, mine.acting, rtol=1e-13)


@compiler
def test_another_plant_in_c_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    other = plant.read_source().replace("GRAVITY = 9.81", "GRAVITY = 9.8")
    monkeypatch.setattr(plant, "read_source", lambda: other)
    with pytest.raises(RuntimeError, match="the plant in C is not ours"):
        plant.make_c_advance()


@compiler
def test_a_compiler_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plant, "read_source", lambda: "no C at all")
    with pytest.raises(timing.AbsentError, match=r"does not compile it: .*error"):
        plant.make_c_advance()


def test_without_a_compiler_the_line_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    measured, taken, absent = measure(plant.make_workloads())
    assert set(taken) == {plant.PLANT}
    assert absent == {plant.C: "no C compiler"}
    assert "no C compiler" in measured.tables[0].note


def test_learning_without_torch_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, "torch", "stable_baselines3")
    monkeypatch.delitem(sys.modules, "sideslip.agents.vec_env", raising=False)
    measured, taken, absent = measure(env_steps.make_learners())
    assert taken == {} and measured.tables == []
    assert absent[env_steps.PENDULUM] == "stable-baselines3 is not installed"


def test_compilation_is_counted_at_the_top_alone() -> None:
    code = """
from sideslip.envs.numerics.jit import jit
@jit
def inner(x):
    return x + 1
@jit
def outer(x):
    return inner(x) * 2
outer(1); outer(1.0); outer(2); inner(1)
"""
    found = suite._measure_compilation(code)
    assert [name for name, _ in found] == ["outer", "outer", "inner"]
    assert all(seconds > 0.0 for _, seconds in found)
    with pytest.raises(RuntimeError, match="no such thing"):
        suite._measure_compilation("raise ValueError('no such thing')")


def test_without_kernels_on_disk_the_first_step_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "LIMIT", 0.01)
    measured = Suite("speed", "", "")
    seconds, absent = suite._add_first_use(measured, quick=True)
    assert seconds == {} and measured.rows == []
    assert absent[suite.FIRST] == "no kernels are cached on disk here"


def test_ratios_are_taken_round_by_round() -> None:
    """Their median is not the ratio of the medians."""
    target = suite.TARGETS[0]
    taken = {
        target.over: timing.Taken([20.0, 300.0, 80.0]),
        target.workload: timing.Taken([1.0, 10.0, 2.0]),
    }
    measured = Suite("speed", "", "")
    suite._add_targets(measured, taken, {})
    (row,) = measured.rows
    assert (row.scenario, row.metric) == (target.name, "ratio")
    assert (row.value, row.low, row.high, row.n) == (30.0, 20.0, 40.0, 3)
    cells = measured.tables[0].cells[0]
    assert cells[1:] == [">= 30 x", "30", "20 .. 40", "met"]


def test_every_target_stands_in_the_table() -> None:
    measured = Suite("speed", "", "")
    suite._add_targets(measured, {suite.FIRST: timing.Taken([0.6])}, {env_steps.LANE: "it rains"})
    (table,) = measured.tables
    assert [cells[0] for cells in table.cells] == [target.name for target in suite.TARGETS]
    said = [cells[-1] for cells in table.cells]
    assert said == ["not measured"] * 8 + ["not met", "not measured"]
    assert f"{env_steps.LANE} (it rains)" in table.note
    assert f"{env_steps.CARTPOLE} (not run)" in table.note


def test_rounds_are_interleaved_and_the_first_calls_do_not_count() -> None:
    order: list[str] = []
    contestants = {
        "a": timing.Workload(lambda: order.append("a"), 1),
        "b": timing.Workload(lambda: order.append("b"), 2, lambda: order.append("start of b")),
    }
    taken = timing.measure_interleaved(contestants, timing.Effort(3, 0.0))
    b = ["start of b", "b"]
    assert order == ["a", "a", *b, *b] + ["a", *b] * 3
    assert {name: len(each) for name, each in taken.items()} == {"a": 3, "b": 3}
    assert timing.Taken([3.0, 1.0, 2.0]).range == (2.0, 1.0, 3.0)


def test_learning_runs_on_one_thread() -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("threadpoolctl")
    with timing.limit_threads():
        assert torch.get_num_threads() == 1


def test_targets_are_held_beside_all_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What each of them measured, and what it could not for want of a package."""
    held: list[Any] = []

    def judge(found: Any, *numbers: Any) -> None:
        found.tables.append(None)
        held.extend(numbers)

    makers = ((env_steps, "make_workloads"), (plant, "make_workloads"),
              (env_steps, "make_learners"))  # fmt: skip
    names = [f"{part.__name__}.{make}" for part, make in makers] + ["first use"]
    for name, (part, make) in zip(names, makers, strict=False):
        workloads = timing.WorkloadSet("", "", "", absent={name: "not there"})
        monkeypatch.setattr(workloads, "measure", lambda *_, name=name: {name: (1.0,)})
        monkeypatch.setattr(part, make, lambda workloads=workloads: workloads)
    monkeypatch.setattr(env_steps, "add_filters", lambda *_: None)
    first = {"first use": (1.0,)}, {"first use": "not there"}
    monkeypatch.setattr(suite, "_add_first_use", lambda *_: first)
    monkeypatch.setattr(suite, "_add_targets", judge)
    monkeypatch.setattr(suite, "_make_verdict", lambda *_: "")
    suite.STUDY.run(Request(quick=True))
    taken, absent = held
    assert list(taken) == names and list(absent) == names
