"""The cost of many episodes: a line through cases of several sizes. No time is asserted."""

import numpy as np
import pytest

from sideslip.benchmarks.speed import scale


def test_the_line_is_found_through_cases_that_lie_on_it() -> None:
    assert scale.line_through(0.2 + 0.003 * np.array(scale.SIZES)) == pytest.approx((0.2, 0.003))


def test_the_page_has_both_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scale, "seconds_of", lambda cell, size: 0.36 + 0.0036 * size)
    monkeypatch.setattr(scale, "overhead", lambda *_: (0.01, 0.05))
    page = scale.report()
    assert "| no control | 0.396 |" in page and "1 and 5 %" in page
    assert "1,100 core-hours" in page  # (0.36 / 1000 + 0.0036) 1e9 / 3600
