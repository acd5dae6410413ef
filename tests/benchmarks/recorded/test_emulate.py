"""The emulated course is the truth, the heading, and the noise, bias and delay asked for."""

import math
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks.recorded.emulate import Emulation, LoggedMotion
from sideslip.benchmarks.recorded.suite import _compute_path
from sideslip.envs.record import FAST, PACKET, PACKET_WIDTH, Log, Record
from tests.envs.recordings.drives import read_log

from .slalom import DT, ROWS, SPEED, columns, saved

DEG = math.pi / 180.0


@pytest.fixture
def log(tmp_path: Path) -> Log:
    return read_log(saved(tmp_path))


def test_a_noiseless_course_is_truth_plus_the_integral_of_the_yaw_rate(log: Log) -> None:
    seen = Emulation(course_noise_deg=0.0, bias_deg=1.0).apply(log, 0)
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
    fresh = Emulation().apply(log, 3).record.packets
    late = Emulation(delay=0.2).apply(log, 3)
    packets = late.record.packets
    np.testing.assert_array_equal(packets[:, PACKET.arrived], packets[:, PACKET.captured] + 20)
    np.testing.assert_array_equal(packets[:, PACKET.value], fresh[: len(packets), PACKET.value])
    assert packets[-1, PACKET.arrived] <= log.record.ticks[-1]
    assert late.slow["gps"].delays == pytest.approx((0.2,))


def test_the_noise_has_its_seed_and_size(log: Log) -> None:
    how = Emulation(course_rate=100.0, course_noise_deg=0.5)
    one, same, other = (how.apply(log, seed).record.packets for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    noise = one[:, PACKET.value] - (log.truth["beta"] + LoggedMotion(log).heading)
    assert np.std(noise) == pytest.approx(0.5 * DEG, rel=0.1)
    assert not np.array_equal(one, other)


def test_a_gyro_bias_reaches_the_estimators_but_not_the_heading(log: Log) -> None:
    plain, biased = Emulation(), Emulation(gyro_bias_degps=0.2)
    one, two = plain.apply(log, 0).record, biased.apply(log, 0).record
    np.testing.assert_allclose(two.fast[:, FAST.gyro] - one.fast[:, FAST.gyro], 0.2 * DEG)
    np.testing.assert_array_equal(two.packets, one.packets)


def test_no_course_without_truth_and_none_to_use_at_a_standstill(tmp_path: Path) -> None:
    beta, speed = columns()["sideslip_rad"], np.full(ROWS, SPEED)
    beta[95:105] = np.nan
    speed[:50] = 0.5
    log = read_log(saved(tmp_path, sideslip_rad=beta, speed_x_mps=speed))
    packets = Emulation().apply(log, 0).record.packets
    assert 10_100 not in packets[:, PACKET.captured]
    np.testing.assert_array_equal(packets[:6, PACKET.quality], [0, 0, 0, 0, 0, 1])


def test_a_path_of_a_circle() -> None:
    """Constant speed, yaw rate and sideslip drive a circle of radius V / gamma."""
    fast = np.zeros((20_001, len(FAST)))
    fast[:, FAST.gyro] = 0.1
    fast[:, [FAST.wheel_left, FAST.wheel_right]] = 10.0
    drive = Log(Record(fast, np.zeros((0, PACKET_WIDTH))), {})
    x, y = _compute_path(drive, np.zeros(20_001))
    radius = np.hypot(x, y - 100.0)
    np.testing.assert_allclose(radius, 100.0, atol=0.01)
