"""The matrix: one cell is what single episodes are, failures are told, a stopped run goes on."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.rollout import rollout
from sideslip.benchmarks.control import build as contest
from sideslip.benchmarks.control import episodes as drive
from sideslip.benchmarks.control import run as results
from sideslip.benchmarks.control import suite as control
from sideslip.benchmarks.control.cache import CachedDrive
from sideslip.benchmarks.control.calibration import read_calibration
from sideslip.benchmarks.control.ceiling import refusals_of
from sideslip.benchmarks.control.cells import MANOEUVRES, STEERING, YAW, Cell, cells
from sideslip.benchmarks.control.delay_price import SCENARIO
from sideslip.benchmarks.control.episodes import Chunk
from sideslip.benchmarks.control.figures import _SHOWN, run_of
from sideslip.benchmarks.control.run import measure
from sideslip.benchmarks.control.scores import Ceiling, Resampled
from sideslip.benchmarks.control.seeds import salt_of, salted_seeds
from sideslip.benchmarks.control.tables import _metrics
from sideslip.envs import COMS, FAILURES, SCENARIOS
from sideslip.estimators import EstimateObservation

SEEDS = (3, 4, 2**32 - 1)
PAIRS = (
    ("", "none"),
    ("multirate-residual-kf", "two-dof"),
    ("exact-kf", "lqr"),
    ("", "ppo-yaw-vision"),
)


@pytest.mark.parametrize(("estimator", "controller"), PAIRS)
def test_a_cell_is_its_single_episodes(estimator: str, controller: str) -> None:
    cell = Cell(YAW, "sine-with-dwell", estimator, controller)
    driven = drive.drive(Chunk(cell, SEEDS, keep=True))
    assert driven.error == ""
    env: gym.Env[Any, Any] = gym.make(YAW, scenario=cell.scenario)
    if estimator:
        outputs = contest.outputs_for(estimator)
        env = EstimateObservation(env, estimator, outputs=outputs, std=False)
    agent = make_agent(controller, env)
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
            assert np.array_equal(driven.series[:, 1], alone["beta"])


def test_no_cell_stands_twice() -> None:
    assert len(set(cells())) == len(list(cells()))


def test_truth_is_told_without_error() -> None:
    env, _ = contest.make_contest(Cell(YAW, "gust", "truth", "two-dof"), 2)
    obs, infos = env.reset(seed=[1, 2])  # type: ignore[arg-type]
    names = [entry.name for entry in env.layout]  # type: ignore[attr-defined]
    for _ in range(30):
        obs, *_, infos = env.step(np.full((2, 1), 0.3, np.float32))
    assert np.array_equal(obs[:, names.index("beta_hat")], infos["beta"].astype(np.float32))
    assert np.array_equal(obs[:, names.index("gamma_hat")], infos["gamma"].astype(np.float32))


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
    make = contest.make_contest
    monkeypatch.setattr(drive, "make_contest", lambda cell, n: (make(cell, n)[0], agent))


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
    driven = drive.drive(Chunk(Cell(YAW, "straight", "", "none", {"scenario": scenario}), SEEDS))
    limit = COMS.yaw_moment_limit
    assert driven["moment_rate"] == pytest.approx(np.full(3, 2.0 * limit / 0.2), rel=0.05)
    assert driven["largest_step"] == pytest.approx(np.full(3, 2.0 * limit))
    assert (driven["saturation"] == 1.0).all()


def test_nan_ends_its_car_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = Cell(YAW, "gust", "", "none")
    whole = drive.drive(Chunk(cell, SEEDS))
    broken(monkeypatch, Broken())
    driven = drive.drive(Chunk(cell, SEEDS))
    assert FAILURES[int(driven["failure"][0])] == "bad-action"
    assert driven["cost"][0] > 90.0 * (SCENARIOS["gust"].duration - 0.1)
    assert np.array_equal(driven.numbers[1:], whole.numbers[1:])


def test_actions_of_the_wrong_shape_are_failures_too(monkeypatch: pytest.MonkeyPatch) -> None:
    broken(monkeypatch, Broken("wrong"))
    driven = drive.drive(Chunk(Cell(YAW, "gust", "", "none"), SEEDS))
    assert driven.error == ""
    assert {FAILURES[int(code)] for code in driven["failure"]} == {"bad-action"}


def test_a_cell_that_cannot_be_built_says_why_and_the_rest_goes_on() -> None:
    asked = [Cell(YAW, "gust", "", "none"), Cell(YAW, "gust", "nobody-kf", "two-dof")]
    found = measure(asked, 4, salt="ab" * 8, jobs=1)
    assert np.isfinite(found.of(YAW, "gust", "none").costs).all()
    assert "nobody-kf" in found.of(YAW, "gust", "two-dof", "nobody-kf").error
    assert any("not driven" in line[-1] and "nobody-kf" in line[-1] for line in refusals_of(found))
    lost, ones = found.of(YAW, "gust", "two-dof", "nobody-kf"), np.ones(4)
    told = _metrics(Resampled(4, 1), 0, lost, ones, ones, None)
    assert all(np.isnan(each.value) for each in told.values())  # not "never spun"


def test_standing_car_and_diverging_plant_end_finite() -> None:
    still = {"base": "gust", "speed": 0.0}
    thrown = {"base": "random-steering", "speed": 60.0, "amplitude": 0.5}
    for scenario, name in ((still, "none"), (thrown, "spin")):
        cell = Cell(YAW, "gust", "exact-kf", "lqr", {"scenario": scenario})
        driven = drive.drive(Chunk(cell, SEEDS))
        assert driven.error == "" and np.isfinite(driven.numbers).all()
        assert FAILURES[int(driven["failure"][0])] == name


def test_a_stopped_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chunk = Chunk(Cell(YAW, "gust", "", "none"), SEEDS, keep=True)
    cached = CachedDrive(tmp_path, "salt")
    first = cached(chunk)
    monkeypatch.setattr("sideslip.benchmarks.control.cache.drive", None)
    again = cached(chunk)
    assert np.array_equal(first.numbers, again.numbers)
    assert first.series is not None and again.series is not None
    assert np.array_equal(first.series, again.series)
    with pytest.raises(TypeError):  # another salt or chunk is driven
        CachedDrive(tmp_path, "other")(chunk)
    monkeypatch.setattr("sideslip.benchmarks.control.cache.sources", lambda: "edited")
    with pytest.raises(TypeError):  # other sources: driven again
        cached(chunk)
    monkeypatch.undo()
    monkeypatch.setattr("sideslip.benchmarks.control.cache.drive", None)
    (found,) = tmp_path.iterdir()
    found.write_bytes(found.read_bytes()[:100])  # cut short by a kill or a full disk
    with pytest.raises(TypeError):
        cached(chunk)


def test_a_small_matrix_from_end_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables, rows, figures, menus, tracks; the animated run is the cell's own episode."""
    few = [
        Cell(env_id, name, estimator, who)
        for env_id in (YAW, STEERING)
        for name in (SCENARIO, "double-lane-change")
        for estimator, who in (("", "none"), ("", "informed"), ("exact-kf", "two-dof"))
    ]
    top = {SCENARIO: Ceiling(0.1, 0.01)}
    monkeypatch.setattr(control, "cells", lambda: few)
    monkeypatch.setattr("sideslip.benchmarks.control.ceiling.ceilings", lambda *_: top)
    monkeypatch.setattr("sideslip.benchmarks.control.delay_price.DELAYS", (0.0, 0.3))
    monkeypatch.setattr("sideslip.benchmarks.control.suite.DELAYS", (0.0, 0.3))
    monkeypatch.setattr("sideslip.benchmarks.control.figures.DELAYS", (0.0, 0.3))
    salts: list[str] = []

    def seeds_of(salt: str, n: int) -> list[int]:
        salts.append(salt)
        return salted_seeds(salt, n)

    monkeypatch.setattr(results, "salted_seeds", seeds_of)
    suite = control.run(4, jobs=1)
    assert len(salts) == 3  # the matrix and two delays
    assert {*salts, *(row.salt for row in suite.rows)} == {salt_of()}
    assert {row.env_version.split()[0] for row in suite.rows} == {YAW, STEERING}
    assert {row.metric for row in suite.rows} >= {"score", "iqm", "cost_over_informed", "spin_rate"}
    assert [row for row in suite.rows if not np.isfinite(row.value)] == []
    assert not any("went wrong" in table.title for table in suite.tables)
    assert len(suite.explorers) == 1 and len(suite.explorers[0].cells) == len(few)
    assert [name for name, *_ in suite.files] == ["sine-with-dwell.kml", "double-lane-change.kml"]
    titles = " ".join(title for title, *_ in suite.figures)
    assert all(text in titles for text in ("score", "price of delay", "In motion"))


def test_the_run_in_motion_is_the_cells_own(monkeypatch: pytest.MonkeyPatch) -> None:
    for cell in _SHOWN:
        same = Cell(cell.env_id, "sine-with-dwell", cell.estimator, cell.controller)
        driven = drive.drive(Chunk(same, (5,)))
        alone = run_of(same, 5)
        assert alone.cost == pytest.approx(driven["cost"][0], rel=1e-12)


def test_the_shipped_ceilings_are_of_this_env() -> None:
    """The uncontrolled car costs on a calibration seed what it did when the file was made."""
    entries = read_calibration()
    assert {entry.scenario for entry in entries.values() if entry.env_id == YAW} >= set(MANOEUVRES)
    for entry in entries.values():
        env = gym.make(entry.env_id, scenario=entry.scenario)
        first = entry.episodes[0]
        cost = rollout(env, None, first.seed).cost
        assert cost == pytest.approx(first.costs["none"], rel=1e-12)
        assert entry.clairvoyant < entry.none
