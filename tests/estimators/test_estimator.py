"""The estimate of a filter now, against its records read by NumPy."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.rollout import rollout
from sideslip.envs.record import Log
from sideslip.estimators import make_estimator


@pytest.fixture(scope="module")
def log() -> Log:
    """0.5 s of a drive with both slow sensors."""
    return rollout(gym.make("sideslip/YawFusion-v0"), seed=3, options={"duration": 0.5}).log


@pytest.mark.parametrize(
    ("name", "options", "layers"),
    [
        ("exact-kf", {}, [0]),
        pytest.param(  # side by side, uncorrelated
            "double-layer",
            {},
            [0, 1],
            marks=pytest.mark.filterwarnings("ignore:double-layer cannot see"),
        ),
        ("joint", {}, [0]),
    ],
)
def test_it_is_its_records(log: Log, name: str, options: dict[str, Any], layers: list[int]) -> None:
    estimator = make_estimator(name, sensors=log.slow, **options)
    estimator.run(log)
    x, P = np.zeros(0), np.zeros((len(estimator.names),) * 2)
    for f in estimator.filters[layers]:
        rows = slice(len(x), len(x) + int(f.n))
        x, P[rows, rows] = np.append(x, f.x[: f.n]), f.P[: f.n, : f.n]
    assert np.array_equal(estimator.x, x)
    assert np.array_equal(estimator.P, P)


@pytest.mark.parametrize("name", ["multirate-kf", "multirate-residual-kf", "lob-2"])
def test_with_periodic_gains_it_is_a_triangle_of_the_table(log: Log, name: str) -> None:
    estimator = make_estimator(name, sensors=log.slow)
    estimator.run(log)
    f, n = estimator.filters[0], len(estimator.names)
    row = estimator.gains[f.cell, 1 + f.at * max(int(f.fasts), 1)]
    upper = np.zeros((n, n))
    upper[np.triu_indices(n)] = row[int(f.total) : int(f.total) + n * (n + 1) // 2]
    assert np.array_equal(estimator.P, upper + np.triu(upper, 1).T)
    assert np.array_equal(estimator.x, f.x[:n])


def test_a_table_that_is_missing_is_made_for_the_covariance_alone(log: Log) -> None:
    estimator = make_estimator("multirate-kf", sensors=log.slow)
    assert not estimator.x.any()
    assert not estimator.gains.any()
    settled = estimator.P
    assert estimator.gains[0].any() and np.linalg.eigvalsh(settled).min() > 0.0
