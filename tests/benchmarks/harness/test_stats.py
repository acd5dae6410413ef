"""Intervals: they cover what they say, and pairing makes them narrow."""

import numpy as np
import pytest

from sideslip.benchmarks.harness.parallel import run_cases
from sideslip.benchmarks.harness.stats import interval, mean, ratio_of_roots, root_mean


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
