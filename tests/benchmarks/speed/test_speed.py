"""The speed suite: contestants that do the same work, and a row for each. No time is asserted."""

import shutil
import sys
from importlib import import_module
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


def make_suite(table: timing.TimeTable) -> Suite:
    """A suite with one table."""
    made = Suite("speed", "", "")
    table.add_table(made)
    return made


def without(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    for name in packages:
        monkeypatch.setitem(sys.modules, name, None)


def test_env_steps_are_measured_and_the_absent_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the optional packages: the suite needs none of them."""
    without(monkeypatch, "highway_env")
    measured = env_steps.measure_steps(SHORT)
    assert set(measured.times) == set(env_steps._WORKLOADS) - {env_steps.LANE}
    assert list(measured.absent) == [env_steps.LANE]
    made = make_suite(measured)
    rows = [(row.scenario, row.metric) for row in made.rows]
    assert rows == [(name, "us_per_step") for name in measured.times]
    assert all(0.0 < row.low <= row.value <= row.high for row in made.rows)
    (table,) = made.tables
    assert f"Not measured: {env_steps.LANE} (" in table.note and "highway_env" in table.note


def test_every_filter_of_the_catalogue_has_its_line() -> None:
    """All names that make a filter, in one environment and in several."""
    names = set(ESTIMATORS)
    assert set(FILTERS) <= names
    envs = env_steps.FUSION, f"{env_steps.FUSION} x 2"
    times = env_steps.measure_filters(SHORT).times
    assert sorted(times) == sorted(f"{env} + {name}" for env in envs for name in names)


def test_the_lane_keeping_environment_runs() -> None:
    pytest.importorskip("highway_env")
    env_steps._make_lane_keeping().work()


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
    measured = plant.measure_plants(SHORT)
    assert set(measured.times) == {plant.PLANT}
    assert measured.absent == {plant.C: "no C compiler"}


def test_learning_without_torch_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, "torch", "stable_baselines3")
    monkeypatch.delitem(sys.modules, "sideslip.agents.vec_env", raising=False)
    measured = env_steps.measure_learners(SHORT)
    assert measured.times == {} and "stable_baselines3" in measured.absent[env_steps.PENDULUM]
    (table,) = make_suite(measured).tables
    assert not table.cells and env_steps.PENDULUM in table.note


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
    measured = suite._measure_first_use(quick=True)
    assert measured.times == {}
    assert measured.absent[suite.FIRST] == "no kernels are cached on disk here"


def make_table(**times: list[float]) -> timing.TimeTable:
    """A table of times by name."""
    arrays = {name: np.array(rounds) for name, rounds in times.items()}
    return timing.TimeTable("", "us_per_step", "us", times=arrays)


def test_ratios_are_taken_round_by_round() -> None:
    """Their median is not the ratio of the medians; times of two tables make one."""
    target = suite.TARGETS[0]
    over = make_table(**{target.over: [20.0, 300.0, 80.0]})
    made = Suite("speed", "", "")
    suite._add_tables(made, [over, make_table(**{target.workload: [1.0, 10.0, 2.0]})])
    (row,) = (row for row in made.rows if row.metric == "ratio")
    assert row.scenario == target.name
    assert (row.value, row.low, row.high, row.n) == (30.0, 20.0, 40.0, 3)
    line = made.tables[0].cells[0]
    assert (line["goal"], line["measured"], line["met"]) == (">= 30 x", (30, 20, 40), "yes")


def test_every_target_stands_in_the_table() -> None:
    lines = suite._evaluate_targets([make_table(**{suite.FIRST: [0.6]})])
    assert [line["scenario"] for line in lines] == [target.name for target in suite.TARGETS]
    outcomes = [line.get("met") for line in lines]
    assert outcomes == [None] * 8 + ["no", None]


def test_a_run_measures_all_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = ((env_steps, "measure_steps"), (env_steps, "measure_filters"),
             (plant, "measure_plants"), (env_steps, "measure_learners"))  # fmt: skip
    for module, name in parts:
        monkeypatch.setattr(module, name, lambda effort, name=name: make_table(**{name: [1.0]}))
    monkeypatch.setattr(suite, "_measure_first_use", lambda quick: make_table(first=[1.0]))
    tables = suite._measure(Request(quick=True))
    assert [*(x for table in tables for x in table.times)] == [*(x for _, x in parts), "first"]


def test_what_lacks_a_package_is_absent_and_a_module_of_ours_is_not() -> None:
    table = make_table()
    effort = timing.Effort(1, 0.0)

    def make(name: str) -> timing.Workload:
        return timing.Workload(import_module(name).run, 1)

    table.measure({"theirs": lambda: make("no_such_package")}, effort)
    assert table.absent == {"theirs": "No module named 'no_such_package'"}
    with pytest.raises(ModuleNotFoundError):
        table.measure({"ours": lambda: make("sideslip.no_such")}, effort)


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


def test_learning_runs_on_one_thread() -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("threadpoolctl")
    with timing.limit_threads():
        assert torch.get_num_threads() == 1
