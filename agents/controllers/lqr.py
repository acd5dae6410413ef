"""LQR: yaw moment, and steering where there is some, of least cost; also adapted to the tyres."""

import copy
import math
from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.numerics.functions import TICK
from ...envs.numerics.jit import copy_into, jit
from ...envs.numerics.primitives import Matrix, Scalar, Vector, absolute
from ...envs.record import Array
from ...envs.vehicle.parameters import GRAVITY, Vehicle, VehicleSource, make_vehicle
from ...envs.vehicle.tyres import MIN_SPEED
from ..design.sampled_model import SPEEDS, DesignSpec, interpolate_gains, make_gain_table
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
        span: Range of the stiffness schedule, as factors of the vehicle's.
        knots: Knots of each stiffness axis; the table is designed once.
        steer_weight: Factor on the cost of added steering, whose rate limit the design lacks.
        grip: Grip limit, as for `Controller`; it also keeps the front tyres from sliding.
        knows_car: Whether gains and motor commands follow each row's observed `TRUE_PARAMETERS`.
    """

    min_period = 1  # ticks, of the period that the gains are designed for

    def __init__(
        self, env: AnyEnv, disturbance_time: float = 0.3, vehicle: VehicleSource | None = None,
        stiffness: Sequence[str] = (), span: tuple[float, float] = (0.5, 1.6), knots: int = 7,
        steer_weight: float = 1.0, grip: float | None = None, knows_car: bool = False,
    ) -> None:  # fmt: skip
        if len(stiffness) not in (0, 2):
            raise ValueError(f"stiffness names two entries or none, got {list(stiffness)}")
        if not (0.0 < span[0] < span[1] < math.inf and knots >= 2):
            raise ValueError(f"span rises from above zero, with 2 knots or more: {span}, {knots}")
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
        factors = np.geomspace(*span, knots) if stiffness else np.zeros(0)
        nominals = car.front_stiffness, car.rear_stiffness
        self._design_gains(car, *(tuple((nominal * factors).tolist()) for nominal in nominals))

    def _design_gains(
        self, car: Vehicle, fronts: Sequence[float] = (), rears: Sequence[float] = ()
    ) -> None:
        """Design the gains for a car, on knots of the stiffnesses (N/rad) or for its own."""
        self.vehicle, self.scheduled = car, bool(fronts)
        self.share = 0.5 * car.rear_track / car.wheel_radius / self.full_scale
        speeds = SPEEDS[::2] if fronts or self._car_columns else SPEEDS  # many tables: half of it
        self.table, self._terminal = make_gain_table(car, self.design_spec, speeds, fronts, rears)
        self.axes = tuple(np.array(axis) for axis in (speeds, fronts or (0.0,), rears or (0.0,)))
        slew = car.steering_rate * self.control_period * TICK
        limits = self.authority, slew, car.front_arm
        self._design = self.table, self.axes, int(self.scheduled), self.share, *limits

    def _list_extra_entries(self, names: Sequence[str]) -> tuple[str, ...]:
        """List entries of an observation that a subclass reads behind `Inputs`."""
        return ()

    def gains(self, speed: float, front: float | None = None, rear: float | None = None) -> Array:
        """Compute the gains K on the states of the design, shape (m, n).

        Args:
            speed: Speed (m/s).
            front: Front cornering stiffness of a tyre (N/rad) for scheduled gains; None: the car's.
            rear: Rear cornering stiffness of a tyre (N/rad), likewise.
        """
        stiffness = front or self.vehicle.front_stiffness, rear or self.vehicle.rear_stiffness
        return self._interpolate(speed, *stiffness)[:, : len(self.design_spec.states)]

    def _interpolate(self, speed: float, front: float, rear: float) -> Array:
        """Interpolate the table of [K S], shape (m, n + m)."""
        KS = np.empty(self.table.shape[3:])
        interpolate_gains(self.table, self.axes, float(speed), float(front), float(rear), KS)
        return KS

    def curvature(self, speed: float) -> Array:
        """Compute S, shape (width, width): an action that is off by e costs e' S e more.

        Args:
            speed: Speed (m/s).
        """
        car, per = self.vehicle, np.array([1.0, self.authority])[: self.width]
        KS = self._interpolate(speed, car.front_stiffness, car.rear_stiffness)
        return np.asarray(KS[:, len(self.design_spec.states) :] * np.outer(per, per))

    def record_action(self, state: Array, action: npt.NDArray[np.float32]) -> None:
        """Note the added steering, from which the rate limit counts, and the moment.

        Args:
            state: Memory, shape (N, memory), updated.
            action: Action that the env gets, shape (N, width).
        """
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
