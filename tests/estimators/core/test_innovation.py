"""Innovations: their distribution, the gate on it, and an R that follows them."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from sideslip.envs.record import PACKET, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.sensors.slow import CAMERA as CAMERA_CODE
from sideslip.estimators import make_estimator
from tests.estimators.simulation import Drive, simulate

DRIVE = Drive(duration=60.0, real=6000.0)
SENSORS = {
    "camera": SlowSensor(0.033, (0.010,), jitter=0.060),
    "gps": SlowSensor(0.2, (0.050,), jitter=0.200),
}


@pytest.fixture(scope="module")
def log() -> Any:
    return simulate(DRIVE, SENSORS, 5)


def told_the_truth(**options: Any) -> Any:
    common: Any = {"vehicle": DRIVE.truth, "sensors": SENSORS, "speed": DRIVE.speed}
    return make_estimator("exact-kf", **(common | {"slow": ["camera", "gps"]} | options))


def test_nis_is_of_the_last_packet_and_unknown_where_it_was_not_used(log: Any) -> None:
    filter_ = told_the_truth()
    record = log.record
    estimates = filter_.run(Record(record.fast[:500], record.packets[:8]))
    assert filter_.nis == estimates.nis[7] and len(estimates.nis) == 8
    filter_.update(record.packets[7])
    assert math.isnan(filter_.nis) and filter_.counts["duplicates"] == 1


def test_the_gate_refuses_as_many_good_samples_as_it_says(log: Any) -> None:
    filter_ = told_the_truth(gate=0.99)
    filter_.run(log)
    count = len(log.record.packets)
    assert abs(filter_.counts["gated"] - 0.01 * count) < 3.0 * math.sqrt(0.01 * count)


@pytest.mark.parametrize("delay", ["clone", "buffer"])
@pytest.mark.parametrize("sensor", [0, 1])
def test_an_outlier_leaves_it_as_if_it_had_never_come(log: Any, delay: Any, sensor: Any) -> None:
    """Bit for bit, also where it comes in the midst of others."""
    filter_ = told_the_truth(delay=delay, gate=0.9999)
    record = Record(log.record.fast[:3000], log.record.packets)
    record.packets = record.packets[record.packets[:, PACKET.arrived] < 3000]
    of_sensor = np.flatnonzero(record.packets[:, PACKET.sensor] == sensor)
    chosen = of_sensor[3:12:4]  # some, the third of the sensor and later ones
    packets = record.packets.copy()
    packets[chosen, PACKET.value] += 3.0
    found = filter_.run(Record(record.fast, packets))
    assert filter_.counts["gated"] == len(chosen)
    limit = chi2.ppf(0.9999, 2 - sensor)
    assert (found.nis[chosen] > limit).all()
    covariance = filter_.P
    without = filter_.run(Record(record.fast, np.delete(packets, chosen, 0)))
    assert filter_.counts["gated"] == 0
    np.testing.assert_array_equal(found.x, without.x)
    np.testing.assert_array_equal(found.std, without.std)
    np.testing.assert_array_equal(covariance, filter_.P)
    np.testing.assert_array_equal(np.delete(found.nis, chosen), without.nis)
    again = filter_.run(Record(record.fast, np.repeat(packets, 2, 0)))
    assert filter_.counts["duplicates"] == len(packets)
    np.testing.assert_array_equal(again.x, without.x)


def test_the_first_course_that_is_refused_is_not_the_first() -> None:
    """The next one, far off, still sets the heading."""
    sensors = {"gps": SlowSensor(0.2)}
    log = simulate(Drive(duration=1.0), sensors, 0)
    log.record.packets[0, PACKET.value] = 0.4  # less than astray, more than believed
    log.record.packets[1:, PACKET.value] += 2.0
    filter_ = make_estimator("exact-kf", sensors=sensors, speed=7.0, gate=0.999)
    found = filter_.run(log)
    assert filter_.counts["gated"] == 1
    assert found["psi"][-1] == pytest.approx(2.0 + log.truth["psi"][-1], abs=0.05)


def test_late_courses_that_set_the_heading_set_it_alike() -> None:
    """The first to arrive turns the heading of the past too, in clones as in the buffer."""
    sensors = {"gps": SlowSensor(0.2, (0.350, 0.010, 0.120))}
    log = simulate(Drive(duration=3.0), sensors, 4)
    packets = log.record.packets
    assert packets[0, PACKET.captured] > packets[1, PACKET.captured]  # the second overtook it
    packets[:, PACKET.value] += 2.0
    clone, buffer = (
        make_estimator("exact-kf", sensors=sensors, speed=7.0, delay=delay).run(log)
        for delay in ("clone", "buffer")
    )
    assert np.abs((clone.x - buffer.x) / clone.std).max() < 1e-4
    assert abs(clone["psi"][-1] - log.truth["psi"][-1] - 2.0) < 0.05


def scales(filter_: Any, log: Any) -> Any:
    """The scales of the camera's R, (k, 2), after every 100 ticks."""
    filter_.prepare_record(log)
    found: Any = []
    record, at = log.record, 0
    for start in range(0, len(record.fast) - 1, 100):
        until = int(np.searchsorted(record.packets[:, PACKET.arrived], start + 100))
        filter_.step(record.fast[start : start + 100], record.packets[at:until])
        at = until
        found.append(filter_.filters[0].scale[CAMERA_CODE, :2].copy())
    return np.array(found)


@pytest.mark.parametrize("wrong", [3.0, 1.0, 1.0 / 3.0])
def test_r_told_wrong_is_found(log: Any, wrong: float) -> None:
    """Told a variance `wrong` times the true one, the scale becomes 1 / wrong within 20 %."""
    share = math.sqrt(wrong)
    filter_ = told_the_truth(adapt=0.02, psi_noise=3.5e-3 * share, y_l_noise=0.02 * share)
    found = scales(filter_, log)
    late = found[len(found) // 4 :].mean(0)
    np.testing.assert_allclose(late * wrong, 1.0, atol=0.2)
    assert found.min() > 0.0


@pytest.mark.parametrize("size", [0.0, 1e6])
def test_r_never_becomes_negative_nor_without_limit(size: float) -> None:
    sensors = {"camera": SlowSensor(0.033)}
    log = simulate(Drive(duration=4.0), sensors, 0)
    log.record.packets[:, PACKET.value : PACKET.value + 2] *= size
    log.record.fast[:, 0] = 0.0
    filter_ = make_estimator("exact-kf", sensors=sensors, speed=7.0, adapt=0.5)
    found = scales(filter_, log)
    assert found.min() >= 0.05 and found.max() <= 100.0
    assert np.isfinite(filter_.P).all() and (np.diag(filter_.P) > 0.0).all()


def test_the_gps_scale_is_of_what_the_hdop_table_says() -> None:
    """With HDOP 4 told to be four times the noise, and being it, nothing is to be adapted."""
    sensors = {"gps": SlowSensor(0.05)}
    drive = Drive(duration=40.0, real=6000.0)
    log = simulate(drive, sensors, 1)
    course = log.truth["beta"] + log.truth["psi"]
    packets = log.record.packets
    noise = packets[:, PACKET.value] - course[packets[:, PACKET.captured].astype(int)]
    packets[:, PACKET.value] += 3.0 * noise
    packets[:, PACKET.value + 4] = 4.0
    filter_ = make_estimator(
        "exact-kf", vehicle=drive.truth, sensors=sensors, speed=drive.speed, adapt=0.02,
        hdop_table=[(1.0, 1.0), (8.0, 8.0)],
    )  # fmt: skip
    found = []
    for start in range(0, 40_000, 1000):
        due = (packets[:, 2] >= start) & (packets[:, 2] < start + 1000)
        filter_.step(log.record.fast[start : start + 1000], packets[due])
        found.append(filter_.filters[0].scale[1, 0])
    assert np.mean(found[10:]) == pytest.approx(1.0, abs=0.2)
