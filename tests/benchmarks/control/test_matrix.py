"""The matrix: one cell is what single episodes are, failures are told, a stopped run goes on."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.rollout import rollout
from sideslip.benchmarks.control import entries
from sideslip.benchmarks.control import run as drive
from sideslip.benchmarks.control import suite as control
from sideslip.benchmarks.control import tables as tables_module
from sideslip.benchmarks.control.entries import (
    LEARNED,
    ORACLE_NAMES,
    REFERENCE_FILTER,
    ControlCase,
    Entry,
    make_cases,
)
from sideslip.benchmarks.control.run import Chunk, measure
from sideslip.benchmarks.control.tasks import YAW, ControlTask, list_scored_tasks, make_salt
from sideslip.benchmarks.report.study import Request
from sideslip.envs import COMS, FAILURES, SCENARIOS
from sideslip.envs.scenarios.manoeuvres import make_scenario
from sideslip.estimators import EstimateObservation
from tests.policies import VISION

SEEDS = (3, 4, 2**32 - 1)
GUST, DWELL = (ControlTask(scenario=name) for name in ("gust", "sine-with-dwell"))
PAIRS = (
    *(("", "none"), ("multirate-residual-kf", "two-dof")),
    *(("exact-kf", "lqr"), ("", VISION)),
)


def test_joint_gives_controllers_its_tyres() -> None:
    tyres = ("front_tyres", "rear_tyres", "inverse_friction")
    assert Entry("lqr", "joint").outputs == (*Entry("lqr", REFERENCE_FILTER).outputs, *tyres)


@pytest.mark.parametrize(("estimator", "controller"), PAIRS)
def test_a_cell_is_its_single_episodes(estimator: str, controller: str) -> None:
    entry = Entry(controller, estimator, {"filter": {}, "controller": {}})
    driven = drive.run_chunk(Chunk(DWELL, entry, SEEDS, keep=True))
    assert driven.error == ""
    env: gym.Env[Any, Any] = gym.make(YAW, scenario=DWELL.scenario)
    if estimator:
        env = EstimateObservation(env, estimator, outputs=entry.outputs, std=False)
    agent = make_agent(controller, env)
    assert rollout(*entry.make(DWELL), SEEDS[0]).cost == rollout(env, agent, SEEDS[0]).cost
    for i, seed in enumerate(SEEDS):
        alone = rollout(env, agent, seed)
        assert driven["cost"][i] == pytest.approx(alone.cost, rel=1e-12)
        assert driven["peak_slip"][i] == np.abs(alone["beta"][1:]).max()
        assert driven["failure"][i] == alone["failure"][-1]
        error = alone["gamma"][1:] - alone["gamma_ref"][1:]
        rms = np.sqrt(np.mean(error**2))
        assert driven["rms_yaw_error"][i] == pytest.approx(rms, rel=1e-12)
        rate = np.mean(np.abs(np.diff(alone["yaw_moment"]))) / 0.01
        assert driven["moment_rate"][i] == pytest.approx(rate, rel=1e-12)
        if i == 0:
            assert driven.series is not None
            for name in ("beta", "psi", "X", "Y"):
                column = driven.series[:, 1 + drive.SIGNALS.index(name)]
                assert np.array_equal(column, alone[name])


def test_every_contest_has_its_rungs_and_no_cell_stands_twice() -> None:
    all_ = list(make_cases(list_scored_tasks()))
    assert len(set(all_)) == len(all_)
    for contest in list_scored_tasks():
        mine = {entry for task, entry in all_ if task == contest}
        assert {entry.agent for entry in mine} >= {*ORACLE_NAMES, "none", "lqr"}
        assert sum(entry.estimator == REFERENCE_FILTER for entry in mine) >= 4
        assert mine >= {*LEARNED.get(contest.kind, ())}
    fast = list(make_cases(list_scored_tasks(), quick=True))
    assert set(fast) < set(all_)
    assert not any(ControlCase(task, entry).is_slow and not entry.is_oracle for task, entry in fast)


@pytest.mark.parametrize("estimator", [REFERENCE_FILTER, "joint"])
def test_a_filter_drives_a_car_that_does_not_roll(estimator: str) -> None:
    """Levels of `exact-kf` are the scenario's, which has no accelerometer then."""
    contest = ControlTask(scenario="tie-vision-fig8")
    assert not make_scenario("tie-vision-fig8").roll
    options = ControlCase(contest, Entry("lqr", estimator)).estimate_options["options"]
    assert "fast" not in options and "accel_y_noise" not in options
    driven = drive.run_chunk(Chunk(contest, Entry("lqr", estimator), (1,)))
    assert not driven.error and np.isfinite(driven.costs).all()


def test_in_a_world_a_filter_has_the_levels_of_nominals() -> None:
    """But where it lacks the sensor; `joint` has its own."""
    contest = ControlTask(scenario="coms-slalom", changes={"world": "v1"})
    names = (REFERENCE_FILTER, "exact-kf, gps", "joint")
    whole, gps, own = (
        ControlCase(contest, Entry("lqr", name)).estimate_options["options"] for name in names
    )
    assert whole["camera_yaw_sd"] > 0.0 and whole["force_share"] > 0.0
    assert whole.keys() - gps.keys() == {"camera_yaw_sd"}
    assert own == {}
    for name in names:
        Entry("lqr", name).make(contest)


class Broken:
    """An agent whose first car gets NaN after some steps."""

    def __init__(self, shape: str = "right") -> None:
        self.shape, self.calls = shape, 0

    def predict(self, obs: Any, *_: Any, **__: Any) -> tuple[Any, None]:
        self.calls += 1
        actions = np.zeros((len(obs), 1 if self.shape == "right" else 3), np.float32)
        if self.calls > 5:
            actions[0] = np.nan
        return actions, None


def broken(monkeypatch: pytest.MonkeyPatch, agent: Any) -> None:
    make = Entry.make
    monkeypatch.setattr(Entry, "make", lambda entry, *args: (make(entry, *args)[0], agent))


class SquareWave:
    """All of the yaw moment to one side, then to the other, every 0.2 s."""

    def __init__(self) -> None:
        self.calls = -1

    def predict(self, obs: Any, *_: Any, **__: Any) -> tuple[Any, None]:
        self.calls += 1
        return np.full((len(obs), 1), 1.0 if self.calls // 20 % 2 else -1.0, np.float32), None


def test_the_moment_rate_is_what_the_motors_delivered_and_the_step_what_was_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From limit to limit five times a second: ten times the limit, in N m/s, whatever the lag."""
    scenario = {"base": "straight", "duration": 4.0, "speed": 8.0}
    broken(monkeypatch, SquareWave())
    task = ControlTask(scenario="straight", changes={"scenario": scenario})
    driven = drive.run_chunk(Chunk(task, Entry("none"), SEEDS))
    limit = COMS.yaw_moment_limit
    assert driven["moment_rate"] == pytest.approx(np.full(3, 2.0 * limit / 0.2), rel=0.05)
    assert driven["largest_step"] == pytest.approx(np.full(3, 2.0 * limit))
    assert (driven["saturation"] == 1.0).all()


def test_nan_ends_its_car_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    chunk = Chunk(GUST, Entry("none"), SEEDS)
    whole = drive.run_chunk(chunk)
    broken(monkeypatch, Broken())
    driven = drive.run_chunk(chunk)
    assert FAILURES[int(driven["failure"][0])] == "bad-action"
    assert driven["cost"][0] > 90.0 * (SCENARIOS["gust"].duration - 0.1)
    assert np.array_equal(driven.numbers[1:], whole.numbers[1:])


def test_actions_of_the_wrong_shape_are_failures_too(monkeypatch: pytest.MonkeyPatch) -> None:
    broken(monkeypatch, Broken("wrong"))
    driven = drive.run_chunk(Chunk(GUST, Entry("none"), SEEDS))
    assert driven.error == ""
    assert {FAILURES[int(code)] for code in driven["failure"]} == {"bad-action"}


def test_a_cell_that_cannot_be_built_says_why_and_the_rest_goes_on() -> None:
    asked = [(GUST, Entry("none")), (GUST, Entry("two-dof", "nobody-kf"))]
    found = measure(asked, range(4), jobs=1)
    assert np.isfinite(found[GUST, Entry("none")].costs).all()
    assert "nobody-kf" in found[asked[1]].error


def test_standing_car_and_diverging_plant_end_finite() -> None:
    still = {"base": "gust", "speed": 0.0}
    thrown = {"base": "random-steering", "speed": 60.0, "amplitude": 0.5}
    for scenario, name in ((still, "none"), (thrown, "spin")):
        task = ControlTask(scenario="gust", changes={"scenario": scenario})
        driven = drive.run_chunk(Chunk(task, Entry("lqr", "exact-kf"), SEEDS))
        assert driven.error == "" and np.isfinite(driven.numbers).all()
        assert FAILURES[int(driven["failure"][0])] == name


def test_a_stopped_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chunk = Chunk(GUST, Entry("none"), SEEDS, keep=True)
    cached = drive._StoredDrives(tmp_path)
    first = cached(chunk)
    cached = replace(cached, function=lambda _: pytest.fail("it is driven again"))
    again = cached(chunk)
    assert np.array_equal(first.numbers, again.numbers)
    assert first.series is not None and again.series is not None
    assert np.array_equal(first.series, again.series)
    with pytest.raises(pytest.fail.Exception):  # another chunk is driven
        cached(Chunk(GUST, chunk.entry, SEEDS[:2], keep=True))
    monkeypatch.setattr(drive, "hash_sources", lambda: "edited")
    with pytest.raises(pytest.fail.Exception):  # other sources: driven again
        cached(chunk)


def test_a_small_matrix_from_end_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables, rows, figures, menus; a contestant that cannot drive leaves the rest."""
    few = [ControlTask(tier, YAW, "coms", "zero-slip", f"coms-{name}")
           for tier, name in (("", "step"), ("road", "random"))]  # fmt: skip
    some = [(c, Entry(rung)) for c in few for rung in (*ORACLE_NAMES, "none")]
    filters = ("exact-kf", "bicycle-kf", "nobody-kf")
    some += [(c, Entry("lqr", name)) for c in few for name in filters]
    monkeypatch.setattr(control, "list_scored_tasks", lambda: few)
    monkeypatch.setattr(entries, "make_cases", lambda *_: some)
    monkeypatch.setattr(control, "TITLES", {"": "no tier", "road": "a tier"})
    monkeypatch.setattr(tables_module, "TITLES", {"": "no tier", "road": "a tier"})
    monkeypatch.setattr(control, "measure_decision_time", lambda *_: 10.0)
    suite = control.STUDY.run(Request(jobs=1, episodes=4))
    assert {row.salt for row in suite.rows} == {make_salt()}
    assert {row.metric for row in suite.rows} >= {"score", "cost_vs_nominal", "failure_rate"}
    assert [row for row in suite.rows if not np.isfinite(row.value)] == []
    assert suite.verdict.startswith("Controllers drive on") and len(suite.verdict.splitlines()) <= 5
    tables = {table.title: table for table in suite.tables}
    wrong = tables["Cells that went wrong"].cells
    assert all("nobody-kf" in line[-1] for line in wrong) and len(wrong) == 2
    first = next(iter(suite.tables))
    assert vars(first.columns[1])["key"] == "score" and len(first.cells) == 7
    assert {line["tasks"] for line in first.cells} == {(1, 1), (0, 1)}
    assert "is not calibrated" in tables["The oracles"].note
    assert len(suite.explorers) == 1 and len(suite.explorers[0].cells) == len(some) - 2
    assert [title.split()[0] for title, *_ in suite.answers] == ["Which", "Which", "Which", "What"]
    (everywhere,) = suite.answers[0][1].layout.annotations[:1]
    assert "All tasks" in everywhere.text
    assert suite.explorers[0].pair[0] == "none"
