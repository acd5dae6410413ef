"""tie-vision's filters, written out again, slowly, in the paper's letters."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import make_estimator
from tests.estimators.simulation import CAMERA, FIG7, simulate

from .literal import T, car, correct, due, excited, gain, inputs, observer, settled, stationary, zoh

V = FIG7.speed
QUICK = type(FIG7)(duration=0.5)
Q: dict[str, Any] = {"q_beta": 2e-3, "q_gamma": 2e-2, "q_psi": 1e-5, "q_y_l": 1e-4}
WITH_P: dict[str, Any] = {"gains": "covariance", **Q}
NOISE = np.diag([2e-3, 2e-2, 1e-5, 1e-4, 0.0, 0.0])
R = np.diag([0.005**2, 3.5e-3**2, 0.02**2])
C_A = np.zeros((3, 6))  # (13): gyro and the states that the camera saw
C_A[0, 1] = C_A[1, 4] = C_A[2, 5] = 1.0
PRIOR = np.diag([0.02**2, 0.05**2, 0.05**2, 0.3**2, 0.0, 0.0])
I = np.eye(6)  # noqa: E741


def augmented(step: Any, follow: Any) -> Any:
    """G^a, H^a of (13); the delayed states follow psi and y_l by a share, or are held (0)."""
    A, B = car(V)
    G, H = zoh(A, B, step)
    G_a = np.zeros((6, 6))
    G_a[:4, :4] = G
    for late, state in ((4, 2), (5, 3)):  # (12): psi_bar_{k+1} = psi_k, y_bar_{k+1} = y_k
        G_a[late, state], G_a[late, late] = follow, 1.0 - follow
    return G_a, np.vstack([H, np.zeros((2, 2))])


HELD = augmented(T, 0.0), augmented(T, 1.0)


def clocked(k: Any) -> Any:
    """G^a, H^a from k-1 to k at 1 ms: the delayed states move in the step after a trigger."""
    return HELD[int((k - 1) % 33 == 0)]


def log_of(seed: Any) -> Any:
    return excited(simulate(QUICK, {"camera": CAMERA}, seed))


@pytest.mark.plain
def test_the_bicycle_filter_knows_the_gyro_alone() -> None:
    """VI.A: beta and gamma of (1)-(2) with the stationary gain."""
    log, C, (A, B) = log_of(0), np.array([[0.0, 1.0]]), car(V)
    G, H = zoh(A[:2, :2], B[:2])
    K = stationary(G, C, NOISE[:2, :2] * T, R[:1, :1])
    wanted = observer(log, G, H, C, K, inputs, [FAST.gyro])
    found = make_estimator("bicycle-kf", speed=V, q_beta=2e-3, q_gamma=2e-2).run(log)
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-11)


UNEVEN = SlowSensor(0.033, (0.020, 0.015, 0.010, 0.025))


@pytest.mark.plain
@pytest.mark.parametrize(
    ("delay", "share", "camera"),
    [
        ("clone", None, CAMERA),
        ("literal", 1.0, UNEVEN),  # psi_bar_{k+1} = psi_k at T = 1 ms, a delay of 1 ms
        ("lag", 1.0 - np.exp(-T / 0.0175), UNEVEN),  # a first-order lag of the mean delay
    ],
)
def test_multirate_with_delayed_states(delay: Any, share: Any, camera: Any) -> None:
    """(12)-(13), (16) at 1 ms as a Kalman filter on six states, for each reading of (12)."""
    log = excited(simulate(QUICK, {"camera": camera}, 0))
    at, n = due(log), 4 if share is None else 6
    x, P = np.zeros(6), PRIOR + (0.0 if share is None else np.diag([0, 0, 0, 0, 0.05**2, 0.3**2]))
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            G, H = clocked(k) if share is None else augmented(T, share)
            x = G @ x + H @ inputs(row)
            P = G @ P @ G.T + NOISE * T
        measured = [0, 1, 2] if k in at else [0]  # (16): between frames the gyro alone
        y = np.array([row[FAST.gyro], *(at[k][5:7] if k in at else ())])
        x, P = correct(x, P, C_A[measured], R[np.ix_(measured, measured)], y)
        wanted.append([x[:n], np.sqrt(np.diag(P)[:n])])
    filter_ = make_estimator("multirate-kf", sensors=log.slow, speed=V, delay=delay, **WITH_P)
    found, (states, stds) = filter_.run(log), np.array(wanted).swapaxes(0, 1)
    assert found.names[4:] == ("psi_late", "y_l_late")[: n - 4]
    np.testing.assert_allclose(found.x, states, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(found.std, stds, rtol=1e-7)


def frame_step(k: Any, P: Any) -> Any:
    """A tick of the covariance recursion; its gains, and P before the sample (30 ms late)."""
    G, _ = clocked(k)
    P = G @ P @ G.T + NOISE * T
    K_fast = gain(P, C_A[:1], R[:1, :1])
    P = (I - K_fast @ C_A[:1]) @ P
    before, K_slow = P, np.zeros((6, 2))
    if k == 30:
        K_slow = gain(P, C_A[1:], R[1:, 1:])
        P = (I - K_slow @ C_A[1:]) @ P
    return P, (K_fast, K_slow, before)


def settled_gains() -> Any:
    return settled(frame_step, 33, 6)


def test_multirate_has_the_periodic_gain_by_default() -> None:
    log, at, gains = log_of(1), due(simulate(QUICK, {"camera": CAMERA}, 1)), settled_gains()
    x: Any = np.zeros(6)
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            G, H = clocked(k)
            x = G @ x + H @ inputs(row)
        K_fast, K_slow, _ = gains[k % 33]
        x = x + K_fast @ (row[[FAST.gyro]] - C_A[:1] @ x)
        if k in at:
            x = x + K_slow @ (at[k][5:7] - C_A[1:] @ x)
        wanted.append(x[:4])
    found = make_estimator("multirate-kf", sensors=log.slow, speed=V, **Q).run(log)
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-10)


@pytest.mark.plain
def test_single_rate_filter_lives_at_the_cameras_rate() -> None:
    """(12)-(15) at T = 33 ms: the frame before, the gyro now, the mean input; held in between."""
    log = log_of(1)
    captured = due(log, PACKET.captured)
    G, H = augmented(0.033, 1.0)
    x, P = np.zeros(6), PRIOR.copy()
    wanted = np.zeros((len(log.record.fast), 4))
    for k in range(0, len(wanted), 33):
        measured = [0] if k == 0 else [0, 1, 2]
        if k > 0:
            x = G @ x + H @ np.mean([inputs(row) for row in log.record.fast[k - 32 : k + 1]], 0)
            P = G @ P @ G.T + NOISE * 0.033
        y: Any = [log.record.fast[k, FAST.gyro], *(captured[k - 33][5:7] if k > 0 else ())]
        x, P = correct(x, P, C_A[measured], R[np.ix_(measured, measured)], y)
        wanted[k : k + 33] = x[:4]
    found = make_estimator("single-rate-kf", sensors=log.slow, speed=V, **WITH_P).run(log)
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-10)


def test_single_rate_filter_that_predicts_between_frames() -> None:
    """The same measurements, with the model at 1 ms in between."""
    log = log_of(2)
    captured = due(log, PACKET.captured)
    x, P = np.zeros(6), PRIOR.copy()
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            G, H = clocked(k)
            x = G @ x + H @ inputs(row)
            P = G @ P @ G.T + NOISE * T
        if k % 33 == 0:
            measured = [0] if k == 0 else [0, 1, 2]
            y: Any = [row[FAST.gyro], *(captured[k - 33][5:7] if k > 0 else ())]
            x, P = correct(x, P, C_A[measured], R[np.ix_(measured, measured)], y)
        wanted.append(x[:4])
    predicting: Any = {"between": "predict", **WITH_P}
    found = make_estimator("single-rate-kf", sensors=log.slow, speed=V, **predicting).run(log)
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


INVERSES: dict[str, Any] = {
    "moore-penrose": lambda P: C_A.T @ np.linalg.inv(C_A @ C_A.T),  # the corrected (20)
    "p-weighted": lambda P: P @ C_A.T @ np.linalg.inv(C_A @ P @ C_A.T),
    "tikhonov": lambda P: np.linalg.inv(C_A.T @ C_A + 1e-3 * I) @ C_A.T,
    "bayes": lambda P: gain(P, C_A, R),
}


PLAIN = {kind: [pytest.mark.plain] * (kind == "moore-penrose") for kind in INVERSES}


@pytest.mark.parametrize("inverse", [pytest.param(kind, marks=PLAIN[kind]) for kind in INVERSES])
def test_pseudo_residuals_follow_the_papers_four_steps(inverse: Any) -> None:
    """(17)-(22); one gain K, in which every tick takes its share of what a sample corrects."""
    log, at, gains = log_of(3), due(simulate(QUICK, {"camera": CAMERA}, 3)), settled_gains()
    K = np.hstack([np.mean([each[0] for each in gains], axis=0), gains[30][1] / 33.0])
    C_plus = INVERSES[inverse](gains[30][2])
    x, e = np.zeros(6), np.zeros(6)
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        G = I
        if k > 0:
            G, H = clocked(k)
            x = G @ x + H @ inputs(row)
        if k in at:
            eps = np.array([row[FAST.gyro], *at[k][5:7]]) - C_A @ x  # (19)
            x = x + K @ eps
            e = (C_plus - K) @ eps  # (20)
        else:
            eps = C_A @ G @ e  # (22)
            eps[0] = row[FAST.gyro] - x[1]  # the gyro is there at every tick
            x = x + K @ eps
            e = (I - K @ C_A) @ G @ e  # (21)
        wanted.append(x[:4])
    kf = make_estimator("multirate-residual-kf", sensors=log.slow, speed=V, inverse=inverse, **Q)
    np.testing.assert_allclose(kf.run(log).x, wanted, rtol=0.0, atol=1e-10)
