"""LQR: the yaw moment, and steering where there is some, that minimise the env's own cost."""

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ..envs.backend import jit
from ..envs.reference import REFERENCES
from ..envs.vehicle import Vehicle
from .controller import Array, Controller
from .design_model import Purpose, design_model, regulator
from .given import AnyEnv, given

SPEEDS = tuple(np.geomspace(2.0, 60.0, 48).tolist())
"""m/s: gains are designed at these, interpolated between and held beyond."""

HASTE = 3.0

STATES = ("steer", "steer_command", "beta_ref", "gamma_ref")


@jit
def cell(axis: Any, at: Any) -> Any:
    """(i, share): where a value lies in an axis, held at its ends; (0, 0) of a single knot."""
    if len(axis) < 2:
        return 0, 0.0
    i = 0
    while i < len(axis) - 2 and at >= axis[i + 1]:
        i += 1
    share = (at - axis[i]) / (axis[i + 1] - axis[i])
    return i, min(max(share, 0.0), 1.0)


@jit
def interpolated(table: Any, axes: Any, v: Any, front: Any, rear: Any, K: Any) -> None:
    """Fill K (m, n) from a table (speeds, fronts, rears, m, n), linear along each axis."""
    i, a = cell(axes[0], v)
    j, b = cell(axes[1], front)
    k, c = cell(axes[2], rear)
    K[:] = 0.0
    for corner in range(8):
        p, q, r = corner & 1, (corner >> 1) & 1, corner >> 2
        w = (a if p else 1.0 - a) * (b if q else 1.0 - b) * (c if r else 1.0 - c)
        if w > 0.0:
            K += w * table[i + p, j + q, k + r]


@jit
def predicted_state(x: Any, share: Any, z: Any) -> None:
    """Fill z, the states of the design model, from a row of inputs, which `_lqr_law` names.

    share: what 1 N m of difference between the motors is of the full yaw moment.
    """
    n = len(z)
    z[0], z[1] = x[8], x[9]
    z[2] = share * (x[3] - x[2])
    z[3:7] = x[4:8]
    z[7:] = x[10 : 3 + n]


@jit
def _lqr_law(
    x: Any, table: Any, axes: Any, scheduled: int, share: Any, authority: Any, action: Any
) -> None:
    """x: wheels, torques, STATES, beta, gamma, disturbances, then stiffnesses if scheduled."""
    m, n = table.shape[3:]
    K, z = np.empty((m, n)), np.empty(n)
    for row in range(len(x)):
        v = 0.5 * (x[row, 0] + x[row, 1])
        front = x[row, 1 + n + 2] if scheduled else 0.0
        rear = x[row, 1 + n + 3] if scheduled else 0.0
        interpolated(table, axes, v, front, rear, K)
        predicted_state(x[row], share, z)
        for i in range(m):
            u = 0.0
            for j in range(n):
                u -= K[i, j] * z[j]
            action[row, i] = u if i == 0 else u / authority


@lru_cache(maxsize=16)
def gain_table(
    vehicle: Vehicle,
    purpose: Purpose,
    speeds: Sequence[float],
    fronts: Sequence[float],
    rears: Sequence[float],
) -> Array:
    """K on a grid, (speeds, fronts, rears, m, n); stiffnesses in N/rad, none: the vehicle's."""
    shape = len(speeds), max(len(fronts), 1), max(len(rears), 1)
    gains = []
    for speed, front, rear in itertools.product(
        speeds,
        fronts or (vehicle.front_stiffness,),
        rears or (vehicle.rear_stiffness,),
    ):
        car = vehicle.replace(front_stiffness=front, rear_stiffness=rear)
        gains.append(regulator(design_model(car, speed, purpose)))
    table = np.array(gains)
    return np.ascontiguousarray(table.reshape(*shape, *table.shape[1:]))


class Lqr(Controller):
    """u = -K(v) x for the nominal vehicle as `design_model` predicts it.

    x: the estimates beta_hat and gamma_hat (without the latter the gyro), the applied torques and
    steering, the driver's command, the references, and the disturbances F_d_hat, N_d_hat or
    d1_hat, d2_hat where the observation has either pair. On a Kalman filter's estimate this is
    LQG.

    disturbance_time: s, in which F_d and N_d decay. vehicle: designed for this instead of the
    env's nominal. stiffness: two entries of the observation with the front and the rear cornering
    stiffness, on which the gains are then scheduled too, within `span` times the vehicle's, on
    `knots` knots each; the table is designed once. haste: of `Purpose`, where the env steers.

    Raises ValueError for a missing entry or an option out of range, ModuleNotFoundError without
    python-control.
    """

    def __init__(
        self,
        env: AnyEnv,
        disturbance_time: float = 0.3,
        vehicle: Vehicle | None = None,
        stiffness: Sequence[str] = (),
        span: tuple[float, float] = (0.5, 1.6),
        knots: int = 7,
        haste: float = HASTE,
    ) -> None:
        if not 0.0 < disturbance_time < math.inf:
            raise ValueError(f"disturbance_time is positive, in s, got {disturbance_time!r}")
        if len(stiffness) not in (0, 2):
            raise ValueError(f"stiffness names two entries or none, got {list(stiffness)}")
        if not (0.0 < span[0] < span[1] < math.inf and knots >= 2):
            raise ValueError(f"span rises from above zero, with 2 knots or more: {span}, {knots}")
        if not 0.0 <= haste < math.inf:
            raise ValueError(f"haste is zero or more, got {haste!r}")
        names = {entry.name for entry in given(env).layout}
        pairs = {"forces": ("F_d_hat", "N_d_hat"), "rates": ("d1_hat", "d2_hat")}
        kind = next((kind for kind, pair in pairs.items() if names.issuperset(pair)), "none")
        self.needs = (
            *("wheel_left", "wheel_right", "torque_left", "torque_right"),
            *STATES,
            *("beta_hat", "gamma_hat" if "gamma_hat" in names else "gyro"),
            *pairs.get(kind, ()),
            *stiffness,
        )
        super().__init__(env)
        car = self.nominal if vehicle is None else vehicle
        self.purpose = Purpose(
            self.control_period,
            self.full_scale,
            self.width == 2,
            REFERENCES.index(self.reference),
            kind,
            float(disturbance_time),
            float(haste),
        )
        fronts, rears = (
            tuple((own * np.geomspace(*span, knots)).tolist()) if stiffness else ()
            for own in (car.front_stiffness, car.rear_stiffness)
        )
        self.share = 0.5 * car.rear_track / car.wheel_radius / self.full_scale
        self.vehicle, self.scheduled = car, len(stiffness) == 2
        speeds = SPEEDS[::2] if stiffness else SPEEDS
        self.table = gain_table(car, self.purpose, speeds, fronts, rears)
        self.axes = tuple(np.array(axis) for axis in (speeds, fronts or (0.0,), rears or (0.0,)))

    def gains(self, speed: float, front: float = 0.0, rear: float = 0.0) -> Array:
        """K (m, n) at a speed in m/s, and at stiffnesses in N/rad where it is scheduled on them."""
        K = np.empty(self.table.shape[3:])
        interpolated(self.table, self.axes, float(speed), float(front), float(rear), K)
        return K

    def _law(self, inputs: Array, state: Array, action: npt.NDArray[np.float64]) -> None:
        _lqr_law(
            inputs, self.table, self.axes, int(self.scheduled), self.share, self.authority, action
        )
