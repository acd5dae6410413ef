"""double-layer-gps' estimator and its rivals, written out again, slowly, in the paper's letters."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.vehicle.parameters import COMS, GRAVITY
from sideslip.estimators import make_estimator
from sideslip.estimators.design.periodic import NO_SENSOR, design_and_map
from tests.estimators.simulation import FIG6, GPS, simulate

from .literal import (
    COURSE,
    T,
    ackermann,
    car,
    correct,
    due,
    excited,
    gain,
    inputs,
    observer,
    pushed,
    stationary,
    zoh,
)

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")

V = FIG6.speed
SHORT = type(FIG6)(duration=1.1, amplitude=0.2, frequency=0.7, real=7000.0)
HDOP = PACKET.value + 4
TABLE = ((1.0, 1.0), (2.0, 1.5), (20.0, 20.0))  # "lookup tables" of 4.3
Q_1 = np.array([3.7e-4, 4.2e-4, 1.2e-6, 3.3e-2, 0.21]) * T
Q_2 = np.array([1e-4, 2e-4, 1e-6, 1e-3, 1.0]) * T
PRIOR_1 = np.diag(np.square([0.02, 0.05, 0.05, 0.1, 1.0]))
PRIOR_2 = np.diag(np.square([0.1, 0.1, 0.02, 0.05, 1.0]))


def log_of(seed: Any, satellites: Any = 12.0, gps: Any = GPS, drive: Any = SHORT) -> Any:
    log = excited(simulate(drive, {"gps": gps}, seed))
    log.record.packets[:, HDOP] = [0.8, 1.4, 1.9, 5.0, 25.0, 1.0][: len(log.record.packets)]
    log.record.packets[1, HDOP + 1] = satellites
    return log


class Layer:
    """The advanced multi-rate Kalman filter of Fig. 7."""

    def __init__(
        self, C: Any, fast: Any, r_fast: Any, P: Any, predicts: bool, ratio: Any = 1
    ) -> None:
        """C: all rows, those of conventional sensors first. fast: how many of them."""
        self.C, self.fast, self.r_fast, self.predicts = C, fast, r_fast, predicts
        self.x, self.P, self.e = np.zeros(len(P)), P.copy(), np.zeros(len(P))
        self.K_gps, self.ratio = np.zeros((len(P), len(C) - fast)), ratio

    def predict(self, A: Any, B: Any, u: Any, Q: Any) -> None:
        self.x, self.P, self.e = A @ self.x + B @ u, A @ self.P @ A.T + np.diag(Q), A @ self.e

    def conventional(self, y: Any) -> None:
        """epsilon^s, with the Kalman gain of this step; C e waits for `between` or `sample`."""
        C = self.C[: self.fast]
        self.before, self.ahead = self.x, self.C @ self.e
        K = self.K_s = gain(self.P, C, self.r_fast)
        self.eps_s = y - C @ self.x
        self.x = self.x + K @ self.eps_s
        self.e = self.e - K @ self.ahead[: self.fast]
        self.P = (np.eye(len(self.P)) - K @ C) @ self.P

    def between(self) -> None:
        """(28) step by step: the predicted residual C A e, with the last sample's gain."""
        if self.predicts:
            ahead = self.ahead[self.fast :]
            self.x, self.e = self.x + self.K_gps @ ahead, self.e - self.K_gps @ ahead

    def sample(self, y: Any, R: Any) -> None:
        """epsilon^GPS; every step of the period takes an even share of its gain."""
        C = self.C[self.fast :]
        if not self.predicts:
            self.x, self.P = correct(self.x, self.P, C, R, y)
            return
        K = gain(self.P, C, R)
        self.P = (np.eye(len(self.P)) - K @ C) @ self.P
        self.K_gps = K / self.ratio  # r = T_s / T_c
        eps = y - C @ self.before
        self.x = self.x + self.K_gps @ eps
        L = np.hstack([self.K_s, self.K_gps])
        C_plus = self.C.T @ np.linalg.inv(self.C @ self.C.T)  # (29), corrected
        self.e = (C_plus - L) @ np.concatenate([self.eps_s, eps])


def roll_model(gamma: Any) -> Any:
    """A, B of (42): v_x, v_y, phi, phi', d at a yaw rate."""
    A = np.zeros((5, 5))
    A[0, 1], A[1, 0], A[1, 2], A[2, 3] = gamma, -gamma, -GRAVITY, 1.0
    A[3, 2] = -COMS.roll_stiffness / COMS.roll_inertia
    A[3, 3] = -COMS.roll_damping / COMS.roll_inertia
    A[3, 4] = 1.0
    B = np.zeros((5, 2))
    B[0, 0] = B[1, 1] = 1.0
    B[3, 1] = COMS.sprung_mass * COMS.roll_arm / COMS.roll_inertia
    return A, B


def literal(log: Any, predicts: bool, table: Any = None) -> Any:
    """Fig. 8: both layers. The models are discretised exactly, not as A T_c + I (38), (42)."""
    A_c, B_c = car(V)
    A, B = zoh(*pushed(A_c[:3, :3], B_c[:3], (0, 1)))  # (34)-(36)
    C_1 = np.array([[0.0, 1, 0, 0, 0], [1, 0, 1, 0, 0]])  # (38)
    C_2 = np.array([[0.0, 0, 0, 1, 0], [1, 0, 0, 0, 0], [0, 1, 0, 0, 0]])  # (41)
    r = round(log.slow["gps"].period / T)
    first = Layer(C_1, 1, np.array([[0.005**2]]), PRIOR_1, predicts, r)
    second = Layer(C_2, 1, np.array([[0.005**2]]), PRIOR_2, predicts, r)
    second.x[0] = V  # the first wheel speed
    at, wanted = due(log), []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            first.predict(A, B, inputs(row), Q_1)
            A_2, B_2 = zoh(*roll_model(row[FAST.gyro]))
            second.predict(A_2, B_2, row[[FAST.accel_x, FAST.accel_y]], Q_2)
        first.conventional(row[[FAST.gyro]])
        second.conventional(row[[FAST.roll_rate]])
        packet = at.get(k)
        first.between()
        second.between()
        if packet is not None and packet[HDOP + 1] >= 4:  # 4.3
            for layer in (first, second):  # the real residual replaces the predicted one
                layer.x = layer.x - predicts * layer.K_gps @ layer.ahead[1:]
            knots, factors = np.transpose(table or [(1.0, 1.0)])
            factor = np.interp(packet[HDOP], knots, factors)
            speed, sigma_V = packet[PACKET.value + 1], 0.05 * factor
            first.sample(packet[[PACKET.value]], np.array([[(COURSE / V * factor) ** 2]]))
            beta, sigma_beta = first.x[0], np.sqrt(first.P[0, 0])
            across = (speed * sigma_beta) ** 2 + (sigma_V * np.sin(beta)) ** 2
            y = speed * np.array([np.cos(beta), np.sin(beta)])  # (8)-(9)
            second.sample(y, np.diag([sigma_V**2, across]))
        wanted.append(np.concatenate([first.x, second.x]))
    return np.array(wanted)


def estimator(log: Any, **options: Any) -> Any:
    noise = np.concatenate([Q_1, Q_2]) / T
    return make_estimator("double-layer", sensors=log.slow, speed=V, Q=noise, **options)


@pytest.mark.parametrize("rule", ["pseudo-residual", "predict"])
@pytest.mark.parametrize("table", [None, TABLE], ids=["constant", "hdop"])
def test_both_layers(rule: Any, table: Any) -> None:
    """(28)-(29), (34)-(42), with R from a table of HDOP."""
    log = log_of(0)
    wanted = literal(log, rule == "pseudo-residual", table)
    found = estimator(log, intersample=rule, hdop_table=table).run(log)
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-9)


@pytest.mark.plain
def test_a_fix_of_three_satellites_is_refused() -> None:
    few = type(FIG6)(duration=0.06, amplitude=0.2, frequency=0.7, real=7000.0)
    gps = SlowSensor(period=0.02)
    log = log_of(1, 3.0, gps, few)
    filter_, default = estimator(log), ((1.0, 1.0), (20.0, 20.0))
    wanted = literal(log, True, default)
    np.testing.assert_allclose(filter_.run(log).x, wanted, rtol=0.0, atol=1e-9)
    assert filter_.counts["poor"] == 1
    assert np.abs(wanted - literal(log_of(1, 12.0, gps, few), True, default)).max() > 1e-6


def test_the_second_layer_works_at_zero_yaw_rate() -> None:
    """5.2: the kinematic filter cannot see v_y there, the second layer can."""
    kinematic = make_estimator("kinematic-velocity-kf", speed=V)
    assert kinematic.unobservable and all("v_y" in way for way in kinematic.unobservable)
    double = estimator(log_of(0))
    assert all("v_y" not in way and "beta" in way for way in double.unobservable)
    fast = np.zeros((10_000, FAST_WIDTH))
    packets = np.zeros((50, PACKET_WIDTH))
    packets[:, 0] = 1.0
    packets[:, 1] = packets[:, 2] = np.arange(50) * 200
    packets[:, 3] = 1.0
    packets[:, PACKET.value + 1] = V
    for filter_, samples, ends in ((double, packets, True), (kinematic, packets[:0], False)):
        filter_.reset()
        filter_.filters[-1].x[1] = 0.5  # m/s, wrong
        filter_.step(fast, samples)
        v_y = filter_.x[filter_.names.index("v_y")]
        assert (abs(v_y) < 0.02) == ends


def test_the_kinematic_filter() -> None:
    """6.3: (4)-(5) without roll, the mean front wheel speed as v_x."""
    log = log_of(2)
    x, P = np.array([V, 0.0]), np.diag([0.1**2, 0.1**2])
    C = np.array([[1.0, 0.0]])
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            gamma = row[FAST.gyro]
            G, H = zoh(np.array([[0.0, gamma], [-gamma, 0.0]]), np.eye(2))
            x = G @ x + H @ row[[FAST.accel_x, FAST.accel_y]]
            P = G @ P @ G.T + np.diag([1e-3, 2e-3]) * T
        wheel = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
        x, P = correct(x, P, C, np.array([[0.015**2]]), np.array([wheel]))
        wanted.append(x)
    filter_ = make_estimator("kinematic-velocity-kf", speed=V, q_v_x=1e-3, q_v_y=2e-3)
    np.testing.assert_allclose(filter_.run(log).x, wanted, rtol=0.0, atol=1e-9)


@pytest.mark.plain
def test_the_roll_filter() -> None:
    """6.2: (3) from a_y, corrected by the roll rate; 30 % off as in (43)."""
    log = log_of(3)
    names = ("roll_inertia", "roll_stiffness", "roll_damping")
    told = COMS.replace(**{name: 1.3 * getattr(COMS, name) for name in names})
    I_x, K_x, C_x = (getattr(told, name) for name in names)
    A = np.array([[0.0, 1.0], [-K_x / I_x, -C_x / I_x]])
    G, H = zoh(A, np.array([[0.0], [COMS.sprung_mass * COMS.roll_arm / I_x]]))
    C, r, Q = np.array([[0.0, 1.0]]), np.array([[0.005**2]]), np.diag([1e-4, 1e-2]) * T

    K = stationary(G, C, Q, r)
    wanted = observer(log, G, H, C, K, [FAST.accel_y], [FAST.roll_rate])
    filter_ = make_estimator("roll-kf", vehicle=told, speed=V, q_phi=1e-4, q_phi_rate=1e-2)
    np.testing.assert_allclose(filter_.run(log).x, wanted, rtol=0.0, atol=1e-10)


def test_the_two_state_observer() -> None:
    """6.1 (Aoki): beta and gamma from the gyro, poles at -60 and -120 rad/s."""
    log = log_of(4)
    A, B = (M[:2, :2] for M in car(V))
    G, H = zoh(A, B)
    C, poles = np.array([[0.0, 1.0]]), np.exp(np.array([-60.0, -120.0]) * T)
    K = ackermann(G, C, poles)
    reached = np.linalg.eigvals((np.eye(2) - K @ C) @ G)
    np.testing.assert_allclose(np.sort(reached), np.sort(poles), rtol=1e-9)
    filter_ = make_estimator("lob-2", speed=V)
    table, _ = design_and_map(filter_.filters[0], NO_SENSOR, V, filter_.config)
    np.testing.assert_allclose(table[1, :2], K[:, 0], rtol=1e-9)
    wanted = observer(log, G, H, C, K, inputs, [FAST.gyro])
    np.testing.assert_allclose(filter_.run(log).x, wanted, rtol=0.0, atol=1e-10)


def test_a_late_fix_is_used_where_it_was_captured() -> None:
    """A GPS that is 30 ms late: the first layer's clone keeps what a fresh fix would say."""
    late = SlowSensor(period=0.2, delays=(0.03,))
    log = simulate(SHORT, {"gps": late}, 5)
    fresh = simulate(SHORT, {"gps": GPS}, 5)
    found = estimator(log, intersample="predict").run(log)["beta"]
    wanted = estimator(fresh, intersample="predict").run(fresh)["beta"]
    np.testing.assert_allclose(found[1050], wanted[1050], rtol=0.0, atol=1e-10)
