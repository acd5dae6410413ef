"""A known car is found from its log, within its intervals; what the log cannot show is said."""

import copy
import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks.recorded.bicycle_fit import Theta, Windows, fit
from sideslip.benchmarks.recorded.identify import (
    IdentificationResult,
    _make_suite,
    _make_validation_table,
    _split_blocks,
    identify,
)
from sideslip.benchmarks.recorded.quality import find_contradictions, find_saturated, find_swapped
from sideslip.benchmarks.recorded.sensor_noise import Finding, _estimate_white_noise, _jackknife
from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.studies.logs import STUDY
from sideslip.envs.record import FAST, Array, Log
from sideslip.envs.vehicle.parameters import PASSENGER_CAR
from sideslip.estimators.wires import AS_LOGGED, SignalCalibration, move_course

from .drawn_cars import drawn_car
from .simulated import as_table, drive


def row(found: IdentificationResult, name: str) -> Finding:
    return next(each for each in found.findings if each.name == name)


def changed(log: Log, **columns: Array) -> Log:
    fast = log.record.fast.copy()
    for name, values in columns.items():
        fast[:, getattr(FAST, name)] = values
    return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))


@pytest.mark.parametrize("plain", [True, False])
def test_a_known_car_is_found_within_its_intervals(plain: bool) -> None:
    """Steering wheel angles of the other sign, 0.4 deg beside, a GPS 0.2 s late."""
    offset = math.radians(0.4)
    log, car = drive(1, -15.0, offset, 0.2, plain)
    found = identify([log], PASSENGER_CAR)
    assert ("linear" if plain else "fiala") in found.remarks[-1]
    for name, true, within in (
        ("front_stiffness_axle", 2.0 * car.front_stiffness, 0.1),
        ("rear_stiffness_axle", 2.0 * car.rear_stiffness, 0.1),
        ("yaw_inertia", car.yaw_inertia, 0.15),
        ("steering ratio", 15.0, 0.1),
        ("steering offset", 0.4, 0.3),
        ("latency of gps", 0.2, 0.2),
        ("noise of gyro", 0.005, 0.1),
        ("noise of accel_y", 0.1, 0.1),
    ):
        finding = row(found, name)
        assert finding.is_determined, finding
        assert abs(finding.value - true) < within * true, finding
        assert abs(finding.value - true) < 2.0 * finding.half, finding
    assert found.wires.sign == -1 and found.wires.ratio == row(found, "steering ratio").value
    assert found.rates[1] < 0.05 * found.rates[0]
    assert found.rates[2] < 1.3 * found.rates[1]


def test_the_start_does_not_matter_where_the_log_tells() -> None:
    log, _ = drive(1)
    starts = (PASSENGER_CAR.scale_stiffness(*at) for at in ((0.7, 1.3), (1.3, 0.7)))
    cars = [identify([log], start, tyres="fiala").car for start in starts]
    one, two = ([x.front_stiffness, x.rear_stiffness, x.yaw_inertia] for x in cars)
    np.testing.assert_allclose(one, two, rtol=0.02)


def test_the_fit_is_exact_on_the_plant_itself() -> None:
    """What is left of the true car is the sensors' noise and the disturbances."""
    log, car = drive(2, disturbance_force=0.0, disturbance_moment=0.0)
    w = dataclasses.replace(Windows.from_logs([log], car), tyres="fiala")
    found = fit(w, Theta(), ("front", "rear", "inertia"))
    assert np.abs(np.array(found.theta[:3])).max() < 0.02
    rate, accel, *_ = np.sqrt(np.mean(w.compute_residual(Theta()) ** 2, axis=(0, 2)))
    assert rate < 0.005 and accel < 0.11


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(0).normal(size=50)
    blocks = np.stack([values, np.ones(50)], axis=1)
    value, half = _jackknife(blocks, lambda sums: float(sums[0] / sums[1]))
    assert value == pytest.approx(values.mean())
    assert half == pytest.approx(2.0096 * values.std(ddof=1) / math.sqrt(50), rel=1e-4)


def test_white_noise_under_a_smooth_signal_and_of_a_slower_sensor() -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.01, 20000)
    smooth = np.sin(np.arange(20000) / 500.0)
    assert _estimate_white_noise([smooth + noise])[0] == pytest.approx(0.01, rel=0.05)
    slower = (smooth + noise)[::4].repeat(4)
    assert _estimate_white_noise([slower])[0] == pytest.approx(0.01, rel=0.1)


def straight(log: Log) -> Log:
    quiet = np.random.default_rng(0).normal(0.0, 1.0, (2, len(log.record.fast)))
    return changed(log, gyro=0.005 * quiet[0], steer=1e-4 * quiet[1], accel_y=0.1 * quiet[0])


def unrelated(log: Log) -> Log:
    return changed(log, steer=log.record.fast[::-1, FAST.steer])


def slow(log: Log) -> Log:
    speed = np.full(len(log.record.fast), 2.0)
    return changed(log, wheel_left=speed, wheel_right=speed)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (straight, "no excitation"),
        (unrelated, "steering and yaw rate are unrelated"),
        (slow, "0 of 6 windows"),
    ],
)
def test_what_is_not_there_is_not_told(spoil: Callable[[Log], Log], reason: str) -> None:
    found = identify([spoil(drive(1)[0])], PASSENGER_CAR)
    assert reason in found.reason and found.car == PASSENGER_CAR and found.wires.gain == 1.0
    assert not any(each.is_determined for each in found.findings[:8])
    assert "shows nothing of the car" in _make_suite(found, "x").verdict


def test_a_stated_ratio_stays_where_hard_turns_hide_it() -> None:
    log, _ = drive(1, amplitude=0.03, amplitude_2=0.02)
    found = identify([log], PASSENGER_CAR, SignalCalibration(ratio=1.1))
    assert found.wires.ratio == 1.1 and not row(found, "steering ratio").is_determined
    assert "a saturating axle" in row(found, "steering ratio").remark


def test_swapped_columns_are_refused() -> None:
    log, _ = drive(1)
    fast = log.record.fast
    for spoilt, message in (
        (changed(log, steer=fast[:, FAST.gyro], gyro=fast[:, FAST.steer]), "steering and yaw rate"),
        (changed(log, accel_x=fast[:, FAST.accel_y], accel_y=fast[:, FAST.accel_x]), "accel_x and"),
    ):
        with pytest.raises(ValueError, match=f"columns are swapped, {message}"):
            identify([spoilt], PASSENGER_CAR)
        assert any("swapped" in x.text for x in find_contradictions([spoilt], PASSENGER_CAR))
    assert find_swapped([log]) == ""


def test_a_gyro_at_its_limit_is_counted_and_left_out() -> None:
    log, car = drive(1)
    gyro = log.record.fast[:, FAST.gyro]
    clipped = changed(log, gyro=np.clip(gyro, -0.3, 0.9 * gyro.max()))
    out = find_saturated(clipped)
    assert (gyro[out] >= 0.9 * gyro.max() - 1e-12).sum() + (gyro[out] <= -0.3).sum() > 0
    assert not find_saturated(log).any()
    assert any(f"limit in {out.sum()} rows" in x.text for x in find_contradictions([clipped], car))
    whole, less = (len(Windows.from_logs([each], car).starts) for each in (log, clipped))
    assert less < whole


@pytest.mark.parametrize(
    ("ratio", "message"),
    [
        (-1.0, r"differ in sign \(--steering-sign -1"),
        (15.0, r"is 1\d\.?\d* times .* the angle of the steering wheel\?"),
        (180.0 / math.pi, "degrees in a column of radians"),
        (15.0 * 180.0 / math.pi, "degrees of the steering wheel in a column of radians"),
        (0.018, "radians in a column of degrees"),
    ],
)
def test_steering_of_another_sign_or_size_is_warned_of(ratio: float, message: str) -> None:
    (found,) = find_contradictions([drive(1, ratio)[0]], PASSENGER_CAR)
    assert re.search(message, found.text), found.text
    assert find_contradictions([drive(1)[0]], PASSENGER_CAR) == []


def test_without_data_there_are_instructions_and_no_numbers() -> None:
    suite = STUDY.run(Request())
    assert not suite.rows and not suite.tables and suite.verdict.startswith("No drive was read")
    assert any("250 LM" in line and "MIT" in line and "https" in line for line in suite.warnings)


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        STUDY.run(Request(data=tmp_path / "none"))


def test_each_drive_has_a_row_and_a_smoother_beside_it(tmp_path: Path) -> None:
    drawn = drawn_car(4, 20.0, 5.0)
    (tmp_path / "own").mkdir()
    table = as_table(drawn.log).assign(sideslip_rad=drawn.log.truth["beta"])
    table.to_csv(tmp_path / "own" / "a.csv", index=False)
    table.drop(columns="sideslip_rad").to_csv(tmp_path / "own" / "b.csv", index=False)
    (tmp_path / "own" / "c.csv").write_text("hello")
    suite = STUDY.run(Request(data=tmp_path))
    (result,) = suite.tables
    filtered, smoothed = result.cells
    assert (filtered["estimator"], smoothed["estimator"]) == ("joint", "its smoother, 1 s")
    assert 0.0 < filtered["median"] < filtered["p95"] < filtered["worst"] < np.radians(5.0)
    assert any("b is not scored: no true sideslip" in line for line in suite.warnings)
    assert any("c.csv: " in line for line in suite.warnings)


def test_a_found_car_stays_within_the_corridors_and_a_wrong_one_does_not() -> None:
    log = copy.deepcopy(drive(1, duration=100.0)[0])
    odd, even = _split_blocks([log])
    rows = sum(len(block.time) for block in (*odd, *even))
    assert rows == len(log.time) and odd[0].time[-1] < even[0].time[0]
    found = _make_validation_table([log], PASSENGER_CAR, AS_LOGGED, None)
    assert "assumptions" in found.note and len(found.cells) == 2
    assert [cell[-1] for cell in found.cells] == ["yes", "yes"]
    for block in even:  # another car drives them: it turns 1.3 times as much
        start = block.record.first - log.record.first
        part = slice(start, start + len(block.time))
        log.record.fast[part, [FAST.gyro, FAST.accel_y]] *= 1.3
    other = _make_validation_table([log], PASSENGER_CAR, AS_LOGGED, None)
    assert [cell[-1] for cell in other.cells] == ["no", "no"]


def test_an_antenna_ahead_is_moved_before_the_car_is_sought() -> None:
    """The same drive with the antenna 1.5 m ahead and said gives the same car."""
    log, _ = drive(1, duration=100.0)
    at = {"gps": (1.5, 0.0, 0.0)}
    record = dataclasses.replace(log.record, packets=log.record.packets.copy())
    ahead = dataclasses.replace(log, record=record)
    move_course(record.fast, record.packets, record.first, {"gps": (-1.5, 0.0, 0.0)})
    plain, moved = (
        identify([x], PASSENGER_CAR, SignalCalibration(at=places), "linear").car
        for x, places in ((log, {}), (ahead, at))
    )
    assert moved.front_stiffness == pytest.approx(plain.front_stiffness, rel=1e-3)
    assert moved.rear_stiffness == pytest.approx(plain.rear_stiffness, rel=1e-3)


def test_a_log_without_excitation_is_not_validated() -> None:
    log, _ = drive(1)
    table = _make_validation_table([_split_blocks([log])[0][0]], PASSENGER_CAR, AS_LOGGED, None)
    assert not table.cells and table.note.startswith("Not validated")
