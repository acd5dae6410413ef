"""One tick of the car: commands, actuators, plant and fast sensors; for numbers, lanes and tensors.

`integrate_tick` is a tick of our plant; `compute_inputs` before the motion and `measure_tick` after
it serve outside plants too.
"""

from typing import Any, NamedTuple

from ..numerics.jit import inline
from ..numerics.primitives import Scalar, Vector, any_lane, select
from ..record import FAST
from ..scenarios.driver import (
    compute_acceleration_command,
    compute_driver_angle,
    compute_speed_reference,
    compute_wind,
)
from ..scenarios.road import NOMINAL_PATH, NominalMotion, step_nominal_car
from ..sensors.inertial import NormalDraws, compute_fast_row, compute_specific_force
from ..task import compute_reference, filter_reference
from ..ticks import TICK
from ..vehicle.actuators import (
    allocate_torques,
    apply_lag,
    compute_torque_limit,
    compute_yaw_moment,
    limit_angle,
    limit_rate,
)
from ..vehicle.dynamics import (
    CarParams,
    DisturbanceForces,
    RoadParams,
    compute_car_curvature,
    kutta3,
)
from ..vehicle.tyres import TyreInputs, compute_tyre_load
from .layout import ActuatorState
from .window import CostInputs

_NO_LAG, _ONE_LAG = range(2)  # 2: both lag


class StepVariant(NamedTuple):
    """Integers that choose a tick's code, the same for all cars computed together."""

    small_angle: int  # 1: the small-angle plant
    law: int  # place in `TYRE_LAWS`
    reference: int  # place in `REFERENCES`
    roll: int  # 1: the body rolls
    has_driver: int  # the driver reacts to the car
    lag: int  # how many of motors and steering lag
    has_load_shift: int  # 1 where the lateral acceleration shifts load between the wheels
    road: int  # place in `scenarios.road.ROADS`


class StepParams(NamedTuple):
    """Parameters that are constant within an env-step; each a tuple of numbers."""

    car: Any
    road: Any
    motor: Any
    steering: Any
    wind: Any
    speed_profile: Any
    target: Any
    disturbance: Any
    task: Any
    noise: Any
    driver: Any
    path: Any
    tyre_change: Any
    nominal_car: Any


class StepState(NamedTuple):
    """The state that a tick changes."""

    motion: Any
    drive: Any
    start: Any  # `TyreLoad` at the tick's start
    driver: Scalar  # rad, the driver's steering command
    car: Any  # with the present tyres
    refs: Any  # rad, rad/s, the references of beta and gamma
    nominal_motion: Any  # the nominal car that lays the road


class AppliedInputs(NamedTuple):
    """Mean inputs over a tick; the first six are columns of `Fast`, from `steer` on."""

    steer: Scalar  # rad, front wheels
    T_l: Scalar  # N m, left motor
    T_r: Scalar  # N m, right motor
    driver: Scalar  # rad, the driver's steering command
    a_x: Scalar  # m/s2, the driver's acceleration command
    curvature: Scalar  # 1/m, the road's at the car
    added: Scalar  # rad, the part of steer that was added to the driver's
    moment: Scalar  # N m, yaw moment of both motors
    effort: Scalar  # the yaw moment as a fraction of full scale


class _PlantInputs(NamedTuple):
    """Inputs of the plant during a tick."""

    steer: Scalar  # rad, command to the front wheels
    T_l: Scalar  # N m, command to the left motor
    T_r: Scalar  # N m, command to the right motor
    disturbance: Any  # `DisturbanceForces`
    applied: Any  # `AppliedInputs`
    drive: Any  # `ActuatorState` at the tick's end


class Measurements(NamedTuple):
    """Sensors at the end of a tick."""

    row: Any  # the fast sensors, columns as in `Fast`
    refs: Any  # rad, rad/s, the references of beta and gamma
    steer: Scalar  # rad, `AppliedInputs.steer`
    moment: Scalar  # N m, `AppliedInputs.moment`
    lost: Any  # whether a number is not finite
    cost_inputs: CostInputs


@inline
def apply_tyre_change(car: Any, change: Any, is_changed: Scalar) -> Any:
    """Change the car's tyres where `is_changed` holds."""
    C_f = select(is_changed, car.C_f * change.front, car.C_f)
    C_r = select(is_changed, car.C_r * change.rear, car.C_r)
    new_stiffness = (C_f, C_r)
    return CarParams(*(car[:4] + new_stiffness + car[6:]))  # fields 4 and 5


@inline
def compute_static_load(drive: Any, car: Any, variant: StepVariant) -> Any:
    """Compute the tyres' load at the actuators' present state."""
    inputs = TyreInputs(drive.delta_f, drive.T_l, drive.T_r)
    return compute_tyre_load(inputs, car, variant.small_angle, variant.has_load_shift)


@inline
def compute_lagged_load(
    steer: Any, T_l: Scalar, T_r: Scalar, drive: Any, rest: Scalar, car: Any, variant: StepVariant
) -> Any:
    """Compute the tyres' load; `rest` of the motors' deviation from T_l and T_r (N m) is left."""
    inputs = TyreInputs(steer, apply_lag(T_l, drive.T_l, rest), apply_lag(T_r, drive.T_r, rest))
    return compute_tyre_load(inputs, car, variant.small_angle, variant.has_load_shift)


@inline
def compute_motor_torques(
    N_z: Scalar,
    tick: Scalar,
    v_x: Scalar,
    integral: Scalar,
    profile: Any,
    car: Any,
    yaw_first: Scalar,
) -> Any:
    """Compute (T_l, T_r, a_x, integral): torques (N m) for yaw moment and driver's acceleration."""
    max_torque = compute_torque_limit(v_x, car)
    limit = 2.0 * max_torque / (car.m * car.r)
    a_x, integral = compute_acceleration_command(tick, v_x, integral, profile, limit)
    T_l, T_r = allocate_torques(N_z, a_x, car, yaw_first, max_torque)
    return T_l, T_r, a_x, integral


@inline
def _apply_due_change(
    params: StepParams, state: StepState, tick: Scalar, variant: StepVariant
) -> StepState:
    """Change the tyres if they are due to change at this tick."""
    is_due, car, start = tick == params.tyre_change.tick, state.car, state.start
    if any_lane(is_due):
        car = apply_tyre_change(car, params.tyre_change, is_due)
        start = compute_static_load(state.drive, car, variant)
    return StepState(
        state.motion, state.drive, start, state.driver, car, state.refs, state.nominal_motion
    )


@inline
def _follow_nominal_path(
    params: StepParams, state: StepState, tick: Scalar
) -> tuple[StepParams, NominalMotion]:
    """Compute (parameters with the road's turning rate, nominal car at the tick's end)."""
    speed, _ = compute_speed_reference(tick, params.speed_profile)
    turn_rate, nominal_motion = step_nominal_car(
        state.nominal_motion, state.driver, speed, params.nominal_car
    )
    road, turn_part = params.road, (turn_rate,)  # `turn` is the road's field 5, `road` field 1
    road_part = (RoadParams(*(road[:5] + turn_part)),)
    return StepParams(*(params[:1] + road_part + params[2:])), nominal_motion


@inline
def compute_inputs(
    params: StepParams, N_z: Scalar, steer_command: Scalar, state: StepState, tick: Scalar,
    draws: NormalDraws,
) -> _PlantInputs:  # fmt: skip
    """Compute the plant's inputs during a tick; arguments as in `integrate_tick`."""
    motor, steering, task, ou = params.motor, params.steering, params.task, params.disturbance
    drive, driver, car = state.drive, state.driver, state.car
    slewing = limit_rate(drive.slewing, steer_command, task.slew)
    limited_steer = limit_angle(slewing, driver, task.stop)
    steer = driver + limited_steer
    T_l, T_r, a_x, integral = compute_motor_torques(
        N_z, tick, state.motion.v_x, drive.integral, params.speed_profile, car, task.yaw_first
    )
    F_w, N_w, N_x = compute_wind(tick, params.wind)
    left, right = apply_lag(T_l, drive.T_l, motor.mean), apply_lag(T_r, drive.T_r, motor.mean)
    moment = compute_yaw_moment(left, right, car)
    applied = AppliedInputs(
        apply_lag(steer, drive.delta_f, steering.mean), left, right, driver, a_x,
        compute_car_curvature(state.motion, params.road),
        apply_lag(limited_steer, drive.added, steering.mean), moment,
        moment * (1.0 / task.yaw_scale),
    )  # fmt: skip
    next_drive = ActuatorState(
        apply_lag(T_l, drive.T_l, motor.end), apply_lag(T_r, drive.T_r, motor.end),
        apply_lag(steer, drive.delta_f, steering.end), integral,
        ou.decay * drive.F_d + ou.noise_gain * ou.force * draws.wheels[2],
        ou.decay * drive.N_d + ou.noise_gain * ou.moment * draws.wheels[3], slewing,
        apply_lag(limited_steer, drive.added, steering.end),
    )  # fmt: skip
    return _PlantInputs(
        steer, T_l, T_r, DisturbanceForces(drive.F_d + F_w, drive.N_d + N_w, N_x), applied,
        next_drive,
    )  # fmt: skip


@inline
def _compute_loads(
    params: StepParams, inputs: _PlantInputs, state: StepState, variant: StepVariant
) -> Any:
    """Compute the tyres' load at the start, the middle and the end of a tick."""
    motor, steering = params.motor, params.steering
    drive, car, start = state.drive, state.car, state.start
    steer, T_l, T_r = inputs.steer, inputs.T_l, inputs.T_r
    if variant.lag == _NO_LAG:
        start = compute_tyre_load(
            TyreInputs(steer, T_l, T_r), car, variant.small_angle, variant.has_load_shift
        )
        middle, end = start, start
    else:  # actuators that lag move continuously: a tick starts where the last one ended
        if variant.lag == _ONE_LAG:  # the other one jumps
            angle = apply_lag(steer, drive.delta_f, steering.start)
            start = compute_lagged_load(angle, T_l, T_r, drive, motor.start, car, variant)
        angle = apply_lag(steer, drive.delta_f, steering.middle)
        middle = compute_lagged_load(angle, T_l, T_r, drive, motor.middle, car, variant)
        angle = apply_lag(steer, drive.delta_f, steering.end)
        end = compute_lagged_load(angle, T_l, T_r, drive, motor.end, car, variant)
    return start, middle, end


@inline
def measure_tick(
    params: StepParams, motion: Any, accel: Vector, applied: AppliedInputs, refs_before: Vector,
    next_steer: Any, draws: NormalDraws, variant: StepVariant,
) -> tuple[Any, Measurements]:  # fmt: skip
    """Compute the driver's command (rad) and the measurements at the end of a tick.

    `accel` is (a_x, a_y), specific forces in m/s2; `refs_before` are the references at the start.
    """
    task = params.task
    row = compute_fast_row(motion, accel, applied, params.car.d_f, params.noise, draws)
    v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
    driver = next_steer
    if variant.has_driver:
        driver = compute_driver_angle(
            applied.driver, motion, params.path, params.road, params.target, params.driver,
            task.stop,
        )  # fmt: skip
    steady = compute_reference(driver, v, params.target, variant.reference)
    refs = filter_reference(refs_before, steady, params.target, variant.reference)
    size = motion.v_x * motion.v_x + motion.v_y * motion.v_y + motion.gamma * motion.gamma
    # squares: the references take them too, so what overflows there is lost as well
    finite = size + motion.psi + motion.Y + motion.phi
    measured = Measurements(
        row, refs, applied.steer, applied.moment, finite - finite != 0.0,
        CostInputs(refs[0], refs[1], applied.effort, applied.added),
    )  # fmt: skip
    return driver, measured


@inline
def integrate_tick(
    params: StepParams, N_z: Scalar, steer_command: Scalar, state: StepState, tick: Scalar,
    draws: NormalDraws, next_steer: Any, variant: StepVariant,
) -> tuple[StepState, Measurements]:  # fmt: skip
    """Integrate one tick of the plant.

    Args:
        params: Parameters.
        N_z: Commanded yaw moment (N m).
        steer_command: Commanded added steering (rad).
        state: State at the start.
        tick: Tick at which it starts.
        draws: Random numbers of the tick's end.
        next_steer: Profile's steering (rad) at the end, used where no driver reacts to the car.
        variant: Variant of the tick.

    Returns:
        State and measurements at the end.
    """
    small_angle, law, roll = variant.small_angle, variant.law, variant.roll
    state, nominal_motion = _apply_due_change(params, state, tick, variant), state.nominal_motion
    if variant.road == NOMINAL_PATH:
        params, nominal_motion = _follow_nominal_path(params, state, tick)
    inputs = compute_inputs(params, N_z, steer_command, state, tick, draws)
    loads = _compute_loads(params, inputs, state, variant)
    before, car, road = state.motion, state.car, params.road
    motion = kutta3(before, loads, inputs.disturbance, car, road, TICK, small_angle, law, roll)
    accel = compute_specific_force(before, motion, road, small_angle, roll)
    driver, measured = measure_tick(
        params, motion, accel, inputs.applied, state.refs, next_steer, draws, variant
    )
    return StepState(
        motion, inputs.drive, loads[2], driver, car, measured.refs, nominal_motion
    ), measured
