"""Whether an estimate is to be believed: what the numbers say of errors that are as expected."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from sideslip.benchmarks.recorded.honesty import compute_honesty, describe_innovations
from sideslip.benchmarks.recorded.suite import SHARES, _compute_held_shares


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_nees_coverage_and_score_of_normal_errors(factor: float) -> None:
    """Deviations that are `factor` times the errors': NEES is 1 / factor^2."""
    error = np.random.default_rng(0).normal(0.0, 0.01, 20_000)
    deviation = np.full(20_000, 0.01 * factor)
    nees, held, score = compute_honesty(error, deviation)
    assert nees == pytest.approx(1.0 / factor**2, rel=0.05)
    assert held == pytest.approx(2.0 * norm.cdf(1.96 * factor) - 1.0, abs=0.01)
    assert score == pytest.approx(np.mean(norm.logpdf(error, 0.0, deviation)))
    shares = 2.0 * norm.cdf(factor * norm.ppf(0.5 + SHARES / 2.0)) - 1.0
    assert _compute_held_shares(error, deviation) == pytest.approx(shares, abs=0.02)


def test_the_score_is_best_at_the_true_deviation() -> None:
    error = np.random.default_rng(1).normal(0.0, 0.01, 20_000)
    scores = [compute_honesty(error, np.full(20_000, 0.01 * f))[2] for f in (0.7, 1.0, 1.4)]
    assert max(scores) == scores[1]


def test_without_truth_innovations_say_whom_not_to_believe() -> None:
    text = describe_innovations({"joint": 7.25, "exact-kf": 1.1})
    assert "do not believe joint (7.2)" in text and "exact-kf" not in text
    assert "nobody is lost" in describe_innovations({"exact-kf": 1.1})
    assert describe_innovations({}) == ""
    assert not math.isnan(compute_honesty(np.zeros(3), np.ones(3))[2])
