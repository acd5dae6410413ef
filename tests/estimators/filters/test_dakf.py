"""dakf-stability's filters and observers, written out again, slowly, in the paper's letters."""

from typing import Any

import numpy as np
import pytest
from scipy.signal import place_poles

from sideslip.envs.record import FAST, PACKET
from sideslip.envs.vehicle.parameters import COMS
from sideslip.estimators import make_estimator
from tests.estimators.simulation import FIG6, GPS, simulate

from .literal import COURSE, T, ackermann, car, correct, due, excited, inputs, observer, pushed, zoh

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")

V = FIG6.speed
WINDY = type(FIG6)(
    duration=1.2, amplitude=0.2, wind=(200.0, 0.2, 0.3, 0.9), outage=(0.5, 0.7), real=7000.0
)
R_V = np.diag([0.005**2, (COURSE / V) ** 2])  # (22)
A_3, B_3 = (M[:3] for M in car(V))


def log_of(seed: Any) -> Any:
    return excited(simulate(WINDY, {"gps": GPS}, seed))


def literal(log: Any, walks: Any, Q_W: Any, prior: Any) -> Any:
    """Fig. 4: the two stages, with (19) when the course is updated and (20) when it is not."""
    A_n, B_n = pushed(A_3[:, :3], B_3, walks)  # (5)-(7): D_n zeta
    A_nd, B_nd = zoh(A_n, B_n)  # (13), (17)
    C = np.zeros((2, len(A_n)))
    C[0, 1] = C[1, 0] = C[1, 2] = 1.0
    at = due(log)
    x, P = np.zeros(len(A_n)), np.diag(np.square(prior))
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            x = A_nd @ x + B_nd @ inputs(row)  # (15)
            P = A_nd @ P @ A_nd.T + np.diag(Q_W) * T
        if k in at:
            y = np.array([row[FAST.gyro], at[k][PACKET.value]])
            x, P = correct(x, P, C, R_V, y)  # (19)
        else:
            x, P = correct(x, P, C[:1], R_V[:1, :1], row[[FAST.gyro]])  # (20)
        wanted.append(np.concatenate([x, np.sqrt(np.diag(P))]))
    return np.array(wanted)


@pytest.mark.parametrize(("name", "walks"), [("course-kf", ()), ("dakf", (0, 1))])
def test_the_kalman_filters_through_an_outage(name: Any, walks: Any) -> None:
    log = log_of(0)
    Q_W = [3.7e-4, 4.2e-4, 1.2e-6, 3.3e-2, 0.21][: 3 + len(walks)]  # (21)
    prior = [0.02, 0.05, 0.05, 0.1, 1.0][: 3 + len(walks)]
    wanted = literal(log, walks, Q_W, prior)
    found = make_estimator(name, sensors=log.slow, speed=V, Q=Q_W).run(log)
    n = len(Q_W)
    np.testing.assert_allclose(found.x, wanted[:, :n], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(found.std, wanted[:, n:], rtol=1e-7)


@pytest.mark.plain
def test_the_linear_observer_has_its_poles_where_they_were_placed() -> None:
    """LOB [5]: gamma and a_y = V (beta' + gamma); two outputs of two states leave one gain."""
    log, A, B = log_of(1), A_3[:2, :2], B_3[:2]
    C = np.array([[0.0, 1.0], [V * A[0, 0], V * (A[0, 1] + 1.0)]])
    D = np.array([[0.0, 0.0], [V * B[0, 0], V * B[0, 1]]])
    G, H = zoh(A, B)
    K = (np.eye(2) - np.exp(-2.0 * T) * np.linalg.inv(G)) @ np.linalg.inv(C)
    np.testing.assert_allclose(np.linalg.eigvals((np.eye(2) - K @ C) @ G), np.exp(-2.0 * T))
    wanted = observer(log, G, H, C, K, inputs, [FAST.gyro, FAST.accel_y], D)
    found = make_estimator("lob", speed=V).run(log)
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-9)


@pytest.mark.plain
def test_the_yaw_moment_observer() -> None:
    """[11]: I gamma' = N_z + N_d with N_d constant, from the gyro."""
    log, I_z = log_of(2), COMS.yaw_inertia
    A, B = np.array([[0.0, 1.0 / I_z], [0.0, 0.0]]), np.array([[1.0 / I_z], [0.0]])
    C = np.array([[1.0, 0.0]])
    G, H = zoh(A, B)
    K = ackermann(G, C, np.exp(np.array([-20.0, -25.0]) * T))
    wanted = observer(log, G, H, C, K, lambda row: inputs(row)[1:], [FAST.gyro])
    found = make_estimator("yaw-moment-observer", speed=V).run(log)
    scale = np.array([1.0, I_z])
    np.testing.assert_allclose(found.x / scale, wanted / scale, rtol=0.0, atol=1e-9)


def test_the_lateral_force_observer() -> None:
    """[11]: I gamma' = l_f F_yf - l_r F_yr + N_z and m a_y = F_yf + F_yr, forces constant."""
    log, I_z, m = log_of(3), COMS.yaw_inertia, COMS.mass
    A = np.zeros((3, 3))
    A[0, 1:] = COMS.front_arm / I_z, -COMS.rear_arm / I_z
    B = np.array([[1.0 / I_z], [0.0], [0.0]])
    C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0 / m, 1.0 / m]])
    G, H = zoh(A, B)
    poles = np.exp(np.array([-20.0, -25.0, -30.0]) * T)
    K = place_poles(G.T, (C @ G).T, poles).gain_matrix.T
    reached = np.linalg.eigvals((np.eye(3) - K @ C) @ G)
    np.testing.assert_allclose(np.sort(reached), np.sort(poles), rtol=1e-9)
    wanted = observer(log, G, H, C, K, lambda row: inputs(row)[1:], [FAST.gyro, FAST.accel_y])
    found = make_estimator("lateral-force-observer", speed=V).run(log)
    scale = np.array([1.0, m, m])
    np.testing.assert_allclose(found.x / scale, wanted / scale, rtol=0.0, atol=1e-8)
