"""uneven-delay's filter and its rivals, written out again, slowly, in the paper's letters."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import make_estimator
from tests.estimators.simulation import CAMERA, FIG7, simulate

from .literal import T, car, correct, due, excited, gain, inputs, settled, zoh

V = FIG7.speed
UNEVEN = SlowSensor(period=0.033, delays=(0.020, 0.015, 0.010, 0.025))  # Fig. 4
Q: dict[str, Any] = {"q_beta": 2e-3, "q_gamma": 2e-2, "q_psi": 1e-5, "q_y_l": 1e-4}
NOISE = np.diag([2e-3, 2e-2, 1e-5, 1e-4]) * T
R = np.diag([0.005**2, 3.5e-3**2, 0.02**2])
C = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])  # (7)
G, H = zoh(*car(V))  # (8)
I = np.eye(4)  # noqa: E741


def one_gain() -> Any:
    """K of every tick: the mean of the gyro's gains, and of a sample's an even share."""

    def step(k: Any, P: Any) -> Any:
        P = G @ P @ G.T + NOISE
        K_veh = gain(P, C[:1], R[:1, :1])
        P = (I - K_veh @ C[:1]) @ P
        K_vis = np.zeros((4, 2))
        if k == 0:
            K_vis = gain(P, C[1:], R[1:, 1:])
            P = (I - K_vis @ C[1:]) @ P
        return P, (K_veh, K_vis)

    gains = settled(step, 33, 4)
    return np.hstack([np.mean([K for K, _ in gains], axis=0), gains[0][1] / 33.0])


def literal(log: Any, captured_of: Any) -> Any:
    """(13), (15), (19)-(22); captured_of(k, packet): the tick whose prediction is compared."""
    at, K = due(log), one_gain()
    C_plus = C.T @ np.linalg.inv(C @ C.T)  # (20), corrected
    x, e = np.zeros(4), np.zeros(4)
    predicted: Any = []
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            x = G @ x + H @ inputs(row)
        predicted.append(x)
        eps = C @ G @ e if k > 0 else np.zeros(3)  # (22)
        eps[0] = row[FAST.gyro] - x[1]  # (13)
        if k in at:
            eps[1:] = at[k][5:7] - (C @ predicted[captured_of(k, at[k])])[1:]  # (15), used at k
            e = (C_plus - K) @ eps  # (20)
        else:
            e = (I - K @ C) @ G @ e  # (21)
        x = x + K @ eps
        wanted.append(x)
    return wanted


def log_of(sensor: Any, seed: Any) -> Any:
    return excited(simulate(type(FIG7)(duration=0.5), {"camera": sensor}, seed))


@pytest.mark.parametrize("sensor", [UNEVEN, CAMERA, SlowSensor(0.033)], ids=["fig4", "30", "0"])
def test_a_sample_meets_the_prediction_stored_at_its_capture(sensor: Any) -> None:
    log = log_of(sensor, 0)
    wanted = literal(log, lambda k, packet: int(packet[PACKET.captured]))
    found = make_estimator("uneven-delay-kf", sensors=log.slow, speed=V, **Q).run(log)
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("assumed", [None, 0.017])
def test_the_rival_assumes_a_constant_delay(assumed: Any) -> None:
    log = log_of(UNEVEN, 1)
    steps = 33 if assumed is None else 17
    wanted = literal(log, lambda k, packet: max(k - steps, 0))
    option: dict[str, Any] = {} if assumed is None else {"assumed_delay": assumed}
    filter_ = make_estimator("constant-delay-kf", sensors=log.slow, speed=V, **Q, **option)
    np.testing.assert_allclose(filter_.run(log).x, wanted, rtol=0.0, atol=1e-10)


def test_samples_come_at_the_uneven_periods_of_16() -> None:
    """T_smp = T_l - T_d^{i-1} + T_d^i: the estimate first moves by frame i just then."""
    log = log_of(UNEVEN, 2)
    still = make_estimator("uneven-delay-kf", sensors=log.slow, speed=V, **Q)
    found, moments = still.run(log).x, []
    for i in range(8):
        other = log_of(UNEVEN, 2)
        other.record.packets[i, PACKET.value] += 0.01
        moments.append(int(np.flatnonzero((still.run(other).x != found).any(1))[0]))
    T_d = np.array([20, 15, 10, 25] * 2)
    np.testing.assert_array_equal(np.diff(moments), 33 - T_d[:-1] + T_d[1:])


@pytest.mark.plain
def test_slip_from_vision_alone() -> None:
    """2.3: without the gyro, the delayed frames alone, as a Kalman filter on six states."""
    log = log_of(CAMERA, 3)
    at = due(log)
    x, P = np.zeros(6), np.diag([0.02**2, 0.05**2, 0.05**2, 0.3**2, 0.0, 0.0])
    C_late = np.zeros((2, 6))
    C_late[0, 4] = C_late[1, 5] = 1.0
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            G_a = np.eye(6)
            G_a[:4, :4] = G
            if (k - 1) % 33 == 0:
                G_a[4:] = 0.0
                G_a[4, 2] = G_a[5, 3] = 1.0
            x = G_a @ x
            x[:4] += H @ inputs(row)
            P = G_a @ P @ G_a.T
            P[:4, :4] += NOISE
        if k in at:
            x, P = correct(x, P, C_late, R[1:, 1:], at[k][5:7])
        wanted.append(x[:4])
    with_P: Any = {"gains": "covariance", **Q}
    found = make_estimator("vision-only-kf", sensors=log.slow, speed=V, **with_P).run(log)
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-10)
