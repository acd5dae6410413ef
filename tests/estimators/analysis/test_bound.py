"""The bound: Riccati, Monte Carlo and the exact filter tell the same story."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from sideslip.envs.record import PACKET
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.vehicle.linear import make_vision_model
from sideslip.estimators import make_estimator
from sideslip.estimators.analysis.bound import Gust, VehicleChange, compute_error_bound
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
    along = compute_error_bound(FIG7.truth, record=log.record, sensors=sensors, speed=FIG7.speed)
    P, names = riccati(FIG7.truth, sensors=sensors, speed=FIG7.speed, seconds=4.0)
    assert names[0] == "beta"
    np.testing.assert_allclose(along[3000:4000], np.sqrt(P[3000:, 0, 0]), rtol=1e-10)


@pytest.mark.long
def test_the_exact_filters_error_is_its_covariance() -> None:
    """40 seeds of tie-vision-fig7: within 3 % of the bound, and consistent."""
    sensors = {"camera": CAMERA}
    filter_ = make_estimator("exact-kf", vehicle=FIG7.truth, sensors=sensors, speed=FIG7.speed)
    errors, nees = [], []
    for seed in range(40):
        log = simulate(FIG7, sensors, seed)
        estimates = filter_.run(log)
        errors.append(error(estimates, log))
        e = (estimates["beta"] - log.truth["beta"])[2000:]
        nees.append(np.mean(e**2 / estimates.std[2000:, 0] ** 2))
    best = compute_error_bound(FIG7.truth, record=log.record, sensors=sensors, speed=FIG7.speed)[
        2000:
    ]
    assert np.sqrt(np.mean(errors) / np.mean(best**2)) <= 1.03
    assert np.mean(nees) == pytest.approx(1.0, abs=0.05)


def test_lost_frames_raise_the_bound() -> None:
    log = simulate(FIG7, {"camera": CAMERA}, 0)
    common: dict[str, Any] = {"sensors": log.slow, "speed": FIG7.speed}
    full = compute_error_bound(FIG7.truth, record=log.record, **common)
    log.record.packets = log.record.packets[::3]
    assert (compute_error_bound(FIG7.truth, record=log.record, **common)[100:] >= full[100:]).all()


CHANGED = 0.1  # s


def dense(what: str, log: Any, gust: Gust, later: Any) -> float:
    """The deviation of beta at the last row: all noises and the gust as one Gaussian vector,
    conditioned on every sample that came."""
    record, V, rows = log.record, FIG7.speed, len(log.record.fast)
    steps = {car.name: _step(car, V) for car in (FIG7.truth, later)}
    keep = math.exp(-1e-3 / 0.3)
    fresh = np.array([50.0, 20.0]) * math.sqrt(1.0 - keep * keep)
    T = np.zeros((rows, 6, 2 * rows + 1))  # states by (F_d, N_d at each row, the gust)
    T[0, 4, 0], T[0, 5, 1] = 50.0, 20.0
    for k in range(1, rows):
        car = later if what == "change" and k > round(1e3 * CHANGED) else FIG7.truth
        F = steps[car.name]
        T[k] = F @ T[k - 1]
        if what == "gust" and gust.start < 1e-3 * k <= gust.end + 1e-9:
            T[k, :4, -1] += gust.force_sd * (F[:4, 4] + gust.arm * F[:4, 5])
        T[k, 4, 2 * k], T[k, 5, 2 * k + 1] = fresh
    seen = [T[:, 1] / 0.005]
    for packet in record.packets:
        k = int(packet[PACKET.captured])
        seen += [T[k, 2][None] / 3.5e-3, T[k, 3][None] / 0.02]
    M = np.concatenate(seen)
    P = np.linalg.inv(np.eye(M.shape[1]) + M.T @ M)
    return float(np.sqrt(T[-1, 0] @ P @ T[-1, 0]))


def _step(car: Any, V: float) -> Any:
    """beta, gamma, psi, y_l, F_d, N_d a tick later."""
    whole = np.zeros((6, 6))
    whole[:4, :4] = make_vision_model(car, V).A
    whole[0, 4], whole[1, 5] = 1.0 / (car.mass * V), 1.0 / car.yaw_inertia
    F = expm(1e-3 * whole)
    F[4:, 4:] = math.exp(-1e-3 / 0.3) * np.eye(2)
    return F


@pytest.mark.parametrize("what", ["nothing", "change", "gust"])
def test_what_changes_on_the_way_is_dense_conditioning(what: str) -> None:
    """0.25 s of late frames: tyres that are others from 0.1 s on, a gust from 0.04 to 0.14 s."""
    log = simulate(FIG7, {"camera": CAMERA}, 0)
    record = log.record
    came = record.packets[record.packets[:, PACKET.arrived] < 250]
    record = dataclasses.replace(record, fast=record.fast[:250], packets=came)
    log = dataclasses.replace(log, record=record, truth={})
    later = FIG7.truth.scale_stiffness(0.6, 1.3).replace(name="later")
    gust = Gust(400.0, 0.3, 0.04, 0.14)
    extra: dict[str, Any] = {
        "change": {"change": VehicleChange(CHANGED, later)},
        "gust": {"gust": gust},
    }
    common: dict[str, Any] = {"record": record, "sensors": log.slow, "speed": FIG7.speed}
    plain = compute_error_bound(FIG7.truth, **common)
    found = compute_error_bound(FIG7.truth, **common, **extra.get(what, {}))
    assert found[-1] == pytest.approx(dense(what, log, gust, later), rel=1e-8)
    np.testing.assert_array_equal(found[:40], plain[:40])
    assert what == "nothing" or abs(found[-1] / plain[-1] - 1.0) > 0.01


def test_a_bound_without_a_change_is_the_bound() -> None:
    """A car that becomes itself, a gust that is over before the first row."""
    log = simulate(FIG7, {"camera": CAMERA}, 0)
    common: dict[str, Any] = {"record": log.record, "sensors": log.slow, "speed": FIG7.speed}
    plain = compute_error_bound(FIG7.truth, **common)
    same = compute_error_bound(FIG7.truth, **common, change=VehicleChange(1.0, FIG7.truth))
    np.testing.assert_array_equal(same, plain)
    over = compute_error_bound(FIG7.truth, **common, gust=Gust(400.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(over, plain, rtol=1e-12)
