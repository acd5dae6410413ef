"""Scores: what 0 and 1 mean, the interquartile mean, intervals that cover, salted seeds."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean

from sideslip.benchmarks.control.scores import (
    Ceiling,
    Resampled,
    improvement,
    normalised,
)
from sideslip.benchmarks.control.seeds import salt_of, salted_seeds
from sideslip.benchmarks.control.tables import _geometric
from sideslip.benchmarks.harness.stats import Estimate

TOP = Ceiling(1.0, 0.0)


def costs(seed: int, n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    none = 5.0 + rng.gamma(2.0, 1.0, n)
    return none, 0.4 * none + rng.normal(0.0, 0.3, n)


def test_none_scores_zero_and_the_ceiling_one() -> None:
    none, _ = costs(0)
    assert normalised(none, none, TOP).mean() == pytest.approx(0.0, abs=1e-15)
    assert normalised(none, np.full(len(none), TOP.mean), TOP).mean() == pytest.approx(1.0)


def test_the_mean_of_the_episodes_scores_is_the_score_of_the_means() -> None:
    none, mine = costs(1)
    by_means = (none.mean() - mine.mean()) / (none.mean() - TOP.mean)
    found = Resampled(len(none), 1).score(none, mine, TOP, 0)
    assert found.value == pytest.approx(by_means, rel=1e-12)
    assert found.low < found.value < found.high


def test_iqm_leaves_out_a_quarter_at_either_end() -> None:
    tables = [costs(k) for k in range(3)]
    none, mine = np.array([t[0] for t in tables]), np.array([t[1] for t in tables])
    mine[0, :40] = 1e6  # a fifteenth of the episodes went wrong
    draw = Resampled(mine.shape[1], 3)
    found = draw.aggregate(none, mine, [TOP] * 3)
    scores = np.array([normalised(n, m, TOP) for n, m in zip(none, mine, strict=True)])
    ordered = np.sort(scores.ravel())
    assert found["iqm"].value == pytest.approx(ordered[150:450].mean(), rel=1e-12)
    assert found["iqm"].value == pytest.approx(trim_mean(scores, 0.25, axis=None))
    assert found["score"].value < -1e3 < 0.4 < found["iqm"].value


def test_intervals_cover_what_they_should() -> None:
    """95 % intervals of 200 samples of the same law hold the true score 187 to 196 times or so."""
    true = (7.0 - 0.4 * 7.0) / (7.0 - TOP.mean)
    hit = 0
    for k in range(200):
        none, mine = costs(100 + k, n=100)
        found = Resampled(100, 1).score(none, mine, TOP, 0)
        hit += found.low <= true <= found.high
    assert 178 <= hit <= 199  # binomial(200, 0.95), 99.9 %


def skewed(manoeuvres: int, seeds: int, which: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(none, costs), (manoeuvres, seeds) each: means, medians and middles lie far apart."""
    rng = np.random.default_rng(which)
    level = np.arange(1.0, manoeuvres + 1.0)[:, None]
    none = level * (5.0 + rng.gamma(2.0, 1.0, (manoeuvres, seeds)))
    return none, 0.2 * none + level * rng.gamma(0.3, 6.0, (manoeuvres, seeds))


def estimates(draw: Resampled, none: np.ndarray, mine: np.ndarray) -> dict[str, Estimate]:
    """Everything that `Resampled` gives of the same episodes."""
    tops = [Ceiling(0.5 * (i + 1.0), 0.0) for i in range(len(none))]
    return {
        "score of one": draw.score(none[0], mine[0], tops[0], 0),
        "over": draw.over(mine[1], none[1], 1),
        "mean": draw.mean(mine[1], 1),
    } | draw.aggregate(none, mine, tops)


def test_on_the_sample_itself_every_interval_is_its_estimate() -> None:
    """Resamples that are the sample: whatever the interval is computed from is then the value."""
    draw = Resampled(50, 3)
    draw.draws = np.broadcast_to(np.arange(50), draw.draws.shape)
    found = estimates(draw, *skewed(3, 50))
    assert len({round(each.value, 3) for each in found.values()}) == len(found)  # far apart
    for name, each in found.items():
        assert (each.low, each.high) == pytest.approx((each.value, each.value), rel=1e-12), name


def test_every_interval_covers_its_own_number() -> None:
    """95 % intervals of 60 samples hold what a very large sample of the same law gives."""
    true = {name: each.value for name, each in estimates_of_many().items()}
    hits = dict.fromkeys(true, 0)
    for k in range(60):
        for name, each in estimates(Resampled(60, 3), *skewed(3, 60, 1 + k)).items():
            hits[name] += each.low <= true[name] <= each.high
    for name, hit in hits.items():  # the percentile bootstrap of 60 skewed numbers: some 92 %
        assert 48 <= hit <= 60, name


def estimates_of_many() -> dict[str, Estimate]:
    """The estimates of 50,000 seeds, without intervals."""
    draw = Resampled(1, 3)
    draw.draws = np.zeros((1, 3, 1), int)
    draw.normal = np.zeros((1, 3))
    return estimates(draw, *skewed(3, 50_000))


def test_the_geometric_means_interval_is_around_it_and_covers_it() -> None:
    """Three manoeuvres whose ratios are 2, 1 and 0.5 times the same: their geometric mean."""
    rng, hit = np.random.default_rng(0), 0
    for _ in range(300):
        logs = rng.normal(np.log([2.0, 1.0, 0.5]), [0.1, 0.2, 0.3])
        ends = 1.96 * np.array([0.1, 0.2, 0.3])
        found = _geometric(
            [Estimate(*np.exp([m, m - e, m + e])) for m, e in zip(logs, ends, strict=True)]
        )
        assert found.value == pytest.approx(np.prod(np.exp(logs)) ** (1.0 / 3.0))
        assert found.low * found.high == pytest.approx(found.value**2)
        hit += found.low <= 1.0 <= found.high
    assert 273 <= hit <= 297  # binomial(300, 0.95), 99.9 %


def test_the_ceilings_error_widens_the_interval() -> None:
    none, mine = costs(2)
    draw = Resampled(len(none), 1)
    sure, unsure = (draw.score(none, mine, Ceiling(1.0, e), 0) for e in (0.0, 0.5))
    assert unsure.half_width > 1.5 * sure.half_width


def test_probability_of_improvement_is_mann_whitneys() -> None:
    ours, theirs = costs(3)[1], costs(4)[1]
    ours[:20] = theirs[:20]  # ties
    u = mannwhitneyu(theirs, ours).statistic / (len(ours) * len(theirs))
    assert improvement(ours, theirs) == pytest.approx(u, rel=1e-12)
    assert improvement(ours, theirs) + improvement(theirs, ours) == pytest.approx(1.0)


def test_seeds_follow_the_salt_and_only_grow() -> None:
    salt = salt_of()
    assert salt == salt_of() and salt != salt_of("more")
    assert salted_seeds(salt, 10) == salted_seeds(salt, 30)[:10]
    assert salted_seeds(salt_of("more"), 10) != salted_seeds(salt, 10)
    assert len(set(salted_seeds(salt, 1000))) == 1000
    with pytest.raises(ValueError, match=r"hexadecimal|invalid literal"):
        salted_seeds("not a salt", 3)
