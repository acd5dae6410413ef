"""What is special about a sensor is in the table: compiled code knows none by its place."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.sensors.slow import CAMERA, GPS, SLOW, SLOW_NAMES
from sideslip.estimators import make_estimator
from sideslip.estimators.design import assemble
from sideslip.estimators.design.options import (
    MEASUREMENTS,
    Measurement,
    MeasurementRow,
    select_states,
)
from tests.estimators.simulation import Drive, simulate

LATE = SlowSensor(0.1, (0.050,))

HDOP, SATELLITES = PACKET.value + 4, PACKET.value + 5


@pytest.fixture
def log() -> Any:
    """Late courses that start far off, at speeds that change, with HDOP and satellites."""
    log = simulate(Drive(duration=3.0), {"gps": LATE}, 2)
    packets, rng = log.record.packets, np.random.default_rng(0)
    packets[:, PACKET.value] += 2.0
    packets[:, HDOP] = rng.uniform(0.5, 6.0, len(packets))
    packets[:, SATELLITES] = rng.integers(2, 12, len(packets))
    wheels = [FAST.wheel_left, FAST.wheel_right]
    log.record.fast[:, wheels] *= np.linspace(0.5, 2.0, len(log.record.fast))[:, None]
    return log


@pytest.mark.parametrize("delay", ["clone", "buffer", "larsen", "stored", "ignore"])
def test_a_gps_in_the_cameras_place_gives_its_bits(delay: str, log: Any, monkeypatch: Any) -> None:
    """Noise by 1/V at the capture, HDOP, satellites and the heading fix go with it."""
    table = None if delay == "larsen" else [(1.0, 1.0), (8.0, 8.0)]
    options: dict[str, Any] = {"delay": delay, "gains": "covariance", "hdop_table": table}
    options["Q"] = [1e-4] * 5  # tunings are found by the sensor's name
    ours = make_estimator("exact-kf", sensors={"gps": LATE}, **options)
    expected = ours.run(log.record)
    assert expected["psi"][-1] > 1.5 and ours.counts["poor"] > 0
    monkeypatch.setitem(MEASUREMENTS, "camera", MEASUREMENTS["gps"])
    monkeypatch.setattr(assemble, "SLOW", SLOW[::-1])
    log.record.packets[:, PACKET.sensor] = CAMERA
    moved = make_estimator("exact-kf", sensors={"camera": LATE}, **options)
    found = moved.run(log.record)
    np.testing.assert_array_equal(found.x, expected.x)
    np.testing.assert_array_equal(found.std, expected.std)
    assert moved.counts == ours.counts


def test_a_sensor_is_what_its_entry_says(log: Any, monkeypatch: Any) -> None:
    """A lane offset alone in the GPS's place: its states, its noise, no fix, angle or 1/V."""
    lane = Measurement((MeasurementRow(("y_l",), "y_l", 0.02),))
    monkeypatch.setitem(MEASUREMENTS, "gps", lane)
    assert select_states(("gps",)) == ("beta", "gamma", "psi", "y_l")
    filter_ = make_estimator("exact-kf", sensors={"gps": LATE}, speed=7.0, y_l_noise=0.3)
    f = filter_.filters[0]
    np.testing.assert_array_equal(f.C[GPS, 0, : f.n], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert (f.rows[GPS], f.r[GPS, 0], f.first_slow) == (1, 0.3**2, GPS)
    assert not f.heading_fix[GPS] and not f.angle[GPS].any() and not f.noise_over_speed[GPS].any()
    packets, quiet = log.record.packets, [FAST.gyro, FAST.steer]
    packets[:, PACKET.value], log.record.fast[:, quiet] = 3.0, 0.0
    packets[:, SATELLITES] = 12.0
    assert filter_.run(log)["y_l"][-1] == pytest.approx(3.0, abs=0.3)


def test_every_slow_sensor_has_an_entry() -> None:
    """Whose rows are the packet's first values, in states that a bicycle has."""
    assert tuple(MEASUREMENTS) == SLOW_NAMES
    for kind in SLOW:
        rows = MEASUREMENTS[kind.name].rows
        assert len(rows) <= len(kind.values)
        assert select_states((kind.name,))[:2] == ("beta", "gamma")
    f = make_estimator("joint", sensors=dict.fromkeys(SLOW_NAMES, SlowSensor(0.2))).filters[0]
    assert (f.hdop_column[GPS], f.satellites_column[GPS]) == (HDOP, SATELLITES)
    assert f.hdop_column[CAMERA] == f.satellites_column[CAMERA] == f.speed_column[CAMERA] == 0
