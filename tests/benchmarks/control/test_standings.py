"""Standings: the best come first, ceilings are carried over, unsure ones judge nobody."""

import numpy as np
import pytest

from sideslip.benchmarks.control import episodes as drive
from sideslip.benchmarks.control import run as results
from sideslip.benchmarks.control.calibration import Entry, Episode
from sideslip.benchmarks.control.ceiling import carried, judged, tops_of
from sideslip.benchmarks.control.cells import MANOEUVRES, YAW, Cell, cells
from sideslip.benchmarks.control.episodes import NUMBERS
from sideslip.benchmarks.control.scores import Ceiling
from sideslip.benchmarks.control.tables import motion_table, rows_of, standings
from sideslip.benchmarks.harness.metrics import EPISODE


def ready(asked: list[Cell]) -> results.Results:
    """Made-up costs: none 10, informed 2, lqr 3, the rest 5."""
    found = results.Results("ab" * 8)
    rng = np.random.default_rng(0)
    for cell in asked:
        level = {"none": 10.0, "informed": 2.0, "lqr": 3.0}.get(cell.controller, 5.0)
        numbers = np.abs(rng.normal(1.0, 0.01, (8, len(NUMBERS)))) * level
        numbers[:, NUMBERS.index("failure")] = 0.0
        found.found[cell] = drive.Driven(numbers, 1.0)
    return found


def test_standings_put_the_best_first_and_rows_hold_them(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = [cell for cell in cells(MANOEUVRES[:3]) if cell.env_id == YAW]
    found = ready(asked)
    tops = {name: Ceiling(1.0, 0.0) for name in MANOEUVRES[:2]}  # the third is not calibrated
    standing = standings(found, YAW, tops)
    assert [each.cell.controller for each in standing[:2]] == ["informed", "lqr"]
    assert standing[-1].label == "none"
    assert standing[0].overall["score"].value == pytest.approx(8.0 / 9.0, abs=0.01)
    assert standing[1].overall["cost_over_informed"].value == pytest.approx(1.5, abs=0.02)
    assert "score" not in standing[0].by_scenario[MANOEUVRES[2]]
    rows = rows_of(standing[0], found.salt)
    assert {row.scenario for row in rows} == {*MANOEUVRES[:3], "all"}
    monkeypatch.setattr(
        "sideslip.benchmarks.control.ceiling.ceilings",
        lambda *_: {MANOEUVRES[0]: Ceiling(4.0, 0.01)},
    )
    raised, log = tops_of(found, YAW)
    assert raised[MANOEUVRES[0]].mean == pytest.approx(2.0, abs=0.02)
    assert len(log) >= 1 and "informed" in log[0]


def entry_of(none: np.ndarray, best: np.ndarray) -> Entry:
    episodes = tuple(
        Episode(k, float(b), "none", {"none": float(n)}, {}, 1.0)
        for k, (n, b) in enumerate(zip(none, best, strict=True))
    )
    means = float(best.mean()), 0.0, float(none.mean()), 0.0
    return Entry(YAW, "gust", "", "", "", "", "", *means, "", episodes)


def test_a_ceiling_is_carried_to_other_seeds() -> None:
    """Exactly where it is linear in the uncontrolled cost; else within its error, mostly."""
    rng = np.random.default_rng(0)
    none = rng.gamma(1.0, 5.0, 64)
    other = rng.gamma(1.0, 8.0, 150)
    sure = carried(entry_of(none, 0.5 + 0.2 * none), other)
    assert sure.mean == pytest.approx(0.5 + 0.2 * other.mean())
    assert sure.error == pytest.approx(0.0, abs=1e-12)
    off = []
    for _ in range(200):
        none, other = rng.gamma(1.0, 5.0, 64), rng.gamma(1.0, 5.0, 150)
        best, there = (5.0 + 0.2 * x + rng.normal(0.0, 1.0, len(x)) for x in (none, other))
        top = carried(entry_of(none, best), other)
        off.append((top.mean - there.mean()) / top.error)
    assert 0.85 < np.std(off) < 1.15 and abs(np.mean(off)) < 0.25


def test_an_unsure_ceiling_is_no_yardstick() -> None:
    asked = [cell for cell in cells(MANOEUVRES[:1]) if cell.env_id == YAW]
    found = ready(asked)  # none 10
    assert judged(found, YAW, {MANOEUVRES[0]: Ceiling(1.0, 0.8)}) == [MANOEUVRES[0]]
    assert judged(found, YAW, {MANOEUVRES[0]: Ceiling(1.0, 1.0)}) == []


def test_a_manoeuvre_that_informed_hardly_improves_is_not_scored() -> None:
    asked = [cell for cell in cells(MANOEUVRES[:1]) if cell.env_id == YAW]
    found = ready(asked)
    assert found.worth_controlling(YAW, MANOEUVRES[0])
    found.of(YAW, MANOEUVRES[0], "informed").costs[:] = 5.5
    assert not found.worth_controlling(YAW, MANOEUVRES[0])
    assert "score" not in standings(found, YAW, {MANOEUVRES[0]: Ceiling(1.0, 0.0)})[0].overall


def test_a_metric_of_the_table_has_its_rows_and_its_column() -> None:
    asked = [cell for cell in cells(MANOEUVRES[:1]) if cell.env_id == YAW]
    standing = standings(ready(asked), YAW, {})
    metrics = {row.metric for row in rows_of(standing[0], "ab")}
    assert {metric.name for metric in EPISODE} - {"failure"} <= metrics
    table = motion_table("", standing)
    for metric in EPISODE:
        if metric.heading:
            column = list(table.header).index(metric.heading)
            value = float(table.cells[0][column]) / metric.scale
            assert value == pytest.approx(standing[0].mean(metric.name), abs=0.5 / metric.scale)
