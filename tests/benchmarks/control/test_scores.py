"""Scores: r of a drive, what a loss counts, which drives count, who stands below the line."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.control.entries import Entry
from sideslip.benchmarks.control.run import NUMBERS, DriveResult
from sideslip.benchmarks.control.score import (
    PairedDrives,
    compute_log_ratios,
    rank_entries,
)
from sideslip.benchmarks.control.suite import _compare_entries, _list_reversals
from sideslip.benchmarks.control.tasks import NOMINAL, STEERING, YAW, ControlTask
from sideslip.benchmarks.harness.stats import Estimate, is_share_larger
from sideslip.envs import FAILURES
from sideslip.envs.scenarios.manoeuvres import SCENARIOS
from sideslip.envs.task import REFERENCES, compute_cost_rate

SPIN = float(FAILURES.index("spin"))
TASK = ControlTask("road", YAW, "passenger-car", "lagged", "road-step")


def driven(costs: Any, failed: Any = (), error: str = "") -> DriveResult:
    """Episodes of these costs, some of which spun."""
    numbers = np.ones((len(costs), len(NUMBERS)))
    numbers[:, NUMBERS.index("cost")] = costs
    numbers[:, NUMBERS.index("failure")] = 0.0
    numbers[list(failed), NUMBERS.index("failure")] = SPIN
    return DriveResult(numbers, error=error)


def test_half_of_the_cost_and_the_losses() -> None:
    """Drives that both finish, that one of them loses, and that both lose."""
    nominal, own = driven([4.0, 4.0, 9e2, 9e2], [2, 3]), driven([1.5, 9e2, 4.0, 9e2], [1, 3])
    pair = PairedDrives(nominal, own, 1.0)
    assert pair.compute_scores() == pytest.approx([math.log(2.0), -2.0, 2.0, 0.0])
    assert pair.compute_scores(3.0, 2.0) == pytest.approx([math.log(6.0 / 3.5), -3.0, 3.0, 0.0])
    assert pair.both.tolist() == [True, False, False, False]
    swapped = PairedDrives(own, nominal, 1.0).compute_scores()
    assert swapped == pytest.approx(-pair.compute_scores())


def test_what_instruments_do_not_resolve_hardly_counts() -> None:
    """A hundredth of nominal's cost is little where nominal's is a hundredth of J_0."""
    pair = PairedDrives(driven([0.01]), driven([0.0001]), 1.0)
    assert 0.0 < pair.compute_scores()[0] < 0.01
    assert compute_log_ratios(np.array([0.01]), driven([0.0001]))[0] > 2.0


@pytest.mark.parametrize("reference", ["lagged", "zero-slip"])
def test_the_floor_is_the_cost_of_a_quarter_degree(reference: str) -> None:
    """And of half a degree a second where yaw rate is judged; of the manoeuvre, not before it."""
    task = ControlTask("road", STEERING, "passenger-car", reference, "road-step")
    errors = math.radians(0.25), math.radians(0.5)
    rate = compute_cost_rate(*errors, 0.0, 0.0, REFERENCES.index(reference))
    assert task.cost_floor == pytest.approx(rate * SCENARIOS["road-step"].duration, rel=2e-3)


def test_a_slow_contestant_is_paired_with_its_own_episodes() -> None:
    costs = np.random.default_rng(1).lognormal(0.0, 1.0, 20)
    pair = PairedDrives(driven(2.0 * costs), driven(costs[:5]), 0.0)
    assert pair.compute_scores() == pytest.approx(np.full(5, math.log(2.0)))


def test_below_the_line_stand_those_that_surely_lose_more_cars() -> None:
    """However good they are otherwise; equal numbers of losses in other drives do not suffice."""
    nominal, n = driven(np.full(40, 8.0), range(10)), 40
    entries = {
        "sure": driven(np.full(n, 0.1), range(20)),  # 10 losses more, in the same drives
        "unsure": driven(np.full(n, 4.0), range(13)),
        "other": driven(np.full(n, 6.0), range(20, 30)),
    }
    results = {(TASK, Entry(name)): result for name, result in entries.items()}
    results[TASK, Entry(NOMINAL)] = nominal
    ranked = rank_entries(results, "road")
    assert [item.entry.label for item in ranked][-1] == "sure" and ranked[-1].loses_more
    assert not any(item.loses_more for item in ranked[:-1])


def test_who_leaves_out_a_task_is_ranked_behind_who_drives_it() -> None:
    """However good it is in the others: a task left out would be one of its worst."""
    other = replace(TASK, scenario="road-slalom")
    results = {(task, Entry(NOMINAL)): driven([8.0] * 10) for task in (TASK, other)}
    results |= {(task, Entry("whole")): driven([9.0] * 10) for task in (TASK, other)}
    results |= {(TASK, Entry("part")): driven([1.0] * 10)}
    results[other, Entry("part")] = replace(driven([1.0] * 10), error="ValueError: no, thanks")
    ranked = rank_entries(results, "road")
    assert [item.entry.label for item in ranked] == ["nominal", "whole", "part"]
    assert [item.rank[0] for item in ranked] == [0, 0, 1]


def test_a_larger_share_is_sure_by_the_sign_of_what_differs() -> None:
    """Six of six that differ are sure at 2.5 %, one-sided, five of five are not."""
    other = np.zeros(100, bool)
    for count, sure in ((6, True), (5, False)):
        assert is_share_larger(np.arange(100) < count, other) is sure
        assert is_share_larger(other, np.arange(100) < count) is False
    assert is_share_larger(other, other) is False


def test_sure_shares_are_rarely_wrong() -> None:
    """Of equal shares that correlate, at most one in forty is called larger."""
    rng = np.random.default_rng(0)
    for n, share in ((12, 0.5), (40, 0.2), (200, 0.05)):
        wrong = 0
        for _ in range(2000):
            shared = rng.random(n) < 0.5 * share
            one, other = (shared | (rng.random(n) < 0.5 * share) for _ in range(2))
            wrong += is_share_larger(one, other)
        assert wrong / 2000 <= 0.03


def test_one_wild_episode_counts_for_three_at_most() -> None:
    r = compute_log_ratios(np.array([1.0, 1.0, 1.0]), driven([1e9, 0.0, 1.0]))
    assert r.tolist() == [-3.0, 3.0, 0.0]


def test_a_reversal_is_sure_in_both_worlds() -> None:
    """Of costs that differ by a factor; what is unsure in either world is none."""
    noise = np.random.default_rng(0).lognormal(0.0, 0.3, (3, 40))

    def compare(**levels: float) -> dict[tuple[str, str], Estimate]:
        results = {(TASK, Entry(NOMINAL)): driven(np.full(40, 8.0))}
        for (name, level), factor in zip(levels.items(), noise[: len(levels)], strict=True):
            results[TASK, Entry(name)] = driven(level * factor)
        return _compare_entries(results)

    base = compare(a=1.0, b=2.0, c=2.01)
    assert _list_reversals(base, compare(a=2.0, b=1.0, c=2.01)) == [("a", "b")]
    assert _list_reversals(base, compare(a=2.0, b=4.0, c=4.0)) == []
    reversed_pairs = _list_reversals(compare(a=2.0, b=1.0, c=1.0), base)
    assert sorted(reversed_pairs) == [("b", "a"), ("c", "a")]
    assert not _list_reversals(base, compare(a=1.0, b=2.01, c=2.0))
    assert not _list_reversals(base, compare(a=2.0))  # the others cannot drive there
