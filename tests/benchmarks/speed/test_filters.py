"""The filters of the speed suite do the same work as their rivals. No time is asserted."""

import math
import sys

import numpy as np
import pytest

from sideslip.benchmarks.harness.results import Suite
from sideslip.benchmarks.speed import filters, timing
from sideslip.benchmarks.speed.filterpy_rival import Rival, four_states, six_states

SHORT = timing.Effort(rounds=1, seconds=0.0)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filters, "TICKS", 400)
    monkeypatch.setattr(filters, "BATCH", 3)


@pytest.mark.parametrize("delay", [0.0, 0.030, 0.129])
@pytest.mark.parametrize(
    ("name", "states"), [("multirate-kf", four_states), ("exact-kf", six_states)]
)
def test_filterpy_and_ours_give_the_same_estimates(name: str, states: object, delay: float) -> None:
    """FilterPy with its rewind by hand is what ours is measured against: the same filter."""
    pytest.importorskip("filterpy")
    drive = filters.drive(delay)
    assert len(drive.log.record.packets) >= 8
    car = drive.facts["vehicle"]
    kf = states(car, drive.facts["speed"], drive.facts["dt"])  # type: ignore[operator]
    theirs = Rival(kf, car, round(delay * 1e3)).run(drive.log.record)
    ours = filters.ours(name, drive).run(drive.log)
    scale = np.abs(ours.x).max(axis=0)
    np.testing.assert_allclose(theirs / scale, ours.x / scale, rtol=0.0, atol=1e-10)


def test_rows_name_every_contestant() -> None:
    pytest.importorskip("filterpy")
    suite = Suite("speed", "", "")
    filters.add(suite, SHORT)
    assert {row.metric for row in suite.rows} == {"us_per_tick", "ratio"}
    assert all(0.0 < row.low <= row.value <= row.high for row in suite.rows)
    named = {row.estimator for row in suite.rows}
    assert {filters.FOUR, filters.SIX, filters.REWIND} <= named
    assert "n = 6, 3 filters a call" in named
    assert {f"clone, {frames} frames under way" for frames in filters.FRAMES} <= named
    assert len(suite.tables) == 2 and len(suite.figures) == 1


def test_the_suite_runs_without_filterpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    suite = Suite("speed", "", "")
    filters.add(suite, SHORT)
    assert [table.title for table in suite.tables] == ["Cost of using late samples exactly"]
    with pytest.raises(ModuleNotFoundError, match=r"sideslip\[bench\]"):
        filters.contestants()


@pytest.mark.parametrize("frames", filters.FRAMES)
def test_delays_keep_so_many_frames_under_way(frames: int) -> None:
    assert math.ceil(filters.delay_of(frames) / 0.033 - 1e-9) == frames
