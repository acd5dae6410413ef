"""`estimate`: a table in, a sideslip angle with its interval out."""

import re
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from sideslip import estimate
from sideslip.agents.rollout import rollout
from sideslip.envs.recordings.log_file import read_parts
from sideslip.envs.vehicle.parameters import GRAVITY, Vehicle
from sideslip.estimators import make_estimator
from sideslip.estimators.wires import SignalCalibration, write_vehicle
from tests.benchmarks.recorded.simulated import TURNS, as_table, decimated

LATE = 0.2  # s


@cache
def drive() -> tuple[pd.DataFrame, np.ndarray, Vehicle]:
    """A drive as a table, its true sideslip angle and the true car."""
    env: Any = gym.make("sideslip/YawFusion-v0", scenario=TURNS, vehicle="passenger-car")
    log = decimated(rollout(env, seed=4).log)
    return as_table(log), log.truth["beta"], env.unwrapped.vehicle


def rms(result: pd.DataFrame, skipped: int = 200) -> float:
    error = (result.sideslip_rad - drive()[1])[skipped:]
    return float(np.sqrt(np.mean(error**2)))


def test_interval_holds_the_true_angle() -> None:
    table, truth, car = drive()
    result = estimate(table, car)
    error = (result.sideslip_rad - truth)[200:]
    assert np.mean(np.abs(error) <= 1.96 * result.sideslip_sd_rad[200:]) >= 0.9
    assert rms(result) < 0.5 * truth[200:].std()
    assert np.sqrt(np.mean((result.yaw_rate_radps - table.yaw_rate_radps) ** 2)) < 0.02
    assert result.healthy.mean() > 0.99
    np.testing.assert_allclose(result.time_s, table.time_s, atol=1e-9)


def test_table_equals_the_filter_that_runs_over_the_whole_record() -> None:
    table, _, car = drive()
    log = read_parts(table)[0][0]
    joint = make_estimator("joint", vehicle=car, sensors=log.slow, dt=log.record.dt)
    expected = joint.run(log)
    result = estimate(table, car)
    beta = expected.names.index("beta")
    assert (result.sideslip_rad == expected.x[:, beta]).all()
    assert (result.sideslip_sd_rad == expected.std[:, beta]).all()


def test_file_equals_table(tmp_path: Path) -> None:
    table, _, car = drive()
    table.to_parquet(tmp_path / "drive.parquet")
    pd.testing.assert_frame_equal(estimate(tmp_path / "drive.parquet", car), estimate(table, car))


def test_units_and_names_are_the_users() -> None:
    table, _, car = drive()
    other = pd.DataFrame(
        {
            "t": 1e3 * table.time_s,
            "v": 3.6 * table.speed_x_mps,
            "GyroZ": np.degrees(table.yaw_rate_radps),
            "steer_deg": np.degrees(table.steer_rad),
            "accel_y_g": table.accel_y_mps2 / GRAVITY,
            "course_deg": np.degrees(table.course_rad),
        }
    )
    mapping = {"time_ms": "t", "speed_x_kmh": "v", "yaw_rate_degps": "GyroZ"}
    result = estimate(other, car, mapping=mapping)
    np.testing.assert_allclose(result.sideslip_rad, estimate(table, car).sideslip_rad, atol=1e-8)


def test_late_course_is_used_at_its_time() -> None:
    table, _, car = drive()
    late = table.assign(course_rad=table.course_rad.shift(round(100 * LATE)))
    in_time, told, ignored = (
        rms(estimate(table, car)),
        rms(estimate(late, car, latency={"gps": LATE})),
        rms(estimate(late, car)),
    )
    assert told < 1.1 * in_time
    assert ignored > 1.25 * told


def test_vehicle_file_brings_the_steering_along(tmp_path: Path) -> None:
    table, _, car = drive()
    wires = SignalCalibration(ratio=16.0, sign=-1, offset=0.01, latency={"gps": LATE})
    write_vehicle(tmp_path / "car.toml", car, wires)
    logged = table.assign(
        steer_rad=-16.0 * (table.steer_rad - 0.01),
        course_rad=table.course_rad.shift(round(100 * LATE)),
    )
    right = table.assign(course_rad=logged.course_rad)
    np.testing.assert_allclose(
        estimate(logged, tmp_path / "car.toml").sideslip_rad,
        estimate(right, car, latency={"gps": LATE}).sideslip_rad,
        atol=1e-8,
    )


def test_filter_begins_anew_after_a_hole() -> None:
    table, _, car = drive()
    holed = table[(table.time_s < 15.0) | (table.time_s > 17.0)]
    result = estimate(holed, car)
    first = int(np.argmax(result.time_s > 16.0))
    assert (np.diff(result.time_s) > 0.0).all()
    assert not result.time_s.between(15.01, 16.99).any()
    assert result.sideslip_sd_rad[first] > result.sideslip_sd_rad[0]
    assert result.sideslip_sd_rad[first] > 2.0 * result.sideslip_sd_rad[first - 1]


@pytest.mark.parametrize("hole", [(30.0, 31.0), (15.0, 17.0)])
def test_time_below_zero_stays_the_logs(hole: tuple[float, float]) -> None:
    table, _, car = drive()
    cut = table[(table.time_s < hole[0]) | (table.time_s > hole[1])]
    expected = estimate(cut, car)
    result = estimate(cut.assign(time_s=cut.time_s - 10.0), car)
    np.testing.assert_allclose(result.time_s, expected.time_s - 10.0, atol=1e-9)
    np.testing.assert_allclose(result.sideslip_rad, expected.sideslip_rad, atol=2e-3)


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({"yaw_rate_radps": None}, {}, "the frame: no column yaw_rate_radps; the log has time_s"),
        ({"yaw_rate_radps": "fast"}, {}, "the frame: column 'yaw_rate_radps', row 1: expected a"),
        ({"camera_psi_rad": 0.1}, {}, "no row has both camera_psi and camera_y_l"),
        ({}, {"latency": {"radar": 0.1}}, "a latency is CHANNEL=S"),
        ({}, {"latency": {"gps": -0.1}}, "a latency is CHANNEL=S"),
        ({}, {"mapping": {"steer_rad": "Delta"}}, "the frame: no column 'Delta' for steer_rad"),
        ({}, {"vehicle": "lorry"}, "lorry"),
    ],
)
def test_refusals(changes: dict[str, Any], arguments: dict[str, Any], message: str) -> None:
    table, _, car = drive()
    wrong = table.assign(**{name: value for name, value in changes.items() if value})
    wrong = wrong.drop(columns=[name for name, value in changes.items() if not value])
    with pytest.raises(ValueError, match=re.escape(message)):
        estimate(wrong, **{"vehicle": car} | arguments)
