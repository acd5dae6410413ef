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
