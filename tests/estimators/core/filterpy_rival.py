"""FilterPy's Kalman filter on the car with gyro and camera, as its users would write it.

Late camera samples are used exactly by a rewind written by hand: everything since the capture is
held, the filter goes back, takes the sample and repeats the ticks since.
"""

import math
from collections import deque
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from sideslip.envs.record import FAST, PACKET, Array, Record
from sideslip.envs.vehicle.linear import LinearModel, make_vision_model
from sideslip.envs.vehicle.parameters import Vehicle

Q = {"beta": 2e-3, "gamma": 2e-2, "psi": 1e-6, "y_l": 1e-4}  # per second
NOISE = {"gyro_noise": 0.005, "psi_noise": 3.5e-3, "y_l_noise": 0.02}
DISTURBANCE = {"force_sd": 50.0, "moment_sd": 20.0, "disturbance_time": 0.3}
PRIOR = {"beta": 0.02, "gamma": 0.05, "psi": 0.05, "y_l": 0.3}

OURS: dict[str, dict[str, Any]] = {
    "multirate-kf": {f"q_{state}": q for state, q in Q.items()} | NOISE | {"prior": PRIOR},
    "exact-kf": NOISE | DISTURBANCE | {"prior": PRIOR},
}
"""Options that make these estimators the filters below: four states, and six."""


def four_states(vehicle: Vehicle, speed: float, dt: float) -> Any:
    """A KalmanFilter of beta, gamma, psi, y_l, inputs delta_f and N_z, measuring the gyro."""
    F, B = make_vision_model(vehicle, speed).discretise(dt)
    return _filter(F, B[:, :2], dt * np.diag(list(Q.values())), list(PRIOR.values()))


def six_states(vehicle: Vehicle, speed: float, dt: float) -> Any:
    """The same with an Ornstein-Uhlenbeck force and moment instead of process noise."""
    model, push = make_vision_model(vehicle, speed), np.zeros((4, 2))
    push[0, 0], push[1, 1] = 1.0 / (vehicle.mass * speed), 1.0 / vehicle.yaw_inertia
    F, B = model.discretise(dt)
    pushed = LinearModel(model.A, push, model.C, model.states, ("F_d", "N_d"), model.outputs)
    D = pushed.discretise(dt)[1]
    keep = math.exp(-dt / DISTURBANCE["disturbance_time"])
    sd = [DISTURBANCE["force_sd"], DISTURBANCE["moment_sd"]]
    F = np.block([[F, D], [np.zeros((2, 4)), keep * np.eye(2)]])
    fresh = (1.0 - keep * keep) * np.square(sd)
    B = np.vstack([B[:, :2], np.zeros((2, 2))])
    return _filter(F, B, np.diag([0.0, 0.0, 0.0, 0.0, *fresh]), [*PRIOR.values(), *sd])


def _filter(F: Array, B: Array, process: Array, prior: list[float]) -> Any:
    n = len(F)
    kf = KalmanFilter(dim_x=n, dim_z=1, dim_u=2)
    kf.F, kf.B, kf.Q = F, B, process
    kf.H, kf.R = np.eye(1, n, 1), np.array([[NOISE["gyro_noise"] ** 2]])
    kf.x, kf.P = np.zeros((n, 1)), np.diag(np.square(prior))
    return kf


class Rival:
    """A KalmanFilter at work on records.

    late: ticks to keep for the rewind; 0 takes every sample for a fresh one.
    """

    def __init__(self, kf: Any, vehicle: Vehicle, late: int = 0) -> None:
        self.kf, self.late = kf, late
        self.arm = vehicle.rear_track / (2.0 * vehicle.wheel_radius)  # N_z = arm (T_r - T_l)
        self.camera = np.eye(2, len(kf.F), 2)
        self.R = np.diag([NOISE["psi_noise"] ** 2, NOISE["y_l_noise"] ** 2])
        self._start = kf.x.copy(), kf.P.copy()

    def run(self, record: Record) -> Array:
        """The states at every row, (K, n), from the beginning."""
        kf = self.kf
        kf.x, kf.P = self._start[0].copy(), self._start[1].copy()
        past: deque[tuple[Array, Array, Array, float]] = deque(maxlen=self.late + 1)
        estimates = np.empty((len(record.fast), len(kf.F)))
        at, packets = 0, record.packets
        for k, row in enumerate(record.fast):
            N_z = self.arm * (row[FAST.torque_right] - row[FAST.torque_left])
            u, gyro = np.array([[row[FAST.steer]], [N_z]]), row[FAST.gyro]
            if k > 0:
                kf.predict(u)
            kf.update(gyro)
            if self.late:
                past.append((kf.x, kf.P, u, gyro))
            while at < len(packets) and packets[at, PACKET.arrived] <= k:
                self._take(packets[at], k, past)
                at += 1
            estimates[k] = kf.x[:, 0]
        return estimates

    def _take(self, packet: Array, now: int, past: "deque[Any]") -> None:
        kf = self.kf
        z = packet[PACKET.value : PACKET.value + 2, None]
        age = now - int(packet[PACKET.captured]) if self.late else 0
        if age == 0:
            kf.update(z, self.R, self.camera)
            if self.late:
                past[-1] = (kf.x, kf.P, *past[-1][2:])
            return
        first = len(past) - 1 - age
        kf.x, kf.P, *inputs = past[first]
        kf.update(z, self.R, self.camera)
        past[first] = (kf.x, kf.P, *inputs)
        for i in range(first + 1, len(past)):
            u, gyro = past[i][2:]
            kf.predict(u)
            kf.update(gyro)
            past[i] = (kf.x, kf.P, u, gyro)
