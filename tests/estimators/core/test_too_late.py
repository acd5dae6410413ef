"""What is too late: refused and counted, never applied to the wrong state."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import make_estimator
from sideslip.estimators.core.memory import N_RECENT, SNAPSHOT_INTERVAL, WINDOW
from tests.estimators.simulation import CAMERA, FIG7

V = FIG7.speed


def rows(count: int) -> Any:
    fast = np.zeros((count, FAST_WIDTH))
    fast[:, FAST.gyro] = 0.02 * np.random.default_rng(0).standard_normal(count)
    return fast


def sample(captured: int, sensor: int = 1, value: float = 0.02) -> Any:
    packet = np.zeros(PACKET_WIDTH)
    packet[: PACKET.value + 2] = sensor, captured, captured, 1.0, 0, value, value
    return packet


NO_PACKETS = np.zeros((0, PACKET_WIDTH))


def test_buffer_goes_back_as_far_as_its_window_and_no_further() -> None:
    """Every sample up to WINDOW - EVERY ticks old is used as if it had come in time."""
    sensors = {"gps": SlowSensor(0.2)}
    late = make_estimator("exact-kf", sensors=sensors, speed=V, delay="buffer")
    in_time = make_estimator("exact-kf", sensors=sensors, speed=V, delay="buffer")
    now = 3 * WINDOW + 7
    for age in (1, SNAPSHOT_INTERVAL, WINDOW // 2, WINDOW - SNAPSHOT_INTERVAL):
        late.reset()
        late.step(rows(now + 1), NO_PACKETS)
        late.update(sample(now - age))
        in_time.run(Record(rows(now + 1), sample(now - age)[None]))
        assert late.counts["refused"] == 0
        sd = np.sqrt(np.diag(in_time.P))
        assert np.abs((late.x - in_time.x) / sd).max() < 1e-10
    for age in (WINDOW, WINDOW + 1, now):
        late.reset()
        late.step(rows(now + 1), NO_PACKETS)
        before = late.x, late.P
        late.update(sample(now - age))
        assert late.counts["refused"] == 1
        np.testing.assert_array_equal(late.x, before[0])
        np.testing.assert_array_equal(late.P, before[1])


def test_buffer_refuses_what_is_older_than_a_sample_it_had_to_give_up() -> None:
    """More samples than there is room for: none is ever left out of what is told again."""
    filter_ = make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2)}, speed=V, delay="buffer")
    packets = [sample(k) for k in range(100, 100 + 2 * N_RECENT)]
    filter_.run(Record(rows(300), np.array(packets)))
    before = filter_.x
    filter_.update(sample(100 + N_RECENT - 1 - SNAPSHOT_INTERVAL))
    assert filter_.counts["refused"] == 1
    np.testing.assert_array_equal(filter_.x, before)
    filter_.update(sample(100))  # it was used; that is forgotten, but not that it was
    assert filter_.counts["refused"] == 2
    filter_.update(sample(120 + N_RECENT + SNAPSHOT_INTERVAL))
    assert filter_.counts["duplicates"] == 1
    filter_.update(sample(250))
    assert filter_.counts["refused"] == 2
    whole = make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2)}, speed=V, delay="buffer")
    whole.run(Record(rows(300), np.array([*packets, sample(250)])))
    sd = np.sqrt(np.diag(whole.P))
    assert np.abs((filter_.x - whole.x) / sd).max() < 1e-10


@pytest.mark.parametrize("rule", ["clone", "larsen", "stored"])
def test_a_sample_that_nothing_is_held_of_changes_nothing(rule: Any) -> None:
    filter_ = make_estimator("exact-kf", sensors={"camera": CAMERA}, speed=V, delay=rule)
    filter_.step(rows(1000), NO_PACKETS)
    before = filter_.x, filter_.P
    for k in (0, 33, 33 * 12):
        filter_.update(sample(k, 0))
    assert filter_.counts["refused"] == 3 and sum(filter_.counts.values()) == 3
    np.testing.assert_array_equal(filter_.x, before[0])
    np.testing.assert_array_equal(filter_.P, before[1])


def test_the_longest_delays_that_fit() -> None:
    make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2, (0.496,))}, delay="buffer")
    make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2, (0.511,))}, delay="stored")
    sensors = {"camera": SlowSensor(0.033, (0.264,))}
    make_estimator("exact-kf", sensors=sensors, delay="clone")


def test_a_row_that_is_told_again_is_not_counted_again() -> None:
    """A gyro that is silent for a while, and samples from before."""
    filter_ = make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2)}, speed=V, delay="buffer")
    fast = rows(200)
    fast[150:160, FAST.gyro] = np.nan
    filter_.step(fast, NO_PACKETS)
    for k in (120, 140, 155):
        filter_.update(sample(k))
    assert filter_.counts == dict.fromkeys(filter_.counts, 0) | {"invalid": 10}
    assert np.isfinite(filter_.x).all()
