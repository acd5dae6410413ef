"""FilterPy's extended Kalman filter of the car with unknown tyres, beside `joint`: error and time.

Written as its users would: eight states, two scalar updates for a camera frame, which is used as it
arrives. So it is the same filter as `joint` where the camera is at once, and another where it is
late.
"""

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.vehicle.vehicle import Vehicle
from ...estimators.design.levels import DISTURBANCE, NOISE
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, call_quietly, make_filter_arguments
from .conditions import CAMERA, LINEAR, MIX
from .measure import run_with_bound

DELAYS = {"camera at once": 0.0, "camera 30 ms late": 0.03}
STATES = 8  # beta, gamma, psi, y_l, F_d, N_d, and both axles' factors


class FilterPyEkf:
    """ekf: FilterPy's filter. dt: s of a tick. speed: m/s, held."""

    def __init__(self, vehicle: Vehicle, speed: float, dt: float) -> None:
        self.car, self.V, self.dt = vehicle, speed, dt
        self.ekf: Any = ExtendedKalmanFilter(dim_x=STATES, dim_z=1)
        force, moment, time_constant = DISTURBANCE.values()
        self.ekf.x = np.array([0.0] * 6 + [1.0, 1.0])
        self.ekf.P = np.diag(np.square([0.0, 0.0, 0.0, 0.0, force, moment, 0.23, 0.23]))
        self.decay = np.exp(-dt / time_constant)
        noise_gain = (1.0 - self.decay**2) * np.square([force, moment])
        self.ekf.Q = np.diag([0.0] * 4 + [*noise_gain] + [0.0, 0.0])
        self.ekf.predict_x = self._predict
        self.rows = np.eye(STATES)
        self.noise = [NOISE[f"{name}_noise"] ** 2 for name in ("gyro", "psi", "y_l")]

    def _compute_slopes(self, steer: float) -> tuple[Array, Array]:
        """dx and its Jacobian, without the decay of the disturbances."""
        car, V, (beta, gamma, psi, _, force, moment, front, rear) = self.car, self.V, self.ekf.x
        C_f, C_r = 2.0 * car.front_stiffness, 2.0 * car.rear_stiffness
        l_f, l_r, m, inertia = car.front_arm, car.rear_arm, car.mass, car.yaw_inertia
        at_front, at_rear = steer - beta - l_f / V * gamma, -beta + l_r / V * gamma
        F_f, F_r = C_f * front * at_front, C_r * rear * at_rear
        dx, A = np.zeros(STATES), np.zeros((STATES, STATES))
        dx[0] = (F_f + F_r + force) / (m * V) - gamma
        dx[1] = (l_f * F_f - l_r * F_r + moment) / inertia
        dx[2], dx[3] = gamma, V * (psi + beta) + car.preview * gamma
        by_beta, by_gamma = C_f * front + C_r * rear, l_f * C_f * front - l_r * C_r * rear
        A[0, :2] = -by_beta / (m * V), -1.0 - by_gamma / (m * V * V)
        turn = l_f * l_f * C_f * front + l_r * l_r * C_r * rear
        A[1, :2] = -by_gamma / inertia, -turn / (inertia * V)
        A[0, 4], A[1, 5] = 1.0 / (m * V), 1.0 / inertia
        A[0, 6:], A[1, 6:] = (
            np.array([C_f * at_front, C_r * at_rear]) / (m * V),
            np.array([l_f * C_f * at_front, -l_r * C_r * at_rear]) / inertia,
        )
        A[2, 1], A[3, :3] = 1.0, (V, car.preview, V)
        return dx, A

    def _predict(self, u: float) -> None:
        dt = self.dt
        dx, A = self._compute_slopes(u)
        self.ekf.F = np.eye(STATES) + dt * A + 0.5 * dt * dt * A @ A
        self.ekf.x = self.ekf.x + dt * dx + 0.5 * dt * dt * A @ dx
        self.ekf.F[4, 4] = self.ekf.F[5, 5] = self.decay
        self.ekf.x[4:6] *= self.decay

    def _update(self, state: int, value: float, r: float) -> None:
        row = self.rows[state : state + 1]
        self.ekf.update(np.array([value]), lambda x: row, lambda x: row @ x, R=r)

    def run(self, log: Log) -> Array:
        """beta at every row."""
        record, slips, came = log.record, np.empty(len(log.record.fast)), 0
        for k, row in enumerate(record.fast):
            if k > 0:
                self.ekf.predict(row[FAST.steer])
            self._update(1, row[FAST.gyro], self.noise[0])
            now = record.first + k
            while came < len(record.packets) and record.packets[came, PACKET.arrived] <= now:
                psi, y_l = record.packets[came, PACKET.value : PACKET.value + 2]
                self._update(2, psi, self.noise[1])
                self._update(3, y_l, self.noise[2])
                came += 1
            slips[k] = self.ekf.x[0]
        return slips


def compare_filters(case: tuple[float, int]) -> Array:
    """(filters, 2) mean squared error of beta and CPU us a tick, of joint and of FilterPy's, and
    the bound's mean square behind; case: the camera's delay in s, and a seed."""
    delay, seed = case
    env: Any = gym.make(CAMERA, scenario=LINEAR | MIX | {"camera_delays": (delay,)})
    log, std = run_with_bound(env, seed)
    facts = make_filter_arguments(env.unwrapped)
    joint = call_quietly(make_estimator, "joint", **facts)
    joint.run(log)  # compiled, and its memory warm
    rival = FilterPyEkf(facts["vehicle"], facts["speed"], facts["dt"])
    settled, results = log.time >= SETTLED - 1e-9, []
    runs: list[Callable[[], Array]] = [lambda: joint.run(log)["beta"], lambda: rival.run(log)]
    for run in runs:
        start = time.process_time()
        beta = run()
        us = 1e6 * (time.process_time() - start) / len(beta)
        results.append([np.mean((beta - log.truth["beta"])[settled] ** 2), us])
    return np.array([*results, [np.mean(std[settled] ** 2), np.nan]])
