"""Metrics: what the steps of an episode make of a number, and that every name has one unit."""

import numpy as np
import pytest

from sideslip.benchmarks.harness.metrics import EPISODE, METRICS, REDUCTIONS, Metric

VALUES = np.array([[0.3, -2.0], [-1.5, 0.5], [0.2, 0.1]])  # of 3 steps and 2 cars


@pytest.mark.parametrize(
    ("fold", "expected"),
    [
        ("sum", VALUES.sum(axis=0)),
        ("mean", VALUES.mean(axis=0)),
        ("rms", np.sqrt((VALUES**2).mean(axis=0))),
        ("max", np.abs(VALUES).max(axis=0)),
        ("last", VALUES[-1]),
    ],
)
def test_a_fold_is_what_its_name_is(fold: str, expected: np.ndarray) -> None:
    total = np.zeros(2)
    for step in VALUES:
        total = REDUCTIONS[fold].add(total, np.abs(step) if fold == "max" else step)
    assert REDUCTIONS[fold].finish(total, np.full(2, 3.0)) == pytest.approx(expected)


def test_every_metric_of_an_episode_has_a_unit_and_a_fold() -> None:
    names = [metric.name for metric in EPISODE]
    assert len(set(names)) == len(names)
    for metric in EPISODE:
        assert METRICS[metric.name] == metric.unit and metric.reduction in REDUCTIONS
    assert Metric("x", "rad", lambda m: m.reward, "sum", scale=1e3).text(0.01234) == "12.3"
