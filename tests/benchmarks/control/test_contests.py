"""Contests: chosen by what is to be won, refused where they are another version's; the ladder."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks.control import tasks as module
from sideslip.benchmarks.control.calibration import _BASELINES, _measure_task
from sideslip.benchmarks.control.entries import Entry
from sideslip.benchmarks.control.run import NUMBERS, Chunk, DriveResult, measure
from sideslip.benchmarks.control.score import PairedDrives
from sideslip.benchmarks.control.tasks import (
    NOMINAL,
    ORACLES,
    PARAMETERS,
    QUICK_LEAD_IN,
    STATE,
    STEERING,
    TIERS,
    ControlTask,
    TaskMeasurement,
    _read_tasks,
    list_candidates,
    list_scored_tasks,
    make_salted_seeds,
)
from sideslip.benchmarks.entrants.worker import run_user_chunk
from sideslip.benchmarks.harness.stats import average
from sideslip.envs import FAILURES, SCENARIOS

ONE = list_candidates()[0]
STATES = ORACLES[STATE]
LIMIT = next(contest for contest in list_candidates() if contest.tier == "limit")
PEAK, SLIP = NUMBERS.index("peak_slip"), NUMBERS.index("rms_slip_error")


def driven(costs: np.ndarray, failed: int = 0, error: str = "", peak: float = 4.0) -> DriveResult:
    numbers = np.ones((len(costs), len(NUMBERS)))
    numbers[:, NUMBERS.index("cost")] = costs
    numbers[:, PEAK] = np.radians(peak)
    numbers[:, SLIP] = np.radians(costs)  # as large as the costs
    code = np.where(np.arange(len(costs)) < failed, FAILURES.index("spin"), 0)
    numbers[:, NUMBERS.index("failure")] = code
    return DriveResult(numbers, error=error)


def found(
    contest: ControlTask, levels: dict[str, float], peak: float = 4.0, **failed: int
) -> TaskMeasurement:
    """What is made of the costs of none, nominal and the oracles on 40 seeds."""
    seeds = np.random.default_rng(0).lognormal(0.0, 1.0, 40) + 1.0
    made = {}
    for name, level in ({"none": 9.0} | levels).items():
        count = failed.get(name.replace("-", "_"), 0)
        made[contest, Entry(name)] = driven(level * seeds, count, peak=peak)
    for name in _BASELINES:
        made.setdefault((contest, Entry(name)), driven(np.full(40, np.nan), error="no plant"))
    return _measure_task(made, contest)


ALL = {NOMINAL: 2.0} | dict.fromkeys(ORACLES[PARAMETERS], 1.5)
BOTH = ALL | {STATES[0]: 1.0, STATES[1]: 0.5}


def test_at_most_24_contests_of_three_tiers_ask_in_several_manoeuvres() -> None:
    scored = list_scored_tasks()
    assert len(scored) <= 24
    for tier in ("small car", "road", "limit"):
        assert len({each.scenario for each in scored if each.tier == tier}) >= 3


def test_a_contest_is_scored_by_what_it_demands_whoever_gains() -> None:
    wide = found(ONE, BOTH)
    assert (wide.verdict, wide.oracle, wide.n) == ("scored", STATES[1], 40)
    assert wide.peak_slip == pytest.approx(4.0, abs=1e-3)
    assert wide.slip_gap == pytest.approx(1.5 * np.median(wide_seeds()), rel=1e-3)
    assert found(ONE, BOTH, peak=1.9).verdict == "the slip angle peaks at 1.9 deg uncontrolled"
    assert found(ONE, BOTH | {NOMINAL: 0.5}).verdict == "scored"  # nothing to win is no reason


def wide_seeds() -> np.ndarray:
    return np.random.default_rng(0).lognormal(0.0, 1.0, 40) + 1.0


def test_at_the_limit_cars_are_lost_and_half_of_them_can_be_saved() -> None:
    """Of 40 cars; who nobody saves separates nobody."""
    assert found(LIMIT, BOTH, none=11).verdict == "28 % of the cars are lost uncontrolled"
    saved = found(LIMIT, BOTH, none=20, nominal=20, oracle_state_nmpc=10, oracle_state_lqr=30)
    assert saved.verdict == "scored" and saved.lost == saved.lost_nominal == 0.5
    lost = dict.fromkeys(("nominal", *(name.replace("-", "_") for name in ALL if "-" in name)), 11)
    lost |= {"oracle_state_nmpc": 11, "oracle_state_lqr": 11}
    assert found(LIMIT, BOTH, none=20, **lost).verdict == "the best baseline loses 28 % of the cars"


def test_an_oracle_that_loses_more_cars_is_not_the_better_one() -> None:
    levels = ALL | {STATES[0]: 0.5, STATES[1]: 1.0}
    assert found(ONE, levels).oracle == STATES[0]
    assert found(ONE, levels, oracle_state_lqr=20).oracle == STATES[1]
    who = ORACLES[PARAMETERS]
    knowing = levels | {who[0]: 1.5, who[1]: 1.2}
    assert found(ONE, knowing).knowing == who[1]
    assert found(ONE, knowing, oracle_parameters_nmpc=20).knowing == who[0]


def test_a_rung_that_cannot_be_computed_leaves_the_other_or_the_reason() -> None:
    assert found(ONE, ALL | {STATES[0]: 1.0}).verdict == "scored"
    for there in (ALL, {STATES[0]: 1.0}, {}):
        lost = found(ONE, there)
        assert "no plant" in lost.verdict and lost.slip_gap == 0.0


def test_the_file_holds_every_number_of_this_version_alone(tmp_path: Path) -> None:
    path = tmp_path / "contests.json"
    entry = found(ONE, BOTH)
    path.write_text(json.dumps([dataclasses.asdict(entry)]))
    assert _read_tasks(path) == (entry,)
    for change, message in (
        ({"world_version": 0}, "measured in world 0, this is 1"),
        ({"scenario": "moon"}, "is no task of this version"),
        ({"tier": "road"}, "is no task of this version"),
        ({"oracle": "nobody"}, "nobody"),
        ({"knowing": "oracle-state-lqr"}, "oracle-state-lqr"),
        ({"lost": "many"}, "lost is 'many', not float"),
    ):
        path.write_text(json.dumps([dataclasses.asdict(entry) | change]))
        with pytest.raises(ValueError, match=message) as caught:
            _read_tasks(path)
        assert str(path) in str(caught.value)
    path.write_text("[")
    with pytest.raises(ValueError, match="cut short"):
        _read_tasks(path)


def test_every_tier_has_its_contests_and_they_can_be_built() -> None:
    assert {contest.tier for contest in list_candidates()} == set(TIERS)
    assert len({contest.name for contest in list_candidates()}) == len(list_candidates())
    assert {each.task for each in _read_tasks()} == set(list_candidates())
    for contest in list_scored_tasks():
        assert SCENARIOS[contest.scenario].tier == contest.tier
        assert (contest.env_id, contest.vehicle, contest.reference) in TIERS[contest.tier]


SCORED = list_scored_tasks() if module.FILE.is_file() else ()


@pytest.mark.long
@pytest.mark.parametrize("contest", SCORED[4::9], ids=[contest.name for contest in SCORED[4::9]])
def test_the_ladder_falls_in_some_scored_contests(contest: ControlTask) -> None:
    """No baseline is surely better than one that knows more, and nominal is surely the worst."""
    contest = dataclasses.replace(contest, changes={"lead_in": QUICK_LEAD_IN})
    cells = [(contest, Entry(rung)) for rung in (NOMINAL, PARAMETERS, STATE)]
    there = measure(cells, make_salted_seeds("0", 32), jobs=2)
    assert not any(each.error for each in there.values())
    nominal, *more = there.values()
    knowing, state = (PairedDrives(nominal, x, contest.cost_floor).compute_scores() for x in more)
    assert average(knowing).high > 0.0 and average(state - knowing).high > 0.0
    assert average(state).low > 0.0


class _Bait:
    """An agent of no use: noise, full torque, a frozen action or bang-bang of the yaw rate."""

    def __init__(self, kind: str) -> None:
        self.kind, self.rng = kind, np.random.default_rng(0)

    def predict(self, obs: np.ndarray, *_: object, **__: object) -> tuple[np.ndarray, None]:
        shape = (len(obs), 2)
        if self.kind == "noise":
            return self.rng.uniform(-1.0, 1.0, shape).astype(np.float32), None
        if self.kind == "bang-bang":  # against the yaw rate, the first entry of the observation
            moment = -np.sign(obs[:, :1])
            return np.hstack([moment, 0.0 * moment]).astype(np.float32), None
        return np.full(shape, 1.0 if self.kind == "full" else 0.3, np.float32), None


@pytest.mark.long
@pytest.mark.parametrize("kind", ["noise", "full", "frozen", "bang-bang"])
@pytest.mark.parametrize("tier", ["small car", "road", "limit"])
def test_baits_catch_nothing(kind: str, tier: str) -> None:
    """They stand below nominal everywhere, and below no control outside the limit."""
    contest = next(each for each in SCORED if each.tier == tier and each.env_id == STEERING)
    contest = dataclasses.replace(contest, changes={"lead_in": QUICK_LEAD_IN})
    bait = Entry("none", objects={"agent": lambda _: _Bait(kind)})
    seeds = make_salted_seeds("0", 32)
    own = run_user_chunk(Chunk(contest, bait, tuple(seeds)))
    there = measure([(contest, Entry(NOMINAL)), (contest, Entry("none"))], seeds, jobs=1)
    nominal, none = (
        average(PairedDrives(other, own, contest.cost_floor).compute_scores())
        for other in there.values()
    )
    assert nominal.high < 0.0
    assert tier == "limit" or none.high < 0.0 or kind == "bang-bang"
