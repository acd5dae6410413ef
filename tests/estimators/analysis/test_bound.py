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
from sideslip.estimators.analysis.limits import compute_error_bound
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


def dense(log: Any) -> float:
    """The deviation of beta at the last row: all noises as one Gaussian vector, conditioned on
    every sample that came."""
    record, rows = log.record, len(log.record.fast)
    F = _step(FIG7.truth, FIG7.speed)
    keep = math.exp(-1e-3 / 0.3)
    fresh = np.array([50.0, 20.0]) * math.sqrt(1.0 - keep * keep)
    T = np.zeros((rows, 6, 2 * rows))  # states by (F_d, N_d at each row)
    T[0, 4, 0], T[0, 5, 1] = 50.0, 20.0
    for k in range(1, rows):
        T[k] = F @ T[k - 1]
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


def test_the_bound_is_dense_conditioning() -> None:
    """0.25 s of late frames."""
    log = simulate(FIG7, {"camera": CAMERA}, 0)
    record = log.record
    came = record.packets[record.packets[:, PACKET.arrived] < 250]
    record = dataclasses.replace(record, fast=record.fast[:250], packets=came)
    log = dataclasses.replace(log, record=record, truth={})
    common: dict[str, Any] = {"record": record, "sensors": log.slow, "speed": FIG7.speed}
    assert compute_error_bound(FIG7.truth, **common)[-1] == pytest.approx(dense(log), rel=1e-8)
