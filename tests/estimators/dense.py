"""Conditioning the joint Gaussian of all ticks on everything that arrived, for bicycle models.

The states of all ticks are an affine map of z ~ N(0, I), the scaled prior and process noise, and so
is every measurement: the posterior of z is one least-squares problem. Nothing is recursive, and no
covariance is squared that would lose half the digits.
"""

import math
from typing import Any

import numpy as np
from scipy.linalg import expm, solve_triangular

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Record
from sideslip.envs.sensors.slow import SLOW_NAMES
from sideslip.envs.vehicle.linear import make_vision_model
from sideslip.envs.vehicle.parameters import COMS

STATES = ("beta", "gamma", "psi", "y_l", "phi", "phi_rate")
PUSHED = {"d1": 0, "d2": 1, "d3": 2}
NOISE = {"camera": (3.5e-3, 0.02), "gps": (math.radians(0.14) * 60.0 / 3.6,)}  # course: x 1/V
MEASURED = {"camera": (("psi",), ("y_l",)), "gps": (("beta", "psi"),)}
GYRO = 0.005
FAST_SD = {"gyro": GYRO, "accel_y": 0.1, "roll_rate": 0.005}
WITH_TYRES = {"front_tyres_sd": 0.23, "rear_tyres_sd": 0.23, "wary": 10}
"""Options with which `exact-kf` has tyres among its states and refuses what contradicts it."""
ARM = COMS.rear_track / (2.0 * COMS.wheel_radius)


def continuous(behind: Any, V: float, rolls: bool) -> Any:
    """dx/dt of `STATES` and the specific force a_y, (7, 9 + m): columns `STATES`, steering, yaw
    moment, the road's curvature, then what is behind.

    A body that rolls leaves beta' and phi'' in one pair of equations, double-layer-gps (1) and (3):
    M V (beta' + gamma) - S phi'' = F_y, I_x phi'' = S a_y - ...
    """
    model, at = make_vision_model(COMS, V), 9
    rows = np.zeros((7, at + len(behind)))
    rows[:4, :4], rows[:4, 6:9] = model.A, model.B
    for j, name in enumerate(behind, at):
        if name in ("F_d", "N_d"):
            to, push = (0, 1.0 / (COMS.mass * V)) if name == "F_d" else (1, 1.0 / COMS.yaw_inertia)
            rows[to, j] = push
        elif name == "bank":
            rows[0, j] = -9.81 / V
        elif name in PUSHED:
            rows[PUSHED[name], j] = 1.0
        elif name == "steer_offset":  # what acts is the measured angle less it
            rows[:4, j] = -model.B[:, 0]
    S = COMS.sprung_mass * COMS.roll_arm
    phi, phi_rate = np.eye(rows.shape[1])[4:6]
    bank = np.array([*np.zeros(at), *(name == "bank" for name in behind)])
    if rolls:
        M = COMS.mass * V
        both = np.array([[M, -S], [-S * V, COMS.roll_inertia]])
        felt = S * (V * np.eye(rows.shape[1])[1] + 9.81 * (phi + bank))
        pull = felt - COMS.roll_stiffness * phi - COMS.roll_damping * phi_rate
        rows[0], rows[5] = np.linalg.solve(both, np.array([M * rows[0], pull]))
        rows[4] = phi_rate
    rows[6] = V * (rows[0] + np.eye(rows.shape[1])[1]) + 9.81 * (phi + bank)
    return rows


def transition(names: Any, V: float, dt: float) -> Any:
    """F (n, n), B (n, 3) of a tick, and a_y's row (n,) and feed-through (3,); disturbances and
    inputs are held over it."""
    behind = [name for name in names if name not in STATES]
    slopes = continuous(behind, V, "phi" in names)
    block = np.zeros((slopes.shape[1],) * 2)
    block[:6] = slopes[:6]
    exact = expm(block * dt)
    rows = [STATES.index(name) for name in names if name in STATES]
    n, m = len(names), len(rows)
    F, B = np.zeros((n, n)), np.zeros((n, 3))
    F[:m, :m], F[:m, m:] = exact[np.ix_(rows, rows)], exact[rows, 9:]
    for j, name in enumerate(behind, m):
        F[j, j] = math.exp(-dt / 0.3) if name in ("F_d", "N_d") else 1.0
    B[:m] = exact[rows, 6:9]
    return F, B, np.concatenate([slopes[6, rows], slopes[6, 9:]]), slopes[6, 6:9]


def speeds(fast: Any, dt: float) -> Any:
    """The speed of the model in every row: low-passed, and renewed where it moved by 0.5 %."""
    share = 1.0 - math.exp(-dt / 0.015)
    now = 0.5 * (fast[:, FAST.wheel_left] + fast[:, FAST.wheel_right])
    smooth, model = now[0], max(now[0], 1.5)
    found = [model]
    for V in now[1:]:
        smooth += share * (V - smooth)
        if abs(max(smooth, 1.5) - model) > 0.005 * model:
            model = max(smooth, 1.5)
        found.append(model)
    return np.array(found)


def first_of_each(packets: Any) -> Any:
    """Packets without the later copies of the same sample."""
    seen: Any = set()
    kept = []
    for packet in packets:
        if (stamp := (packet[PACKET.sensor], packet[PACKET.captured])) not in seen:
            kept.append(packet)
        seen.add(stamp)
    return kept


class Posterior:
    """The states of every tick given a record; a fast measurement that is NaN is none.

    prior: variances. Q: variances of a tick's noise (n,). V: speeds of all rows. factor: on the
    course's noise by HDOP.
    """

    def __init__(
        self, names: Any, record: Record, prior: Any, Q: Any, V: Any,
        fast: tuple[str, ...] = ("gyro",), factor: Any = lambda hdop: 1.0,
    ) -> None:  # fmt: skip
        n, K = len(names), len(record.fast)
        noisy = np.flatnonzero(Q)
        q = len(noisy)
        self.mean: Any = np.zeros((K, n))
        self.T: Any = np.zeros((K, n, n + (K - 1) * q))
        self.T[0, :, :n] = np.diag(np.sqrt(prior))
        models = {speed: transition(names, speed, record.dt) for speed in set(V)}
        arm = ARM * (record.fast[:, FAST.torque_right] - record.fast[:, FAST.torque_left])
        bends = record.fast[:, FAST.curvature]
        acted = np.column_stack([record.fast[:, FAST.steer], arm, bends])
        road = np.concatenate([[0.0], np.cumsum((V * bends)[1:])]) * record.dt  # its direction
        for k in range(1, K):
            a, u = n + (k - 1) * q, acted[k]
            F, B, _, _ = models[V[k]]
            F = F @ np.diag([V[k - 1] / V[k]] + [1.0] * (n - 1))  # beta = v_y / V; v_y stays
            self.mean[k] = F @ self.mean[k - 1] + B @ u
            self.T[k, :, :a] = F @ self.T[k - 1, :, :a]
            self.T[k, noisy, np.arange(a, a + q)] = np.sqrt(Q[noisy])
        M: Any = [np.eye(n + (K - 1) * q)]
        b: Any = [np.zeros(n + (K - 1) * q)]
        for name in fast:
            rows, through = np.zeros((K, n)), np.zeros((K, 3))
            if name == "accel_y":
                rows[:] = [models[speed][2] for speed in V]
                through[:] = [models[speed][3] for speed in V]
            else:
                rows[:, names.index({"gyro": "gamma", "roll_rate": "phi_rate"}[name])] = 1.0
            bias = {"gyro": "bias", "accel_y": "accel_bias"}.get(name)
            if bias in names:
                rows[:, names.index(bias)] = 1.0
            known = np.einsum("kn,kn->k", rows, self.mean) + np.einsum("ki,ki->k", through, acted)
            measured = record.fast[:, getattr(FAST, name)]
            there = np.isfinite(measured)
            M.append(np.einsum("kn,knm->km", rows, self.T)[there] / FAST_SD[name])
            b.append((measured - known)[there] / FAST_SD[name])
        for packet in first_of_each(record.packets):
            name, k = SLOW_NAMES[int(packet[PACKET.sensor])], int(packet[PACKET.captured])
            for i, states in enumerate(MEASURED[name]):
                sd = NOISE[name][i]
                if name == "gps":
                    sd *= factor(packet[PACKET.value + 4]) / V[k]
                at = [names.index(state) for state in states]
                M.append(self.T[k, at].sum(0)[None] / sd)
                due = self.mean[k, at].sum() + (road[k] if name == "gps" else 0.0)
                if name == "camera" and "camera_yaw" in names:
                    reach, yaw = (1.0, COMS.preview)[i], names.index("camera_yaw")
                    M[-1] += reach * self.T[k, yaw][None] / sd
                    due += reach * self.mean[k, yaw]
                b.append(np.array([(packet[PACKET.value + i] - due) / sd]))
        A = np.column_stack([np.concatenate(M), np.concatenate(b)])
        R: Any = np.linalg.qr(A, mode="r")
        self.R = R[:-1, :-1]
        self.z = solve_triangular(self.R, R[:-1, -1])

    def at(self, k: int) -> Any:
        """Mean and covariance of the states at row k."""
        root = solve_triangular(self.R, self.T[k].T, trans="T")
        return self.mean[k] + self.T[k] @ self.z, root.T @ root


def inputs(rng: Any, rows: int) -> Any:
    """Fast rows with random inputs and gyro samples, and a car that gets faster."""
    fast = np.zeros((rows, FAST_WIDTH))
    fast[:, FAST.steer] = 0.05 * rng.standard_normal(rows)
    fast[:, FAST.torque_right] = 20.0 * rng.standard_normal(rows)
    fast[:, FAST.gyro] = 0.1 * rng.standard_normal(rows)
    fast[:, FAST.curvature] = 0.05 * rng.standard_normal(rows)
    fast[:, FAST.accel_y] = rng.standard_normal(rows)
    fast[:, FAST.roll_rate] = 0.1 * rng.standard_normal(rows)
    V = rng.uniform(2.0, 15.0) + np.linspace(0.0, 3.0, rows)
    fast[:, FAST.wheel_left] = fast[:, FAST.wheel_right] = V
    return fast


def arrivals(rng: Any, sensors: Any, rows: int, dt: float, clock: bool = True) -> Any:
    """Packets that come late, in any order, twice (with other values) or never, by arrival.

    clock: captured on the sensor's clock, else at random ticks.
    """
    packets: Any = []
    for name, sensor in sensors.items():
        captures = np.arange(round((sensor.phase or 0.0) / dt), rows, round(sensor.period / dt))
        if not clock:
            captures = np.sort(rng.choice(rows, len(captures), replace=False))
        for i, k in enumerate(captures):
            if rng.random() < 0.2:
                continue
            for _ in range(1 + int(rng.random() < 0.2)):
                late = round(sensor.delays[i % len(sensor.delays)] / dt)
                late += int(rng.integers(0, round(sensor.jitter / dt) + 1))
                row = np.zeros(PACKET_WIDTH)
                row[: PACKET.value] = SLOW_NAMES.index(name), k, k + late, 1.0, i
                row[PACKET.value :] = 0.05 * rng.standard_normal(6)
                row[PACKET.value + 4 :] = rng.uniform(0.5, 6.0), 12.0
                if k + late < rows:
                    packets.append(row)
    packets = np.array(packets).reshape(-1, PACKET_WIDTH)
    return packets[np.lexsort((packets[:, 0], packets[:, 1], packets[:, 2]))]
