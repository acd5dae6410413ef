"""FilterPy's unscented Kalman filter as an estimator of one's own: all that it takes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from sideslip.envs import Vehicle
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.sensors.slow import CAMERA

Array = Any


class Ukf:
    """beta, gamma, psi and y_l of the nonlinear single-track car, from gyro and camera.

    gyro (rad/s), camera (rad, m): standard deviations of the sensors. q: of the states' rates.
    """

    names = ("beta", "gamma", "psi", "y_l")

    def __init__(
        self, *, vehicle: Vehicle, sensors: Mapping[str, SlowSensor], dt: float,
        speed: float | None, gyro: float = 0.005, camera: tuple[float, float] = (3.5e-3, 0.02),
        q: tuple[float, ...] = (0.01, 0.1, 1e-3, 1e-2),
    ) -> None:  # fmt: skip
        self.car, self.dt, self.held, self.q = vehicle, dt, speed, q
        self.gyro, self.camera = np.array([[gyro**2]]), np.diag(np.square(camera))
        self.reset(sensors, 0)

    def reset(self, sensors: Mapping[str, SlowSensor], first: int) -> None:
        points = MerweScaledSigmaPoints(4, alpha=0.5, beta=2.0, kappa=0.0)
        self.ukf = UnscentedKalmanFilter(4, 1, self.dt, hx=None, fx=self.moved, points=points)
        self.ukf.P = np.diag(np.square([0.02, 0.05, 0.05, 0.3]))
        self.ukf.Q = self.dt * np.diag(np.square(self.q))
        self.tick, self.speed = first - 1, self.held or 1.0

    @property
    def x(self) -> Array:
        return self.ukf.x

    @property
    def P(self) -> Array:
        return self.ukf.P

    def step(self, rows: Array, packets: Array) -> None:
        for row in rows:
            self.tick += 1
            rolling = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
            self.speed = self.held or max(rolling, 1.0)
            arm = self.car.rear_track / (2.0 * self.car.wheel_radius)
            moment = arm * (row[FAST.torque_right] - row[FAST.torque_left])
            self.ukf.predict(steer=row[FAST.steer], moment=moment)
            self.ukf.update(row[[FAST.gyro]], self.gyro, hx=lambda x: x[[1]])
            for packet in packets[packets[:, PACKET.arrived] == self.tick]:
                if packet[PACKET.sensor] == CAMERA:
                    age = self.dt * (self.tick - packet[PACKET.captured])
                    seen = packet[PACKET.value : PACKET.value + 2]
                    self.ukf.update(seen, self.camera, hx=self.seen, age=age)

    def moved(self, x: Array, dt: float, steer: float, moment: float) -> Array:
        """The single-track model with linear tyres at the true slip angles: tie-vision (1)-(7)."""
        car, V, (beta, gamma, psi, _) = self.car, self.speed, x
        front = 2.0 * car.front_stiffness * (steer - np.arctan(beta + car.front_arm * gamma / V))
        rear = -2.0 * car.rear_stiffness * np.arctan(beta - car.rear_arm * gamma / V)
        turning = car.front_arm * front - car.rear_arm * rear + moment
        rates = [
            (front + rear) / (car.mass * V) - gamma,
            turning / car.yaw_inertia,
            gamma,
            V * beta + car.preview * gamma + V * psi,
        ]
        return x + dt * np.array(rates)

    def seen(self, x: Array, age: float) -> Array:
        """Heading and lateral offset `age` seconds ago."""
        beta, gamma, psi, y_l = x
        sideways = self.speed * (beta + psi) + self.car.preview * gamma
        return np.array([psi - age * gamma, y_l - age * sideways])
