"""The cost of many episodes: a line through cases of several sizes. No time is asserted."""

import numpy as np
import pytest

from sideslip.benchmarks.speed import scale


def test_the_line_is_found_through_cases_that_lie_on_it() -> None:
    assert scale.line_through(0.2 + 0.003 * np.array(scale.SIZES)) == pytest.approx((0.2, 0.003))


def test_the_page_has_all_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scale, "seconds_of", lambda cell, size: 0.36 + 0.0036 * size)
    monkeypatch.setattr(scale, "overhead", lambda *_: (0.01, 0.05))
    monkeypatch.setattr(scale, "step_seconds", lambda count: 0.72e-6 + 4e-6 / count)
    monkeypatch.setattr(scale, "COUNTS", (1, 4, 10**9))
    monkeypatch.setattr(scale, "beside", lambda workers: 1.25)
    page = scale.report()
    assert "| no control | 0.396 |" in page and "1 and 5 %" in page
    assert "1,100 core-hours" in page  # (0.36 / 1000 + 0.0036) 1e9 / 3600
    assert "| us | 4.72 | 1.72 | 0.72 |" in page and "1.25 times its time alone" in page
    assert "at N = 1000000000 take 200 core-hours, and $8 at" in page  # 0.72e6 s / 3600


def test_a_step_is_timed_for_one_row_of_a_batch() -> None:
    assert 0.0 < scale.step_seconds(64) < scale.step_seconds(1) < 1.0
