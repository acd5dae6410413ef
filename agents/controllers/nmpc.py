"""Nonlinear model predictive control by Gauss-Newton iterations, and control adapted to tyres."""

import math
from collections import namedtuple
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics.functions import sincos
from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Scalar, Vector
from ...envs.record import Array
from ...envs.task import LAGGED, ReferenceParams, compute_reference
from ...envs.ticks import TICK
from ...envs.vehicle.dynamics import CarParams, DisturbanceForces, Motion
from ...envs.vehicle.parameters import GRAVITY, Vehicle, VehicleSource
from ...envs.vehicle.tyres import MIN_SPEED, fit_fiala
from ..design.gauss_newton import MAX_VARIABLES, update_plan
from ..design.prediction import PredictionModel, PredictionStart, PredictionTask, make_prediction
from ..design.sampled_model import interpolate_gains
from ..env_info import AnyEnv, list_plant_kinds
from .base import check_positive
from .lqr import IN, Lqr

MIN_STEP = 10  # ticks, the shortest of the prediction
_FIRST_ITERATIONS = 6  # added to the others at an episode's first decision
_MAX_SIDESLIP = 1.2  # rad: a prediction starts from this sideslip angle at most
STATUSES = ("unknown", "solved", "the observation is not finite", "diverged")
UNKNOWN, SOLVED, NOT_FINITE, DIVERGED = range(len(STATUSES))
TYRES = ("front_tyres_hat", "rear_tyres_hat")
INVERSE_FRICTION = "inverse_friction_hat"
_MIN_FRICTION, _MAX_FRICTION = 0.2, 1.2  # estimates beyond count as these

# Added steering last commanded (rad) and status; the plan's variables follow, and what
# `Lqr` remembers of the yaw moment.
Memory = namedtuple("Memory", "added_command status")
LAST = Memory(*range(2))
PLAN = len(Memory._fields)


class Design(NamedTuple):
    """The parts that all decisions of a controller share."""

    model: PredictionModel
    target: ReferenceParams  # of the nominal car
    gains: Matrix  # K of `GainTables`, (..., m, n)
    terminal: Matrix  # T of `GainTables`, (..., 4, n)
    axes: tuple[Vector, ...]  # knots of speed, front and rear stiffness
    scheduled: int  # 1: gains follow the stiffnesses of the observation
    blocks: Vector  # steps of each block
    disturbed: int  # disturbances of the observation: 0 none, 1 forces, 2 rates
    steps: float  # steps of the prediction in a control period
    iterations: int  # of a decision


def _make_blocks(steps: int, count: int) -> Array:
    """Make lengths of at most `count` blocks that grow towards the end of a horizon of steps."""
    ends = np.unique(np.rint(np.geomspace(1.0, steps, count)).astype(np.int64))
    return np.diff(ends, prepend=0)


@jit
def _replace_tyres(car: CarParams, C_f: Scalar, C_r: Scalar, mu: Scalar) -> CarParams:
    """Replace a car's stiffnesses of a tyre (N/rad) and its friction, under all wheels."""
    # C_f and C_r are the fields 4 and 5, mu of the left wheels is 10, mu_r of the right ones 19
    tyres, left, right = (C_f, C_r), (mu,), (mu,)
    return CarParams(*(car[:4] + tyres + car[6:10] + left + car[11:19] + right + car[20:]))


@jit
def _shift_plan(plan: Vector, blocks: Vector, m: int, steps: float) -> None:
    """Shift a plan by so many steps of the prediction, each block towards its next."""
    for i in range(len(plan) - m):
        plan[i] += (plan[i + m] - plan[i]) * min(1.0, steps / blocks[i // m])


@jit
def _interpolate_regulator(
    table: Matrix, axes: tuple[Vector, ...], v: Scalar, front: Scalar, rear: Scalar, per: Vector,
    remembered: int,
) -> Matrix:  # fmt: skip
    """Interpolate a table's rows, shape (rows, 9 + remembered), for the states of `prediction`."""
    # per: what turns F_d and N_d into the table's own disturbances, forces or rates
    values, padded = np.empty(table.shape[3:]), np.zeros((table.shape[3], 9 + remembered))
    interpolate_gains(table, axes, v, front, rear, values)
    n = values.shape[1] - remembered
    for i in range(len(values)):
        for j in range(n):
            padded[i, j] = values[i, j]
        for j in range(remembered):
            padded[i, 9 + j] = values[i, n + j]
        padded[i, 7] *= per[0]
        padded[i, 8] *= per[1]
    return padded


@jit
def _prepare_prediction(
    design: Design, x: Vector, friction: Scalar, roll: Vector, added_command: Scalar,
    max_moment: Scalar, before: Vector,
) -> PredictionTask:  # fmt: skip
    """Prepare the predictions of a row's decision."""
    # x: row of `lqr.Inputs`, roll: angle and rate (rad, rad/s), NaN where they are not measured,
    # added_command: the last one of added steering (rad), max_moment: fraction of full scale,
    # before: yaw moment at the last decision and its command (of full scale), or empty
    model, disturbed = design.model, design.disturbed
    v = max(0.5 * (x[IN.wheel_left] + x[IN.wheel_right]), MIN_SPEED)
    front = x[IN.front_stiffness] if design.scheduled else model.car.C_f
    rear = x[IN.rear_stiffness] if design.scheduled else model.car.C_r
    car = _replace_tyres(model.car, front, rear, friction)
    gamma, driver, refs = x[IN.gamma_hat], x[IN.steer_command], (x[IN.beta_ref], x[IN.gamma_ref])
    steady = refs
    if model.kind.reference == LAGGED:
        steady = compute_reference(driver, v, design.target, LAGGED)
    per = (car.m * v, car.I) if disturbed == 2 else (1.0, 1.0)
    F_d = x[IN.disturbance_1] * per[0] if disturbed else 0.0
    N_d = x[IN.disturbance_2] * per[1] if disturbed else 0.0
    phi, phi_rate = roll[0], roll[1]
    if phi != phi:  # not measured: as in a steady turn
        phi, phi_rate = car.S * v * gamma / (car.K_x - car.S * GRAVITY), 0.0
    rolls = float(model.kind.roll)  # 1: the car rolls
    sine, cosine = sincos(min(max(x[IN.beta_hat], -_MAX_SIDESLIP), _MAX_SIDESLIP))
    v_y = v * (x[IN.beta_hat] if model.kind.small_angle else sine / cosine)
    motion = Motion(v, v_y, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, rolls * phi, rolls * phi_rate)
    T_l, T_r, n = x[IN.torque_left], x[IN.torque_right], len(before)
    start = PredictionStart(
        car, motion, T_l, T_r, x[IN.steer], added_command, driver, (T_l + T_r) / (car.m * car.r),
        refs, steady, DisturbanceForces(F_d, N_d, 0.0), max_moment,
        before[0] if n > 0 else 0.0, before[1] if n > 0 else 0.0,
    )  # fmt: skip
    per_force = 1.0 / per[0], 1.0 / per[1]
    K = _interpolate_regulator(design.gains, design.axes, v, front, rear, per_force, n)
    terminal = _interpolate_regulator(design.terminal, design.axes, v, front, rear, per_force, n)
    return PredictionTask(model, start, K, terminal, design.blocks)


@jit
def _nmpc_law(
    x: Vector, state: Matrix, action: Matrix, max_moment: Vector, friction: Vector, rolls: Vector,
    design: Design,
) -> None:  # fmt: skip
    """Compute the actions; state: `Memory` and the plan, rolls: as in `_prepare_prediction`."""
    blocks, m = design.blocks, design.gains.shape[3]
    for row in range(len(x)):
        last_command, end = state[row, LAST.added_command], PLAN + m * len(blocks)
        task = _prepare_prediction(
            design, x[row], friction[row], rolls[row], last_command, max_moment[row],
            state[row, end:],
        )  # fmt: skip
        plan, extra_iterations = state[row, PLAN:end].copy(), _FIRST_ITERATIONS
        if state[row, LAST.status] == SOLVED:
            _shift_plan(plan, blocks, m, design.steps)
            extra_iterations = 0
        J, share, added_command = update_plan(task, plan, design.iterations + extra_iterations)
        if np.isfinite(J):
            state[row, PLAN:end], state[row, LAST.added_command] = plan, added_command
            if state.shape[1] > end:
                start = task.start
                torque_per_share = 2.0 * design.model.full_scale * start.car.r / start.car.d_r
                state[row, end] = (start.T_r - start.T_l) / torque_per_share
                state[row, end + 1] = share
            state[row, LAST.status] = SOLVED
            action[row, 0] = share
            if m > 1:
                action[row, 1] = added_command / design.model.authority
        else:
            state[row, :], action[row, :] = 0.0, math.nan
            state[row, LAST.status] = DIVERGED


class Nmpc(Lqr):
    """Real-time Gauss-Newton iterations on the env's own plant and cost, with `lqr`'s cost to go.

    The prediction has steps of a control period, or of 10 ms where that is shorter. Tyres, roll,
    motors and limits are those of the nominal car, or of the true one where the observation has
    them (`stiffness`, `true_friction`). The driver's command and acceleration are held. The plan is
    added to `lqr`'s action, within the limits of moment, `grip`, steering and its rate. Where no
    limit is met and the car is linear the action is `lqr`'s. It also reads phi_hat and phi_rate_hat
    where they are there. Where no prediction is finite the action is NaN.

    Args:
        env: Env of the controller.
        horizon: Length of the prediction (s).
        iterations: Iterations of a decision; an episode's first one has more.
        disturbance_time: Time in which F_d and N_d decay (s).
        vehicle: Vehicle of the design, as for `Lqr`.
        stiffness: Entries of front and rear cornering stiffness, as for `Lqr`.
        span: Range of the stiffness schedule, as for `Lqr`.
        knots: Knots of each stiffness axis, as for `Lqr`.
        steer_weight: Factor on the cost of added steering, as for `Lqr`.
        grip: Grip limit, as for `Controller`.
        knows_car: Whether each row's car is in the observation, as for `Lqr`.

    Raises:
        ValueError: An entry is missing, an option is out of range, or rows have different plants.
    """

    min_period = MIN_STEP
    knows_friction = True

    def __init__(
        self, env: AnyEnv, horizon: float = 0.5, iterations: int = 2, disturbance_time: float = 0.3,
        vehicle: VehicleSource | None = None, stiffness: Sequence[str] = (),
        span: tuple[float, float] = (0.5, 1.6), knots: int = 7, steer_weight: float = 10.0,
        grip: float | None = None, knows_car: bool = False,
    ) -> None:  # fmt: skip
        options = disturbance_time, vehicle, stiffness, span, knots, steer_weight, grip, knows_car
        super().__init__(env, *options)
        if isinstance(iterations, bool) or not isinstance(iterations, int) or iterations < 1:
            raise ValueError(f"iterations is a positive whole number, got {iterations!r}")
        spec = self.design_spec
        steps = max(round(check_positive("horizon", horizon) / (spec.period * TICK)), 1)
        blocks = _make_blocks(steps, MAX_VARIABLES // self.width)
        self.memory = PLAN + self.width * len(blocks) + self.remembered
        self._plant, *others = list_plant_kinds(env)
        if others:
            raise ValueError("rows of a vector env share one prediction, but their plants differ")
        disturbed = ("none", "forces", "rates").index(spec.disturbances)
        lasting = blocks, disturbed, self.control_period / spec.period, iterations
        self.design = self._make_design(*lasting)

    def _make_design(self, *lasting: Any) -> Design:
        """Make the parts of all decisions from the gains and what lasts when these change."""
        tables, target = (self.table[..., : -self.width], self._terminal), self._target
        plant = self.vehicle, self._plant, self.design_spec
        model = make_prediction(*plant, target, self.authority)
        gains, terminal = map(np.ascontiguousarray, tables)
        return Design(model, target, gains, terminal, self.axes, int(self.scheduled), *lasting)

    def _design_anew(self, car: Vehicle) -> "Nmpc":
        fitted = fit_fiala(car) if self._plant.tyres == "magic-formula" else car
        other = super()._design_anew(fitted)
        assert isinstance(other, Nmpc)
        other.design = other._make_design(*self.design[-4:])
        return other

    def _list_extra_entries(self, names: Sequence[str]) -> tuple[str, ...]:
        rolling = ("phi_hat", "phi_rate_hat")
        self._rolling = set(rolling) <= set(names)
        return rolling if self._rolling else ()

    def _mark_not_finite(self, rows: npt.NDArray[np.bool_], state: Array) -> None:
        state[rows, LAST.status] = NOT_FINITE

    def status(self, state: Array) -> list[str]:
        """List the status of each row's last decision, of `STATUSES`.

        Args:
            state: Memory, shape (N, memory).

        Returns:
            Names, one for each row.
        """
        return [STATUSES[int(code)] for code in state[:, LAST.status]]

    def _compute_actions(self, inputs: Array, state: Array, action: Array) -> None:
        rolls = np.full((len(inputs), 2), np.nan)
        if self._rolling:
            rolls = inputs[:, len(IN) : len(IN) + 2]
        limits = self._compute_max_moment(inputs), np.ascontiguousarray(self._get_friction(inputs))
        _nmpc_law(inputs, state, action, *limits, np.ascontiguousarray(rolls), self.design)


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


class AdaptiveNmpc(AdaptiveLqr, Nmpc):
    """`Nmpc` that predicts with tyres and friction of `joint`, as `AdaptiveLqr` has them."""
