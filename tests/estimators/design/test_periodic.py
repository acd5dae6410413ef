"""Periodic gains are the covariance filter's limit."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET_WIDTH, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import make_estimator
from tests.estimators.simulation import CAMERA, FIG7, GPS, simulate

SETS = {
    "camera": {"camera": CAMERA},
    "uneven": {"camera": SlowSensor(0.033, (0.020, 0.015, 0.010, 0.025))},
    "gps": {"gps": GPS},
    "late-gps": {"gps": SlowSensor(0.1, (0.25,), phase=0.030)},
}
LONG = type(FIG7)(duration=80.0)


@pytest.mark.parametrize(
    ("name", "which"),
    [
        ("multirate-kf", "uneven"),
        ("multirate-kf", "late-gps"),
        ("single-rate-kf", "camera"),
        ("single-rate-kf", "gps"),
    ],
)
def test_periodic_gains_equal_the_covariance_filters_limit(name: Any, which: Any) -> None:
    log = simulate(LONG, SETS[which], 0)
    common: dict[str, Any] = {"sensors": log.slow, "speed": LONG.speed, "q_psi": 1e-5}
    if "camera" in log.slow:
        common["q_y_l"] = 1e-4
    periodic = make_estimator(name, gains="periodic", **common)
    covariance = make_estimator(name, gains="covariance", **common)
    a, b = periodic.run(log), covariance.run(log)
    late = log.time > 75.0
    assert np.abs((a.x - b.x)[late] / b.std[late]).max() < 1e-6
    np.testing.assert_allclose(a.std[late], b.std[late], rtol=1e-9)
    np.testing.assert_allclose(periodic.P, covariance.P, rtol=1e-7, atol=1e-18)


def test_gains_have_a_limit_where_the_covariance_has_none() -> None:
    with pytest.warns(UserWarning, match="cannot see"):
        filter_ = make_estimator("dakf", sensors={"gps": GPS}, speed=7.0, gains="periodic")
    filter_.P  # noqa: B018  designs the table
    assert np.isfinite(filter_.gains).all()
    assert filter_.spectral_radius == pytest.approx(1.0, abs=1e-9)


def test_gains_are_made_for_each_speed_when_it_is_reached() -> None:
    """A filter that measures its speed has, at a held one, the gains of the nearest table."""
    log = simulate(FIG7, {"camera": CAMERA}, 1)
    measured = make_estimator("multirate-kf", sensors=log.slow)
    told = make_estimator("multirate-kf", sensors=log.slow, speed=7.0)
    measured.run(log)
    told.run(log)
    cell = int(measured.filters[0].cell)
    assert 1.5 + 0.5 * cell == 7.0
    np.testing.assert_array_equal(measured.gains[cell], told.gains[0])
    assert measured.gains[cell - 1].max() == 0.0  # never asked for


def test_a_changing_speed_rebuilds_the_model_by_half_a_percent() -> None:
    rows = np.zeros((4000, FAST_WIDTH))
    rows[:, FAST.wheel_left] = rows[:, FAST.wheel_right] = np.linspace(3.0, 12.0, 4000)
    filter_ = make_estimator("multirate-kf", sensors={"camera": CAMERA})
    speeds = []
    for row in rows[::10]:
        filter_.step(np.repeat(row[None], 10, 0), np.zeros((0, PACKET_WIDTH)))
        speeds.append(float(filter_.filters[0].model_speed))
    lowpass = 3.0
    for k, row in enumerate(np.repeat(rows[::10, FAST.wheel_left], 10)):
        lowpass = row if k == 0 else lowpass + (1.0 - np.exp(-0.001 / 0.015)) * (row - lowpass)
    assert speeds[-1] == pytest.approx(lowpass, rel=0.0051)
    steps = np.diff([s for i, s in enumerate(speeds) if i == 0 or s != speeds[i - 1]])
    assert steps.min() > 0.005 * 3.0


def test_a_record_may_start_at_any_tick() -> None:
    sensors = {"camera": SlowSensor(0.033, (0.020, 0.010), phase=0.004)}
    log = simulate(type(FIG7)(duration=0.5), sensors, 5)
    later = log.record.packets.copy()
    later[:, 1:3] += 660.0
    for name in ("multirate-kf", "single-rate-kf", "exact-kf"):
        filter_ = make_estimator(name, sensors=sensors, speed=FIG7.speed)
        once = filter_.run(log.record)
        again = filter_.run(Record(log.record.fast, later, 660))
        np.testing.assert_array_equal(once.x, again.x)
        assert again.time[0] == pytest.approx(0.660)
