"""Lane keeping on curved roads: motion and position together, by front steering and yaw moment.

Uneven-delay's aim (docs/PAPERS.md): sideslip angle, yaw rate, heading and offset serve it.
"""

from collections import namedtuple
from typing import Any

import numpy as np

from ...envs.numerics.functions import TICK
from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, maximum
from ...envs.record import Array
from ...envs.task import BETA_SCALE, EFFORT_WEIGHT, GAMMA_SCALE, STEER_SCALE
from ...envs.vehicle.linear import LinearModel, make_vision_model
from ...envs.vehicle.parameters import Vehicle
from ..design.sampled_model import SPEEDS, DesignModel, interpolate_gains
from ..env_info import AnyEnv
from .base import Controller, check_positive

# Columns of the law's inputs.
Inputs = namedtuple("Inputs", "wheel_left wheel_right torque_left torque_right steer steer_command "
                              "beta_hat gamma_hat psi_hat y_l_hat")  # fmt: skip
# States of the lane model: the inputs move the first seven, the others move by themselves. psi is
# relative to the road (rad), y the offset of the centre of gravity from the road's centre line (m),
# integral its integral (m s), N_z a fraction of full scale.
Lane = namedtuple("Lane", "beta gamma psi y N_z delta_f integral driver kappa")
# The integral of y (m s), what the curvature is computed from (low-passed gamma / V in 1/m, and
# low-passed psi in rad), and whether the episode has started (1).
Memory = namedtuple("Memory", "integral rate heading started")

IN, AT, LAST = Inputs(*range(10)), Lane(*range(9)), Memory(*range(4))
MOVED = Lane._fields[: AT.driver]
HASTE = 3.0  # weight of the steering's haste in the cost, which `_make_lane_model` explains
_OFFSET_SCALE, _INTEGRAL_SCALE = 0.1, 0.2  # m, m s


def _make_lane_model(
    vehicle: Vehicle, speed: float, period: int, full_scale: float, haste: float, inputs: slice
) -> DesignModel:
    """Make the model of `Lane` over a period (ticks) and its cost, for some of the two inputs."""
    # Inputs are the fraction of the full yaw moment (N m), and rad added to the driver's steering.
    n, T = len(AT), period * TICK
    plane = make_vision_model(vehicle, speed)
    lags = [max(tau, TICK) for tau in (vehicle.motor_lag, vehicle.steering_lag)]
    A, B = np.zeros((n, n)), np.zeros((n, 2))
    A[:3, :3] = plane.A[:3, :3]
    for state, column in ((AT.N_z, 1), (AT.delta_f, 0), (AT.kappa, 2)):
        A[:3, state] = plane.B[:3, column]
    A[:3, AT.N_z] *= full_scale
    A[AT.y, AT.beta] = A[AT.y, AT.psi] = speed  # y' = V (beta + psi), tie-vision (5)
    for i, (state, lag) in enumerate(zip((AT.N_z, AT.delta_f), lags, strict=True)):
        A[state, state], B[state, i] = -1.0 / lag, 1.0 / lag
    A[AT.delta_f, AT.driver] = 1.0 / lags[1]
    A[AT.integral, AT.y] = 1.0
    G, H = LinearModel(A, B, np.eye(n), Lane._fields, (), ()).discretise(T)
    # The cost at a period's end is the env's of beta and both inputs, with gamma against V kappa,
    # and the squares of the offset over 0.1 m and of its integral over 0.2 m s. The last term is
    # haste ((command - applied angle) / reach)^2, with the angle `reach` that the actuator's rate
    # covers in a period and a lag: without it a linear law commands too fast a steering.
    C = np.zeros((6, n))
    C[range(6), (AT.beta, AT.gamma, AT.N_z, AT.y, AT.integral, AT.delta_f)] = 1.0
    C[1, AT.kappa], C[5, AT.driver] = -speed, -1.0  # gamma - V kappa; the added steering alone
    command_error = np.zeros((1, n + 2))  # the steering command less the applied angle
    command_error[0, [AT.delta_f, AT.driver, n + 1]] = -1.0, 1.0, 1.0
    cost_outputs = np.vstack([C @ np.hstack([G, H]), command_error])
    reach = vehicle.steering_rate * (T + vehicle.steering_lag)
    scales = (BETA_SCALE, GAMMA_SCALE, 1.0, _OFFSET_SCALE, _INTEGRAL_SCALE, STEER_SCALE, reach)
    shares = (1.0, 1.0, EFFORT_WEIGHT, 1.0, 1.0, EFFORT_WEIGHT, haste)
    W = T * np.diag([share / scale**2 for share, scale in zip(shares, scales, strict=True)])
    cost_matrix = cost_outputs.T @ W @ cost_outputs
    cost_matrix = 0.5 * (cost_matrix + cost_matrix.T)
    Q, R, N = cost_matrix[:n, :n], cost_matrix[n:, n:], cost_matrix[:n, n:]
    moved = len(MOVED)
    return DesignModel(G, H[:, inputs], Q, R[inputs, inputs], N[:, inputs], Lane._fields, moved)


@jit
def _lane_keeping_law(x: Matrix, state: Matrix, action: Matrix, design: tuple[Any, ...]) -> None:
    """Compute the actions from `Inputs` x and update the `Memory` state."""
    table, axes, share_per_torque, preview, filter_time, dt, authority = design
    m, n = table.shape[3:]
    K, z = np.empty((m, n)), np.empty(n)
    for row in range(len(x)):
        v = maximum(0.5 * (x[row, IN.wheel_left] + x[row, IN.wheel_right]), axes[0][0])
        gamma, psi = x[row, IN.gamma_hat], x[row, IN.psi_hat]
        if state[row, LAST.started] == 0.0:
            state[row, LAST.rate], state[row, LAST.heading] = gamma / v, psi
            state[row, LAST.started] = 1.0
        turned = psi - state[row, LAST.heading]
        kappa = state[row, LAST.rate] - turned / (v * filter_time)  # psi' = gamma - V kappa
        state[row, LAST.rate] += (gamma / v - state[row, LAST.rate]) * dt / filter_time
        state[row, LAST.heading] += turned * dt / filter_time
        y = x[row, IN.y_l_hat] - preview * psi + 0.5 * kappa * preview * preview  # tie-vision (4)
        z[AT.beta], z[AT.gamma], z[AT.psi], z[AT.y] = x[row, IN.beta_hat], gamma, psi, y
        z[AT.N_z] = share_per_torque * (x[row, IN.torque_right] - x[row, IN.torque_left])
        z[AT.delta_f], z[AT.driver] = x[row, IN.steer], x[row, IN.steer_command]
        z[AT.integral], z[AT.kappa] = state[row, LAST.integral], kappa
        interpolate_gains(table, axes, v, 0.0, 0.0, K)
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
            state[row, LAST.integral] += y * dt


class LaneKeeping(Controller):
    """LQR on beta, gamma, psi, y and the integral of y, with the road's curvature fed forward.

    It reads a vision filter's beta_hat, gamma_hat, psi_hat and y_l_hat. The curvature follows from
    psi' = gamma - V kappa, filtered; the integral makes up its error. y is the offset of the centre
    of gravity: on a curve, that of the preview point is not zero for a car in its lane.
    Raises ValueError where no action steers, an entry is missing, or an option is out of range.

    Args:
        env: Env of the controller, whose action steers.
        moment: Whether to use the yaw moment beside the steering.
        curvature_time: Time constant of the curvature's filter (s), of a control period at least.
        haste: Weight of the steering command less the applied angle, as for `HASTE`.
    """

    needs = Inputs._fields
    memory = len(Memory._fields)

    def __init__(
        self, env: AnyEnv, moment: bool = True, curvature_time: float = 0.3, haste: float = HASTE
    ) -> None:
        super().__init__(env)
        if self.width != 2:
            raise ValueError("LaneKeeping needs an env whose action steers (steering=True)")
        haste = check_positive("haste", haste, allow_zero=True)
        speeds, inputs = SPEEDS[::2], slice(0 if moment else 1, 2)
        design, car = (self.control_period, self.full_scale, haste, inputs), self.nominal
        gains = [_make_lane_model(car, speed, *design).solve()[0] for speed in speeds]
        table = np.ascontiguousarray(np.array(gains)[:, None, None])
        axes, time = (np.array(speeds), np.zeros(1), np.zeros(1)), self.control_period * TICK
        share = 0.5 * car.rear_track / car.wheel_radius / self.full_scale
        filter_time = max(check_positive("curvature_time", curvature_time), time)
        self._design = table, axes, share, car.preview, filter_time, time, self.authority

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _lane_keeping_law(inputs, state, action, self._design)
