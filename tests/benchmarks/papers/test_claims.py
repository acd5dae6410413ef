"""The ledger's rule, its arithmetic, and that every claim of it can be measured."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.harness.metrics import METRICS
from sideslip.benchmarks.harness.stats import Bound
from sideslip.benchmarks.papers import dual_rate, suite
from sideslip.benchmarks.papers.ledger import (
    Claim,
    ClaimPart,
    MeasuredClaim,
    Numbers,
    Results,
    SeedResult,
    Simulation,
    join_numbers,
)
from sideslip.benchmarks.papers.suite import CLAIMS, SIMULATIONS
from sideslip.benchmarks.papers.tie_vision_theory import _compute_residuals
from sideslip.benchmarks.report.study import Request


def measure(results: Results, *parts: ClaimPart) -> MeasuredClaim:
    measured = [part.measure(results) for part in parts]
    return MeasuredClaim("p", Claim("(1)", "t", parts), measured)


def judged(*parts: tuple[Any, Any]) -> str:
    """The verdict on parts of (numbers, bound)."""
    results = {"s": {(str(i), "m"): np.array(v) for i, (v, _) in enumerate(parts)}}
    made = [ClaimPart("l", "s", str(i), "m", bound) for i, (_, bound) in enumerate(parts)]
    return measure(results, *made).verdict


BELOW = Bound("<", 1.0)
ALWAYS, NINE, SIX, NEVER = [0.5] * 10, [0.5] * 9 + [2.0], [0.5] * 6 + [2.0] * 4, [2.0] * 10


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([(ALWAYS, BELOW)], "reproduced"),
        ([(NINE, BELOW)], "reproduced"),
        ([(SIX, BELOW)], "partly"),
        ([(NEVER, BELOW)], "not reproduced"),
        ([(ALWAYS, BELOW), (NEVER, BELOW)], "partly"),
        ([(SIX, BELOW), (SIX, BELOW)], "partly"),
        ([(NEVER, BELOW), (NEVER, BELOW)], "not reproduced"),
        ([(NEVER, None)], "report only"),
        ([(ALWAYS, BELOW), (NEVER, None)], "reproduced"),
        ([([np.nan] * 3, BELOW)], "not reproduced"),
    ],
)
def test_the_verdict_follows_from_the_numbers(parts: Any, expected: str) -> None:
    assert judged(*parts) == expected


def test_a_threshold_is_one_of_the_median_and_not_of_the_verdict() -> None:
    results = {"s": {("a", "m"): np.array([0.7, 0.8, 5.0])}}
    found = measure(results, ClaimPart("l", "s", "a", "m", BELOW, Bound("<=", 0.75)))
    assert found.parts[0].number == (0.8, 0.7, 5.0)
    assert found.parts[0].meets_threshold is False
    assert found.verdict == "partly"


def test_ratios_are_taken_seed_by_seed() -> None:
    numbers = {("a", "beta"): [1.0, 2.0], ("b", "beta"): [2.0, 1.0], ("c", "beta"): [4.0, 8.0]}
    results = {"s": {key: np.array(value) for key, value in numbers.items()}}
    for rivals, pick, expected in (
        (("b",), np.min, [0.5, 2.0]),
        (("b", "c"), np.max, [0.25, 0.25]),
        (("b", "c"), np.min, [0.5, 2.0]),
    ):
        found = ClaimPart("l", "s", "a", rivals=rivals, pick=pick).measure(results)
        np.testing.assert_array_equal(found.values, expected)
    pooled = ClaimPart("l", "s", "a", rivals=("c",), is_pooled=True).measure(results)
    assert pooled.values == pytest.approx([0.25])


def test_the_ledger_names_what_exists() -> None:
    for _, claim in CLAIMS:
        for part in claim.parts:
            assert part.scenario in SIMULATIONS and part.metric in METRICS


def test_every_simulation_has_its_share_of_the_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """All seven, but for what nothing is drawn in, for shares, and for five times as many."""
    numbers: Numbers = {(x.subject, x.quantity): 1.0 for _, claim in CLAIMS for x in claim.parts}
    numbers |= {(rival, x.quantity): 1.0 for _, y in CLAIMS for x in y.parts for rival in x.rivals}
    seen = dict[str, list[int]]()

    def run(case: tuple[Simulation, Sequence[int]]) -> list[SeedResult]:
        seen.setdefault(case[0].name, []).extend(case[1])
        return [SeedResult(numbers)] * len(case[1])

    monkeypatch.setattr(suite, "run_simulation", run)
    suite._measure(Request(episodes=7, jobs=1))
    assert all(seeds == list(range(len(seeds))) for seeds in seen.values())
    once = ("tie-vision-table2", "tie-vision-static", "uneven-delay-rank", "dual-rate-rank")
    counts = dict.fromkeys(SIMULATIONS, 7) | dict.fromkeys((*once, "dakf-rank"), 1)
    others = {"tie-vision-fig7": 35, "dakf-fig7-larger": 2, "dakf-fig9": 4}
    assert {name: len(seeds) for name, seeds in seen.items()} == counts | others


def test_joined_numbers_keep_the_order_of_the_seeds() -> None:
    outcomes = [SeedResult({("a", "m"): np.array([k, k + 1.0]), ("b", "m"): k}) for k in (0.0, 2.0)]
    joined = join_numbers(outcomes)
    np.testing.assert_array_equal(joined["a", "m"], np.arange(4.0))
    np.testing.assert_array_equal(joined["b", "m"], [0.0, 2.0])


def test_exact_ranks() -> None:
    """Ranks: dakf 4 of 5, dual-rate 4 of 6, vision alone 4 of 4."""
    ranks = {name: value for (name, _), value in dual_rate.compute_coms_ranks(0).items()}
    assert ranks == {"dakf": 4.0, "dual-rate": 4.0, "vision": 4.0}
    singular = np.array([[Fraction(1, 3), Fraction(2, 3)], [Fraction(1), Fraction(2)]])
    assert dual_rate._rank(singular) == 1


def test_the_appendix_holds_as_corrected_and_fails_as_printed() -> None:
    """tie-vision's appendix on random time-varying systems."""
    for seed in range(3):
        for (label, _), value in _compute_residuals(seed).items():
            assert value > 0.01 if label.endswith("printed") else value < 1e-12, label
