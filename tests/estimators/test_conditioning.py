"""The filter equals conditioning the joint Gaussian of all ticks on everything that arrived."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from sideslip.envs.linear import vision
from sideslip.envs.record import FAST, FAST_WIDTH, PACKET_WIDTH, Record, SlowSensor
from sideslip.envs.vehicle import COMS
from sideslip.estimators import make_estimator

SPEED, DT = 7.0, 0.001
TICKS = 60
PRIOR = {"beta": 0.02, "gamma": 0.05, "psi": 0.05, "y_l": 0.3, "F_d": 50.0, "N_d": 20.0}
NOISE = {"camera": (3.5e-3, 0.02), "gps": (math.radians(0.14) * (60.0 / 3.6) / SPEED,)}
MEASURED = {"camera": ((2,), (3,)), "gps": ((0, 2),)}


def disturbed_model() -> Any:
    """F, B, Q of beta, gamma, psi, y_l, force, moment; the disturbances are held over a tick."""
    model = vision(COMS, SPEED)
    push = np.zeros((4, 2))
    push[0, 0], push[1, 1] = 1.0 / (COMS.mass * SPEED), 1.0 / COMS.yaw_inertia
    block = np.zeros((8, 8))
    block[:4, :4], block[:4, 4:6], block[:4, 6:] = model.A, model.B[:, :2], push
    exact = expm(block * DT)
    keep = math.exp(-DT / 0.3)
    F = np.zeros((6, 6))
    F[:4, :4], F[:4, 4:], F[4:, 4:] = exact[:4, :4], exact[:4, 6:], keep * np.eye(2)
    B = np.zeros((6, 2))
    B[:4] = exact[:4, 4:6]
    Q = np.diag([0.0, 0.0, 0.0, 0.0, (1 - keep**2) * 50.0**2, (1 - keep**2) * 20.0**2])
    return F, B, Q


def random_record(rng: Any, sensors: Any) -> Any:
    """Inputs, gyro samples and packets that come late, out of order or never."""
    fast = np.zeros((TICKS + 1, FAST_WIDTH))
    fast[:, FAST.steer] = 0.05 * rng.standard_normal(TICKS + 1)
    fast[:, FAST.torque_right] = 20.0 * rng.standard_normal(TICKS + 1)
    fast[:, FAST.gyro] = 0.1 * rng.standard_normal(TICKS + 1)
    packets: Any = []
    for code, (name, sensor) in enumerate(sensors.items()):
        for i, k in enumerate(range(round(sensor.phase / DT), TICKS, round(sensor.period / DT))):
            late = int(rng.integers(0, round(sensor.longest_delay / DT) + 1))
            if rng.random() < 0.8 and k + late <= TICKS:
                row = np.zeros(PACKET_WIDTH)
                row[:5] = code, k, k + late, 1.0, i
                row[5 : 5 + len(NOISE[name])] = 0.05 * rng.standard_normal(len(NOISE[name]))
                packets.append(row)
    packets = np.array(packets)
    return Record(fast, packets[np.lexsort((packets[:, 0], packets[:, 1], packets[:, 2]))])


def dense_posterior(record: Any) -> Any:
    """Mean and covariance at the last tick from the joint Gaussian of all ticks."""
    F, B, Q = disturbed_model()
    n, K = 6, TICKS
    mean, cov = np.zeros(n * (K + 1)), np.zeros((n * (K + 1), n * (K + 1)))
    cov[:n, :n] = np.diag([v**2 for v in PRIOR.values()])
    arm = COMS.rear_track / (2.0 * COMS.wheel_radius)
    for k in range(K):
        a, b = n * k, n * (k + 1)
        row = record.fast[k + 1]
        u = [row[FAST.steer], arm * (row[FAST.torque_right] - row[FAST.torque_left])]
        mean[b : b + n] = F @ mean[a:b] + B @ u
        cov[b : b + n, :b] = F @ cov[a:b, :b]
        cov[:b, b : b + n] = cov[b : b + n, :b].T
        cov[b : b + n, b : b + n] = F @ cov[a:b, a:b] @ F.T + Q
    C: Any = []
    y: Any = []
    r: Any = []
    for k in range(K + 1):
        C.append(np.eye(1, len(mean), n * k + 1)[0])
        y.append(record.fast[k, FAST.gyro])
        r.append(0.005**2)
    for packet in record.packets:
        name = ("camera", "gps")[int(packet[0])]
        for i, states in enumerate(MEASURED[name]):
            row = np.zeros(len(mean))
            row[[n * int(packet[1]) + state for state in states]] = 1.0
            C.append(row)
            y.append(packet[5 + i])
            r.append(NOISE[name][i] ** 2)
    C, y, r = np.array(C), np.array(y), np.array(r)
    now = np.arange(n * K, n * (K + 1))
    scale = 1.0 / np.sqrt(np.einsum("ij,jk,ik->i", C, cov, C) + r)  # for the solver's sake
    S = (C @ cov @ C.T + np.diag(r)) * np.outer(scale, scale)
    cross = (cov @ C.T)[now] * scale
    gain = np.linalg.solve(S, cross.T).T
    return mean[now] + gain @ (scale * (y - C @ mean)), cov[np.ix_(now, now)] - gain @ cross.T


CAMERA = SlowSensor(period=0.007, delays=(0.003,), jitter=0.015, phase=0.002)
GPS = SlowSensor(period=0.011, delays=(0.0,), jitter=0.030, phase=0.0)


@pytest.mark.parametrize("seed", range(5))
def test_the_filter_equals_dense_gaussian_conditioning(seed: Any) -> None:
    sensors = {"camera": CAMERA, "gps": GPS}
    record = random_record(np.random.default_rng(seed), sensors)
    prior = {name: PRIOR[name] for name in ("beta", "gamma", "psi", "y_l")}
    filter_ = make_estimator(
        "exact-kf", sensors=sensors, speed=SPEED, slow=["camera", "gps"], prior=prior
    )
    filter_.run(record)
    assert filter_.counts == dict.fromkeys(filter_.counts, 0)
    mean, cov = dense_posterior(record)
    sd = np.sqrt(np.diag(cov))
    assert np.abs((filter_.x - mean) / sd).max() < 1e-10
    assert np.abs((filter_.P - cov) / np.outer(sd, sd)).max() < 1e-9


def test_a_late_sample_used_at_once_is_the_sample_used_in_time() -> None:
    """With all samples in, the order of arrival has left no trace."""
    sensors = {"camera": CAMERA}
    record = random_record(np.random.default_rng(7), sensors)
    in_time = record.packets.copy()
    in_time[:, 2] = in_time[:, 1]
    in_time = in_time[np.argsort(in_time[:, 1])]
    filter_ = make_estimator("exact-kf", sensors=sensors, speed=SPEED)
    filter_.run(record)
    late = filter_.x, filter_.P
    filter_.run(Record(record.fast, in_time))
    sd = np.sqrt(np.diag(late[1]))
    assert np.abs((filter_.x - late[0]) / sd).max() < 1e-10
    assert np.abs((filter_.P - late[1]) / np.outer(sd, sd)).max() < 1e-9
