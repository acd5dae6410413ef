"""Scores: what 0 and 1 are, which episodes count, what a failure costs."""

import math
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.control.run import NUMBERS, DriveResult
from sideslip.benchmarks.control.score import ScoreScale, compute_log_ratios, score
from sideslip.envs import FAILURES

Array = np.ndarray
SPIN = float(FAILURES.index("spin"))


def driven(costs: Any, failed: Any = (), error: str = "") -> DriveResult:
    """Episodes of these costs, some of which spun."""
    numbers = np.ones((len(costs), len(NUMBERS)))
    numbers[:, NUMBERS.index("cost")] = costs
    numbers[:, NUMBERS.index("failure")] = 0.0
    numbers[list(failed), NUMBERS.index("failure")] = SPIN
    return DriveResult(numbers, 1.0, error=error)


def test_nominal_scores_zero_the_oracle_one_and_half_of_the_way_half() -> None:
    rng = np.random.default_rng(0)
    best = rng.lognormal(0.0, 1.0, 50) + 1.0
    middle, nominal = (best + 0.001) * 2.0 - 0.001, (best + 0.001) * 4.0 - 0.001
    yard = ScoreScale(driven(nominal), driven(best))
    assert yard.gap == pytest.approx(math.log(4.0))
    for costs, expected in ((nominal, 0.0), (middle, 0.5), (best, 1.0)):
        found = score([yard.compute_paired_ratios(driven(costs))])
        assert found == pytest.approx((expected,) * 3, abs=1e-12)


def test_the_score_is_a_ratio_of_sums_over_contests() -> None:
    """A contest with little to win weighs little, whatever is done there."""
    wide = ScoreScale(driven([8.0] * 4), driven([1.0] * 4))
    narrow = ScoreScale(driven([1.08] * 4), driven([1.0] * 4))
    drives = ((wide, 1.0), (narrow, 1.2))
    pairs = [scale.compute_paired_ratios(driven([cost] * 4)) for scale, cost in drives]
    gaps = wide.gap, narrow.gap
    expected = (gaps[0] + math.log(1.081 / 1.201)) / sum(gaps)
    assert score(pairs).value == pytest.approx(expected)
    assert score(pairs).value > 0.9 > np.mean([1.0, score(pairs[1:]).value])


def test_only_episodes_that_both_rungs_survive_count() -> None:
    nominal, oracle = driven([4.0] * 6, [0]), driven([2.0] * 6, [1, 2])
    yard = ScoreScale(nominal, oracle)
    assert yard.mark_compared(6).tolist() == [False, False, False, True, True, True]
    r, own = yard.compute_paired_ratios(driven([2.0] * 6, [0, 3]))
    assert own == pytest.approx([math.log(4.001 / 2.001)] * 3)
    assert r.tolist() == pytest.approx([math.log(1.0 / 20.0), own[1], own[2]])


def test_one_wild_episode_counts_for_three_at_most() -> None:
    r = compute_log_ratios(np.array([1.0, 1.0, 1.0]), driven([1e9, 0.0, 1.0]))
    assert r.tolist() == [-3.0, 3.0, 0.0]


def test_a_slow_contestant_is_paired_with_its_own_episodes() -> None:
    """And a slow oracle pairs everybody with the few that it drove."""
    rng = np.random.default_rng(1)
    costs = rng.lognormal(0.0, 1.0, 20)
    for oracles, mine, n in ((20, 5, 5), (8, 20, 8)):
        yard = ScoreScale(driven(2.0 * costs), driven(0.5 * costs[:oracles]))
        r, own = yard.compute_paired_ratios(driven(costs[:mine]))
        assert len(r) == len(own) == n
        assert r == pytest.approx(np.log((2.0 * costs[:n] + 0.001) / (costs[:n] + 0.001)))


def test_nothing_to_win_or_to_count_is_no_score() -> None:
    same = ScoreScale(driven([1.0] * 4), driven([0.97] * 4))
    assert math.isnan(score([same.compute_paired_ratios(driven([0.5] * 4))]).value)
    lost = ScoreScale(driven([1.0] * 4, range(4)), driven([0.5] * 4))
    assert math.isnan(lost.gap)
    assert math.isnan(score([lost.compute_paired_ratios(driven([0.5] * 4))]).value)
    good = ScoreScale(driven([2.0] * 4), driven([0.5] * 4))
    pairs = [scale.compute_paired_ratios(driven([0.5] * 4)) for scale in (lost, good)]
    assert score(pairs).value == pytest.approx(1.0)  # the rest goes on
    with pytest.raises(ValueError, match="oracle-state: no plant"):
        ScoreScale(driven([1.0]), driven([1.0], error="no plant"))
