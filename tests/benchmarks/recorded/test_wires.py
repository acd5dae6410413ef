"""Steering, latencies and noise: in a file, and applied to a log."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from sideslip.benchmarks.cli.data import _parse_estimator_options
from sideslip.benchmarks.cli.main import app
from sideslip.benchmarks.recorded.replay import replay_file
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, make_vehicle
from sideslip.estimators.wires import (
    SignalCalibration,
    apply_wires,
    read_wires,
    write_vehicle,
)

from .simulated import as_table, drive
from .slalom import columns, saved


def test_a_file_keeps_the_car_and_the_wires(tmp_path: Path) -> None:
    wires = SignalCalibration(15.0, -1, 0.01, {"gps": 0.2, "steer": -0.02}, {"gyro_noise": 0.004})
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
        (
            'noise = {gyro_noise = "loud"}',
            "noise gyro_noise is a number of zero or more, got 'loud'",
        ),
        ("noise = {gyro_nois = 0.1}", "did you mean 'gyro_noise'"),
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
        assert "front_tyres" in run.output and "WARNING" not in run.output
    run = CliRunner().invoke(app, ["replay", str(path), "--vehicle", "passenger-car", *more])
    assert "WARNING: steering and yaw rate differ in sign" in " ".join(run.output.split())


def test_parts_are_replayed_by_themselves(tmp_path: Path) -> None:
    time = columns()["time_s"] + 3.0 * (np.arange(1001) >= 500)
    path = saved(tmp_path, time_s=time)
    settings: dict[str, Any] = {"estimators": ["multirate-kf"], "seeds": 1, "figures": False}
    suite = replay_file(path, PASSENGER_CAR, **settings)
    assert "2 parts, between which rows are missing." in suite.text
    assert {row.scenario.partition(":")[0][-6:] for row in suite.rows} == {"part 1", "part 2"}


def test_options_of_estimators() -> None:
    found = _parse_estimator_options(["joint.robust=4", "dakf.q_beta=1e-4", "joint.gate=0.9"])
    assert found == {"joint": {"robust": 4, "gate": 0.9}, "dakf": {"q_beta": 1e-4}}
    with pytest.raises(ValueError, match=r"ESTIMATOR\.NAME=VALUE, got 'robust=4'"):
        _parse_estimator_options(["robust=4"])
