"""Paired statistics: what they are, and how often their 95 % intervals hold the true number."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import trim_mean

from sideslip.benchmarks.harness.stats import (
    Estimate,
    average,
    chance_of_no_less,
    geometric_mean,
    holm,
    ratio_of_sums,
    share,
    won,
    worst,
)

Array = np.ndarray
SETS = 1000


def costs(rng: np.random.Generator, n: int) -> tuple[Array, Array, Array]:
    """(nominal, a contestant, the best) on the same n seeds: skewed, and 2 % of the cars fail."""
    seed = np.where(rng.random(n) < 0.02, rng.uniform(50.0, 500.0, n), rng.lognormal(0.0, 1.0, n))
    mine, best = rng.gamma(2.0, 0.4, n), rng.gamma(2.0, 0.2, n)
    return seed, seed * mine, seed * best


def logs(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Clipped logarithms of nominal's cost over the contestant's and over the best's."""
    nominal, mine, best = costs(rng, n)
    r, gap = (np.clip(np.log(nominal / each), -3.0, 3.0) for each in (mine, best))
    return r, gap


def score(rng: np.random.Generator, n: int) -> Estimate:
    strata = [logs(rng, n), logs(rng, n), logs(rng, n)]
    return ratio_of_sums([r for r, _ in strata], [gap for _, gap in strata])


STATISTICS: dict[str, tuple[Callable[[np.random.Generator, int], Estimate], int]] = {
    "geometric mean": (lambda rng, n: geometric_mean(logs(rng, n)[0]), 60),
    "score": (score, 40),
    "average": (lambda rng, n: average(costs(rng, n)[1] / costs(rng, n)[0].clip(1.0)), 100),
    "share won": (lambda rng, n: won(*costs(rng, n)[1::-1]), 100),
    "failure rate": (lambda rng, n: share(costs(rng, n)[0] > 50.0), 400),
    "worst 5 %": (lambda rng, n: worst(costs(rng, n)[1]), 1000),
}


@pytest.mark.long
@pytest.mark.parametrize("name", STATISTICS)
def test_intervals_cover_in_92_to_98_of_100_data_sets(name: str) -> None:
    """The true number is that of a million episodes of the same law."""
    statistic, n = STATISTICS[name]
    true = truth(name)
    rng = np.random.default_rng(7)
    found = [statistic(rng, n) for _ in range(SETS)]
    hits = sum(each.low <= true <= each.high for each in found)
    assert 0.92 <= hits / SETS <= 0.98, hits


def truth(name: str) -> float:
    rng = np.random.default_rng(11)
    r, gap = logs(rng, 1_000_000)
    nominal, mine, _ = costs(rng, 1_000_000)
    true: dict[str, float] = {
        "geometric mean": math.exp(r.mean()),
        "score": r.mean() / gap.mean(),
        "average": float(np.mean(mine / costs(rng, 1_000_000)[0].clip(1.0))),
        "share won": float(np.mean(mine < nominal)),
        "failure rate": float(np.mean(nominal > 50.0)),
        "worst 5 %": float(np.sort(mine)[-50_000:].mean()),
    }
    return true[name]


def test_what_the_numbers_are() -> None:
    rng = np.random.default_rng(3)
    nominal, mine, _ = costs(rng, 500)
    r, gap = logs(rng, 500)
    ratio = geometric_mean(np.log(mine / nominal))
    assert ratio.value == pytest.approx(np.prod((mine / nominal) ** (1.0 / 500)))
    assert ratio.low * ratio.high == pytest.approx(ratio.value**2)
    assert won(np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0, 2.0])).value == 0.5
    assert worst(mine).value == pytest.approx(np.sort(mine)[-25:].mean())
    assert worst(mine).low < worst(mine).value < worst(mine).high
    sums = ratio_of_sums([r, 2.0 * r], [gap, gap])
    assert sums.value == pytest.approx(3.0 * r.mean() / (2.0 * gap.mean()))
    assert trim_mean(r, 0.25) / gap.mean() != pytest.approx(sums.value, rel=1e-3)  # no middle


def test_strata_have_one_weight_each() -> None:
    few, many = np.full(4, 2.0), np.full(400, 4.0)
    assert average(few, many) == pytest.approx((3.0, 3.0, 3.0))
    assert geometric_mean(np.log(few), np.log(many)).value == pytest.approx(8.0**0.5)


def test_pairing_makes_intervals_narrow() -> None:
    """An episode's top and bottom stay together: a constant ratio has no spread at all."""
    _, gap = logs(np.random.default_rng(0), 50)
    found = ratio_of_sums([0.7 * gap], [gap])
    assert found == pytest.approx((0.7, 0.7, 0.7), rel=1e-12)


def test_rates_near_zero_and_one_have_an_interval() -> None:
    """Nobody of 100 failed: by Wilson at most 3.7 % do, and no interval leaves [0, 1]."""
    none, all_ = share(np.zeros(100)), share(np.ones(100))
    assert none.low == pytest.approx(0.0, abs=1e-9) and none.high == pytest.approx(0.037, abs=1e-3)
    assert (all_.low, all_.high) == pytest.approx((1.0 - none.high, 1.0))


def test_holm_is_the_step_down() -> None:
    assert holm([0.001, 0.04, 0.02, 0.5]) == [True, False, False, False]  # 0.02 > 0.05 / 3
    assert holm([0.001, 0.02, 0.016, 0.5]) == [True, True, True, False]
    assert holm([]) == []


@pytest.mark.long
def test_holm_accuses_nobody_in_19_of_20_tables() -> None:
    """Twenty contestants as good as the best, 500 times: at most one table in 20 accuses one."""
    rng = np.random.default_rng(5)
    wrong = sum(
        any(holm([chance_of_no_less(rng.laplace(size=64)) for _ in range(20)])) for _ in range(500)
    )
    assert wrong / 500 < 0.08
    assert holm([chance_of_no_less(rng.normal(-0.5, 1.0, 64)) for _ in range(20)]).count(True) > 10


@pytest.mark.parametrize("n", [0, 1])
def test_nothing_to_count_is_no_number(n: int) -> None:
    few = np.ones(n)
    for found in (geometric_mean(few), ratio_of_sums([few], [few]), worst(few)):
        assert math.isnan(found.value) == (n == 0) and math.isnan(found.low)
    assert math.isnan(share(few).value) == (n == 0)
    assert chance_of_no_less(few) == 1.0
    assert math.isnan(ratio_of_sums([], []).value)
    assert math.isnan(ratio_of_sums([np.ones(4)], [-np.ones(4)]).value)
    assert all(math.isnan(each(np.array([1.0, np.nan])).value) for each in (share, worst))
