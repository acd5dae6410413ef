"""The suite of conditions: a condition is what its name says, and what errs is caught."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.harness.drives import make_unchecked_filter
from sideslip.benchmarks.harness.results import read_json
from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.studies import conditions
from sideslip.benchmarks.studies.conditions import (
    BAD_INPUT,
    BASE,
    CONDITIONS,
    IDEAL_SUFFIX,
    Condition,
    Edit,
)
from sideslip.envs.record import FAST, PACKET, Log
from sideslip.estimators.filters import FILTERS

DOCS = Path(conditions.__file__ or "").resolve().parents[2] / "docs"
NAMED = {condition.name: condition for condition in CONDITIONS}
SHORT = 3.0  # s


def drive(name: str, seed: int = 0, **changes: Any) -> tuple[Log, Log, Any]:
    """A drive, the same with the condition's error, and the env."""
    condition = dataclasses.replace(NAMED[name], **changes)
    log, base = conditions._drive_car(condition, seed)
    return log, conditions._apply_edit(condition.edit, log, seed), base


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda condition: condition.name)
def test_every_condition_is_driven_and_errs(condition: Condition) -> None:
    """By its record, or by a car or a road that differs from those without a fault."""
    log, wrong, _ = drive(condition.name, duration=SHORT)
    edited = not np.array_equal(log.record.fast, wrong.record.fast)
    edited |= not np.array_equal(log.record.packets, wrong.record.packets)
    expected = condition.edit != Edit() and condition.edit.start < SHORT
    assert edited == expected and np.isfinite(wrong.record.fast).all()
    assert condition.edit != Edit() or condition.scenario or condition.fault == np.inf


def test_a_column_has_exactly_its_error() -> None:
    log, wrong, _ = drive("steering's offset 0.5 deg", duration=SHORT)
    change = wrong.record.fast - log.record.fast
    assert change[:, FAST.steer] == pytest.approx(np.radians(0.5), abs=1e-12)
    assert not np.delete(change, FAST.steer, axis=1).any()
    log, wrong, _ = drive("gyro 20 ms late", duration=SHORT)
    gyro, late = log.record.fast[:, FAST.gyro], wrong.record.fast[:, FAST.gyro]
    assert np.array_equal(late[20:], gyro[:-20]) and (late[:20] == gyro[0]).all()
    log, wrong, _ = drive("gyro drifts to 1 deg/s", duration=SHORT)
    rise = (wrong.record.fast - log.record.fast)[:, FAST.gyro] - np.radians(1.0) * log.time / 20.0
    assert np.abs(rise).max() < 1e-12
    log, wrong, _ = drive("vibration of 1 m/s2")
    shaken = (wrong.record.fast - log.record.fast)[:, FAST.accel_y]
    assert np.std(shaken) == pytest.approx(1.0, rel=0.15)
    assert np.corrcoef(shaken[1:], shaken[:-1])[0, 1] == pytest.approx(np.exp(-0.016 * np.pi), 0.01)


def test_steering_is_in_degrees_from_five_seconds_on() -> None:
    log, wrong, _ = drive(BAD_INPUT, duration=6.0)
    true, read = (x.record.fast[:, FAST.steer] for x in (log, wrong))
    assert np.array_equal(read[:5000], true[:5000])
    assert read[5000:] == pytest.approx(np.degrees(true[5000:]))


@pytest.mark.parametrize(("name", "late"), [("GPS's", 1), ("camera's", 3)])
def test_stamps_are_late_by_packets(name: str, late: int) -> None:
    name = next(full for full in NAMED if full.startswith(f"{name} stamps"))
    log, wrong, _ = drive(name, duration=SHORT)
    true, read = log.record.packets, wrong.record.packets
    assert np.array_equal(true[:, : PACKET.value], read[:, : PACKET.value])
    assert np.array_equal(read[late:, PACKET.value :], true[:-late, PACKET.value :])


def test_a_scenario_does_what_its_name_says() -> None:
    loaded = drive("mass + 25 %" + IDEAL_SUFFIX, duration=SHORT)[2]
    assert loaded.vehicle.mass == 1.25 * loaded.nominal.mass == 1.25 * 1500.0
    slippery = drive("friction 0.35, hard steering" + IDEAL_SUFFIX, duration=SHORT)[2]
    assert slippery.vehicle.friction == 0.35
    speed = drive("stops and stands")[0].record.fast[9500:, FAST.wheel_left]
    assert np.abs(speed).max() < 0.2
    log = drive("stop and go")[0]
    assert log.record.fast[4900, FAST.wheel_left] - log.record.fast[9500, FAST.wheel_left] > 4.5
    captured = drive("no GPS for 10 s")[0].record.packets[:, PACKET.captured]
    assert not ((captured > 6000) & (captured < 15800)).any()
    for name in NAMED:
        is_ideal = drive(name, duration=0.5)[2].config.world.is_ideal
        assert is_ideal == name.endswith(IDEAL_SUFFIX), name


def measure(name: str, seeds: int) -> dict[str, Any]:
    """The cells of a condition's line, on the study's first seeds."""
    outcomes = conditions._measure_seeds((NAMED[name], range(seeds)))
    return conditions._summarise_outcomes([item for item in outcomes if item is not None])


def test_who_is_told_errs_less_and_nobody_alarms_without_a_fault() -> None:
    for name in (BASE, "camera and GPS" + IDEAL_SUFFIX):
        cells = measure(name, 6)
        assert 1.0 < cells["rmse_over_told"].value < 4.0, name
        assert cells["rmse_over_gyro"].value < 1.0 and cells["coverage"].value > 0.88
        assert cells["false_alarms"] == 0.0 and cells["lost"] == 0.0


def test_who_is_told_is_honest() -> None:
    """So its levels are those of the drives."""
    condition, squares = NAMED["camera and GPS" + IDEAL_SUFFIX], []
    for seed in range(conditions._FIRST_SEED, conditions._FIRST_SEED + 4):
        run = conditions._run_informed_filter(condition, seed)
        error = run["beta"] - conditions._drive_car(condition, seed)[0].truth["beta"]
        deviation = run.std[:, run.names.index("beta")]
        squares.append(np.mean((error / deviation)[2000:] ** 2))
    assert 0.5 < np.mean(squares) < 2.0


def test_a_filter_that_is_too_sure_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its levels are a fifth."""
    honest = measure(BASE, 4)
    levels = ("force_share", "moment_share", "model_error", "accel_bias_sd", "steer_offset_sd")

    def make_sure(name: str, log: Log, vehicle: Any, options: Any) -> Any:
        row = dict(FILTERS[name].options)
        row = {level: row[level] / 5.0 for level in (*levels, "moment_sd", "accel_y_noise")}
        return make_unchecked_filter(name, log, vehicle, options or row)

    monkeypatch.setattr(conditions, "make_unchecked_filter", make_sure)
    sure = measure(BASE, 4)
    assert sure["nees"].value > 2.0 > honest["nees"].value
    assert sure["coverage"].value < 0.88 < honest["coverage"].value


def test_a_filter_that_is_lost_says_so() -> None:
    cells = measure(BAD_INPUT, 4)
    assert cells["nees"].value > conditions._LOST and cells["lost"] > 0.0
    assert 0.0 < cells["healthy_after"] < 3.0 and cells["false_alarms"] == 0.0


def test_looking_at_the_health_changes_no_bit() -> None:
    log, _, base = drive(BASE, duration=SHORT)
    filter_ = make_unchecked_filter(conditions.NAME, log, base.nominal, {})
    watched, healthy = filter_.run_with_health(log, conditions._WATCH)
    run = filter_.run(log)
    assert np.array_equal(watched.x, run.x) and len(healthy) == len(log.time)
    assert np.array_equal(watched.std, run.std)


def test_a_run_has_rows_verdict_and_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    names = BASE, "GPS", BAD_INPUT, "GPS" + IDEAL_SUFFIX
    short = [dataclasses.replace(NAMED[name], duration=4.0) for name in names]
    monkeypatch.setattr(conditions, "CONDITIONS", short)
    suite = conditions.STUDY.run(Request(quick=True, jobs=1))
    metrics = {"rmse", "rmse_over_told", "rmse_over_gyro", "nees", "coverage"}
    assert {row.metric for row in suite.rows} >= metrics
    assert {row.scenario: row.n for row in suite.rows} == dict.fromkeys(names, 4) | {BASE: 16}
    lines = suite.verdict.splitlines()
    assert len(lines) == 5 and max(map(len, lines)) <= 110 and "worst is GPS" in lines[1]
    assert suite.answers[0][2] == lines[1] and len(suite.tables) == 1


def test_the_page_says_what_its_file_says() -> None:
    cells = dict[str, dict[str, float]]()
    rows = read_json(DOCS / "conditions.json")
    for row in rows:
        cells.setdefault(row.scenario, {})[row.metric] = row.value
    assert list(cells) == list(NAMED) and {row.suite for row in rows} == {"conditions"}
    text = " ".join((DOCS / "results" / "conditions.md").read_text().split())
    others = {name: cells[name] for name in NAMED if name != BASE and BAD_INPUT not in name}
    judged = [item for name, item in others.items() if not name.endswith(IDEAL_SUFFIX)]
    clean = [item["nees"] for name, item in others.items() if name.endswith(IDEAL_SUFFIX)]
    middle = np.median([item["rmse_over_told"] for item in judged])
    held = sum(item["coverage"] >= 0.88 for item in judged)
    honest = sum(0.5 <= item["nees"] <= 2.0 for item in judged)
    for sentence in (
        f"In world `v1` it errs {cells[BASE]['rmse_over_told']:.2f} times as much.",
        f"With one error more, in {len(judged)} conditions, the median is {middle:.2f}.",
        f"The 95 % interval holds at least 88 % of the time in {held} of them.",
        f"NEES is 0.5 to 2 in {honest}.",
        f"its interval is about twice too wide (NEES {np.median(clean):.1f})",
    ):
        assert sentence in text, sentence
    few, many = sorted({row.n for row in rows})[-2:]
    assert re.search(rf"has {few} drives of the passenger car, the base world {many}\.", text)
    assert json.loads((DOCS / "conditions.json").read_text())[0]["scenario"] == BASE
