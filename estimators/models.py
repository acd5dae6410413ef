"""Which states a filter has and what its sensors measure; the model at a speed, compiled.

States stand in the order of `ORDER`, as many of them as the model has. The first ones follow the
bicycle model and what it moves ("dense"), the disturbances behind them decay by themselves.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..envs.backend import jit, maximum
from ..envs.linear import bicycle_coefficients
from ..envs.record import CAMERA, GPS, SLOW_NAMES
from ..envs.vehicle import Vehicle
from .memory import CORE

Array = npt.NDArray[np.float64]

SLOWEST = 1.5  # m/s: below it the model stays that of this speed
SMOOTHING_TIME = 0.2  # s, of the measured speed
COURSE_SPEED = 60.0 / 3.6  # m/s at which the receivers' course noise is quoted


@dataclass(frozen=True)
class Model:
    """States by name and what drives the disturbances among them.

    states: "beta", "gamma", then any of "psi", "y_l" in this order. disturbances: none, "walk"
    (d_1, d_2 of dakf-stability (8)-(9), (14)) or "forces" (an Ornstein-Uhlenbeck force and moment).
    """

    states: tuple[str, ...]
    disturbances: str = "none"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all states."""
        return self.states + DISTURBANCES[self.disturbances]


DISTURBANCES = {"none": (), "walk": ("d1", "d2"), "forces": ("F_d", "N_d")}
UNITS = {
    "beta": "rad",
    "gamma": "rad/s",
    "psi": "rad",
    "y_l": "m",
    "d1": "rad/s",
    "d2": "rad/s2",
    "F_d": "N",
    "N_d": "N m",
}

BICYCLE = Model(("beta", "gamma"))
COURSE = Model(("beta", "gamma", "psi"))
VISION = Model(("beta", "gamma", "psi", "y_l"))
ROWS: dict[str, tuple[tuple[str, ...], ...]] = {
    "camera": (("psi",), ("y_l",)),
    "gps": (("beta", "psi"),),
}
"""What each slow sensor measures: sums of states, one a row."""

_ANGLES = {"camera": (1, 0), "gps": (1, 0)}
_NEEDS = {"camera": ("psi", "y_l"), "gps": ("psi",)}


def states_for(sensors: tuple[str, ...]) -> tuple[str, ...]:
    """The smallest set of states that the given slow sensors measure."""
    needed = {state for sensor in sensors for state in _NEEDS[sensor]}
    return BICYCLE.states + tuple(state for state in ("psi", "y_l") if state in needed)


def write_model(
    f: Any, model: Model, vehicle: Vehicle, step: float, noise: Mapping[str, float], Q: Array
) -> None:
    """Write everything about the model and its rows into a filter's record.

    step: s. noise: standard deviations "gyro", "psi", "y_l", "course" (at 60 km/h, growing as
    1/V) or "course_fixed" (at any speed), and of disturbances "force", "moment", "time".
    Q: (n, n), process noise per second on top of them.
    """
    names, dense = model.names, len(model.states)
    n = len(names)
    f.n = f.total = n
    f.dense = dense
    f.forces = int(model.disturbances == "forces")
    f.car[:] = [
        vehicle.mass,
        vehicle.yaw_inertia,
        vehicle.front_arm,
        vehicle.rear_arm,
        vehicle.front_stiffness,
        vehicle.rear_stiffness,
    ]
    f.preview = vehicle.preview
    f.moment_arm = vehicle.rear_track / (2.0 * vehicle.wheel_radius)
    f.step = step
    f.Q[:n, :n] = Q * step
    f.decay[:] = 1.0
    if model.disturbances == "forces":  # exact discretisation of the process
        keep = math.exp(-step / noise["time"])
        f.decay[dense:n] = keep
        f.Q[dense, dense] += (1.0 - keep * keep) * noise["force"] ** 2
        f.Q[dense + 1, dense + 1] += (1.0 - keep * keep) * noise["moment"] ** 2
    f.gyro[1] = 1.0
    f.r_gyro = noise["gyro"] ** 2
    for sensor in SLOW_NAMES:
        s = SLOW_NAMES.index(sensor)
        if f.period[s] == 0:
            continue
        f.rows[s] = len(ROWS[sensor])
        f.angle[s] = _ANGLES[sensor]
        for i, summed in enumerate(ROWS[sensor]):
            for state in summed:
                f.row[s, i, names.index(state)] = 1.0
    f.r[CAMERA] = noise["psi"] ** 2, noise["y_l"] ** 2
    fixed = noise.get("course_fixed")
    f.r[GPS, 0] = 0.0 if fixed is None else fixed**2
    f.r_course = 0.0 if fixed is not None else (noise["course"] * COURSE_SPEED) ** 2


@jit
def continuous(f: Any, V: Any) -> None:
    """A and B = [inputs, disturbances] at the speed V: tie-vision (8), dakf-stability (5)-(11)."""
    m, I, l_f, l_r, C_f, C_r = f.car[0], f.car[1], f.car[2], f.car[3], f.car[4], f.car[5]  # noqa: E741
    a11, a12, a21, a22, b11, b21, b22 = bicycle_coefficients(m, I, l_f, l_r, C_f, C_r, V)
    A, B = f.A, f.B
    for i in range(CORE):
        for j in range(CORE):
            A[i, j] = 0.0
            B[i, j] = 0.0
    A[0, 0], A[0, 1], A[1, 0], A[1, 1] = a11, a12, a21, a22
    B[0, 0], B[1, 0], B[1, 1] = b11, b21, b22
    if f.dense > 2:
        A[2, 1] = 1.0  # psi' = gamma, tie-vision (7)
    if f.dense > 3:
        A[3, 0], A[3, 1], A[3, 2] = V, f.preview, V  # tie-vision (6)
    if f.n > f.dense:
        B[0, 2] = 1.0 / (m * V) if f.forces == 1 else 1.0
        B[1, 3] = b22 if f.forces == 1 else 1.0


@jit
def _product(a: Any, b: Any, c: Any, n: int, m: int) -> None:
    """c = a b for a (n, n) and b (n, m)."""
    for i in range(n):
        for j in range(m):
            c[i, j] = 0.0
        for k in range(n):
            for j in range(m):
                c[i, j] += a[i, k] * b[k, j]


@jit
def discretise(f: Any) -> None:
    """G and H of tie-vision (9): exact for inputs and disturbances held over the step.

    Phi = integral of e^(A t) over the step by its Taylor series, after halving the step until
    ||A h|| <= 1/2 and doubling back; G = I + A Phi. Accurate to rounding (relative 1e-14).
    """
    n, m = f.dense, 2 + f.n - f.dense
    E, Phi, T = f.work[0], f.work[1], f.work[2]
    norm = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += abs(f.A[i, j])
        norm = maximum(norm, total * f.step)
    h, doublings = f.step, 0
    while norm > 0.5:
        norm *= 0.5
        h *= 0.5
        doublings += 1
    for i in range(n):
        for j in range(n):
            Phi[i, j] = 0.0
        Phi[i, i] = h
    for order in range(15, 1, -1):  # Horner: Phi = h (I + A h / 2 (I + A h / 3 (...)))
        _product(f.A, Phi, T, n, n)
        for i in range(n):
            for j in range(n):
                Phi[i, j] = T[i, j] * (h / order)
            Phi[i, i] += h
    for _ in range(doublings):  # the integral over 2 h is (I + e^(A h)) times that over h
        _product(f.A, Phi, E, n, n)
        for i in range(n):
            E[i, i] += 2.0
        _product(E, Phi, T, n, n)
        for i in range(n):
            for j in range(n):
                Phi[i, j] = T[i, j]
    _product(f.A, Phi, E, n, n)
    _product(Phi, f.B, T, n, m)
    for i in range(n):
        E[i, i] += 1.0
        for j in range(n):
            f.G[i, j] = E[i, j]
        for j in range(2):
            f.H[i, j] = T[i, j]
        for j in range(2, m):
            f.G[i, n + j - 2] = T[i, j]


@jit
def build(f: Any, speed: Any) -> None:
    """The model at a speed in m/s, and the course's variance there."""
    V = maximum(speed, SLOWEST)
    continuous(f, V)
    discretise(f)
    f.model_speed = V
    if f.r_course > 0.0:
        f.r[GPS, 0] = f.r_course / (V * V)
