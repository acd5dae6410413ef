"""Predictions of nonlinear predictive control: the plant's own source, many plans at once.

A plan, constant in blocks of steps, is added to the linear regulator's action, and the sum limited
as the plant limits it. So the plan of zeros is the regulator itself, optimal where the car is
linear and no limit is met. As many plans as a SIMD value has lanes are simulated at once.

The regulator's states, the columns of K and T, are beta, gamma, yaw moment (of full scale),
delta_f, driver's angle, beta_ref, gamma_ref, F_d, N_d and, where its rate costs, `_REMEMBERED`.
"""

import math
from typing import NamedTuple

import numpy as np

from ...envs.engine.config import make_car
from ...envs.engine.layout import StepVariant
from ...envs.engine.tick import compute_lagged_load
from ...envs.numerics.functions import TICK
from ...envs.numerics.jit import inline, noinline
from ...envs.numerics.packed import load_element, store_element
from ...envs.numerics.primitives import Matrix, Scalar, Vector, maximum, minimum, select
from ...envs.task import (
    BETA_SCALE,
    EFFORT_WEIGHT,
    GAMMA_SCALE,
    LAGGED,
    RATE_TICKS,
    STEER_SCALE,
    ZERO_SLIP,
    ReferenceParams,
)  # fmt: skip
from ...envs.vehicle.actuators import (
    Lag,
    allocate_torques,
    apply_lag,
    compute_torque_limit,
    limit_angle,
    limit_rate,
    make_lag,
)
from ...envs.vehicle.dynamics import (
    CarParams,
    DisturbanceForces,
    Motion,
    RoadParams,
    compute_sideslip_angle,
    rk4,
)
from ...envs.vehicle.parameters import Vehicle
from ...envs.vehicle.tyres import FIALA, MAGIC_FORMULA, TYRE_LAWS
from ..env_info import PlantKind
from .sampled_model import DesignSpec


class PredictionModel(NamedTuple):
    """The numbers that all predictions share."""

    car: CarParams  # the nominal one
    road: RoadParams  # straight and flat
    kind: StepVariant
    motor: Lag  # lag of the motors over a step
    steering: Lag  # lag of the steering over a step
    motor_rest: tuple[float, float]  # mean and std of the motors' remaining fraction in a step
    steering_rest: tuple[float, float]  # mean and std of the steering's remaining fraction
    step: float  # s
    full_scale: float  # N m
    authority: float  # rad
    slew: float  # rad a step
    stop: float  # rad
    yaw_first: float  # 1: the yaw moment comes before the drive torque
    decay: float  # fraction of the disturbances that a step leaves
    ref_decay: float  # fraction of a lagged reference's deviation that a step leaves
    per_beta: float  # square root of the cost's weight of beta (1/rad)
    per_gamma: float  # of gamma (s/rad)
    per_share: float  # of the yaw moment's fraction
    per_steer: float  # of added steering (1/rad)
    per_change: float  # of the yaw moment's change since the step before, over that of the moment


class PredictionState(NamedTuple):
    """A prediction's state between steps."""

    motion: Motion
    T_l: Scalar  # torque of the left motor (N m)
    T_r: Scalar  # torque of the right motor (N m)
    delta_f: Scalar  # applied steering angle (rad)
    added_command: Scalar  # added steering that was last commanded (rad)
    beta_ref: Scalar  # reference of the sideslip angle (rad)
    gamma_ref: Scalar  # reference of the yaw rate (rad/s)
    F_d: Scalar  # disturbance force (N)
    N_d: Scalar  # disturbance moment (N m)
    share_before: Scalar  # yaw moment a step ago, as a fraction of full scale
    command_before: Scalar  # its command from then on, likewise


class PredictionTask(NamedTuple):
    """All that the plans of a decision are simulated from."""

    model: PredictionModel
    start: PredictionState
    car: CarParams
    driver: Scalar  # driver's steering angle, held (rad)
    a_x: Scalar  # acceleration, held (m/s^2)
    steady: tuple[Scalar, Scalar]  # values that a lagged reference approaches
    max_moment: Scalar  # largest yaw moment as a fraction of full scale
    K: Matrix  # gains of the regulator on its states, (m, 9), or (m, 11) where the rate costs
    terminal: Matrix  # T of the terminal cost |T x|^2, (4, 9) or (6, 11)
    blocks: Vector  # steps of each block


class PlanBatch(NamedTuple):
    """Plans side by side and their results, one column for each."""

    plans: Matrix  # fractions of moment and, where the car steers, authority; (variables, count)
    perturbations: Matrix  # added to commands behind their limits, for differences; likewise
    limits: Matrix  # 1 or -1 where a block starts at a limit, (variables, count)
    residuals: Matrix  # their squares sum to J and the terminal cost, (residuals, count)
    first: Matrix  # first yaw moment (of full scale) and added steering (rad), (2, count)


def _compute_lag_moments(time_constant: float, ticks: int) -> tuple[float, float]:
    """Compute mean and standard deviation, over a step's ticks, of a lag's remaining part rho."""
    # the mean square of command + deviation rho is (command + deviation mean)^2 + (deviation std)^2
    tick = make_lag(time_constant, TICK)
    rho = tick.mean * tick.end ** np.arange(ticks)
    return float(rho.mean()), float(rho.std())


def make_prediction(
    vehicle: Vehicle, plant: PlantKind, spec: DesignSpec, target: ReferenceParams, authority: float
) -> PredictionModel:
    """Make the model of a car in a design's periods, with its cost.

    Args:
        vehicle: Vehicle of the predictions.
        plant: Kind of the plant.
        spec: Parameters of the design.
        target: Parameters of the reference.
        authority: Added steering at an action of 1 (rad).
    """
    law, small, roll = TYRE_LAWS.index(plant.tyres), int(plant.small_angle), int(plant.roll)
    law = FIALA if law == MAGIC_FORMULA else law  # plans know no relaxation: see `fit_fiala`
    kind = StepVariant(small, law, spec.kind, roll, has_driver=0, lag=2, road=0, has_errors=0)
    ticks, step = spec.period, spec.period * TICK
    disturbance_time = spec.disturbance_time if spec.disturbances == "forces" else math.inf
    motor, steering = (vehicle.motor_lag, vehicle.steering_lag) if plant.lags else (0.0, 0.0)
    return PredictionModel(
        make_car(vehicle), RoadParams(0.0, 0.0, 1.0), kind,
        make_lag(motor, step), make_lag(steering, step),
        _compute_lag_moments(motor, ticks), _compute_lag_moments(steering, ticks),
        step, spec.full_scale, authority,
        vehicle.steering_rate * step, vehicle.steering_stop, float(plant.yaw_first),
        math.exp(-step / disturbance_time),
        target.rest**ticks if spec.kind == LAGGED else 1.0,
        1.0 / BETA_SCALE,
        0.0 if kind.reference == ZERO_SLIP else 1.0 / GAMMA_SCALE,
        math.sqrt(EFFORT_WEIGHT),
        math.sqrt(spec.steer_weight * EFFORT_WEIGHT) / STEER_SCALE,
        math.sqrt(spec.moment_rate / (step * RATE_TICKS * TICK * EFFORT_WEIGHT)),
    )  # fmt: skip


# Residuals of a step: errors of sideslip angle and yaw rate, then of the yaw moment and of added
# steering the mean over the step and the standard deviation within it. Where the moment's rate
# costs, two more have those of the moment's change since the step before.
N_RESIDUALS = 6
N_TERMINAL = 4  # residuals behind the last step, of what is to come


@inline
def _clip_symmetric(value: Scalar, limit: Scalar) -> Scalar:
    """Clip a value to +-limit."""
    return minimum(maximum(value, 0.0 - limit), limit)


@inline
def _detect_limit(value: Scalar, low: Scalar, high: Scalar) -> Scalar:
    """Detect a limit: 1 or -1 where the value is at the upper or the lower one, else 0."""
    close = 1e-9 * (high - low)
    return select(value >= high - close, 1.0, select(value <= low + close, -1.0, 0.0))


@inline
def _multiply_row(
    M: Matrix, row: int, task: PredictionTask, state: PredictionState, beta: Scalar
) -> Scalar:
    """Multiply a row of M, K or T of shape (rows, 9 or 11), by the states."""
    model = task.model
    share = 0.5 * model.car.d_r / model.car.r / model.full_scale * (state.T_r - state.T_l)
    first = M[row, 0] * beta + M[row, 1] * state.motion.gamma + M[row, 2] * share
    middle = M[row, 3] * state.delta_f + M[row, 4] * task.driver + M[row, 5] * state.beta_ref
    last = M[row, 6] * state.gamma_ref + M[row, 7] * state.F_d + M[row, 8] * state.N_d
    total = first + middle + last
    if M.shape[1] > 9:
        total = total + (M[row, 9] * state.share_before + M[row, 10] * state.command_before)
    return total


@inline
def _compute_commands(
    task: PredictionTask, state: PredictionState, beta: Scalar, moment_share: Scalar,
    steer_share: Scalar,
) -> tuple[Scalar, Scalar, Scalar, Scalar]:  # fmt: skip
    """Compute the commands within their limits, and 1 or -1 at a limit of either."""
    # The plan adds `moment_share` (of full scale) and `steer_share` (of the authority) to the
    # regulator's action. Commands are the yaw moment (of full scale) and the added steering (rad).
    model, K, max_moment = task.model, task.K, task.max_moment
    regulator_share = 0.0 - _multiply_row(K, 0, task, state, beta)
    share = _clip_symmetric(regulator_share, max_moment) + moment_share
    added_command, steer_limit = 0.0 * share, 0.0 * share
    if len(K) > 1:
        added_command = 0.0 - _multiply_row(K, 1, task, state, beta)
        added_command = _clip_symmetric(added_command, model.authority)
        added_command = added_command + model.authority * steer_share
        added_command = _clip_symmetric(added_command, model.authority)
        added_command = limit_rate(state.added_command, added_command, model.slew)
        high = minimum(state.added_command + model.slew, model.authority)
        low = maximum(state.added_command - model.slew, 0.0 - model.authority)
        steer_limit = _detect_limit(added_command, low, high)
    share = _clip_symmetric(share, max_moment)
    return share, added_command, _detect_limit(share, 0.0 - max_moment, max_moment), steer_limit


@inline
def _predict_step(
    task: PredictionTask, state: PredictionState, share: Scalar, added_command: Scalar,
    share_beyond: Scalar, steer_beyond: Scalar,
) -> tuple[PredictionState, tuple[Scalar, ...]]:  # fmt: skip
    """Predict one step with held commands: the state after it, and residuals of effort, change."""
    model, car, driver = task.model, task.car, task.driver
    kind, motor, steering = model.kind, model.motor, model.steering
    max_torque = compute_torque_limit(state.motion.v_x, car)
    N_z = share * model.full_scale
    T_l, T_r = allocate_torques(N_z, task.a_x, car, model.yaw_first, max_torque)
    torque_beyond = share_beyond * (model.full_scale * car.r / car.d_r)
    T_l, T_r = T_l - torque_beyond, T_r + torque_beyond
    added_target = limit_angle(added_command, driver, model.stop) + steer_beyond
    steer = driver + added_target
    first = apply_lag(steer, state.delta_f, steering.start)
    middle = apply_lag(steer, state.delta_f, steering.middle)
    last = apply_lag(steer, state.delta_f, steering.end)
    loads = (
        compute_lagged_load(first, T_l, T_r, state, motor.start, car, kind),
        compute_lagged_load(middle, T_l, T_r, state, motor.middle, car, kind),
        compute_lagged_load(last, T_l, T_r, state, motor.end, car, kind),
    )
    push = DisturbanceForces(state.F_d, state.N_d, 0.0)
    motion = rk4(state.motion, loads, push, car, model.road, model.step, kind)
    per_torque = 0.5 * car.d_r / car.r / model.full_scale
    target_share, share_before = per_torque * (T_r - T_l), per_torque * (state.T_r - state.T_l)
    added_before = state.delta_f - driver
    mean = model.per_share * apply_lag(target_share, share_before, model.motor_rest[0])
    deviation = model.per_share * model.motor_rest[1] * (share_before - target_share)
    # of the step before, whose change costs
    mean_before = apply_lag(state.command_before, state.share_before, model.motor_rest[0])
    deviation_before = model.motor_rest[1] * (state.share_before - state.command_before)
    efforts = (
        mean,
        deviation,
        model.per_steer * apply_lag(added_target, added_before, model.steering_rest[0]),
        model.per_steer * model.steering_rest[1] * (added_before - added_target),
        model.per_change * (mean - model.per_share * mean_before),
        model.per_change * (deviation - model.per_share * deviation_before),
    )
    next_state = PredictionState(
        motion, apply_lag(T_l, state.T_l, motor.end), apply_lag(T_r, state.T_r, motor.end),
        last, added_command,
        apply_lag(task.steady[0], state.beta_ref, model.ref_decay),
        apply_lag(task.steady[1], state.gamma_ref, model.ref_decay),
        model.decay * state.F_d, model.decay * state.N_d, share_before, target_share,
    )  # fmt: skip
    return next_state, efforts


@noinline
def simulate_plans(task: PredictionTask, batch: PlanBatch) -> None:
    """Simulate as many plans as there are lanes; fill their limits, residuals and first commands.

    Args:
        task: Model, start, regulator and blocks.
        batch: Plans, of which each is one lane.
    """
    model, begin, terminal, blocks = task.model, task.start, task.terminal, task.blocks
    plans, perturbations, limits, residuals, first = batch
    zero, m = 0.0 * load_element(plans, 0), len(task.K)
    motion = Motion(
        begin.motion.v_x + zero, begin.motion.v_y + zero, begin.motion.gamma + zero, zero, zero,
        zero, zero, zero, zero,
        begin.motion.phi + zero, begin.motion.phi_dot + zero, zero, zero,
    )  # fmt: skip
    state = PredictionState(
        motion, begin.T_l + zero, begin.T_r + zero, begin.delta_f + zero,
        begin.added_command + zero, begin.beta_ref + zero, begin.gamma_ref + zero,
        begin.F_d + zero, begin.N_d + zero, begin.share_before + zero, begin.command_before + zero,
    )  # fmt: skip
    beta = compute_sideslip_angle(motion.v_x, motion.v_y, model.kind.small_angle)
    n_step = N_RESIDUALS + len(terminal) - N_TERMINAL
    row, last = 0, n_step * (blocks.sum() - 1)
    for b in range(len(blocks)):
        moment_share, share_beyond = load_element(plans, m * b), load_element(perturbations, m * b)
        steer_share, steer_beyond = zero, zero
        if m > 1:
            steer_share = load_element(plans, m * b + 1)
            steer_beyond = model.authority * load_element(perturbations, m * b + 1)
        for k in range(blocks[b]):
            share, added, moment_limit, steer_limit = _compute_commands(
                task, state, beta, moment_share, steer_share
            )
            if k == 0:
                store_element(limits, moment_limit, m * b)
                if m > 1:
                    store_element(limits, steer_limit, m * b + 1)
            if row == 0:
                store_element(first, share, 0)
                store_element(first, added, 1)
            state, efforts = _predict_step(task, state, share, added, share_beyond, steer_beyond)
            motion = state.motion
            beta = compute_sideslip_angle(motion.v_x, motion.v_y, model.kind.small_angle)
            # J sums the ticks after the start: trapezoid rule over the ends of the steps, plus half
            # a tick because the last tick counts whole
            node = math.sqrt(model.step if row < last else 0.5 * (model.step + TICK))
            span = math.sqrt(model.step)
            store_element(residuals, node * model.per_beta * (beta - state.beta_ref), row)
            gamma_error = motion.gamma - state.gamma_ref
            store_element(residuals, node * model.per_gamma * gamma_error, row + 1)
            for i in range(2, n_step):  # the last two where the moment's rate costs
                store_element(residuals, span * efforts[i - 2], row + i)
            row += n_step
    for j in range(len(terminal)):
        store_element(residuals, _multiply_row(terminal, j, task, state, beta), row + j)
