"""The bound again, slowly: a Riccati recursion in NumPy and textbook letters, clones included."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from sideslip.envs.numerics.functions import TICK
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.vehicle.linear import LinearModel, make_vision_model
from sideslip.envs.vehicle.parameters import Vehicle
from sideslip.estimators.design.gains import joseph_form, kalman_gain
from sideslip.estimators.design.options import NOISE, OPTIONS
from tests.estimators.dense import MEASURED

Array = npt.NDArray[np.float64]
DISTURBANCE: dict[str, Any] = {
    key: OPTIONS[key].default for key in ("force_sd", "moment_sd", "disturbance_time")
}
NOISES = {"camera": ("psi_noise", "y_l_noise"), "gps": ("course_noise",)}


def riccati(
    vehicle: Vehicle, *, sensors: Mapping[str, SlowSensor], speed: float, dt: float = TICK,
    seconds: float = 8.0, **options: float,
) -> tuple[Array, tuple[str, ...]]:  # fmt: skip
    """Covariances of the optimal estimates at every tick, (ticks, n, n), and the n states' names,
    from a start that is known. Delays repeat.

    The states: the bicycle's with the camera's, and the disturbing force and moment "F_d", "N_d".
    options: standard deviations of `NOISE` and `DISTURBANCE`.
    """
    assert set(options) <= set(NOISE) | set(DISTURBANCE)
    sd = NOISE | DISTURBANCE | {"course_noise": math.radians(0.14) * 60.0 / 3.6 / speed} | options
    F, Q, names = _disturbed(vehicle, speed, dt, sd)
    n = len(names)
    links, N = [], n
    for name, sensor in sensors.items():
        assert sensor.jitter == 0.0
        links.append(_Link(name, sensor, dt, names, N, sd))
        N += links[-1].frames * len(links[-1].rows)
    G = np.eye(N)
    G[:n, :n] = F
    noise = np.zeros((N, N))
    noise[:n, :n] = Q
    P, gyro = np.zeros((N, N)), np.eye(1, N, 1)
    P[n - 2, n - 2], P[n - 1, n - 1] = sd["force_sd"] ** 2, sd["moment_sd"] ** 2
    covariances = np.zeros((round(seconds / dt), n, n))
    for k in range(len(covariances)):
        for link in links:
            L = link.latch(k - 1, N)
            P = L @ P @ L.T
        if k > 0:
            P = G @ P @ G.T + noise
        P = updated(P, gyro, np.array([[sd["gyro_noise"] ** 2]]))
        for link in links:
            for C in link.arriving(k, N):
                P = updated(P, C, link.R)
        covariances[k] = P[:n, :n]
    return covariances, names


def updated(P: Array, C: Array, R: Array) -> Array:
    """The covariance after a measurement y = C x + v, by Joseph's form."""
    return joseph_form(P, kalman_gain(P, C, R), C, R)


def _disturbed(
    vehicle: Vehicle, speed: float, dt: float, sd: Mapping[str, float]
) -> tuple[Array, Array, tuple[str, ...]]:
    """F, Q of the vision model with a force and a moment that are held over a tick, and names."""
    model = make_vision_model(vehicle, speed)
    push = np.zeros((4, 2))
    push[0, 0] = 1.0 / (vehicle.mass * speed)
    push[1, 1] = 1.0 / vehicle.yaw_inertia
    states = (*model.states, "F_d", "N_d")
    A, D = LinearModel(model.A, push, model.C, model.states, states[4:], ()).discretise(dt)
    keep = math.exp(-dt / sd["disturbance_time"])
    F = np.block([[A, D], [np.zeros((2, 4)), keep * np.eye(2)]])
    fresh = (1.0 - keep * keep) * np.array([sd["force_sd"], sd["moment_sd"]]) ** 2
    return F, np.diag([0.0, 0.0, 0.0, 0.0, *fresh]), states


class _Link:
    """One slow sensor on a clock: its rows, its clones and when its frames arrive."""

    def __init__(
        self, name: str, sensor: SlowSensor, dt: float, names: tuple[str, ...], first: int,
        sd: Mapping[str, float],
    ) -> None:  # fmt: skip
        self.rows = [[names.index(state) for state in row] for row in MEASURED[name]]
        self.R = np.diag([sd[key] ** 2 for key in NOISES[name]])
        self.period, self.phase = round(sensor.period / dt), round((sensor.phase or 0.0) / dt)
        self.lags = [round(delay / dt) for delay in sensor.delays]
        self.frames, self.first = math.ceil(max(self.lags) / self.period), first

    def _clones(self, frame: int) -> range:
        start = self.first + frame % self.frames * len(self.rows)
        return range(start, start + len(self.rows))

    def latch(self, k: int, N: int) -> Array:
        """What happens to the clones in the step after tick k, (N, N)."""
        L = np.eye(N)
        frame, rest = divmod(k - self.phase, self.period)
        if k >= self.phase and rest == 0 and self.frames > 0:
            for clone, row in zip(self._clones(frame), self.rows, strict=True):
                L[clone] = 0.0
                L[clone, row] = 1.0
        return L

    def arriving(self, k: int, N: int) -> list[Array]:
        """C (p, N) of each frame that arrives at tick k."""
        found = []
        for i, lag in enumerate(self.lags):
            frame, rest = divmod(k - lag - self.phase, self.period)
            if frame < 0 or rest != 0 or frame % len(self.lags) != i:
                continue
            C = np.zeros((len(self.rows), N))
            for row, states in enumerate(self.rows):
                C[row, states if lag == 0 else [self._clones(frame)[row]]] = 1.0
            found.append(C)
        return found
