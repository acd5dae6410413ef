"""The swerve among other vehicles: its numbers, its verdict, and a suite without its extra."""

import importlib.util

import numpy as np
import pytest

from sideslip.benchmarks.harness.verdict import LETTERS, LINES
from sideslip.benchmarks.report import study
from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.studies import traffic
from sideslip.envs.task import COLLISION, DEPARTURE, RUNNING, SPIN

pytest.importorskip("highway_env")


def made(*ends: int) -> np.ndarray:
    """(10, 3) of `simulate_swerve`: the ends first, then successes."""
    failures = np.array([*ends, *[RUNNING] * (10 - len(ends))], float)
    costs = np.where(failures == RUNNING, 1.0, 300.0)
    return np.stack([costs, failures, np.full(10, 0.1)], axis=1)


def test_an_episode_is_that_of_the_environment() -> None:
    """Everybody drives the same seeds; without control the first numbers are the env's own."""
    import gymnasium as gym

    env = gym.make(traffic.ID, on_bad_action="fail")
    env.reset(seed=traffic.FIRST_SEED)
    cost, over = 0.0, False
    while not over:
        _, reward, terminated, truncated, info = env.step([0.0])
        cost, over = cost - float(reward), terminated or truncated
    ((found, failure, slip),) = traffic._simulate_swerve(("none", (0,)))
    assert (found, failure) == (cost, info["failure"])
    assert 0.0 < slip < 0.6


@pytest.mark.parametrize("who", traffic.CONTROLLERS)
def test_every_contestant_drives(who: str) -> None:
    numbers = traffic._simulate_swerve((who, (1,)))
    assert np.shape(numbers) == (1, 3) and np.isfinite(numbers).all()


def test_the_verdict_names_the_best_and_why_the_others_fail() -> None:
    swerves = {who: made(SPIN, DEPARTURE) for who in traffic.CONTROLLERS}
    swerves["none"] = made(SPIN, SPIN, COLLISION, DEPARTURE)
    swerves["lqr"], swerves[traffic.ORACLE] = made(COLLISION), made()
    lanes = {name: np.full((2, 5), 0.1 * (1 + i)) for i, name in enumerate(traffic.READERS)}
    text = traffic.STUDY.compose_verdict((swerves, lanes))
    lines = text.splitlines()
    assert len(lines) <= LINES and max(map(len, lines)) <= LETTERS
    assert "lqr 90 % [" in lines[1] and "none 60 % [" in lines[1]
    assert "spin 20 %, collision 10 %, departure 10 %" in lines[2] and "100 % [" in lines[2]
    assert "multirate-residual-kf holds 10 cm" in lines[3] and "30 cm" in lines[3]


def test_without_highway_env_the_suite_has_no_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "find_spec", lambda name: None)
    suite = traffic.STUDY.run(Request())
    assert not suite.rows and "sideslip[highway]" in suite.verdict
    assert importlib.util.find_spec("highway_env") is not None
