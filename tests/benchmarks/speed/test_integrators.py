"""Errors of the plant's rules of integration. No time is asserted."""

import pytest

from sideslip.benchmarks.speed import integrators


def test_in_a_smooth_drive_the_fourth_stage_counts() -> None:
    three, four = integrators.errors_in("curved-road-driver", False, 400)
    assert 0.0 < four.max() < 1e-10 < three.max() < 1e-7


def test_the_table_is_of_all_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(integrators, "nanoseconds", lambda: [13.41, 16.1])
    lines = integrators.table(["random-steering", "limit-step"], 30).splitlines()
    assert lines[0].startswith("| 4 drives of 0.03 s |") and len(lines) == 4
    assert lines[2].startswith("| Kutta, three stages | 13.4 ns | ")
    assert lines[3].startswith("| classical, four stages | 16.1 ns | ")
