"""What the papers' filters are written out with again: textbook steps, slowly, in NumPy."""

from typing import Any

import numpy as np
from scipy.linalg import expm

from sideslip.envs.record import FAST, PACKET
from sideslip.envs.vehicle.parameters import COMS

T = 0.001
COURSE = np.radians(0.14) * 60.0 / 3.6  # rad m/s; its noise is this over the speed


def zoh(A: Any, B: Any, step: float = T) -> Any:
    """G = e^(A T), H = int_0^T e^(A tau) d tau B: tie-vision (9)."""
    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    exact = expm(block * step)
    return exact[:n, :n], exact[:n, n:]


def car(V: float, vehicle: Any = COMS) -> Any:
    """A, B of tie-vision (8): beta, gamma, psi, y_l from delta_f and N_z."""
    m, I = vehicle.mass, vehicle.yaw_inertia  # noqa: E741
    l_f, l_r, l_pre = vehicle.front_arm, vehicle.rear_arm, vehicle.preview
    C_f, C_r = vehicle.front_stiffness, vehicle.rear_stiffness
    A = np.array(
        [
            [-2 * (C_f + C_r) / (m * V), -1 - 2 * (C_f * l_f - C_r * l_r) / (m * V**2), 0, 0],
            [-2 * (C_f * l_f - C_r * l_r) / I, -2 * (C_f * l_f**2 + C_r * l_r**2) / (I * V), 0, 0],
            [0, 1, 0, 0],
            [V, l_pre, V, 0],
        ]
    )
    B = np.array([[2 * C_f / (m * V), 0], [2 * C_f * l_f / I, 1 / I], [0, 0], [0, 0]])
    return A, B


def pushed(A: Any, B: Any, rows: Any) -> Any:
    """A and B with a state of its own behind that pushes each of the rows."""
    n, d = len(A), len(rows)
    wide = np.zeros((n + d, n + d))
    wide[:n, :n] = A
    wide[list(rows), range(n, n + d)] = 1.0
    return wide, np.vstack([B, np.zeros((d, B.shape[1]))])


def inputs(row: Any, vehicle: Any = COMS) -> Any:
    """delta_f and N_z of a fast row; tie-vision (3) with z up."""
    torque = row[FAST.torque_right] - row[FAST.torque_left]
    return np.array([row[FAST.steer], vehicle.rear_track / (2 * vehicle.wheel_radius) * torque])


def gain(P: Any, C: Any, R: Any) -> Any:
    return P @ C.T @ np.linalg.inv(C @ P @ C.T + R)


def correct(x: Any, P: Any, C: Any, R: Any, y: Any) -> Any:
    """The textbook's correction by all rows together."""
    K = gain(P, C, R)
    return x + K @ (y - C @ x), (np.eye(len(x)) - K @ C) @ P


def due(log: Any, column: Any = PACKET.arrived) -> Any:
    """Packets by the tick in a column."""
    return {int(packet[column]): packet for packet in log.record.packets}


def settled(step: Any, period: int, size: int, cycles: int = 3000) -> Any:
    """Gains of a schedule that repeats: `step(k, P)` -> (P, gains) until they do."""
    P, before = np.eye(size), np.zeros((size, size))
    for _ in range(cycles):
        gains = []
        for k in range(period):
            P, now = step(k, P)
            gains.append(now)
        if np.abs(P - before).max() < 1e-14 * np.abs(P).max():
            break
        before = P
    return gains


def stationary(G: Any, C: Any, Q: Any, R: Any) -> Any:
    """The settled gain of a filter that measures at every step."""

    def step(_: Any, P: Any) -> Any:
        P = G @ P @ G.T + Q
        K = gain(P, C, R)
        return (np.eye(len(G)) - K @ C) @ P, K

    return settled(step, 1, len(G))[0]


def ackermann(G: Any, C: Any, poles: Any) -> Any:
    """K of one output with the poles of (I - K C) G, z-plane: Ackermann's formula on (G, C G)."""
    n = len(G)
    wanted = np.eye(n)
    for pole in poles:
        wanted = wanted @ (G - pole * np.eye(n))
    seen = np.vstack([C @ np.linalg.matrix_power(G, i + 1) for i in range(n)])
    return wanted @ np.linalg.inv(seen)[:, -1:]


def observer(log: Any, G: Any, H: Any, C: Any, K: Any, u: Any, y: Any, D: Any = None) -> Any:
    """x_k = G x + H u, then + K (y - C x - D u); u, y: of a fast row, or their columns."""
    u_of, y_of = (each if callable(each) else lambda row, at=each: row[at] for each in (u, y))
    x: Any = np.zeros(len(G))
    wanted: Any = []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            x = G @ x + H @ u_of(row)
        x = x + K @ (y_of(row) - C @ x - (0.0 if D is None else D @ u_of(row)))
        wanted.append(x)
    return np.array(wanted)


def excited(log: Any) -> Any:
    """The same log with motor torques, so that N_z matters."""
    t = np.arange(len(log.record.fast)) * T
    log.record.fast[:, FAST.torque_right] = 20.0 * np.sin(9.0 * t)
    log.record.fast[:, FAST.torque_left] = -5.0 * np.cos(4.0 * t)
    return log
