"""A policy against others: the same seeds for all, written into its card, a cell of the matrix."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.agents import make_agent
from sideslip.agents.learned.network import Network
from sideslip.agents.learned.policy import Card, list_shipped, load_policy, save_policy
from sideslip.benchmarks.control import tasks
from sideslip.benchmarks.control.entries import LEARNED, ControlCase, Entry
from sideslip.benchmarks.control.run import Chunk, _StoredDrives
from sideslip.benchmarks.control.tasks import ControlTask, make_salt, make_salted_seeds
from sideslip.benchmarks.studies.policies import evaluate_policy, record_evaluation
from tests.benchmarks.conftest import Run

SHORT = {"base": "random-steering", "duration": 1.5}
HERE = "sideslip/YawVision-v0"


def a_file(folder: Path, estimator: str = "", **options: Any) -> Path:
    """A damper: the yaw moment opposes the gyro."""
    card = Card.from_env_id(
        HERE, {"scenario": SHORT}, estimator, options, steps=1, command="by hand"
    )
    names = [name for name, _ in card.observation]
    scale = np.array([float(name == "gyro") for name in names])
    network = Network(np.zeros(len(names)), scale, [-0.3 * scale[None]], [np.zeros(1)])
    path = folder / "damper.safetensors"
    save_policy(path, network, card)
    return path


def test_everybody_drives_the_same_seeds_which_the_weights_make(tmp_path: Path) -> None:
    path = a_file(tmp_path)
    found = evaluate_policy(str(path), 6)
    assert list(found.drives) == ["damper", "lqr on exact-kf", "none"] and found.left_out == {}
    assert found.salt == load_policy(path).salt
    assert found.seeds == make_salted_seeds(found.salt, 6)
    env = gym.make(HERE, scenario=SHORT)
    for name, agent in (("damper", make_agent(str(path), env)), ("none", None)):
        alone = [sideslip.rollout(env, agent, seed).cost for seed in found.seeds]
        assert found.drives[name].costs == pytest.approx(alone, rel=1e-12)
    assert found.drives["lqr on exact-kf"].costs.mean() < found.drives["none"].costs.mean()
    assert evaluate_policy(str(path), 3, seed=7).seeds == [7, 8, 9]


def test_a_policy_may_not_be_called_what_it_is_held_against(tmp_path: Path) -> None:
    path = a_file(tmp_path).rename(tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match="is called 'none', as what it is held against"):
        evaluate_policy(str(path), 1)


def test_the_evaluation_goes_into_the_card_and_leaves_the_weights(tmp_path: Path) -> None:
    path = a_file(tmp_path)
    before = load_policy(path)
    found = record_evaluation(path, 5)
    after = load_policy(path)
    assert after.salt == before.salt
    assert after.card == replace(before.card, evaluation=found)
    assert found["episodes"] == 5 and found["salt"] == before.salt
    drives = evaluate_policy(str(path), 5).drives
    for name, costs in found["cost"].items():
        assert costs["mean"] == pytest.approx(drives[name].costs.mean(), abs=1e-6)
        assert costs["low"] <= costs["mean"] <= costs["high"]


def test_the_suite_tells_it_in_rows_table_and_pictures(tmp_path: Path) -> None:
    found = evaluate_policy(
        str(a_file(tmp_path)), 4, env_id="sideslip/YawFusion-v0", scenario="gust"
    )
    suite = found.make_suite()
    (table,) = suite.tables
    assert [line["label"] for line in table.cells] == ["damper", "lqr on exact-kf", "none"]
    costs = {row.controller: row.value for row in suite.rows if row.metric == "cost"}
    assert costs["damper"] == pytest.approx(found.drives["damper"].costs.mean())
    assert {row.scenario for row in suite.rows} == {"gust"}
    assert "another reference, model" in suite.text  # it was trained for zero slip
    assert len(suite.explorers) == 1
    ratios = np.log((found.drives["damper"].costs + 0.001) / (found.drives["none"].costs + 0.001))
    said = suite.verdict.splitlines()
    assert said[1].startswith(f"damper costs {100.0 * np.exp(ratios.mean()):.0f} % [")
    assert said[1].endswith("of none, seed by seed.") and "these 4" in said[2]
    assert table.cells[2]["cost ratio"] in said[1]  # one statistic on a screen


def test_without_a_classical_line_the_rest_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sideslip.benchmarks.studies.policies.FILTER", "nobody-kf")
    found = evaluate_policy(str(a_file(tmp_path)), 2)
    assert list(found.drives) == ["damper", "none"]
    assert "lqr on nobody-kf was not driven" in found.make_suite().tables[0].note


@pytest.mark.parametrize("name", list_shipped())
def test_what_a_shipped_card_says_is_so(name: str) -> None:
    """The first of its test seeds again: the uncontrolled mean is that of all of them."""
    told = load_policy(name).card.evaluation
    found = evaluate_policy(name, 16)
    assert found.salt == told["salt"]
    none = found.drives["none"].costs
    error = none.std(ddof=1) / 4.0
    assert abs(none.mean() - told["cost"]["none"]["mean"]) < 5.0 * error
    assert np.median(found.drives[name].costs) < 0.6 * np.median(none)  # a lost car is the mean


def test_a_policy_of_the_matrix_is_shipped() -> None:
    policies = [entry.agent for entries in LEARNED.values() for entry in entries]
    assert policies and {*policies} <= {*list_shipped()}


def test_a_policy_in_a_cell_gets_the_estimate_it_was_trained_on(tmp_path: Path) -> None:
    path = a_file(tmp_path, "multirate-kf", outputs=["beta"], std=True)
    task, entry = ControlTask(scenario="gust"), Entry(str(path), "multirate-kf")
    assert ControlCase(task, entry).estimate_options == {"outputs": ["beta"], "std": True}
    env, agent = entry.make(task, 2)
    assert [item.name for item in env.layout[-2:]] == ["beta_hat", "beta_std"]
    assert agent.needs == ("gyro",)


def test_seeds_and_cases_are_of_the_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = a_file(tmp_path)
    task = ControlTask(scenario="gust", changes={"scenario": SHORT})
    chunk = Chunk(task, Entry(str(path)), (1, 2))
    cached = _StoredDrives(tmp_path / "cached")
    first = cached(chunk)
    assert np.array_equal(cached(chunk).numbers, first.numbers)
    policy = load_policy(path)
    other = replace(policy.network, biases=[np.ones(1)])
    save_policy(path, other, policy.card)
    assert not np.array_equal(cached(chunk).numbers, first.numbers)
    salt = make_salt()
    monkeypatch.setattr(
        tasks, "_ENTRY_SOURCES", {"estimators": (".py", ".toml"), "agents": (".py",)}
    )
    assert make_salt() != salt


def test_the_command_shows_writes_and_tells_the_card(run: Run, tmp_path: Path) -> None:
    path, html, plot = a_file(tmp_path), tmp_path / "report.html", tmp_path / "drive.png"
    status, out, _ = run("enjoy", path, "--episodes", 3, "--html", html, "--plot", plot)
    assert status == 0 and "lqr on exact-kf" in out and "random-steering" in out
    assert plot.read_bytes()[:4] == b"\x89PNG" and "damper" in html.read_text()
    status, out, _ = run("enjoy", path, "--card")
    assert status == 0
    for word in (HERE, "by hand", "zero-slip", "22 x 1", "beta_ref"):
        assert word in out
    status, out, _ = run("run", HERE, "--agent", path, "--scenario", "lane-change")
    assert status == 0 and "lane-change" in out
    assert "distill-car-yaw" in run("list")[1]


@pytest.mark.parametrize(
    ("name", "kind"),
    [("distill-car-steering", "car-steering"), ("distill-coms-yaw", "coms-zero-slip")],
)
def test_a_policys_rival_has_the_options_of_its_car(name: str, kind: str) -> None:
    """Not those of the id's own car: a policy's card has the car as an option of the env."""
    task = evaluate_policy(name, 2).task
    assert task.kind == kind and task.tier == ""
