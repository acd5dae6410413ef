"""LQR by yaw moment and, where there is some, steering: of motion, adapted to tyres, in a lane."""

import copy
from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.numerics.functions import TICK
from ...envs.numerics.jit import copy_into, jit
from ...envs.numerics.packed import read, write
from ...envs.numerics.primitives import Matrix, Scalar, Vector, absolute, maximum
from ...envs.record import Array
from ...envs.task import BETA_SCALE, EFFORT_WEIGHT, GAMMA_SCALE, STEER_SCALE
from ...envs.validation import check_int
from ...envs.vehicle.linear import LinearModel, make_vision_model
from ...envs.vehicle.parameters import GRAVITY, Vehicle, VehicleSource, make_vehicle
from ...envs.vehicle.tyres import MIN_SPEED
from ..design.sampled_model import SPEEDS, DesignModel, DesignSpec, interpolate_gains, make_gains
from ..env_info import AnyEnv, get_env_facts
from .base import Controller, check_positive

# Columns of the law's inputs; beta_ref stands in for those that `Lqr` does without.
Inputs = namedtuple("Inputs", "wheel_left wheel_right torque_left torque_right steer steer_command "
                              "beta_ref gamma_ref beta_hat gamma_hat disturbance_1 disturbance_2 "
                              "front_stiffness rear_stiffness")  # fmt: skip
IN = Inputs(*range(14))
TRUE_PARAMETERS = (
    *("mass", "yaw_inertia", "front_arm", "rear_arm", "front_stiffness", "rear_stiffness"),
    *("friction", "motor_left", "motor_right"),
)  # parameters of the true car, of which the observation has true_<name>; the last are its motors
TYRES = ("front_tyres_hat", "rear_tyres_hat")  # of `joint`
INVERSE_FRICTION = "inverse_friction_hat"
_SPAN = 0.5, 1.6  # of the stiffness schedule, factors of the vehicle's
_MIN_FRICTION, _MAX_FRICTION = 0.2, 1.2  # estimates beyond count as these
_MAX_CARS = 1024  # for which the gains are kept


@jit
def make_design_state(x: Vector, share: Scalar, z: Vector) -> None:
    """Fill the states of the design model from a row of `Inputs`.

    Args:
        x: Row of `Inputs`.
        share: Yaw moment, as a fraction of full scale, per difference of motor torques (1/N m).
        z: States of the design model, shape (n,), filled.
    """
    z[0], z[1] = x[IN.beta_hat], x[IN.gamma_hat]
    z[2] = share * (x[IN.torque_right] - x[IN.torque_left])
    copy_into(x[IN.steer : IN.beta_hat], z[3:7])
    copy_into(x[IN.disturbance_1 : IN.disturbance_1 + len(z) - 7], z[7:])


@jit
def _lqr_law(
    x: Matrix, state: Matrix, action: Matrix, max_share: Vector, sliding_slip: Vector, design: Any
) -> None:
    """Compute the actions of LQR within the limits, and the next `Lqr.memory`."""
    # max_share: largest yaw moment (of full scale), sliding_slip: that of the front tyres (rad)
    table, axes, scheduled, share, authority, slew, front_arm = design
    m, n = table.shape[3], table.shape[4] - table.shape[3]
    KS, z, first = np.empty((m, n + m)), np.empty(n), m - 1
    remembers = state.shape[1] > first
    for row in range(len(x)):
        v = 0.5 * (x[row, IN.wheel_left] + x[row, IN.wheel_right])
        front = x[row, IN.front_stiffness] if scheduled else 0.0
        rear = x[row, IN.rear_stiffness] if scheduled else 0.0
        interpolate_gains(table, axes, v, front, rear, KS)
        make_design_state(x[row], share, z)
        if remembers:
            copy_into(state[row, first:], z[n - 2 :])  # N_z before, commanded N_z
            state[row, first] = z[2]
        u, w = 0.0, 0.0
        for j in range(n):
            u -= KS[0, j] * z[j]
            w -= KS[m - 1, j] * z[j]
        if m == 1:
            action[row, 0] = _clip(u, -max_share[row], max_share[row])
            if remembers:
                state[row, first + 1] = action[row, 0]
            continue
        low, high = max(state[row, 0] - slew, -authority), min(state[row, 0] + slew, authority)
        # added steering at which the front tyres have no slip angle
        straight = z[0] + front_arm * z[1] / max(v, MIN_SPEED) - z[4]
        max_w = max(straight + sliding_slip[row], 0.0)
        min_w = min(straight - sliding_slip[row], 0.0)
        low, high = _clip(min_w, low, high), _clip(max_w, low, high)
        u, w = _solve_box_qp(KS, n, u, w, max_share[row], low, high)
        action[row, 0], action[row, 1], state[row, 0] = u, w / authority, w
        if remembers:
            state[row, first + 1] = u


class Lqr(Controller):
    """u = -K(v) x for the nominal vehicle as `make_design_model` predicts it.

    x has the estimates beta_hat and gamma_hat (without the latter the gyro), the applied torques
    and steering, the driver's command, the references, and the disturbances F_d_hat, N_d_hat or
    d1_hat, d2_hat where the observation has either pair. On a Kalman filter's estimate this is LQG.
    Where the env steers, both inputs are optimal within their limits and the steering's rate, if
    none were met later. The memory is the steering last added and, where the yaw moment's rate
    costs, its fraction at the last decision and its command. Raises ValueError for an
    entry that is missing, or an option out of range.

    Args:
        env: Env of the controller.
        disturbance_time: Time in which F_d and N_d decay (s).
        vehicle: Vehicle of the design, as for `make_vehicle`; None: the env's nominal one.
        stiffness: Entries of the front and rear cornering stiffness (N/rad), to schedule gains on.
        knots: Knots of each stiffness axis, from 0.5 to 1.6 of the vehicle's; at least 2.
        steer_weight: Factor on the cost of added steering, whose rate limit the design lacks.
        grip: Grip limit, as for `Controller`; it also keeps the front tyres from sliding.
        knows_car: Whether gains and motor commands follow each row's observed `TRUE_PARAMETERS`.
    """

    min_period = 1  # ticks, of the period that the gains are designed for

    def __init__(
        self, env: AnyEnv, disturbance_time: float = 0.3, vehicle: VehicleSource | None = None,
        stiffness: Sequence[str] = (), knots: int = 7, steer_weight: float = 1.0,
        grip: float | None = None, knows_car: bool = False,
    ) -> None:  # fmt: skip
        if len(stiffness) not in (0, 2):
            raise ValueError(f"stiffness names two entries or none, got {list(stiffness)}")
        check_int("knots", knots, "knots", 2)
        names = get_env_facts(env).names
        pairs = {"forces": ("F_d_hat", "N_d_hat"), "rates": ("d1_hat", "d2_hat")}
        kind = next((kind for kind, pair in pairs.items() if set(pair) <= set(names)), "none")
        substitutes = ("beta_ref", "beta_ref")
        yaw_rate = "gamma_hat" if "gamma_hat" in names else "gyro"
        extra = *pairs.get(kind, substitutes), *(stiffness or substitutes)
        self.needs = *Inputs._fields[: IN.gamma_hat], yaw_rate, *extra
        self.needs += self._list_extra_entries(names)
        self._car_columns: slice | None = None
        self._by_car: dict[bytes, Lqr] = {}
        if knows_car:
            self._car_columns = slice(len(self.needs), len(self.needs) + len(TRUE_PARAMETERS))
            self.needs += tuple(f"true_{name}" for name in TRUE_PARAMETERS)
        super().__init__(env, grip)
        car = self.nominal if vehicle is None else make_vehicle(vehicle)
        rate = get_env_facts(env).moment_rate
        self._steer_unit = self.authority  # of the added steering that is remembered
        self.remembered = 2 if rate > 0.0 else 0  # numbers at the end of the memory
        self.memory = self.width - 1 + self.remembered
        period = max(self.control_period, self.min_period)
        time = check_positive("disturbance_time", disturbance_time)
        weight = check_positive("steer_weight", steer_weight)
        plant = period, self.full_scale, self.width == 2
        self.design_spec = DesignSpec(*plant, self._reference_kind, kind, time, weight, rate)
        factors = np.geomspace(*_SPAN, knots) if stiffness else np.zeros(0)
        nominals = car.front_stiffness, car.rear_stiffness
        self._design_gains(car, *(tuple((nominal * factors).tolist()) for nominal in nominals))

    def _design_gains(
        self, car: Vehicle, fronts: Sequence[float] = (), rears: Sequence[float] = ()
    ) -> None:
        """Design the gains for a car, on knots of the stiffnesses (N/rad) or for its own."""
        self.vehicle, self.scheduled = car, bool(fronts)
        self.share = 0.5 * car.rear_track / car.wheel_radius / self.full_scale
        speeds = SPEEDS[::2] if fronts or self._car_columns else SPEEDS  # many tables: half of it
        self.table, self._terminal = make_gains(car, self.design_spec, speeds, fronts, rears)
        self.axes = tuple(np.array(axis) for axis in (speeds, fronts or (0.0,), rears or (0.0,)))
        limits = self.authority, car.steering_rate * self.control_period * TICK, car.front_arm
        self._design = self.table, self.axes, int(self.scheduled), self.share, *limits

    def _list_extra_entries(self, names: Sequence[str]) -> tuple[str, ...]:
        """List entries of an observation that a subclass reads behind `Inputs`."""
        return ()

    def _interpolate(self, v: float, front: float = 0.0, rear: float = 0.0) -> Array:
        """Interpolate the table of [K S], (m, n + m), at stiffnesses (N/rad); 0: the vehicle's."""
        C_f, C_r = front or self.vehicle.front_stiffness, rear or self.vehicle.rear_stiffness
        KS = np.empty(self.table.shape[3:])
        interpolate_gains(self.table, self.axes, float(v), float(C_f), float(C_r), KS)
        return KS

    def curvature(self, speed: float) -> Array:
        """Compute S, shape (width, width): an action that is off by e costs e' S e more."""
        per, KS = np.array([1.0, self.authority])[: self.width], self._interpolate(speed)
        return np.asarray(KS[:, len(self.design_spec.states) :] * np.outer(per, per))

    def record_action(self, state: Array, action: npt.NDArray[np.float32]) -> None:
        """Note the added steering, from which the rate limit counts, and the moment."""
        if self.width == 2:
            state[:, 0] = action[:, 1] * self._steer_unit
        if self.remembered:
            state[:, -1] = action[:, 0]

    def _design_anew(self, car: Vehicle) -> "Lqr":
        """Make the same controller for another car."""
        other = copy.copy(self)
        other._design_gains(car)
        return other

    def _get_for_car(self, numbers: Array) -> "Lqr":
        """Get the controller for the car of some numbers, shape (len(TRUE_PARAMETERS),)."""
        key = numbers.tobytes()
        if key not in self._by_car:
            if len(self._by_car) >= _MAX_CARS:
                self._by_car.clear()
            parameters = dict(zip(TRUE_PARAMETERS[:-2], numbers.tolist(), strict=False))
            self._by_car[key] = self._design_anew(self.vehicle.replace(**parameters))
        return self._by_car[key]

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        if self._car_columns is None:
            self._compute_actions(inputs, state, action)
            return
        for i in range(len(inputs)):
            x, numbers, row = inputs[i], inputs[i, self._car_columns], slice(i, i + 1)
            if not numbers.all():  # inputs that are not finite came as zeros
                continue
            self._get_for_car(numbers)._compute_actions(inputs[row], state[row], action[row])
            left, right = numbers[-2:]
            drive = 0.5 * (x[IN.torque_left] / left + x[IN.torque_right] / right)  # N m, commanded
            uneven = self.share * (right - left) * drive
            action[i, 0] = (action[i, 0] - uneven) / (0.5 * (left + right))

    def _compute_actions(self, inputs: Array, state: Array, action: Array) -> None:
        """Compute what `_law` does with gains of one car for all rows."""
        limits = self._compute_max_moment(inputs), self._compute_sliding_slip(inputs)
        _lqr_law(inputs, state, action, *limits, self._design)

    def _compute_sliding_slip(self, inputs: Array) -> Array:
        """Compute the slip angle at which Fiala's front tyres slide, in rad, shape (N,)."""
        if self.grip is None:  # no limit
            return np.full(len(inputs), np.inf)
        car = self.vehicle
        stiffness = inputs[:, IN.front_stiffness] if self.scheduled else car.front_stiffness
        load = car.mass * GRAVITY * car.rear_arm / (2.0 * car.wheelbase)  # N, of a front tyre
        # tan(slip angle) = 3 mu F_z / C, small angles
        return np.asarray(3.0 * self._get_friction(inputs) * load / np.maximum(stiffness, 1.0))


class AdaptiveLqr(Lqr):
    """`Lqr` scheduled on the stiffness factors front_tyres_hat and rear_tyres_hat of `joint`.

    Where the observation has inverse_friction_hat, limits use that friction, within 0.2 to 1.2.

    Args:
        env: Env of the controller, with both factors in its observation.
        grip: Grip limit, as for `Controller`.
        options: Other arguments of `Lqr`.
    """

    def __init__(self, env: AnyEnv, grip: float | None = 0.7, **options: Any) -> None:
        super().__init__(env, stiffness=TYRES, grip=grip, **options)

    def _list_extra_entries(self, names: Sequence[str]) -> tuple[str, ...]:
        extra = (INVERSE_FRICTION,) if INVERSE_FRICTION in names else ()
        return (*super()._list_extra_entries(names), *extra)

    def _get_friction(self, inputs: Array) -> Array:
        if INVERSE_FRICTION not in self.needs:
            return super()._get_friction(inputs)
        estimated = inputs[:, self.needs.index(INVERSE_FRICTION)]
        return np.asarray(1.0 / np.clip(estimated, 1.0 / _MAX_FRICTION, 1.0 / _MIN_FRICTION))

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        inputs[:, IN.front_stiffness] *= self.vehicle.front_stiffness
        inputs[:, IN.rear_stiffness] *= self.vehicle.rear_stiffness
        super()._law(inputs, state, action)


@jit
def _clip(value: Scalar, low: Scalar, high: Scalar) -> Scalar:
    return min(max(value, low), high)


@jit
def _solve_box_qp(
    KS: Matrix, n: int, u: Scalar, w: Scalar, max_u: Scalar, low: Scalar, high: Scalar
) -> tuple[Scalar, Scalar]:
    """Find the point with |u| <= max_u, low <= w <= high nearest to (u, w) by S = KS[:, n:]."""
    s_uu, s_uw, s_ww = KS[0, n], KS[0, n + 1], KS[1, n + 1]
    # The distance is du^2 s_uu + 2 du dw s_uw + dw^2 s_ww, positive definite: the point is (u, w)
    # itself where it is within, else the least of the four edges' own minima.
    if absolute(u) <= max_u and low <= w <= high:
        return u, w
    best_u, best_w, best_cost = 0.0, 0.0, -1.0
    for edge in range(4):
        if edge < 2:
            a = max_u if edge == 0 else -max_u
            b = _clip(w - s_uw / s_ww * (a - u), low, high)
        else:
            b = low if edge == 2 else high
            a = _clip(u - s_uw / s_uu * (b - w), -max_u, max_u)
        du, dw = a - u, b - w
        cost = du * du * s_uu + 2.0 * du * dw * s_uw + dw * dw * s_ww
        if best_cost < 0.0 or cost < best_cost:
            best_u, best_w, best_cost = a, b, cost
    return best_u, best_w


# Lane keeping, uneven-delay's aim (docs/PAPERS.md): beta, gamma, heading and offset serve it.
# Columns of the law's inputs.
LaneInputs = namedtuple("LaneInputs", "wheel_left wheel_right torque_left torque_right steer "
                        "steer_command beta_hat gamma_hat psi_hat y_l_hat")  # fmt: skip
# States of the lane model: the inputs move the first seven, the others move by themselves. psi is
# relative to the road (rad), y the offset of the centre of gravity from the road's centre line (m),
# integral its integral (m s), N_z a fraction of full scale.
Lane = namedtuple("Lane", "beta gamma psi y N_z delta_f integral driver kappa")
# The integral of y (m s), what the curvature is computed from (low-passed gamma / V in 1/m, and
# low-passed psi in rad), and whether the episode has started (1).
LaneMemory = namedtuple("LaneMemory", "integral rate heading started")

LANE_IN, AT, LANE_LAST = LaneInputs(*range(10)), Lane(*range(9)), LaneMemory(*range(4))
LANE_MOVED = Lane._fields[: AT.driver]
_HASTE = 3.0  # weight of the steering's haste in the cost, which `_make_lane_model` explains
_CURVATURE_TIME = 0.3  # s, time constant of the curvature's filter
_OFFSET_SCALE, _INTEGRAL_SCALE = 0.1, 0.2  # m, m s


def _make_lane_model(
    vehicle: Vehicle, speed: float, period: int, full_scale: float, inputs: slice
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
    # _HASTE ((command - applied angle) / reach)^2, with the angle `reach` that the actuator's rate
    # covers in a period and a lag: without it a linear law commands too fast a steering.
    C = np.zeros((6, n))
    C[range(6), (AT.beta, AT.gamma, AT.N_z, AT.y, AT.integral, AT.delta_f)] = 1.0
    C[1, AT.kappa], C[5, AT.driver] = -speed, -1.0  # gamma - V kappa; the added steering alone
    command_error = np.zeros((1, n + 2))  # the steering command less the applied angle
    command_error[0, [AT.delta_f, AT.driver, n + 1]] = -1.0, 1.0, 1.0
    cost_outputs = np.vstack([C @ np.hstack([G, H]), command_error])
    reach = vehicle.steering_rate * (T + vehicle.steering_lag)
    scales = (BETA_SCALE, GAMMA_SCALE, 1.0, _OFFSET_SCALE, _INTEGRAL_SCALE, STEER_SCALE, reach)
    shares = (1.0, 1.0, EFFORT_WEIGHT, 1.0, 1.0, EFFORT_WEIGHT, _HASTE)
    W = T * np.diag([share / scale**2 for share, scale in zip(shares, scales, strict=True)])
    cost_matrix = cost_outputs.T @ W @ cost_outputs
    cost_matrix = 0.5 * (cost_matrix + cost_matrix.T)
    Q, R, N = cost_matrix[:n, :n], cost_matrix[n:, n:], cost_matrix[:n, n:]
    moved = len(LANE_MOVED)
    return DesignModel(G, H[:, inputs], Q, R[inputs, inputs], N[:, inputs], Lane._fields, moved)


@jit
def _lane_keeping_law(x: Matrix, state: Matrix, action: Matrix, _: Vector, design: Any) -> None:
    """Compute the actions from `LaneInputs` x and update the `LaneMemory` state."""
    table, axes, share_per_torque, preview, filter_time, dt, authority = design
    m, n = table.shape[3:]
    K, z = np.empty((m, n)), np.empty(n)
    for k in range(len(x)):
        row, last = read(x[k], LANE_IN), read(state[k], LANE_LAST)
        v = maximum(0.5 * (row.wheel_left + row.wheel_right), axes[0][0])
        gamma, psi, rate, heading = row.gamma_hat, row.psi_hat, last.rate, last.heading
        if last.started == 0.0:
            rate, heading = gamma / v, psi
        turned = psi - heading
        kappa = rate - turned / (v * filter_time)  # psi' = gamma - V kappa
        rate += (gamma / v - rate) * dt / filter_time
        heading += turned * dt / filter_time
        y = row.y_l_hat - preview * psi + 0.5 * kappa * preview * preview  # tie-vision (4)
        z[AT.beta], z[AT.gamma], z[AT.psi], z[AT.y] = row.beta_hat, gamma, psi, y
        z[AT.N_z] = share_per_torque * (row.torque_right - row.torque_left)
        z[AT.delta_f], z[AT.driver] = row.steer, row.steer_command
        z[AT.integral], z[AT.kappa] = last.integral, kappa
        interpolate_gains(table, axes, v, 0.0, 0.0, K)
        for i in range(m):  # the yaw moment, if it is used, and the steering
            for j in range(n):
                action[k, 2 - m + i] -= K[i, j] * z[j]
        action[k, 1] /= authority
        integral = last.integral
        if abs(action[k, 0]) <= 1.0 and abs(action[k, 1]) <= 1.0:  # else it would wind up
            integral += y * dt
        write(state[k], LaneMemory(integral, rate, heading, 1.0), LANE_LAST)


class LaneKeeping(Controller):
    """LQR on beta, gamma, psi, y and the integral of y, with the road's curvature fed forward.

    It reads a vision filter's beta_hat, gamma_hat, psi_hat and y_l_hat. The curvature follows from
    psi' = gamma - V kappa, filtered; the integral makes up its error. y is the offset of the centre
    of gravity: on a curve, that of the preview point is not zero for a car in its lane.
    Raises ValueError where no action steers, an entry is missing, or an option is out of range.

    Args:
        env: Env of the controller, whose action steers.
        moment: Whether to use the yaw moment beside the steering.
    """

    law = staticmethod(_lane_keeping_law)
    needs = LaneInputs._fields
    memory = len(LaneMemory._fields)

    def __init__(self, env: AnyEnv, moment: bool = True) -> None:
        super().__init__(env)
        if self.width != 2:
            raise ValueError("LaneKeeping needs an env whose action steers (steering=True)")
        speeds, inputs = SPEEDS[::2], slice(0 if moment else 1, 2)
        car, design = self.nominal, (self.control_period, self.full_scale, inputs)
        gains = [_make_lane_model(car, speed, *design).solve()[0] for speed in speeds]
        table = np.ascontiguousarray(np.array(gains)[:, None, None])
        axes, time = (np.array(speeds), np.zeros(1), np.zeros(1)), self.control_period * TICK
        share = 0.5 * car.rear_track / car.wheel_radius / self.full_scale
        filter_time = max(_CURVATURE_TIME, time)
        self._design = table, axes, share, car.preview, filter_time, time, self.authority
