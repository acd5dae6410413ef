"""The best that any estimator can do: the covariance of the optimal filter of the true model.

Defined where the plant is linear (small-angle plant, linear tyres, speed held): then no estimator
has a smaller mean squared error than the filter that knows the vehicle, the noise and the
disturbances' statistics. Deterministic wind and biases do not change it: it knows them. A vehicle
that changes on the way does, and these recursions have one vehicle: for a scenario with a
tyre_change_time they are no bound.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import Record
from ...envs.sensors.link import SlowSensor
from ...envs.ticks import TICK
from ...envs.vehicle.linear import LinearModel, vision
from ...envs.vehicle.vehicle import Vehicle
from ..design import kalman
from ..design.config import DISTURBANCE, NOISE
from ..design.measurements import COURSE_SPEED, MEASUREMENTS
from ..design.models import states_for
from ..design.schedule import whole_ticks
from ..make import make_estimator

Array = npt.NDArray[np.float64]


def bound(
    vehicle: Vehicle,
    *,
    record: Record,
    sensors: Mapping[str, SlowSensor],
    speed: float,
    dt: float = TICK,
    **options: Any,
) -> Array:
    """Standard deviation of the optimal estimate of beta at every row of a record, (K,) in rad.

    vehicle: the true one. sensors: all slow sensors that are there; the packets' captured and
    arrived ticks are those of the record. speed: held, m/s. options: those of `exact-kf` that say
    the true noise and disturbances. The start is known exactly, as it is in the environment.

    The lowest possible RMSE over a stretch of time is the root of the mean square of this.
    """
    options.setdefault("prior", dict.fromkeys(states_for(tuple(sensors)), 0.0))
    filter_ = make_estimator(
        "exact-kf",
        vehicle=vehicle,
        sensors=sensors,
        dt=dt,
        speed=speed,
        slow=list(sensors),
        **options,
    )
    return filter_.run(record).std[:, 0]


def riccati(
    vehicle: Vehicle,
    *,
    sensors: Mapping[str, SlowSensor],
    speed: float,
    dt: float = TICK,
    seconds: float = 8.0,
    **options: float,
) -> tuple[Array, tuple[str, ...]]:
    """Covariances of the optimal estimates at every tick, (ticks, n, n), and the n states' names,
    from a start that is known: a Riccati recursion in NumPy and textbook letters.

    Where delays repeat it is the bound, and has a periodic limit. The states are the bicycle's with
    the camera's, and the disturbing force and moment "F_d", "N_d". options: the standard deviations
    of `NOISE` and `DISTURBANCE` of `design.config`. Raises TypeError for others, ValueError for a
    sensor with random delay.
    """
    unknown = sorted(set(options) - set(NOISE) - set(DISTURBANCE))
    if unknown:
        raise TypeError(f"riccati has no option {', '.join(unknown)}")
    sd = NOISE | DISTURBANCE | options
    measured = [row for name in sensors for row in MEASUREMENTS[name].rows]
    for key in (f"{row.noise}_noise" for row in measured if row.over_speed):
        if key not in options:
            sd[key] *= COURSE_SPEED / speed
    F, Q, names = _disturbed(vehicle, speed, dt, sd)
    n = len(names)
    links, N = [], n
    for name, sensor in sensors.items():
        if sensor.jitter > 0.0:
            raise ValueError(f"the {name}'s delay is random: no periodic limit")
        links.append(_Link(name, sensor, dt, names, N, sd))
        N += links[-1].frames * len(links[-1].rows)
    G = np.eye(N)
    G[:n, :n] = F
    noise = np.zeros((N, N))
    noise[:n, :n] = Q
    P, gyro = np.zeros((N, N)), np.eye(1, N, 1)
    P[n - 2, n - 2], P[n - 1, n - 1] = sd["force_sd"] ** 2, sd["moment_sd"] ** 2
    x, covariances = np.zeros(N), np.zeros((round(seconds / dt), n, n))
    for k in range(len(covariances)):
        for link in links:
            L = link.latch(k - 1, N)
            P = L @ P @ L.T
        if k > 0:
            _, P = kalman.predict(x, P, G, noise)
        _, P = kalman.update(x, P, gyro, np.array([[sd["gyro_noise"] ** 2]]), np.zeros(1))
        for link in links:
            for C in link.arriving(k, N):
                _, P = kalman.update(x, P, C, link.R, np.zeros(len(C)))
        covariances[k] = P[:n, :n]
    return covariances, names


def _disturbed(
    vehicle: Vehicle, speed: float, dt: float, sd: Mapping[str, float]
) -> tuple[Array, Array, tuple[str, ...]]:
    """F, Q of the vision model with a force and a moment that are held over a tick, and names."""
    model = vision(vehicle, speed)
    push = np.zeros((4, 2))
    push[0, 0] = 1.0 / (vehicle.mass * speed)
    push[1, 1] = 1.0 / vehicle.yaw_inertia
    states = (*model.states, "F_d", "N_d")
    A, D = LinearModel(model.A, push, model.C, model.states, states[4:], ()).discrete(dt)
    keep = math.exp(-dt / sd["disturbance_time"])
    F = np.block([[A, D], [np.zeros((2, 4)), keep * np.eye(2)]])
    fresh = (1.0 - keep * keep) * np.array([sd["force_sd"], sd["moment_sd"]]) ** 2
    return F, np.diag([0.0, 0.0, 0.0, 0.0, *fresh]), states


class _Link:
    """One slow sensor on a clock: its rows, its clones and when its frames arrive."""

    def __init__(
        self,
        name: str,
        sensor: SlowSensor,
        dt: float,
        names: tuple[str, ...],
        first: int,
        sd: Mapping[str, float],
    ) -> None:
        rows = MEASUREMENTS[name].rows
        self.rows = [[names.index(state) for state in row.states] for row in rows]
        self.R = np.diag([sd[f"{row.noise}_noise"] ** 2 for row in rows])
        self.period = whole_ticks(sensor.period, dt, f"the {name}'s period")
        self.phase = whole_ticks(sensor.phase or 0.0, dt, f"the {name}'s phase")
        self.lags = [whole_ticks(d, dt, f"a delay of the {name}") for d in sensor.delays]
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
