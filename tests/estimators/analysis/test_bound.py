"""The bound: Riccati, Monte Carlo and the exact filter tell the same story."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import make_estimator
from sideslip.estimators.analysis.bound import bound
from tests.estimators.riccati import riccati
from tests.estimators.simulation import CAMERA, FIG7, GPS, error, simulate

SETS = {
    "camera": {"camera": CAMERA},
    "uneven": {"camera": SlowSensor(0.033, (0.020, 0.015, 0.010, 0.025))},
    "gps": {"gps": GPS},
    "both": {"camera": CAMERA, "gps": SlowSensor(0.1, (0.25,))},
}


@pytest.mark.parametrize("which", SETS)
def test_the_recursion_along_the_arrivals_equals_the_riccati_limit(which: Any) -> None:
    sensors = SETS[which]
    log = simulate(FIG7, sensors, 0)
    along = bound(FIG7.truth, record=log.record, sensors=sensors, speed=FIG7.speed)
    P, names = riccati(FIG7.truth, sensors=sensors, speed=FIG7.speed, seconds=4.0)
    assert names[0] == "beta"
    np.testing.assert_allclose(along[3000:4000], np.sqrt(P[3000:, 0, 0]), rtol=1e-10)


def test_the_exact_filters_error_is_its_covariance() -> None:
    """100 seeds of tie-vision-fig7: within 3 % of the bound, and consistent."""
    sensors = {"camera": CAMERA}
    filter_ = make_estimator("exact-kf", vehicle=FIG7.truth, sensors=sensors, speed=FIG7.speed)
    errors, nees = [], []
    for seed in range(100):
        log = simulate(FIG7, sensors, seed)
        estimates = filter_.run(log)
        errors.append(error(estimates, log))
        e = (estimates["beta"] - log.truth["beta"])[2000:]
        nees.append(np.mean(e**2 / estimates.std[2000:, 0] ** 2))
    best = bound(FIG7.truth, record=log.record, sensors=sensors, speed=FIG7.speed)[2000:]
    assert np.sqrt(np.mean(errors) / np.mean(best**2)) <= 1.03
    assert np.mean(nees) == pytest.approx(1.0, abs=0.05)


def test_lost_frames_raise_the_bound() -> None:
    log = simulate(FIG7, {"camera": CAMERA}, 0)
    common: dict[str, Any] = {"sensors": log.slow, "speed": FIG7.speed}
    full = bound(FIG7.truth, record=log.record, **common)
    log.record.packets = log.record.packets[::3]
    assert (bound(FIG7.truth, record=log.record, **common)[100:] >= full[100:]).all()
