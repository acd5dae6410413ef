"""Lane keeping on curved roads: motion and position together, by front steering and yaw moment.

The aim of uneven-delay: a vision filter's sideslip angle, yaw rate, heading and lateral position
serve one controller of all four.
"""

import math
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import maximum
from ...envs.task.cost import BETA_SCALE, EFFORT_WEIGHT, GAMMA_SCALE, STEER_SCALE
from ...envs.ticks import TICK
from ...envs.vehicle.linear import LinearModel, vision
from ...envs.vehicle.vehicle import Vehicle
from ..design.gain_schedule import SPEEDS, interpolated
from ..design.sampled_model import optimal
from ..env_facts import AnyEnv
from .base import Array, Controller

MOVED = ("beta", "gamma", "psi", "y", "N_z", "delta_f", "integral")
"""States that the inputs move; y is the offset of the centre of gravity from the road, in m, and
the integral its own, in m s."""
OTHERS = ("driver", "kappa")
HASTE = 3.0
OFFSET_SCALE, INTEGRAL_SCALE = 0.1, 0.2  # m, m s
MEMORY = ("integral", "rate", "heading", "started")


def lane_model(
    vehicle: Vehicle, speed: float, period: int, full_scale: float, haste: float
) -> tuple[Array, Array, Array, Array, Array]:
    """(G, H, Q, R, N) of MOVED and OTHERS over `period` ticks, as `optimal` takes them.

    Inputs: the share of the full yaw moment in N m, and rad added to the driver's steering. The
    cost rate is the env's of beta and of both inputs, with gamma against V kappa, the offset over
    0.1 m and its integral over 0.2 m s squared, and haste times the square of how far the steering
    asked for is ahead of the applied, in what its rate covers in a period and a lag: without it a
    linear law asks for what the rate cannot give. It is taken at the end of each period.
    """
    n, T = len(MOVED) + len(OTHERS), period * TICK
    plane = vision(vehicle, speed)
    lags = [max(tau, TICK) for tau in (vehicle.motor_lag, vehicle.steering_lag)]
    A, B = np.zeros((n, n)), np.zeros((n, 2))
    A[:3, :3] = plane.A[:3, :3]
    A[:3, 4], A[:3, 5], A[:3, 8] = (plane.B[:3, i] for i in (1, 0, 2))  # N_z, delta_f, kappa
    A[:3, 4] *= full_scale
    A[3, 0] = A[3, 2] = speed  # y' = V (beta + psi), tie-vision (5)
    A[4, 4], B[4, 0] = -1.0 / lags[0], 1.0 / lags[0]
    A[5, 5], A[5, 7], B[5, 1] = -1.0 / lags[1], 1.0 / lags[1], 1.0 / lags[1]
    A[6, 3] = 1.0
    G, H = LinearModel(A, B, np.eye(n), MOVED + OTHERS, (), ()).discrete(T)
    C = np.zeros((6, n))  # beta, gamma - V kappa, N_z, y, its integral, added steering
    C[0, 0] = C[1, 1] = C[2, 4] = C[3, 3] = C[4, 6] = C[5, 5] = 1.0
    C[1, 8], C[5, 7] = -speed, -1.0
    ahead = np.zeros((1, n + 2))  # of the applied steering, the one asked for
    ahead[0, 5], ahead[0, 7], ahead[0, n + 1] = -1.0, 1.0, 1.0
    judged = np.vstack([C @ np.hstack([G, H]), ahead])
    reach = vehicle.steering_rate * (T + vehicle.steering_lag)
    scales = (BETA_SCALE, GAMMA_SCALE, 1.0, OFFSET_SCALE, INTEGRAL_SCALE, STEER_SCALE, reach)
    shares = (1.0, 1.0, EFFORT_WEIGHT, 1.0, 1.0, EFFORT_WEIGHT, haste)
    W = T * np.diag([share / scale**2 for share, scale in zip(shares, scales, strict=True)])
    whole = judged.T @ W @ judged
    whole = 0.5 * (whole + whole.T)
    return G, H, whole[:n, :n], whole[n:, n:], whole[:n, n:]


@jit
def _lane_keeping_law(
    x: Any,
    state: Any,
    table: Any,
    axes: Any,
    share: float,
    preview: float,
    time: float,
    dt: float,
    authority: float,
    action: Any,
) -> None:
    """x: wheels, torques, steer, steer_command, beta, gamma, psi, y_l. state: MEMORY."""
    m, n = table.shape[3:]
    K, z = np.empty((m, n)), np.empty(n)
    for row in range(len(x)):
        v = maximum(0.5 * (x[row, 0] + x[row, 1]), axes[0][0])
        gamma, psi = x[row, 7], x[row, 8]
        if state[row, 3] == 0.0:
            state[row, 1], state[row, 2], state[row, 3] = gamma / v, psi, 1.0
        kappa = state[row, 1] - (psi - state[row, 2]) / (v * time)  # psi' = gamma - V kappa
        state[row, 1] += (gamma / v - state[row, 1]) * dt / time
        state[row, 2] += (psi - state[row, 2]) * dt / time
        y = x[row, 9] - preview * psi + 0.5 * kappa * preview * preview  # tie-vision (4)
        z[0], z[1], z[2], z[3] = x[row, 6], gamma, psi, y
        z[4], z[5], z[6] = share * (x[row, 3] - x[row, 2]), x[row, 4], state[row, 0]
        z[7], z[8] = x[row, 5], kappa
        interpolated(table, axes, v, 0.0, 0.0, K)
        free = True
        for i in range(m):
            u = 0.0
            for j in range(n):
                u -= K[i, j] * z[j]
            if i == m - 1:
                action[row, 1] = u / authority
            else:
                action[row, 0] = u
        for i in range(2):
            free = free and -1.0 <= action[row, i] <= 1.0
        if free:  # else the integral would wind up
            state[row, 0] += y * dt


class LaneKeeping(Controller):
    """LQR on beta, gamma, psi, y and the integral of y, with the road's curvature fed forward.

    It reads a vision filter's beta_hat, gamma_hat, psi_hat and y_l_hat. The curvature is what the
    yaw rate and the turning of the heading leave, psi' = gamma - V kappa, filtered over
    `curvature_time` seconds; what that lacks, the integral makes up. y is the offset of the centre
    of gravity, not of the preview point, which on a curve is never zero for a car in its lane.

    moment: also by the yaw moment, else by steering alone. haste: of `lane_model`. Memory: MEMORY.

    Raises ValueError for an env whose action does not steer, a missing entry or an option out of
    range, ModuleNotFoundError without python-control.
    """

    needs = (
        "wheel_left",
        "wheel_right",
        "torque_left",
        "torque_right",
        "steer",
        "steer_command",
        "beta_hat",
        "gamma_hat",
        "psi_hat",
        "y_l_hat",
    )
    memory = len(MEMORY)

    def __init__(
        self,
        env: AnyEnv,
        moment: bool = True,
        curvature_time: float = 0.3,
        haste: float = HASTE,
    ) -> None:
        super().__init__(env)
        if self.width != 2:
            raise ValueError("LaneKeeping needs an env whose action steers (steering=True)")
        if not 0.0 < curvature_time < math.inf:
            raise ValueError(f"curvature_time is positive, in s, got {curvature_time!r}")
        if not 0.0 <= haste < math.inf:
            raise ValueError(f"haste is zero or more, got {haste!r}")
        self.moment, self.curvature_time = bool(moment), float(curvature_time)
        speeds = SPEEDS[::2]
        inputs = slice(0 if moment else 1, 2)
        gains = []
        for speed in speeds:
            G, H, Q, R, N = lane_model(
                self.nominal, speed, self.control_period, self.full_scale, haste
            )
            gains.append(
                optimal(G, H[:, inputs], Q, R[inputs, inputs], N[:, inputs], len(MOVED))[0]
            )
        self._table = np.ascontiguousarray(np.array(gains)[:, None, None])
        self._axes = (np.array(speeds), np.zeros(1), np.zeros(1))
        self._share = 0.5 * self.nominal.rear_track / self.nominal.wheel_radius / self.full_scale

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _lane_keeping_law(
            inputs,
            state,
            self._table,
            self._axes,
            self._share,
            self.nominal.preview,
            self.curvature_time,
            self.control_period * TICK,
            self.authority,
            action,
        )
