"""Intervals: they cover what they say, and pairing makes them narrow."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from sideslip.benchmarks.harness.parallel import run_cases
from sideslip.benchmarks.harness.stats import (
    interval,
    mean,
    profile,
    ratio_of_roots,
    root_mean,
    won,
)


def test_interval_covers_the_mean_nineteen_times_in_twenty() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(300):
        _, low, high = interval(rng.normal(size=60), mean)
        hits += low <= 0.0 <= high
    # binomial with p = 0.95 (the percentile bootstrap of 60 values: about 0.94): 5 sigma is 0.07
    assert 0.87 <= hits / 300 <= 1.0


def test_the_interval_is_of_the_same_statistic_as_the_estimate() -> None:
    """Percentiles pass through rising functions: the root's interval is the interval's root."""
    values = np.random.default_rng(4).gamma(0.5, 2.0, 40)  # the median is a third of the mean

    def far_away(x: np.ndarray, axis: int = -1) -> np.ndarray:
        return 7.0 + 1.5 * mean(x, axis)

    plain = np.array(interval(values, mean))
    assert plain[1] < plain[0] < plain[2]
    assert np.array(interval(values, far_away)) == pytest.approx(7.0 + 1.5 * plain, rel=1e-12)
    # between two resamples the percentile is interpolated, which a root is not
    assert np.array(interval(values, root_mean)) == pytest.approx(np.sqrt(plain), rel=1e-6)
    least, low, high = interval(values, np.min)  # no resample has a smaller one
    assert least == low == values.min() <= high
    # the ratio's interval is that of its inverse, turned round
    other = np.random.default_rng(5).gamma(0.5, 2.0, 40)
    ratio = np.array(interval(values, ratio_of_roots, other))
    inverse = np.array(interval(other, ratio_of_roots, values))
    assert ratio == pytest.approx(1.0 / inverse[[0, 2, 1]], rel=1e-5)


def test_pairing_removes_what_the_seeds_share() -> None:
    rng = np.random.default_rng(2)
    shared = rng.uniform(1.0, 100.0, 50)
    estimate, low, high = interval(4.0 * shared, ratio_of_roots, shared)
    assert (estimate, low, high) == pytest.approx((2.0, 2.0, 2.0))


def test_the_same_values_give_the_same_interval_and_no_spread_gives_none() -> None:
    values = np.random.default_rng(3).uniform(size=20)
    assert interval(values, root_mean) == interval(values, root_mean)
    assert interval(np.full(9, 4.0), root_mean) == (2.0, 2.0, 2.0)
    assert interval(np.array([4.0]), root_mean) == (2.0, 2.0, 2.0)


def _square(value: int) -> int:
    return value * value


@pytest.mark.parametrize("jobs", [1, 2])
def test_cases_come_back_in_order(jobs: int) -> None:
    assert run_cases(_square, range(7), "squares", jobs) == [0, 1, 4, 9, 16, 25, 36]


def test_definitions_are_those_of_rliable() -> None:
    """Agarwal et al., NeurIPS 2021: the probability of improvement is the mean over tasks of
    Mann and Whitney's U over the number of pairs, the score distribution the share of runs above
    a level. Our task is a seed, with one run each."""
    rng = np.random.default_rng(7)
    costs, others = (rng.integers(0, 6, 80).astype(float) for _ in range(2))
    U = [mannwhitneyu([-a], [-b]).statistic for a, b in zip(costs, others, strict=True)]
    assert won(costs, others).value == pytest.approx(np.mean(U), abs=1e-12)
    levels = np.array([-1.0, 0.0, 2.5, 5.0])
    above = [np.mean(-costs >= -level) for level in levels]
    assert profile(costs, levels)[0] == pytest.approx(above, abs=1e-12)


def test_a_profile_rises_to_all_that_do_not_fail() -> None:
    values = np.array([0.5, 1.0, 2.0, np.inf, np.nan])
    value, low, high = profile(values, np.array([0.1, 0.5, 1.0, 100.0]))
    assert value == pytest.approx([0.0, 0.2, 0.4, 0.6])
    assert np.all(low <= value) and np.all(value <= high)
