"""Paired statistics: what they are, and how often their 95 % intervals hold the true number."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.stats import binom, mannwhitneyu, ttest_1samp, ttest_ind

from sideslip.benchmarks.harness.stats import (
    Estimate,
    average,
    compute_tail_mean,
    compute_win_rate,
    geometric_mean,
    interval,
    margin_of_error,
    mean_share,
    ratio_of_means,
    ratio_of_roots,
    root_mean,
    share,
)

Array = np.ndarray
Random = np.random.Generator
SETS = 1000
LEAST = int(binom.ppf(1e-3, SETS, 0.93))
"""Hits of an interval that covers 93 % fall below it once in a thousand times: 904 of 1000."""
MOST = int(binom.isf(1e-3, SETS, 0.97))
"""Hits of one that covers 97 % rise above it as rarely: 985 of 1000."""


def costs(rng: Random, n: int) -> tuple[Array, Array, Array]:
    """(nominal, a contestant, the best) on the same n seeds: skewed, and 2 % of the cars fail."""
    seed = np.where(rng.random(n) < 0.02, rng.uniform(50.0, 500.0, n), rng.lognormal(0.0, 1.0, n))
    mine, best = rng.gamma(2.0, 0.4, n), rng.gamma(2.0, 0.2, n)
    return seed, seed * mine, seed * best


def logs(rng: Random, n: int) -> tuple[Array, Array]:
    """Clipped logarithms of nominal's cost over the contestant's and over the best's."""
    nominal, mine, best = costs(rng, n)
    r, gap = (np.clip(np.log(nominal / each), -3.0, 3.0) for each in (mine, best))
    return r, gap


def unlike(rng: Random, sizes: Sequence[int], fails: float = 0.0) -> list[tuple[Array, Array]]:
    """Strata of such logarithms with means and spreads of their own, some with failures."""
    strata = []
    for i, n in enumerate(sizes):
        r, gap = logs(rng, n)
        r = (0.25 + 0.75 * (i % 3)) * r + 0.2 * (i % 2)
        strata.append((np.where(rng.random(n) < fails, -3.0, r), gap))
    return strata


def overall(strata: Sequence[tuple[Array, Array]]) -> Estimate:
    return geometric_mean(*(r for r, _ in strata))


def mean_cost(rng: Random, n: int, spread: float, fails: float = 0.0) -> Estimate:
    cost = rng.lognormal(0.0, spread, n)
    return interval(np.where(rng.random(n) < fails, rng.uniform(50.0, 500.0, n), cost))


def squares(rng: Random, n: int) -> tuple[Array, Array]:
    """Mean squared errors of two estimators on drives that are more or less hard."""
    hard = rng.lognormal(0.0, 0.5, n)
    return hard * rng.gamma(2.0, 0.5, n), hard * rng.gamma(2.0, 1.0, n)


MANY = 100_000  # of a stratum, whose estimate is taken for the true one
OF_STRATA: dict[str, tuple[Callable[[Random, Sequence[int]], Estimate], Sequence[int]]] = {
    "geometric mean": (lambda rng, n: overall(unlike(rng, n)), (60,)),
    "geometric mean, 2 strata of 2": (lambda rng, n: overall(unlike(rng, n)), (2,) * 2),
    "geometric mean, 8 strata of 2": (lambda rng, n: overall(unlike(rng, n)), (2,) * 8),
    "geometric mean, 3 to 8": (lambda rng, n: overall(unlike(rng, n)), (3, 4, 6, 8)),
    "geometric mean, 8 to 64": (lambda rng, n: overall(unlike(rng, n, 0.05)), (8, 16, 32, 64)),
    "geometric mean, 8 strata of 8": (lambda rng, n: overall(unlike(rng, n, 0.05)), (8,) * 8),
    "gap": (lambda rng, n: average(logs(rng, n[0])[1]), (8,)),
    "share won": (lambda rng, n: compute_win_rate(*costs(rng, n[0])[1::-1]), (64,)),
    "worst 5 %": (lambda rng, n: compute_tail_mean(costs(rng, n[0])[1]), (500,)),
}
TIGHT = ("geometric mean", "share won", "worst 5 %")
"""Of so many that the interval is not wider than it need be."""
OF_SEEDS: dict[str, tuple[Callable[[Random], Estimate], float]] = {
    "mean cost, 8 seeds": (lambda rng: mean_cost(rng, 8, 0.5), math.exp(0.125)),
    "mean cost, 64 seeds": (lambda rng: mean_cost(rng, 64, 1.0), math.exp(0.5)),
    "mean cost, 64 seeds, failures": (
        lambda rng: mean_cost(rng, 64, 1.0, 0.2), 0.8 * math.exp(0.5) + 0.2 * 275.0
    ),
    "ratio of errors, 4 seeds": (lambda rng: ratio_of_errors(rng, 4), math.sqrt(0.5)),
    "ratio of errors, 10 seeds": (lambda rng: ratio_of_errors(rng, 10), math.sqrt(0.5)),
    "ratio of costs, 16 seeds": (lambda rng: interval(
        (pair := squares(rng, 16))[0], ratio_of_means, pair[1]), 0.5),
    "signed mean, 8 seeds": (lambda rng: interval(0.3 + rng.laplace(size=8)), 0.3),
    "mean share, 4 seeds": (lambda rng: mean_share(rng.beta(9.0, 0.5, 4)), 9.0 / 9.5),
    "mean share, 16 seeds": (lambda rng: mean_share(rng.beta(0.5, 9.0, 16)), 0.5 / 9.5),
}  # fmt: skip


def ratio_of_errors(rng: Random, n: int) -> Estimate:
    ours, theirs = squares(rng, n)
    return interval(ours, ratio_of_roots, theirs)


def hits(estimates: Sequence[Estimate], true: float) -> int:
    return sum(each.low <= true <= each.high for each in estimates)


@pytest.mark.long
@pytest.mark.parametrize("name", OF_STRATA)
def test_intervals_over_strata_cover_93_of_100_data_sets(name: str) -> None:
    """The true number is that of strata as large as can be, of the same laws."""
    statistic, sizes = OF_STRATA[name]
    true = statistic(np.random.default_rng(11), [MANY] * len(sizes)).value
    rng = np.random.default_rng(7)
    count = hits([statistic(rng, sizes) for _ in range(SETS)], true)
    assert count >= LEAST
    if name in TIGHT:
        assert count <= MOST


@pytest.mark.long
@pytest.mark.parametrize("name", OF_SEEDS)
def test_intervals_over_seeds_cover_93_of_100_data_sets(name: str) -> None:
    statistic, true = OF_SEEDS[name]
    rng = np.random.default_rng(8)
    assert hits([statistic(rng) for _ in range(SETS)], true) >= LEAST


@pytest.mark.parametrize("n", [8, 64, 256])
def test_failure_rates_are_covered_by_enumeration(n: int) -> None:
    """Wilson's interval has its 95 % on average over the rates."""
    ends = np.array([share(np.arange(n) < k)[1:] for k in range(n + 1)])
    rates = np.linspace(0.01, 0.99, 197)
    holds = (ends[:, :1] <= rates) & (rates <= ends[:, 1:])
    covered = (binom.pmf(np.arange(n + 1)[:, None], n, rates) * holds).sum(axis=0)
    assert covered.mean() >= 0.95
    assert np.mean(covered < 0.93) <= (1.0 / 6.0 if n < 64 else 0.02)


def test_no_mean_knows_the_failures_that_no_episode_shows() -> None:
    """Where one of 64 cars fails, the interval of the mean covers; where none does, none can."""
    rng = np.random.default_rng(10)
    true = 0.98 * math.exp(0.5) + 0.02 * 275.0
    cost = rng.lognormal(0.0, 1.0, (SETS, 64))
    cost = np.where(rng.random(cost.shape) < 0.02, rng.uniform(50.0, 500.0, cost.shape), cost)
    shown = (cost > 50.0).any(axis=1)
    assert hits([interval(each) for each in cost[shown]], true) >= 0.95 * shown.sum()
    assert hits([interval(each) for each in cost[~shown]], true) <= 0.05 * (~shown).sum()
    assert share(np.zeros(64)).high > 0.02


def test_margins_are_students_and_welchs() -> None:
    """Of numbers without outliers, on one mean and on the difference of two."""
    few, many = np.array([1.0, 4.0, 2.0]), 3.0 + 0.1 * np.arange(12.0)
    low, high = ttest_1samp(few, 0.0).confidence_interval()
    assert average(few) == pytest.approx((few.mean(), low, high))
    low, high = ttest_ind(few, many, equal_var=False).confidence_interval()
    assert margin_of_error(few, -many) == pytest.approx(0.5 * (high - low))
    found = average(few, -many)
    assert 0.5 * (found.high - found.low) == pytest.approx(0.25 * (high - low))
    assert margin_of_error(few, np.full(5, 2.0)) == margin_of_error(few)


def test_an_outlier_leaves_few_degrees_of_freedom() -> None:
    """What one number of a hundred decides is known as from two or three, not from a hundred."""
    one = np.zeros(100)
    one[0] = 100.0
    assert margin_of_error(one) == pytest.approx(4.303, abs=1e-3)  # sd 10, t of 2
    flat = np.linspace(-1.0, 1.0, 100)
    assert margin_of_error(flat) == pytest.approx(1.984 * flat.std(ddof=1) / 10.0, rel=1e-3)


def test_what_the_numbers_are() -> None:
    rng = np.random.default_rng(3)
    nominal, mine, _ = costs(rng, 500)
    ratio = geometric_mean(np.log(mine / nominal))
    assert ratio.value == pytest.approx(np.prod((mine / nominal) ** (1.0 / 500)))
    assert ratio.low * ratio.high == pytest.approx(ratio.value**2)
    assert compute_win_rate(np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0, 2.0])).value == 0.5
    tail = compute_tail_mean(mine)
    assert tail.value == pytest.approx(np.sort(mine)[-25:].mean())
    assert tail.low < tail.value < tail.high
    assert compute_tail_mean(np.where(mine < np.median(mine), 0.1 * mine, mine)) == tail


def test_strata_have_one_weight_each() -> None:
    few, many = np.full(4, 2.0), np.full(400, 4.0)
    assert average(few, many) == pytest.approx((3.0, 3.0, 3.0))
    assert geometric_mean(np.log(few), np.log(many)).value == pytest.approx(8.0**0.5)


def test_rates_near_zero_and_one_have_an_interval() -> None:
    """Nobody of 100 failed: by Wilson at most 3.7 % do, and no interval leaves [0, 1]."""
    none, all_ = share(np.zeros(100)), share(np.ones(100))
    assert none.low == pytest.approx(0.0, abs=1e-9) and none.high == pytest.approx(0.037, abs=1e-3)
    assert (all_.low, all_.high) == pytest.approx((1.0 - none.high, 1.0))


@pytest.mark.parametrize("n", [0, 1])
def test_nothing_to_count_is_no_number(n: int) -> None:
    few = np.ones(n)
    for found in (geometric_mean(few), compute_tail_mean(few)):
        assert math.isnan(found.value) == (n == 0) and math.isnan(found.low)
    assert math.isnan(share(few).value) == (n == 0)
    lost = np.array([1.0, np.nan])
    assert math.isnan(share(lost).value) and math.isnan(compute_tail_mean(lost).value)


def far_away(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.asarray(-7.0 - 1.5 * np.mean(values, axis))


def test_the_interval_is_of_the_same_statistic_as_the_estimate() -> None:
    """The root's interval is the interval's root, that of a line the line of the interval."""
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
    """Agarwal et al., NeurIPS 2021: Mann and Whitney's U over the pairs; our task is a seed."""
    rng = np.random.default_rng(7)
    costs, others = (rng.integers(0, 6, 80).astype(float) for _ in range(2))
    U = [mannwhitneyu([-a], [-b]).statistic for a, b in zip(costs, others, strict=True)]
    assert compute_win_rate(costs, others).value == pytest.approx(np.mean(U), abs=1e-12)
