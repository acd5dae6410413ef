"""A recorded drive is replayed, scored against its truth, and drawn."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pandas import read_csv

from sideslip.benchmarks.harness.results import Suite, read_json, write_json
from sideslip.benchmarks.recorded.replay import (
    ESTIMATORS,
    Settings,
    _emulate_course,
    _make_drives,
    replay,
    replay_file,
)
from sideslip.benchmarks.recorded.sensor_noise import GYRO_ONLY
from sideslip.envs.record import FAST, PACKET, Log
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, make_vehicle
from sideslip.estimators import make_estimator
from tests.envs.recordings.drives import read_log

from .slalom import DT, ROWS, SPEED, VEHICLE, columns, saved

STANFORD = Path(__file__).parents[3] / "shared" / "data" / "stanford_250lm" / "log.csv"
DEG = math.pi / 180.0
SLOW = r"a course at 250 Hz needs a log at least as fast; .* 100 rows"


@pytest.fixture
def log(tmp_path: Path) -> Log:
    return read_log(saved(tmp_path))


def values(suite: Suite, metric: str) -> dict[str, float]:
    return {row.estimator: row.value for row in suite.rows if row.metric == metric}


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"course_rate": 0.0}, ValueError, "course_rate must be positive"),
        ({"course_rate": 250.0}, ValueError, SLOW),
        ({"course_noise_deg": -1.0}, ValueError, "course_noise_deg must be finite and not negat"),
        ({"delay": -0.1}, ValueError, "delay must be finite and not negative"),
        ({"bias_deg": math.nan}, ValueError, "bias_deg must be finite"),
        ({"seeds": 0}, ValueError, "expected seeds >= 1"),
        ({"q_gamma": -1.0}, ValueError, "q_gamma must be finite and not negative"),
        ({"estimators": ["kf"]}, ValueError, "unknown estimator 'kf'; did you mean 'dakf'"),
        ({"course_rat": 5.0}, TypeError, "course_rat"),
    ],
)
def test_bad_settings_are_refused(
    log: Log, settings: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        replay(log, PASSENGER_CAR, figures=False, **settings)


@pytest.mark.parametrize("option", [{"nominal": "coms"}, {"until": 30.0}])
def test_options_of_the_identified_car_are_not_ignored_for_a_named_one(
    tmp_path: Path, option: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match="--until and --nominal are for --vehicle identify"):
        replay_file(saved(tmp_path), "passenger-car", **option)


def test_told_the_true_car_the_drive_is_followed_exactly(log: Log) -> None:
    """The input's shift by one row is what makes this exact: unshifted, 1.2e-4 rad are left."""
    suite = replay(log, PASSENGER_CAR, estimators=["multirate-kf"], seeds=2, figures=False)
    rmse = values(suite, "rmse")
    assert rmse[GYRO_ONLY] < 1e-12
    assert rmse["multirate-kf"] < 0.2 * DEG  # the course's noise


def test_rows_hold_what_the_estimator_gives_by_itself(log: Log) -> None:
    soft = PASSENGER_CAR.scale_stiffness(0.7)
    settings: dict[str, Any] = {"estimators": ["multirate-kf"], "seeds": 3, "seed": 5}
    suite = replay(log, soft, figures=False, **settings)
    options = {"q_beta": 1e-3, "q_gamma": 0.1, "q_psi": 0.0, "course_noise": 0.5 * DEG}
    errors = []
    for seed in (5, 6, 7):
        seen = _emulate_course(log, Settings(), seed)
        facts: dict[str, Any] = {"vehicle": soft, "sensors": seen.slow, "dt": log.record.dt}
        estimator = make_estimator("multirate-kf", **facts, **options)
        error = estimator.run(seen)["beta"][200:] - log.truth["beta"][200:]
        errors.append(np.sqrt(np.mean(error**2)))
    row = next(r for r in suite.rows if r.metric == "rmse" and r.estimator == "multirate-kf")
    assert (row.low, row.value, row.high) == pytest.approx(tuple(sorted(errors)), rel=1e-12)
    assert row.n == 3
    spec = json.loads(row.spec)
    assert spec["vehicle"]["front_stiffness"] == soft.front_stiffness
    assert spec["settings"]["seed"] == 5
    ratio = values(suite, "ratio")
    assert ratio[GYRO_ONLY] == 1.0
    assert ratio["multirate-kf"] == pytest.approx(row.value / values(suite, "rmse")[GYRO_ONLY])


def test_all_estimators_are_scored_tabled_and_drawn(log: Log) -> None:
    suite = replay(log, PASSENGER_CAR.scale_stiffness(0.7), seeds=2)
    assert suite.name == "replay"
    served = set(ESTIMATORS)
    assert set(values(suite, "rmse")) == served
    (table,) = suite.tables
    assert {line["estimator"] for line in table.cells} == served
    assert {"nees", "coverage", "log_score"} <= table.cells[0].keys()
    scores = [line["log_score"].value for line in table.cells]
    assert scores == sorted(scores, reverse=True)
    assert "cannot see" in table.note  # dakf's unobservable direction
    ((question, bars, closest),) = suite.answers
    assert log.name in question and len(bars.data) > 0
    assert closest.startswith("From the recorded angle ")
    assert len(suite.figures) == 2
    for title, figure, text in suite.figures:
        assert title.startswith(log.name)
        assert len(figure.data) > 0
        assert text


def test_a_log_without_truth_or_slow_sensors_says_what_is_left_out(tmp_path: Path) -> None:
    log = read_log(saved(tmp_path, sideslip_rad=None))
    suite = replay(log, PASSENGER_CAR)
    assert [line["estimator"] for line in suite.tables[0].cells] == [GYRO_ONLY]
    assert suite.rows == []
    assert "no sideslip truth, so nothing is scored" in suite.text
    assert "`course-kf` left out: needs gps" in suite.tables[0].note
    assert "`exact-kf` left out: needs gps or camera" in suite.tables[0].note
    assert len(suite.figures) == 1 and suite.answers == []


def test_a_logged_course_is_used_as_it_is(tmp_path: Path) -> None:
    course = np.full(ROWS, np.nan)
    plain = read_log(saved(tmp_path))
    heading = plain.truth["beta"] + plain.heading + 0.7  # another zero of heading
    course[::20] = heading[::20]
    log = read_log(saved(tmp_path, course_rad=course))
    suite = replay(log, PASSENGER_CAR, figures=False)
    assert "Slow sensors are the log's own: gps" in suite.text
    rmse = values(suite, "rmse")
    assert set(rmse) == set(ESTIMATORS)
    assert rmse["course-kf"] < 0.01 * DEG
    assert {row.n for row in suite.rows} == {1}
    blind = read_log(saved(tmp_path, course_rad=course, sideslip_rad=None))
    unscored = replay(blind, PASSENGER_CAR)
    assert {line["estimator"] for line in unscored.tables[0].cells} == set(rmse)
    assert values(unscored, "rmse") == {}


def test_a_drive_that_ends_before_errors_count(tmp_path: Path) -> None:
    short = {name: column[:150] for name, column in columns().items()}
    log = read_log(saved(tmp_path, **short))
    with pytest.raises(ValueError, match=r"lasts 1\.49 s, errors count from 2 s on"):
        replay(log, PASSENGER_CAR)


def test_files_in_rows_out(tmp_path: Path) -> None:
    vehicle = tmp_path / "mine.toml"
    vehicle.write_text(VEHICLE)
    table = columns()
    drive = saved(tmp_path, steer_rad=None, Delta=table["steer_rad"] / DEG)
    settings: dict[str, Any] = {"estimators": ["multirate-kf"], "seeds": 1, "figures": False}
    suite = replay_file(drive, vehicle, mapping=["steer_deg=Delta"], **settings)
    assert len(suite.tables) == 1 and len(suite.rows) == 2 * 4
    write_json(tmp_path / "rows.json", suite.rows)
    assert len(read_json(tmp_path / "rows.json")) == len(suite.rows)


@pytest.mark.skipif(not STANFORD.exists(), reason="the shared recordings are not here")
def test_the_stanford_drive_reaches_its_numbers() -> None:
    """Told the fitted car x 0.7: gyro only 1.11 deg, multirate 0.50-0.53."""
    settings: dict[str, Any] = {"seeds": 3, "figures": False}
    car = make_vehicle("ferrari-250lm-fitted").scale_stiffness(0.7)
    suite = replay(read_log(STANFORD), car, estimators=["multirate-kf"], **settings)
    rmse = values(suite, "rmse")
    assert rmse[GYRO_ONLY] == pytest.approx(1.11 * DEG, abs=0.02 * DEG)
    assert rmse["multirate-kf"] < 0.55 * DEG
    assert values(suite, "ratio")["multirate-kf"] <= 0.60


def test_no_course_is_emulated_in_a_part_that_lacks_the_logs_own(tmp_path: Path) -> None:
    rows = read_csv(saved(tmp_path)).assign(course_rad=math.nan)
    rows.loc[: len(rows) // 2 - 40 : 20, "course_rad"] = 0.1
    path = tmp_path / "parts.csv"
    rows.drop(index=range(len(rows) // 2 - 35, len(rows) // 2 + 35)).to_csv(path, index=False)
    suite = replay_file(path, PASSENGER_CAR, estimators=["exact-kf"], figures=False)
    kinds = {(row.scenario.rpartition("part ")[2][0], row.estimator) for row in suite.rows}
    assert kinds == {("1", GYRO_ONLY), ("1", "exact-kf"), ("2", GYRO_ONLY)}
    assert "Part 2 has no sample of gps." in suite.text and "emulated" not in suite.text


def test_without_gps_and_truth_inertial_sensors_serve_two_filters(tmp_path: Path) -> None:
    rows = read_csv(saved(tmp_path))
    rows = rows.drop(columns=[name for name in ("course_rad", "sideslip_rad") if name in rows])
    rows.assign(accel_y_mps2=0.0).to_csv(tmp_path / "bare.csv", index=False)
    suite = replay_file(tmp_path / "bare.csv", PASSENGER_CAR, figures=False)
    assert {line["estimator"] for line in suite.tables[0].cells} == {GYRO_ONLY, "joint"}


def test_that_most_rows_were_dropped_is_the_first_line(tmp_path: Path) -> None:
    rows = read_csv(saved(tmp_path))
    rows.loc[: 0.6 * len(rows), "yaw_rate_radps"] = math.nan
    rows.to_csv(tmp_path / "late.csv", index=False)
    settings: dict[str, Any] = {"estimators": [], "figures": False}
    first, *_ = replay_file(tmp_path / "late.csv", PASSENGER_CAR, **settings).warnings
    assert "rows lack a value of yaw_rate" in first


def test_the_verdict_is_of_the_longest_part_and_says_so(tmp_path: Path) -> None:
    rows = read_csv(saved(tmp_path))
    hole, path = len(rows) // 4, tmp_path / "parts.csv"
    rows.drop(index=range(hole, hole + 70)).to_csv(path, index=False)
    settings: dict[str, Any] = {"estimators": ["exact-kf"], "figures": False}
    suite = replay_file(path, PASSENGER_CAR, **settings)
    rows.iloc[hole + 70 :].to_csv(tmp_path / "long.csv", index=False)
    assert suite.verdict == replay_file(tmp_path / "long.csv", PASSENGER_CAR, **settings).verdict
    assert "the verdict is of the longest of 2 parts" in suite.warnings[-1]


def test_an_option_of_an_emulated_course_is_refused_beside_a_real_one(tmp_path: Path) -> None:
    rows = read_csv(saved(tmp_path)).assign(course_rad=math.nan)
    rows.loc[::20, "course_rad"] = 0.1
    rows.to_csv(tmp_path / "course.csv", index=False)
    with pytest.raises(ValueError, match="delay is of an emulated course"):
        replay_file(tmp_path / "course.csv", PASSENGER_CAR, delay=0.5)


def test_a_noiseless_course_is_truth_plus_the_integral_of_the_yaw_rate(log: Log) -> None:
    seen = _emulate_course(log, Settings(course_noise_deg=0.0, bias_deg=1.0), 0)
    packets = seen.record.select_packets("gps")
    captured = packets[:, PACKET.captured].astype(int)
    np.testing.assert_array_equal(captured, np.arange(10_000, 11_001, 10))
    gamma, beta = log.record.fast[:, FAST.gyro], log.truth["beta"]
    for packet, row in zip(packets, captured - 10_000, strict=True):
        psi = sum(0.5 * (gamma[i] + gamma[i + 1]) * DT for i in range(row))  # slowly
        assert packet[PACKET.value] == pytest.approx(psi + beta[row] + 1.0 * DEG, abs=1e-12)
    assert (packets[:, PACKET.quality] == 1.0).all()
    assert seen.slow["gps"].period == pytest.approx(0.1)
    assert seen.truth is log.truth


def test_a_late_course_arrives_so_many_rows_later(log: Log) -> None:
    fresh = _emulate_course(log, Settings(), 3).record.packets
    late = _emulate_course(log, Settings(delay=0.2), 3)
    packets = late.record.packets
    np.testing.assert_array_equal(packets[:, PACKET.arrived], packets[:, PACKET.captured] + 20)
    np.testing.assert_array_equal(packets[:, PACKET.value], fresh[: len(packets), PACKET.value])
    assert packets[-1, PACKET.arrived] <= log.record.ticks[-1]
    assert late.slow["gps"].delays == pytest.approx((0.2,))


def test_the_noise_has_its_seed_and_size(log: Log) -> None:
    how = Settings(course_rate=100.0, course_noise_deg=0.5)
    one, same, other = (_emulate_course(log, how, seed).record.packets for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    noise = one[:, PACKET.value] - (log.truth["beta"] + log.heading)
    assert np.std(noise) == pytest.approx(0.5 * DEG, rel=0.1)
    assert not np.array_equal(one, other)


def test_a_gyro_bias_reaches_the_estimators_but_not_the_heading(log: Log) -> None:
    one, two = (_make_drives(log, Settings(gyro_bias_degps=x))[0].record for x in (0.0, 0.2))
    np.testing.assert_allclose(two.fast[:, FAST.gyro] - one.fast[:, FAST.gyro], 0.2 * DEG)
    np.testing.assert_array_equal(two.packets, one.packets)


def test_no_course_without_truth_and_none_to_use_at_a_standstill(tmp_path: Path) -> None:
    beta, speed = columns()["sideslip_rad"], np.full(ROWS, SPEED)
    beta[95:105] = np.nan
    speed[:50] = 0.5
    log = read_log(saved(tmp_path, sideslip_rad=beta, speed_x_mps=speed))
    packets = _emulate_course(log, Settings(), 0).record.packets
    assert 10_100 not in packets[:, PACKET.captured]
    np.testing.assert_array_equal(packets[:6, PACKET.quality], [0, 0, 0, 0, 0, 1])
