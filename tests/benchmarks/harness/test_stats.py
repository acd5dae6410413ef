"""Intervals: they cover what they say, and pairing makes them narrow."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, ttest_1samp

from sideslip.benchmarks.harness.stats import (
    compute_win_rate,
    interval,
    mean_share,
    ratio_of_roots,
    root_mean,
)


def far_away(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.asarray(-7.0 - 1.5 * np.mean(values, axis))


def test_the_interval_is_of_the_same_statistic_as_the_estimate() -> None:
    """On the logarithm's scale the root's interval is the interval's root, on the plain one that
    of a line is the line of the interval."""
    values = np.random.default_rng(4).gamma(0.5, 2.0, 40)  # the median is a third of the mean
    positive, signed = np.array(interval(values)), np.array(interval(values - 0.5))
    assert positive[1] * positive[2] == pytest.approx(positive[0] ** 2)
    assert signed[1] + signed[2] == pytest.approx(2.0 * signed[0])
    assert np.array(interval(values, root_mean)) == pytest.approx(np.sqrt(positive))
    lines = interval(values - 0.5, far_away)
    assert np.array(lines) == pytest.approx(-7.0 - 1.5 * signed[[0, 2, 1]], rel=1e-12)
    # the ratio's interval is that of its inverse, turned round
    other = np.random.default_rng(5).gamma(0.5, 2.0, 40)
    ratio = np.array(interval(values, ratio_of_roots, other))
    inverse = np.array(interval(other, ratio_of_roots, values))
    assert ratio == pytest.approx(1.0 / inverse[[0, 2, 1]])


def test_the_interval_of_a_mean_is_students() -> None:
    values = np.array([-3.0, -2.0, 1.0, 2.0, 4.0, 5.0])  # no outlier
    low, high = ttest_1samp(values, 0.0).confidence_interval()
    assert interval(values) == pytest.approx((values.mean(), low, high))


def test_a_mean_share_stays_between_none_and_all() -> None:
    values = np.array([0.9, 1.0, 0.95, 1.0, 1.0, 0.85])
    found = mean_share(values)
    assert found.value == pytest.approx(values.mean())
    assert 0.7 < found.low < found.value < found.high < 1.0
    lost = np.array(mean_share(1.0 - values))
    assert np.array(found) == pytest.approx(1.0 - lost[[0, 2, 1]])
    assert mean_share(np.ones(5)) == (1.0, 1.0, 1.0)


def test_a_single_one_of_many_has_bounds_in_order() -> None:
    for values in ([1.0, 0.0, 0.0, 0.0], [0.1] + [0.0] * 9):
        share = mean_share(np.array(values))
        assert 0.0 <= share.low <= share.value <= share.high <= 1.0


def test_pairing_removes_what_the_seeds_share() -> None:
    rng = np.random.default_rng(2)
    shared = rng.uniform(1.0, 100.0, 50)
    assert interval(4.0 * shared, ratio_of_roots, shared) == pytest.approx((2.0, 2.0, 2.0))


def test_no_spread_gives_a_point_and_too_few_seeds_no_interval() -> None:
    assert interval(np.full(9, 4.0), root_mean) == (2.0, 2.0, 2.0)
    few = interval(np.array([4.0, 5.0, 3.0]))
    assert few.value == 4.0 and np.isnan(few[1:]).all()
    lonely = mean_share(np.array([1.0, 1.0, 1.0, 0.8]))  # without the last the odds are infinite
    assert lonely.value == 0.95 and np.isnan(lonely[1:]).all()
    assert few.inline() == "4.00"
    assert interval(np.arange(1.0, 6.0)).inline(10.0, ".0f") == "30 [15, 58]"


def test_definitions_are_those_of_rliable() -> None:
    """Agarwal et al., NeurIPS 2021: the probability of improvement is the mean over tasks of
    Mann and Whitney's U over the number of pairs. Our task is a seed, with one run each."""
    rng = np.random.default_rng(7)
    costs, others = (rng.integers(0, 6, 80).astype(float) for _ in range(2))
    U = [mannwhitneyu([-a], [-b]).statistic for a, b in zip(costs, others, strict=True)]
    assert compute_win_rate(costs, others).value == pytest.approx(np.mean(U), abs=1e-12)
