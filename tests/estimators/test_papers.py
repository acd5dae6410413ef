"""The papers' filters, written out again, slowly, in the papers' letters."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.linear import vision
from sideslip.envs.record import FAST, PACKET, SlowSensor
from sideslip.envs.vehicle import COMS
from sideslip.estimators import make_estimator
from tests.estimators.simulation import CAMERA, FIG7, simulate

pytestmark = pytest.mark.plain

V = FIG7.speed
QUICK = type(FIG7)(duration=0.5)
Q: dict[str, Any] = {"q_beta": 2e-3, "q_gamma": 2e-2, "q_psi": 1e-5, "q_y_l": 1e-4}
R = np.diag([0.005**2, 3.5e-3**2, 0.02**2])


def arrivals(log: Any, at: Any) -> Any:
    """Packets by the tick in column `at`."""
    return {int(packet[at]): packet for packet in log.record.packets}


def augmented(T: Any, trigger: Any) -> Any:
    """G^a, H^a of tie-vision (13); the delayed states are held but for the step after a trigger."""
    G, H = vision(COMS, V).discrete(T)
    G_a = np.zeros((6, 6))
    G_a[:4, :4] = G
    if trigger:
        G_a[4, 2] = G_a[5, 3] = 1.0  # (12): psi_bar_{k+1} = psi_k, y_bar_{k+1} = y_k
    else:
        G_a[4, 4] = G_a[5, 5] = 1.0
    return G_a, np.vstack([H[:, :2], np.zeros((2, 2))])


C_A = np.zeros((3, 6))
C_A[0, 1] = C_A[1, 4] = C_A[2, 5] = 1.0
PRIOR = np.diag([0.02**2, 0.05**2, 0.05**2, 0.3**2, 0.0, 0.0])


def test_delayed_states_held_between_triggers_are_clones() -> None:
    """tie-vision (12)-(13), (16) at 1 ms as a plain Kalman filter on six states."""
    log = simulate(QUICK, {"camera": CAMERA}, 0)
    due = arrivals(log, PACKET.arrived)
    x, P = np.zeros(6), PRIOR.copy()
    noise = np.diag([2e-3, 2e-2, 1e-5, 1e-4, 0.0, 0.0]) * 0.001
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            G, H = augmented(0.001, (k - 1) % 33 == 0)
            x = G @ x + H @ [row[FAST.steer], 0.0]
            P = G @ P @ G.T + noise
        measured = [0, 1, 2] if k in due else [0]  # (16): between frames the gyro alone
        y = np.array([row[FAST.gyro], *(due[k][5:7] if k in due else ())])
        C, noise_y = C_A[measured], R[np.ix_(measured, measured)]
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + noise_y)
        x = x + K @ (y - C @ x)
        P = (np.eye(6) - K @ C) @ P
        wanted.append(np.concatenate([x[:4], np.sqrt(np.diag(P)[:4])]))
    found = make_estimator("multirate-kf", sensors=log.slow, speed=V, gains="covariance", **Q).run(
        log
    )
    wanted = np.array(wanted)
    np.testing.assert_allclose(found.x, wanted[:, :4], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(found.std, wanted[:, 4:], rtol=1e-7)


def test_single_rate_filter_lives_at_the_cameras_rate() -> None:
    """tie-vision (12)-(15) at T = 33 ms: the frame before, the gyro now, the mean input."""
    log = simulate(QUICK, {"camera": CAMERA}, 1)
    log.record.fast[:, FAST.torque_right] = np.linspace(0.0, 30.0, len(log.record.fast))
    captured = arrivals(log, PACKET.captured)
    G, H = augmented(0.033, True)
    noise = np.diag([2e-3, 2e-2, 1e-5, 1e-4, 0.0, 0.0]) * 0.033
    x, P = np.zeros(6), PRIOR.copy()
    wanted = np.zeros((len(log.record.fast), 4))
    for k in range(0, len(wanted), 33):
        fast = log.record.fast[k - 32 : k + 1]
        measured = [0] if k == 0 else [0, 1, 2]
        if k > 0:
            N_z = 0.82 / (2 * 0.22) * (fast[:, FAST.torque_right] - fast[:, FAST.torque_left])
            x = G @ x + H @ [fast[:, FAST.steer].mean(), N_z.mean()]
            P = G @ P @ G.T + noise
        y: Any = [log.record.fast[k, FAST.gyro]]
        y = np.array([*y, *captured[k - 33][5:7]] if k > 0 else y)
        C = C_A[measured]
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R[np.ix_(measured, measured)])
        x = x + K @ (y - C @ x)
        P = (np.eye(6) - K @ C) @ P
        wanted[k : k + 33] = x[:4]  # held in between
    found = make_estimator(
        "single-rate-kf", sensors=log.slow, speed=V, gains="covariance", **Q
    ).run(log)
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-10)


def test_a_single_rate_filter_uses_a_sample_without_delay_at_once() -> None:
    sensors = {"gps": SlowSensor(0.05)}
    log = simulate(QUICK, sensors, 2)
    found = make_estimator("single-rate-kf", sensors=sensors, speed=V).run(log)
    for packet in log.record.packets[1:]:
        k = int(packet[PACKET.captured])
        other = simulate(QUICK, sensors, 2)
        other.record.packets[int(packet[PACKET.sequence]), PACKET.value] += 0.01
        moved = make_estimator("single-rate-kf", sensors=sensors, speed=V).run(other)
        changed = np.flatnonzero((moved.x != found.x).any(1))
        assert changed[0] == k


@pytest.mark.parametrize("inverse", ["moore-penrose", "p-weighted", "tikhonov"])
def test_pseudo_residuals_follow_the_papers_four_steps(inverse: Any) -> None:
    """tie-vision (17)-(22) with the corrected (20); slow rows only get pseudo-residuals."""
    log = simulate(QUICK, {"camera": CAMERA}, 3)
    due = arrivals(log, PACKET.arrived)
    filter_ = make_estimator(
        "multirate-residual-kf", sensors=log.slow, speed=V, inverse=inverse, **Q
    )
    K, C_plus = filter_.gains[0, -6:-3, :6].T, filter_.gains[0, -3:, :6].T
    found = filter_.run(log)
    if inverse == "moore-penrose":
        K, C_plus = filter_.gains[0, -6:-3, :6].T, C_A.T @ np.linalg.inv(C_A @ C_A.T)
    elif inverse == "p-weighted":
        np.testing.assert_allclose(C_A @ filter_.gains[0, -3:, :6].T, np.eye(3), atol=1e-12)
        K, C_plus = filter_.gains[0, -6:-3, :6].T, filter_.gains[0, -3:, :6].T
    else:
        ridge = np.linalg.inv(C_A.T @ C_A + 1e-3 * np.eye(6)) @ C_A.T
        K, C_plus = filter_.gains[0, -6:-3, :6].T, ridge
    x, e = np.zeros(6), np.zeros(6)
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        G = np.eye(6)
        if k > 0:
            G, H = augmented(0.001, (k - 1) % 33 == 0)
            x = G @ x + H @ [row[FAST.steer], 0.0]
        if k in due:
            eps = np.array([row[FAST.gyro], *due[k][5:7]]) - C_A @ x  # (19)
            x = x + K @ eps
            e = (C_plus - K) @ eps  # (20)
        else:
            eps = C_A @ G @ e  # (22)
            eps[0] = row[FAST.gyro] - x[1]  # the gyro is there at every tick
            x = x + K @ eps
            e = (np.eye(6) - K @ C_A) @ G @ e  # (21)
        wanted.append(x[:4])
    np.testing.assert_allclose(found.x, np.array(wanted), rtol=0.0, atol=1e-11)


def test_the_constant_gain_shares_out_the_multirate_gain() -> None:
    slow = {"camera": CAMERA}
    residual = make_estimator("multirate-residual-kf", sensors=slow, speed=V, **Q)
    residual.P  # noqa: B018  designs the table
    multirate = make_estimator("multirate-kf", sensors=slow, speed=V, **Q)
    multirate.P  # noqa: B018
    gains = multirate.gains[0]
    K = residual.gains[0, -6:-3, :6]
    np.testing.assert_allclose(K[0], gains[1:34, :6].mean(0), rtol=1e-12)
    np.testing.assert_allclose(K[1:], gains[34:36, :6] / 33.0, rtol=1e-12)
