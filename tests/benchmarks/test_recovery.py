"""From where a car is saved: what is mapped, in which units, and that feedback saves more."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.picture import write_picture
from sideslip.benchmarks.report.html import write_report
from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.studies import recovery_region
from sideslip.benchmarks.studies.recovery_region import (
    CARS,
    CLAIRVOYANT,
    ORACLES,
    RecoveryCase,
    _compute_recovery_mask,
    _make_grid,
    _PulseThenAgent,
)

CAR, COMS = CARS


def test_feedback_saves_cars_that_nothing_saves() -> None:
    """The uncontrolled COMS above its critical slip is lost in places where lqr catches it."""
    points = (9, 7)
    for car in CARS:
        none, lqr = (
            _compute_recovery_mask(RecoveryCase(car, name, points, 4)) for name in ("none", "lqr")
        )
        assert none.shape == lqr.shape == (7, 9, 4)
        assert none.mean() < lqr.mean(), car
        assert (lqr[3, 4] == 1.0).all() and (none[3, 4] == 1.0).all()  # straight ahead, at rest


def test_a_slide_that_turns_further_out_is_lost_and_one_that_turns_back_is_saved() -> None:
    """beta' = ... - gamma: a yaw rate against the slip's sign makes it grow."""
    found = _compute_recovery_mask(RecoveryCase(CAR, "none", (3, 3), 4))
    assert found[0, 2].max() == found[2, 0].max() == 0.0
    assert found[2, 2].mean() > 0.0 and found[0, 0].mean() > 0.0


def test_after_a_beginning_the_agent_takes_over() -> None:
    """Row by row, with the memory that it has built up meanwhile."""

    class Counts:
        def predict(self, obs: Any, state: Any, start: Any, deterministic: bool) -> Any:
            count = 0.0 if state is None else state + 1.0
            return np.full((3, 1), 0.1 * count, np.float32), count

    begun, state, taken = (
        _PulseThenAgent(Counts(), np.array([1.0, -1.0, 1.0]), np.array([2, 1, 0])),
        None,
        [],
    )
    for _ in range(3):
        action, state = begun.predict(np.zeros((3, 2)), state, None)
        taken.append(action[:, 0])
    np.testing.assert_allclose(taken, [[1.0, -1.0, 0.0], [1.0, 0.1, 0.1], [0.2, 0.2, 0.2]])


def test_of_several_beginnings_the_best_counts() -> None:
    points, tries = (3, 3), ((1.0, 0.0), (1.0, 0.5), (-1.0, 1.5))
    found = [
        _compute_recovery_mask(RecoveryCase(CAR, ORACLES[0], points, 4, (each,))) for each in tries
    ]
    np.testing.assert_array_equal(
        found[0], _compute_recovery_mask(RecoveryCase(CAR, ORACLES[0], points, 4))
    )
    both = _compute_recovery_mask(RecoveryCase(CAR, ORACLES[0], points, 4, tries))
    np.testing.assert_array_equal(both, np.maximum.reduce(found))


def test_starts_are_what_the_axes_say(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    def steps(env: Any, agent: Any, seeds: list[int], options: dict[str, Any]) -> Any:
        info = env.reset(seed=seeds, options=options)[1]
        seen.extend([seeds, info["beta"], info["gamma"]])
        return iter(())

    monkeypatch.setattr(recovery_region, "iterate_steps", steps)
    _compute_recovery_mask(RecoveryCase(COMS, "none", (3, 2), 2))
    seeds, beta, gamma = seen
    assert seeds == [recovery_region.FIRST_SEED, recovery_region.FIRST_SEED + 1] * 6
    betas, gammas = _make_grid((3, 2))
    np.testing.assert_allclose(beta.reshape(2, 3, 2)[1, :, 0], betas, atol=1e-9)
    np.testing.assert_allclose(gamma.reshape(2, 3, 2)[:, 1, 1], gammas, atol=1e-9)


def test_table_rows_maps_and_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recovery_region, "POINTS", ((3, 3), (3, 3)))
    monkeypatch.setattr(recovery_region, "CONTROLLERS", ("none", "lqr"))
    suite = recovery_region.STUDY.run(Request(quick=True, jobs=1))
    assert [table.title for table in suite.tables] == list(CARS)
    shares = {(row.scenario, row.controller): row for row in suite.rows}
    names = ("none", "lqr", CLAIRVOYANT)
    assert set(shares) == {(car, name) for car in CARS for name in names}
    for car in CARS:
        assert shares[car, CLAIRVOYANT].value >= max(shares[car, n].value for n in names)
    sure = [row for row in suite.rows if np.isfinite(row.low)]  # not where one seed alone differs
    assert sure and all(0.0 <= row.low <= row.value <= row.high <= 1.0 for row in sure)
    for each in suite.maps:
        assert "deg" in each.x_label and "deg/s" in each.y_label
        assert each.x[-1] == pytest.approx(np.degrees(recovery_region.MAX_START[0]))
        assert {share.shape for share in each.shares.values()} == {(3, 3)}
    pytest.importorskip("matplotlib")
    write_picture(tmp_path / "maps.png", [suite])
    assert (tmp_path / "maps.png").read_bytes()[:4] == b"\x89PNG"
    pytest.importorskip("plotly")
    assert len(suite.figures) == len(CARS)
    write_report(tmp_path / "report.html", [suite], "sideslip bench recovery", {})
    assert "share of cars saved" in (tmp_path / "report.html").read_text()


def test_without_plotly_the_tables_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.delitem(sys.modules, "sideslip.benchmarks.report.figures", raising=False)
    monkeypatch.setattr(recovery_region, "POINTS", ((1, 1), (1, 1)))
    monkeypatch.setattr(recovery_region, "SEEDS", (1, 1))
    monkeypatch.setattr(recovery_region, "CONTROLLERS", ("none",))
    suite = recovery_region.STUDY.run(Request(quick=True, jobs=1))
    assert suite.figures == [] and len(suite.tables) == len(suite.maps) == 2
