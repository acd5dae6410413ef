"""Verdicts name the truly best by construction, call a tie a tie, and stay within five lines."""

from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.harness.stats import Bound, Estimate
from sideslip.benchmarks.papers import suite as papers
from sideslip.benchmarks.papers.ledger import Claim, ClaimPart, MeasuredClaim, MeasuredPart
from sideslip.benchmarks.papers.manoeuvres import BOUND
from sideslip.benchmarks.procedures import iso
from sideslip.benchmarks.procedures import suite as procedures
from sideslip.benchmarks.procedures.drive import CARS, ENTRIES, ProcedureCase
from sideslip.benchmarks.procedures.fmvss126 import SineDwellResult, SineDwellRun
from sideslip.benchmarks.recorded import replay as recorded
from sideslip.benchmarks.recorded.replay import ReplayResult as Replayed
from sideslip.benchmarks.report.study import LETTERS, LINES, describe_leader, format_verdict
from sideslip.benchmarks.speed import env_steps
from sideslip.benchmarks.speed import suite as speed
from sideslip.benchmarks.speed.timing import TimeTable
from sideslip.benchmarks.studies import estimation

RNG = np.random.default_rng(0)


def fits(text: str) -> list[str]:
    """The lines of a verdict, none too long, none empty."""
    found = text.splitlines()
    assert 1 <= len(found) <= LINES
    assert [line for line in found if not line or len(line) > LETTERS] == []
    assert "nan" not in text
    return found


def test_a_verdict_has_five_lines_at_most() -> None:
    assert format_verdict("a", "", "b") == "a\nb"
    with pytest.raises(ValueError, match=r"at most 5 lines, got 6"):
        format_verdict(*"abcdef")


def test_an_interval_that_reaches_one_is_a_tie() -> None:
    sure, unsure = Estimate(0.7, 0.6, 0.8), Estimate(0.9, 0.8, 1.01)
    assert describe_leader("a", {"b": sure}, "cost") == "a costs least, 70 % [60, 80] as much as b"
    tie = "a and {} cost least, too close to tell apart"
    assert describe_leader("a", {"b": unsure, "c": sure}, "cost") == tie.format("b")
    assert describe_leader("a", {"b": sure, "c": Estimate(0.9)}, "cost") == tie.format("c")
    assert describe_leader("a", {"b": Estimate(0.999, 0.998, 0.9995)}, "cost") == tie.format("b")
    assert describe_leader("a", {}, "cost") == "a costs least"


def errors(levels: dict[str, float], experiment: estimation.Experiment) -> Any:
    """Squared errors of 50 seeds, of those not named 16."""
    common = RNG.lognormal(0.0, 0.3, 50)
    labels = [each.label for each in experiment.simulation.filters]
    scales = {label: levels.get(label, 16.0) * RNG.lognormal(0.0, 0.05, 50) for label in labels}
    scales[BOUND] = np.ones(50)
    return {(label, "square"): scale * common for label, scale in scales.items()}, None


def test_the_best_estimator_is_named_for_each_experiment() -> None:
    true = {estimation.TRUE_MODEL: 1.0}  # knows more than the others: not in the contest
    found = [
        errors({"multirate-kf": 4.0, "bicycle-kf": 64.0} | true, estimation.EXPERIMENTS[0]),
        errors({"dakf": 4.0, "course-kf": 4.0} | true, estimation.EXPERIMENTS[1]),
    ]
    _, camera, gps, why, _ = fits(estimation.STUDY.compose_verdict(found))
    assert camera.startswith("Late camera: multirate-kf errs least, 50 % [")
    assert "2.00 times the least possible" in camera
    assert "err least, too close to tell apart" in gps and "dakf" in gps and "course-kf" in gps
    assert "4.0 and 2.0 times as large" in why


def claim(paper: str, stated: str, value: float) -> Any:
    part = ClaimPart("x", "s", "a", stated=Bound(stated, 1.0), threshold=Bound("<", 9.0))
    parts = (MeasuredPart(part, np.full(4, value)),)
    return MeasuredClaim(paper, Claim("Fig. 1", "smaller", [part]), parts)


def test_claims_are_counted_and_those_that_do_not_hold_named() -> None:
    ledger = [claim("one", "<", 0.5), claim("one", ">", 0.5), claim("two", "<", 0.1)]
    counts, by, failed, missed, _ = fits(papers._compose_verdict((ledger, {})))
    assert counts == "3 claims of 2 papers: 2 reproduced, 1 not reproduced."
    assert "one 1 of 2; two 1 of 1" in by
    assert failed.startswith("Not reproduced: one Fig. 1.")
    assert missed == "All our thresholds are met."


def test_procedures_name_who_passes_and_who_is_fastest(monkeypatch: pytest.MonkeyPatch) -> None:
    def sine(fails: bool) -> Any:
        ratio = 0.9 if fails else 0.1
        runs = (SineDwellRun(3.0, 0.1, 0.1, 2.0), SineDwellRun(6.0, ratio, 0.1, 2.0))
        return [SineDwellResult(0.3, runs)]

    track = next(iter(iso.TRACKS))
    monkeypatch.setattr(procedures, "_find_highest_speed", lambda runs: runs)
    done: dict[ProcedureCase, Any] = {}
    for car in CARS:
        for name in ENTRIES:
            fails = name not in ("two-dof", "esc", "lqr")
            done[ProcedureCase("fmvss-126", car, name)] = sine(fails)
            done[ProcedureCase(track, car, name)] = 30.0 if name == "lqr" else 20.0
    lines = fits(procedures._make_verdict(done))
    assert "coms: two-dof, esc and lqr; none fails above 3 A" in lines[1]
    assert "coms 108 with lqr (none 72)" in " ".join(lines)


def test_a_replay_without_truth_has_no_winner() -> None:
    traces = {"bicycle-kf": np.zeros(3), "exact-kf": np.zeros(3)}
    first, *_ = fits(recorded._compose_verdict(Replayed(traces=traces), False))
    assert first.startswith("Nobody wins")
    squares = {"exact-kf": [0.9e-4, 1.0e-4, 1.1e-4], "bicycle-kf": [4e-4] * 3}
    scores = {
        name: np.array([[square, 1.0, 0.94, 3.0 - i] for square in row])
        for i, (name, row) in enumerate(squares.items())
    }
    known = Replayed(scores=scores, traces=traces)
    lines = fits(recorded._compose_verdict(known, True))
    assert "By the log score exact-kf is best; its 95 % interval holds 94 %." in lines[2]
    lost = Replayed(traces=traces, nis={"joint": 7.0, "exact-kf": 1.0})
    assert "do not believe joint (7.0)" in fits(recorded._compose_verdict(lost, False))[1]
    assert "exact-kf strays least, 50 % [47, 52] as much as bicycle-kf" in lines[1]
    assert "0.57 deg" in lines[2] and "1.15 deg" in lines[3] and "drawn noise" in lines[4]


def test_speed_counts_its_goals_and_names_those_that_are_missed() -> None:
    rounds = {env_steps.FUSION_V1: [9.0, 10.0, 11.0], env_steps.V1_AT_ONCE: [0.5] * 3}
    rounds |= {env_steps.FUSION: [10.0] * 3, env_steps.LANE: [300.0] * 3, speed.FIRST: [0.6]}
    times = {name: np.array(x) for name, x in rounds.items()}
    lines = fits(speed._make_verdict([TimeTable("", "", "", times=times)]))
    assert lines[0].startswith("10 ms of driving cost 10 us on one core, 0.5 us a car")
    assert "it is 30 for lane-keeping" in lines[1]
    assert lines[2] == f"1 of 10 goals are met; not met: {speed.FIRST} (0.6 of <= 0.5 CPU-s)."
