"""The speed suite: contestants that do the same work, and a row for each. No time is asserted."""

import math
import sys

import numpy as np
import pytest

from sideslip.benchmarks import speed, speed_filters, timing
from sideslip.benchmarks.rivals import Rival, four_states, six_states
from sideslip.benchmarks.rows import Suite


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "ROUNDS", 1)
    monkeypatch.setattr(speed_filters, "TICKS", 400)
    monkeypatch.setattr(speed_filters, "BATCH", 3)


@pytest.mark.parametrize("delay", [0.0, 0.030, 0.129])
@pytest.mark.parametrize(
    ("name", "states"), [("multirate-kf", four_states), ("exact-kf", six_states)]
)
def test_filterpy_and_ours_give_the_same_estimates(name: str, states: object, delay: float) -> None:
    """FilterPy with its rewind by hand is what ours is measured against: the same filter."""
    pytest.importorskip("filterpy")
    drive = speed_filters.drive(delay)
    assert len(drive.log.record.packets) >= 8
    car = drive.told["vehicle"]
    kf = states(car, drive.told["speed"], drive.told["dt"])  # type: ignore[operator]
    theirs = Rival(kf, car, round(delay * 1e3)).run(drive.log.record)
    ours = speed_filters.ours(name, drive).run(drive.log)
    scale = np.abs(ours.x).max(axis=0)
    np.testing.assert_allclose(theirs / scale, ours.x / scale, rtol=0.0, atol=1e-10)


def test_rows_name_every_contestant() -> None:
    suite = speed.run()
    assert {row.metric for row in suite.rows} == {"us_per_step", "us_per_tick", "ratio"}
    assert all(0.0 < row.low <= row.value <= row.high for row in suite.rows)
    named = {row.scenario for row in suite.rows} | {row.estimator for row in suite.rows}
    assert {"sideslip/YawVision-v0", "CartPole-v1", "lane-keeping-v0 (highway-env)"} <= named
    assert {speed_filters.FOUR, speed_filters.SIX, speed_filters.REWIND} <= named
    assert "n = 6, 3 filters a call" in named
    assert {f"clone, {frames} frames under way" for frames in speed_filters.FRAMES} <= named
    assert len(suite.tables) == 3 and len(suite.figures) == 1


def test_the_suite_runs_without_filterpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    suite = Suite("speed", "", "")
    speed_filters.add(suite)
    assert [table.title for table in suite.tables] == ["Cost of using late samples exactly"]
    with pytest.raises(ModuleNotFoundError, match=r"sideslip\[bench\]"):
        speed_filters.contestants()


@pytest.mark.parametrize("frames", speed_filters.FRAMES)
def test_delays_keep_so_many_frames_under_way(frames: int) -> None:
    assert math.ceil(speed_filters.delay_of(frames) / 0.033 - 1e-9) == frames


def test_rounds_are_interleaved_and_the_first_does_not_count() -> None:
    order: list[str] = []

    def contestant(name: str, cost: float) -> timing.Contestant:
        def work() -> float:
            order.append(name)
            return cost + len(order)

        return work

    taken = timing.interleaved({"a": contestant("a", 0.0), "b": contestant("b", 10.0)}, rounds=3)
    assert order == ["a", "b"] * 4
    assert taken == {"a": [3.0, 5.0, 7.0], "b": [14.0, 16.0, 18.0]}
    assert timing.spread([3.0, 1.0, 2.0]) == (2.0, 1.0, 3.0)
    assert timing.ratios([4.0, 9.0], [2.0, 3.0]) == [2.0, 3.0]
