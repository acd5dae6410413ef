"""`estimate` and `Stream`: a table or samples in, a sideslip angle with its interval out."""

import math
import re
from collections.abc import Iterable
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
from sideslip.estimators.joint import SideslipEstimate, Stream
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
    columns = {
        "t": 1e3 * table.time_s, "v": 3.6 * table.speed_x_mps,
        "GyroZ": np.degrees(table.yaw_rate_radps), "steer_deg": np.degrees(table.steer_rad),
        "accel_y_g": table.accel_y_mps2 / GRAVITY, "course_deg": np.degrees(table.course_rad),
    }  # fmt: skip
    mapping = {"time_ms": "t", "speed_x_kmh": "v", "yaw_rate_degps": "GyroZ"}
    result = estimate(pd.DataFrame(columns), car, mapping=mapping)
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


Sample = tuple[str, float, float]


def samples(end: float = math.inf) -> list[Sample]:
    """Samples of the drive by time of capture."""
    table = drive()[0]
    names = [name for name in table.columns if name != "time_s"]
    rows = table[table.time_s < end].to_dict("records")
    return [
        (name, float(row["time_s"]), float(row[name]))
        for row in rows
        for name in names
        if math.isfinite(row[name])
    ]


def make_stream(**options: Any) -> Stream:
    table, _, car = drive()
    return Stream(car, [name for name in table.columns if name != "time_s"], **options)


def run(arrivals: Iterable[Sample]) -> SideslipEstimate:
    """The last estimate; the filter is asked at every yaw rate."""
    stream, last = make_stream(), None
    for name, stamp, value in arrivals:
        stream.push(name, stamp, value)
        if name == "yaw_rate_radps":
            last = stream.estimate()
    assert stream.counts == {"outside": 0}
    last = stream.estimate()
    assert last is not None
    return last


def test_punctual_samples_equal_the_table() -> None:
    table, _, car = drive()
    expected = estimate(table, car).iloc[-1]
    last = run(samples())
    assert last.time == pytest.approx(expected.time_s)
    assert last.sideslip == expected.sideslip_rad
    assert last.sideslip_sd == expected.sideslip_sd_rad
    assert last.yaw_rate == expected.yaw_rate_radps
    assert last.healthy


def test_any_order_within_the_memory_changes_nothing() -> None:
    punctual = samples(12.0)
    rng = np.random.default_rng(0)
    order = sorted(punctual, key=lambda x: x[1] + 0.4 * rng.random())
    assert order != punctual
    assert run(order) == run(punctual)


@pytest.mark.parametrize("memory", [0.02, 1.0])
def test_it_does_not_matter_how_often_one_asks(memory: float) -> None:
    asked, unasked = make_stream(memory=memory), make_stream(memory=memory)
    for sample in samples(18.0):
        asked.push(*sample)
        unasked.push(*sample)
        asked.estimate()
    assert unasked.estimate() == asked.estimate()
    assert asked.counts == {"outside": 0}


def test_a_channel_that_falls_silent_is_said() -> None:
    stream = make_stream()
    for name, stamp, value in samples(8.0):
        if name != "steer_rad" or stamp < 6.0:
            stream.push(name, stamp, value)
            now = stream.estimate() if name == "yaw_rate_radps" else None
            assert now is None or now.healthy == (now.time <= 6.24)


def test_none_before_every_fast_channel_has_come() -> None:
    stream = make_stream()
    assert stream.estimate() is None
    for name, stamp, value in samples(2.0):
        if name != "steer_rad":
            stream.push(name, stamp, value)
    assert stream.estimate() is None
    stream.push("steer_rad", 1.9, 0.0)
    assert stream.estimate() is not None


def test_a_wild_stamp_is_ignored_and_a_clock_set_anew_is_followed() -> None:
    stream = make_stream()
    for sample in samples(5.0):
        stream.push(*sample)
    before = stream.estimate()
    stream.push("yaw_rate_radps", 1e6, 0.0)
    stream.push("yaw_rate_radps", -3.0, 0.0)
    assert stream.counts == {"outside": 2}
    assert stream.estimate() == before
    for name, stamp, value in samples(5.0):
        stream.push(name, stamp + 1000.0, value)
    after = stream.estimate()
    assert before is not None and after is not None
    assert after.time == pytest.approx(before.time + 1000.0)
    assert after.sideslip == pytest.approx(before.sideslip, abs=2e-3)


@pytest.mark.parametrize(
    ("sample", "message"),
    [
        (("radar", 1.0, 0.0), "unknown channel 'radar'; known: speed_x_mps, yaw_rate_radps"),
        (("steer_rad", math.nan, 0.0), "steer_rad: expected finite numbers, got nan s, 0.0"),
        (("steer_rad", 1.0, math.inf), "steer_rad: expected finite numbers, got 1.0 s, inf"),
    ],
)
def test_refused_samples(sample: Sample, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        make_stream().push(*sample)


@pytest.mark.parametrize(
    ("channels", "options", "message"),
    [
        ("", {}, "no channel of yaw_rate among speed_x_kmh, steer_deg"),
        ("gyro", {}, "unknown column name 'gyro'"),
        ("yaw_rate_radps yaw_rate_degps", {}, "yaw_rate comes twice among speed_x_kmh"),
        ("yaw_rate_radps", {"dt": 2.0}, "expected 0 < dt <= 0.25"),
        ("yaw_rate_radps course_rad gps_latency_s", {}, "gps_latency: no channel, for a sample t"),
        ("yaw_rate_radps camera_psi_rad", {}, "a camera's sample has both values; no channel of "),
        ("yaw_rate_radps", {"memory": 0.0}, "got 0.01, 0.0"),
        ("yaw_rate_radps gps_speed_mps", {}, "gps_speed is used beside course alone"),
        ("yaw_rate_radps time_s", {}, "time is no sensor's"),
        ("yaw_rate_radps course_rad_held", {}, "course_rad_held: what is pushed is a sample"),
    ],
)
def test_refused_streams(channels: str, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        Stream("passenger-car", ("speed_x_kmh", "steer_deg", *channels.split()), **options)


def test_a_clock_below_zero_gives_the_same_numbers() -> None:
    estimates = []
    for shift in (0.0, -100.0):
        stream = make_stream()
        for name, stamp, value in samples(6.0):
            stream.push(name, stamp + shift, value)
            stream.estimate()
        estimates.append(stream.estimate())
        assert stream.counts == {"outside": 0} and not any(stream._filter.counts.values())
    one, other = estimates
    assert one is not None and other is not None
    assert other.time == pytest.approx(one.time - 100.0)
    assert other.sideslip == pytest.approx(one.sideslip, abs=1e-9)


def test_old_fixes_that_come_at_once_do_not_set_the_clock_back() -> None:
    stream = make_stream()
    for sample in samples(6.0):
        stream.push(*sample)
    before = stream.estimate()
    for k in range(20):
        stream.push("course_rad", 2.0 + 0.1 * k, 0.0)
    assert stream.counts == {"outside": 20} and stream.estimate() == before


def test_a_sample_that_comes_later_than_the_memory_is_refused_at_once(tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    channels = ("speed_x_mps", "steer_rad", "yaw_rate_radps", "course_rad")
    car.write_text('base = "passenger-car"\nlatency = {gps = 1.2}\n')
    with pytest.raises(ValueError, match=r"course_rad is 1[.]2 s late: memory 1 s is too short"):
        Stream(car, channels)
    Stream(car, channels, memory=2.0)
