"""Steering, latencies and noise: in a file, and applied to a log."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm
from typer.testing import CliRunner

from sideslip.benchmarks.cli.data import _parse_estimator_options
from sideslip.benchmarks.cli.main import app
from sideslip.benchmarks.harness.stats import compute_honesty
from sideslip.benchmarks.report.study import describe_innovations
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, make_vehicle
from sideslip.estimators.wires import SignalCalibration, apply_wires, read_wires, write_vehicle

from .simulated import as_table, drive


def test_a_file_keeps_the_car_and_the_wires(tmp_path: Path) -> None:
    late, places = {"gps": 0.2, "steer": -0.02}, {"gps": [1.5, 0.0, 1.2]}
    wires = SignalCalibration(15.0, -1, 0.01, late, {"gyro_noise": 0.004}, places)
    write_vehicle(tmp_path / "car.toml", PASSENGER_CAR, wires)
    assert make_vehicle(tmp_path / "car.toml") == PASSENGER_CAR
    assert read_wires(tmp_path / "car.toml") == wires
    assert read_wires("coms") == read_wires(None) == SignalCalibration()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steering = {ratio = 0.0}", "ratio above 0"),
        ("steering = {sign = 2}", "sign of 1 or -1"),
        ("steering = {wheel = 1.0}", "wheel"),
        ("latency = {radar = 0.1}", "radar=0.1"),
        ("latency = {gps = -0.1}", "0 to 5 s"),
        ("latency = {steer = 9.0}", "-5 to 5 s"),
        ('noise = {gyro_noise = "loud"}', "gyro_noise is a number of zero or more, got 'loud'"),
        ("noise = {gyro_nois = 0.1}", "did you mean 'gyro_noise'"),
        ("at = {gps = [1.0, 0.0]}", r"gps sits at \[x, y, z\] m forward, left, up, within 10 m"),
        ("at = {gps = [1000.0, 0.0, 0.0]}", "within 10 m, got"),
        ("at = {radar = [1.0, 0.0, 0.0]}", "sensor with a place 'radar'"),
    ],
)
def test_bad_wires_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "car.toml"
    path.write_text(f'base = "coms"\n{text}\n')
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        read_wires(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_log_is_put_right() -> None:
    right, _ = drive(1)
    wrong, _ = drive(1, -15.0, 0.01, 0.2)
    late = wrong.record.fast.copy()
    late[5:, FAST.accel_y] = wrong.record.fast[:-5, FAST.accel_y]
    wrong.record.fast[:] = late
    made = apply_wires(wrong, SignalCalibration(15.0, -1, 0.01, {"gps": 0.2, "accel_y": 0.05}))
    for column in (FAST.steer, FAST.accel_y):
        ours, true = made.record.fast[:-5, column], right.record.fast[:-5, column]
        np.testing.assert_allclose(ours, true, atol=1e-12)
    delays = made.record.packets[:, PACKET.arrived] - made.record.packets[:, PACKET.captured]
    assert set(delays) == {20.0} and made.slow["gps"].delays == (0.2,)
    period, phase = made.slow["gps"].period, made.slow["gps"].phase or 0.0
    beside = (made.record.packets[:, PACKET.captured] * 0.01 - phase) % period
    assert np.minimum(beside, period - beside).max() < 0.011


def test_identify_writes_what_replay_reads(tmp_path: Path) -> None:
    """Told nothing but the log, a replay of steering-wheel degrees of the other sign works."""
    log, true = drive(1, -15.0, 0.0, 0.2)
    path = tmp_path / "drive.csv"
    as_table(log).to_csv(path, index=False)
    run = CliRunner().invoke(app, ["identify", str(path), "--out", str(tmp_path / "car.toml")])
    assert run.exit_code == 0, run.output
    car = make_vehicle(tmp_path / "car.toml")
    assert car.front_stiffness == pytest.approx(true.front_stiffness, rel=0.1)
    assert read_wires(tmp_path / "car.toml").latency["gps"] == pytest.approx(0.2, abs=0.03)
    for vehicle in ([str(tmp_path / "car.toml")], ["identify", "--until", "30"]):
        more = ["--estimator", "joint", "--estimator-option", "joint.robust=1"]
        run = CliRunner().invoke(app, ["replay", str(path), "--vehicle", *vehicle, *more])
        assert run.exit_code == 0, run.output
        assert "WARNING" not in run.output
    run = CliRunner().invoke(app, ["replay", str(path), "--vehicle", "passenger-car", *more])
    assert "WARNING: steering and yaw rate differ in sign" in " ".join(run.output.split())


def test_options_of_estimators() -> None:
    found = _parse_estimator_options(["joint.robust=4", "dakf.q_beta=1e-4", "joint.gate=0.9"])
    assert found == {"joint": {"robust": 4, "gate": 0.9}, "dakf": {"q_beta": 1e-4}}
    with pytest.raises(ValueError, match=r"ESTIMATOR\.NAME=VALUE, got 'robust=4'"):
        _parse_estimator_options(["robust=4"])


def test_a_sensor_ahead_of_the_centre_of_gravity_is_moved_there() -> None:
    """Rigid body: v = v_cg + w x p, a = a_cg + w' x p + w x (w x p), with known motion."""
    right, _ = drive(1)
    t, n = right.time, len(right.time)
    rate, slope = 0.3 * np.sin(t), 0.3 * np.cos(t)
    roll_rate, slip, speed = 0.05 * np.cos(2.0 * t), 0.03 * np.sin(t), np.full(n, 20.0)
    x, y, z = place = (1.5, -0.4, 1.2)
    fast = right.record.fast.copy()
    fast[:, [FAST.gyro, FAST.roll_rate]] = np.stack([rate, roll_rate], axis=1)
    fast[:, [FAST.wheel_left, FAST.wheel_right]] = speed[:, None]
    fast[:, FAST.accel_y] = 1.0 + slope * x - rate**2 * y
    fast[:, FAST.accel_x] = 2.0 - slope * y - rate**2 * x
    v_y = speed * np.tan(slip) + rate * x - roll_rate * z
    shown = np.arctan2(v_y, speed - rate * y)
    packets = right.record.packets.copy()
    rows = packets[:, PACKET.captured].astype(int) - right.record.first
    packets[:, PACKET.value] = shown[rows]
    record = dataclasses.replace(right.record, fast=fast, packets=packets)
    log = dataclasses.replace(right, record=record, truth={"beta": shown})
    places = dict.fromkeys(("gps", "sideslip", "accel"), place)
    moved = apply_wires(log, SignalCalibration(at=places))
    assert np.abs(shown - slip).max() > 0.02
    np.testing.assert_allclose(moved.truth["beta"], slip, atol=3e-4)  # slips are small
    np.testing.assert_allclose(moved.record.packets[:, PACKET.value], slip[rows], atol=3e-4)
    inner = slice(10, -10)
    np.testing.assert_allclose(moved.record.fast[inner, FAST.accel_y], 1.0, atol=1e-3)
    np.testing.assert_allclose(moved.record.fast[inner, FAST.accel_x], 2.0, atol=1e-3)


def test_a_stream_moves_the_course_as_the_whole_record_does(tmp_path: Path) -> None:
    import sideslip

    table = as_table(drive(2)[0]).iloc[:600]
    car = tmp_path / "car.toml"
    write_vehicle(car, PASSENGER_CAR, SignalCalibration(at={"gps": [1.5, 0.0, 0.0]}))
    names = [str(name) for name in table if name != "time_s"]
    stream = sideslip.Stream(car, names)
    for row in table.to_dict("records"):
        for name in names:
            if np.isfinite(value := float(row[name])):
                stream.push(name, float(row["time_s"]), value)
    answer, whole = stream.estimate(), sideslip.estimate(table, car).iloc[-1]
    assert answer is not None and answer.sideslip == pytest.approx(whole["sideslip_rad"], abs=1e-9)
    plain = sideslip.estimate(table, "passenger-car").iloc[-1]
    assert abs(plain["sideslip_rad"] - whole["sideslip_rad"]) > 1e-4
    write_vehicle(car, PASSENGER_CAR, SignalCalibration(at={"accel": [1.0, 0.0, 0.0]}))
    with pytest.raises(ValueError, match="accelerations of the centre of gravity"):
        sideslip.Stream(car, names)


def test_a_stated_latency_comes_to_the_logged_one() -> None:
    log, _ = drive(1)
    packets = log.record.packets.copy()
    packets[:, PACKET.arrived] += 10
    slow = {"gps": dataclasses.replace(log.slow["gps"], delays=(0.1,))}
    record = dataclasses.replace(log.record, packets=packets)
    punctual = dataclasses.replace(log, record=record, slow=slow)
    late = apply_wires(punctual, SignalCalibration(latency={"gps": 0.2}))
    delays = late.record.packets[:, PACKET.arrived] - late.record.packets[:, PACKET.captured]
    assert late.slow["gps"].longest_delay == pytest.approx(0.3) and set(delays) == {30.0}


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_nees_coverage_and_score_of_normal_errors(factor: float) -> None:
    """Deviations that are `factor` times the errors': NEES is 1 / factor^2."""
    error = np.random.default_rng(0).normal(0.0, 0.01, 20_000)
    deviation = np.full(20_000, 0.01 * factor)
    nees, held, score = compute_honesty(error, deviation)
    assert nees == pytest.approx(1.0 / factor**2, rel=0.05)
    assert held == pytest.approx(2.0 * norm.cdf(1.96 * factor) - 1.0, abs=0.01)
    assert score == pytest.approx(np.mean(norm.logpdf(error, 0.0, deviation)))


def test_without_truth_innovations_say_whom_not_to_believe() -> None:
    text = describe_innovations({"joint": 7.25, "exact-kf": 1.1})
    assert "do not believe joint (7.2)" in text and "exact-kf" not in text
    assert "nobody is lost" in describe_innovations({"exact-kf": 1.1})
    assert describe_innovations({}) == ""
    assert not math.isnan(compute_honesty(np.zeros(3), np.ones(3))[2])
