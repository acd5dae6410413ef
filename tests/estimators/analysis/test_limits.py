"""The bound by Riccati, Monte Carlo and dense conditioning; what sensors can see."""

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from sideslip.envs.record import PACKET
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.vehicle.linear import make_vision_model
from sideslip.envs.vehicle.parameters import COMS
from sideslip.estimators import make_estimator
from sideslip.estimators.analysis.limits import (
    UNKNOWNS,
    _find_unobservable_subspace,
    compute_error_bound,
    make_observability_table,
)
from sideslip.estimators.design.gains import transition_matrix
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
    best = compute_error_bound(FIG7.truth, record=log.record, sensors=sensors, speed=FIG7.speed)
    assert np.sqrt(np.mean(errors) / np.mean(best[2000:] ** 2)) <= 1.03
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


pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")
GYRO, ACCEL = ("gyro",), ("gyro", "accel_y")
BOTH = ("camera", "gps")
ASKEW = ("camera_yaw", "steer_offset", "bank")  # which together hide behind each other


def is_together(sensors: Any, *unknowns: str) -> bool:
    """Whether a set of sensors sees all of some unknowns at once, straight on."""
    return not _find_unobservable_subspace(sensors, unknowns)[1].size


def test_every_pair_but_one_is_seen_straight_on() -> None:
    """A gyro's bias beside the camera's yaw too: a yaw lets y_l drift where no heading does."""
    for fast, slow in itertools.product((GYRO, ACCEL), (("camera",), ("gps",), BOTH)):
        sensors = (*fast, *slow)
        for pair in itertools.combinations(UNKNOWNS, 2):
            if ("camera_yaw" in pair and slow == ("gps",)) or (
                "accel_bias" in pair and fast == GYRO
            ):
                continue
            hidden = sensors == ("gyro", "gps") and set(pair) == {"steer_offset", "bank"}
            assert is_together(sensors, *pair) != hidden, (sensors, pair)


def test_camera_s_yaw_steering_s_offset_and_bank_hide_behind_each_other() -> None:
    """A car that is held askew by the bank and the wheels goes straight: beta = -psi, yaw = -psi.
    The accelerometer feels the bank's force, unless it has a bias of its own."""
    for slow in (("camera",), BOTH):
        names, basis = _find_unobservable_subspace((*GYRO, *slow), ASKEW)
        v = dict(zip(names, basis[:, 0] / basis[names.index("beta"), 0], strict=True))
        assert basis.shape[1] == 1
        assert v["camera_yaw"] == pytest.approx(1.0) and v["psi"] == pytest.approx(-1.0)
        assert v["y_l"] == pytest.approx(-COMS.preview)
        assert is_together((*ACCEL, *slow), *ASKEW)
        assert not is_together((*ACCEL, *slow), *ASKEW, "accel_bias")


def test_a_constant_moment_and_force_are_an_offset_of_the_steering() -> None:
    """Disturbances that walk instead of forgetting leave nothing of it."""
    for walk in (False, True):
        filter_ = make_estimator(
            "exact-kf", sensors={"camera": CAMERA}, speed=7.0, steer_offset_sd=0.01,
            disturbances="walk" if walk else "forces",
        )  # fmt: skip
        assert any("steer_offset" in direction for direction in filter_.unobservable) == walk


def test_the_table_has_a_line_for_each_set_of_sensors() -> None:
    table = make_observability_table()
    for line in table:
        assert line["bias"] != "no" and line["bank"] == "alone"
        assert (line["accel_bias"] == "") == ("accel_y" not in line["sensors"])
        assert (line["camera_yaw"] == "") == ("camera" not in line["sensors"])
    assert len(table) == 6


@pytest.mark.parametrize("fast", [GYRO, ACCEL])
def test_the_filter_learns_nothing_of_what_is_unobservable(fast: Any) -> None:
    """By the definition, C F^k v = 0, and by the filter itself: the information v^T P^-1 v never
    exceeds the prior's; along any of its states alone it does."""
    unknowns = list(UNKNOWNS)
    if fast == GYRO:
        unknowns.remove("accel_bias")
    log = simulate(FIG7, {"camera": CAMERA, "gps": GPS}, 0)
    filter_ = make_estimator(
        "exact-kf", sensors=log.slow, slow=list(BOTH), fast=list(fast), speed=7.0,
        **{f"{name}_sd": UNKNOWNS[name] for name in unknowns},
    )  # fmt: skip
    names, basis = _find_unobservable_subspace((*fast, *BOTH), tuple(unknowns))
    (v,), f, n = basis.T, filter_.filters[0], len(filter_.names)
    assert names == filter_.names
    F, C = transition_matrix(f, f.G[: f.dense, :n]), [f.C_fast[: f.fasts, :n], *f.C[:, :, :n]]
    size, v = np.sqrt(np.diag(f.prior)[:n]), v / np.abs(v).max()
    prior = v @ np.linalg.solve(f.prior[:n, :n], v)
    for k in range(3000):
        assert all(np.abs(rows @ v).max() < 1e-9 for rows in C), k
        v = F @ v

    def inform(P: Any, direction: Any) -> Any:
        scaled = direction / size
        return scaled @ np.linalg.solve(P / np.outer(size, size), scaled)

    filter_.run(log)
    assert inform(filter_.P, v) <= prior * (1.0 + 1e-6)
    for name in unknowns:
        alone = np.eye(n)[names.index(name)]
        assert inform(filter_.P, alone) > 3.0 / UNKNOWNS[name] ** 2
