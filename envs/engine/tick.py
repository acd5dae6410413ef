"""One tick of the car: commands, actuators, plant and fast sensors; for numbers, lanes and tensors.

`integrate_tick` is a tick of our plant; `compute_inputs` before the motion and `measure_tick` after
it serve outside plants too.
"""

from typing import Any, NamedTuple

from ..numerics.functions import TICK, compute_sine
from ..numerics.jit import inline
from ..numerics.primitives import Scalar, Vector, any_lane, select
from ..record import FAST
from ..scenarios.driver import (
    DriverParams,
    SpeedProfile,
    Wind,
    compute_acceleration_command,
    compute_driver_angle,
    compute_speed_reference,
    compute_wind,
)
from ..scenarios.road import NOMINAL_PATH, NominalMotion, TrackPath, step_nominal_car
from ..sensors.inertial import (
    ErrorState,
    Noise,
    NormalDraws,
    SensorErrors,
    advance_errors,
    apply_sensor_errors,
    compute_fast_row,
    compute_specific_force,
)
from ..task import ReferenceParams, compute_reference, filter_reference
from ..vehicle.actuators import (
    Lag,
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
    Motion,
    RoadParams,
    compute_car_curvature,
    compute_gravity,
    kutta3,
)
from ..vehicle.linear import Bicycle
from ..vehicle.tyres import TyreInputs, TyreLoad, compute_tyre_load
from .layout import ActuatorState, Disturbance, FrictionWave, StepVariant, TaskParams, TyreChange
from .window import CostInputs

_NO_LAG, _ONE_LAG = range(2)  # 2: both lag


class StepParams(NamedTuple):
    """Parameters that are constant within an env-step."""

    car: CarParams
    road: RoadParams
    motor: Lag
    steering: Lag
    wind: Wind
    speed_profile: SpeedProfile
    target: ReferenceParams
    disturbance: Disturbance
    task: TaskParams
    noise: Noise
    driver: DriverParams
    path: TrackPath
    tyre_change: TyreChange
    nominal_car: Bicycle
    errors: SensorErrors
    friction_wave: FrictionWave


class StepState(NamedTuple):
    """The state that a tick changes."""

    motion: Motion
    drive: ActuatorState
    start: Any  # `TyreLoad` at the tick's start; outside plants have none
    driver: Scalar  # rad, the driver's steering command
    car: CarParams  # with the present tyres
    refs: Vector  # rad, rad/s, the references of beta and gamma
    nominal_motion: NominalMotion  # the nominal car that lays the road
    errors: ErrorState


class TickInputs(NamedTuple):
    """Inputs of a tick: commands, and numbers of the window."""

    N_z: Scalar  # N m, commanded yaw moment
    added: Scalar  # rad, commanded added steering
    draws: NormalDraws  # of the sensors at its end, and of the disturbance from then on
    next_steer: Scalar  # rad, the profile's steering at the end, where no driver reacts to the car
    effort_before: Scalar  # yaw moment `RATE_TICKS` ago as a fraction of full scale


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
    errors: ErrorState  # at the tick's end


class _PlantInputs(NamedTuple):
    """Inputs of the plant during a tick."""

    steer: Scalar  # rad, command to the front wheels
    T_l: Scalar  # N m, command to the left motor
    T_r: Scalar  # N m, command to the right motor
    disturbance: DisturbanceForces
    applied: AppliedInputs
    drive: ActuatorState  # at the tick's end


class Measurements(NamedTuple):
    """Sensors at the end of a tick."""

    row: Vector  # the fast sensors, columns as in `Fast`
    refs: Vector  # rad, rad/s, the references of beta and gamma
    steer: Scalar  # rad, `AppliedInputs.steer`
    moment: Scalar  # N m, `AppliedInputs.moment`
    lost: Scalar  # whether a number is not finite
    cost_inputs: CostInputs


@inline
def apply_tyre_change(car: CarParams, change: TyreChange, is_changed: Scalar) -> CarParams:
    """Change the car's tyres and the road's friction.

    Args:
        car: Parameters of the car.
        change: Factors on stiffnesses and friction, and the tick of the change.
        is_changed: Whether they are changed.
    """
    C_f = select(is_changed, car.C_f * change.front, car.C_f)
    C_r = select(is_changed, car.C_r * change.rear, car.C_r)
    factor = select(is_changed, change.friction, 1.0)
    tyres, left, right = (C_f, C_r), (car.mu * factor,), (car.mu_r * factor,)
    # fields 4, 5, 10 and 19
    return CarParams(*(car[:4] + tyres + car[6:10] + left + car[11:19] + right + car[20:]))


@inline
def compute_lagged_load(
    steer: Scalar, T_l: Scalar, T_r: Scalar, drive: Any, rest: Scalar, car: CarParams,
    variant: StepVariant,
) -> Any:  # fmt: skip
    """Compute the tyres' load while the motors lag.

    Args:
        steer: Front steering angle (rad).
        T_l: Command of the left motor (N m).
        T_r: Command of the right motor (N m).
        drive: State of the actuators at the tick's start, with `T_l` and `T_r`.
        rest: Fraction of the motors' deviation from their commands that is left.
        car: Parameters of the car.
        variant: Variant of the tick.
    """
    inputs = TyreInputs(steer, apply_lag(T_l, drive.T_l, rest), apply_lag(T_r, drive.T_r, rest))
    return compute_tyre_load(inputs, car, variant)


@inline
def compute_motor_torques(
    N_z: Scalar, tick: Scalar, v_x: Scalar, integral: Scalar, profile: SpeedProfile, car: CarParams,
    yaw_first: Scalar,
) -> tuple[Scalar, Scalar, Scalar, Scalar]:  # fmt: skip
    """Compute left and right torque (N m), acceleration command and its next integral part (m/s2).

    Args:
        N_z: Commanded yaw moment (N m).
        tick: Tick of the commands.
        v_x: Speed (m/s).
        integral: Integral part of the driver's acceleration command (m/s2).
        profile: The driver's speed profile.
        car: Parameters of the car.
        yaw_first: 1 where the yaw moment comes before acceleration.
    """
    max_torque = compute_torque_limit(v_x, car)
    limit = 2.0 * max_torque / (car.m * car.r)
    a_x, integral = compute_acceleration_command(tick, v_x, integral, profile, limit)
    T_l, T_r = allocate_torques(N_z, a_x, car, yaw_first, max_torque)
    return T_l, T_r, a_x, integral


@inline
def _update_tyres(
    params: StepParams, state: StepState, tick: Scalar, variant: StepVariant
) -> StepState:
    """Change the tyres if they are due to, and friction to that of the car's place, for a tick."""
    change, car, start = params.tyre_change, state.car, state.start
    is_due = tick == change.tick
    if any_lane(is_due):
        car = apply_tyre_change(car, change, is_due)
        start = compute_tyre_load(state.drive, car, variant)
    if variant.has_errors:
        wave = params.friction_wave
        factor = 1.0 + wave.share * compute_sine(wave.rate * state.motion.s + wave.phase)
        factor = factor * select(tick >= change.tick, change.friction, 1.0)
        left, right = (params.car.mu * factor,), (params.car.mu_r * factor,)  # fields 10 and 19
        car = CarParams(*(car[:10] + left + car[11:19] + right + car[20:]))
        start = compute_tyre_load(state.drive, car, variant)
    return StepState(
        state.motion, state.drive, start, state.driver, car, state.refs, state.nominal_motion,
        state.errors,
    )  # fmt: skip


@inline
def _follow_nominal_path(
    params: StepParams, state: StepState, tick: Scalar
) -> tuple[StepParams, NominalMotion]:
    """Compute (parameters with the road's turning rate, nominal car at the tick's end)."""
    speed, _ = compute_speed_reference(tick, params.speed_profile)
    car, driver = params.nominal_car, state.driver
    turn_rate, nominal_motion = step_nominal_car(state.nominal_motion, driver, speed, car)
    road, turn_part = params.road, (turn_rate,)  # `turn` is the road's field 5, `road` field 1
    road_part = (RoadParams(*(road[:5] + turn_part + road[6:])),)
    return StepParams(*(params[:1] + road_part + params[2:])), nominal_motion


@inline
def compute_inputs(
    params: StepParams, inputs: TickInputs, state: StepState, tick: Scalar, variant: StepVariant
) -> _PlantInputs:
    """Compute the plant's inputs during a tick."""
    motor, steering, task, ou = params.motor, params.steering, params.task, params.disturbance
    drive, driver, car, draws = state.drive, state.driver, state.car, inputs.draws
    slewing = limit_rate(drive.slewing, inputs.added, task.slew)
    limited_steer = limit_angle(slewing, driver, task.stop)
    steer = driver + limited_steer
    v_x, profile = state.motion.v_x, params.speed_profile
    T_l, T_r, a_x, integral = compute_motor_torques(
        inputs.N_z, tick, v_x, drive.integral, profile, car, task.yaw_first
    )
    curvature, errors = compute_car_curvature(state.motion, params.road), state.errors
    if variant.has_errors:
        is_limited = task.torque_slew > 0.0
        T_l = select(is_limited, limit_rate(drive.command_l, T_l, task.torque_slew), T_l)
        T_r = select(is_limited, limit_rate(drive.command_r, T_r, task.torque_slew), T_r)
        errors = advance_errors(errors, params.errors, curvature, state.motion.s, draws.vibration)
    F_w, N_w, N_x = compute_wind(tick, params.wind)
    left, right = apply_lag(T_l, drive.T_l, motor.mean), apply_lag(T_r, drive.T_r, motor.mean)
    moment = compute_yaw_moment(left, right, car)
    applied = AppliedInputs(
        apply_lag(steer, drive.delta_f, steering.mean), left, right, driver, a_x,
        curvature, apply_lag(limited_steer, drive.added, steering.mean), moment,
        moment * (1.0 / task.yaw_scale), errors,
    )  # fmt: skip
    next_drive = ActuatorState(
        apply_lag(T_l, drive.T_l, motor.end), apply_lag(T_r, drive.T_r, motor.end),
        apply_lag(steer, drive.delta_f, steering.end), integral,
        ou.decay * drive.F_d + ou.noise_gain * ou.force * draws.wheels[2],
        ou.decay * drive.N_d + ou.noise_gain * ou.moment * draws.wheels[3], slewing,
        apply_lag(limited_steer, drive.added, steering.end), T_l, T_r,
    )  # fmt: skip
    disturbance = DisturbanceForces(drive.F_d + F_w, drive.N_d + N_w, N_x)
    return _PlantInputs(steer, T_l, T_r, disturbance, applied, next_drive)


@inline
def _compute_loads(
    params: StepParams, inputs: _PlantInputs, state: StepState, variant: StepVariant
) -> tuple[TyreLoad, TyreLoad, TyreLoad]:
    """Compute the tyres' load at the start, the middle and the end of a tick."""
    motor, steering = params.motor, params.steering
    drive, car, start = state.drive, state.car, state.start
    steer, T_l, T_r = inputs.steer, inputs.T_l, inputs.T_r
    if variant.lag == _NO_LAG:
        load = compute_tyre_load(TyreInputs(steer, T_l, T_r), car, variant)
        return load, load, load
    # actuators that lag move continuously: a tick starts where the last one ended
    if variant.lag == _ONE_LAG:  # the one without lag jumps: its `Lag` is all 0
        angle = apply_lag(steer, drive.delta_f, steering.start)
        start = compute_lagged_load(angle, T_l, T_r, drive, motor.start, car, variant)
    angle = apply_lag(steer, drive.delta_f, steering.middle)
    middle = compute_lagged_load(angle, T_l, T_r, drive, motor.middle, car, variant)
    angle = apply_lag(steer, drive.delta_f, steering.end)
    return start, middle, compute_lagged_load(angle, T_l, T_r, drive, motor.end, car, variant)


@inline
def measure_tick(
    params: StepParams, motion: Motion, accel: Vector, applied: AppliedInputs, refs_before: Vector,
    inputs: TickInputs, variant: StepVariant,
) -> tuple[Scalar, Measurements]:  # fmt: skip
    """Compute the driver's steering command (rad) and the measurements at the end of a tick.

    Args:
        params: Parameters of the step.
        motion: Motion at the end.
        accel: (a_x, a_y), specific forces (m/s2).
        applied: Mean inputs over the tick.
        refs_before: References of beta and gamma at the start (rad, rad/s).
        inputs: Inputs of the tick.
        variant: Variant of the tick.
    """
    task = params.task
    row = compute_fast_row(motion, accel, applied, params.car.d_f, params.noise, inputs.draws)
    if variant.has_errors:
        row = apply_sensor_errors(row, motion, accel, applied.errors, params.errors)
    v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
    driver = inputs.next_steer
    if variant.has_driver:
        driver = compute_driver_angle(
            applied.driver, motion, params.path, params.road, params.target, params.driver,
            task.stop,
        )  # fmt: skip
    command = driver  # as it is measured: the car's own controller makes the reference
    if variant.has_errors:
        command = params.errors.steer_scale * driver + params.errors.steer_offset
    steady = compute_reference(command, v, params.target, variant.reference)
    refs = filter_reference(refs_before, steady, params.target, variant.reference)
    size = motion.v_x * motion.v_x + motion.v_y * motion.v_y + motion.gamma * motion.gamma
    # squares: the references take them too, so what overflows there is lost as well
    finite = size + motion.psi + motion.Y + motion.phi
    effort_change = applied.effort - inputs.effort_before
    cost_inputs = CostInputs(refs[0], refs[1], effort_change, applied.added, applied.effort)
    lost = finite - finite != 0.0
    return driver, Measurements(row, refs, applied.steer, applied.moment, lost, cost_inputs)


@inline
def integrate_tick(
    params: StepParams, inputs: TickInputs, state: StepState, tick: Scalar, variant: StepVariant
) -> tuple[StepState, Measurements]:
    """Integrate one tick of the plant."""
    state, nominal_motion = _update_tyres(params, state, tick, variant), state.nominal_motion
    if variant.road == NOMINAL_PATH:
        params, nominal_motion = _follow_nominal_path(params, state, tick)
    plant = compute_inputs(params, inputs, state, tick, variant)
    loads = _compute_loads(params, plant, state, variant)
    before, car, road, none = state.motion, state.car, params.road, (0.0 * params.road.wave,)
    motion = kutta3(before, loads, plant.disturbance, car, road, TICK, variant)
    if variant.has_errors:  # its wave (field 6) is felt as in the plant, in the tick's middle
        road = RoadParams(*(road[:6] + none + road[7:]))
    accel = compute_specific_force(before, motion, road, variant.small_angle, variant.roll)
    if variant.has_errors:
        wave = RoadParams(*(params.road[:3] + none + none + params.road[5:]))
        g_x, g_y = compute_gravity(before, wave, variant.small_angle, 0.5 * TICK)
        # the accelerometer is ahead of the centre of gravity
        ahead, turning = params.errors.accel_ahead, 0.5 * (before.gamma + motion.gamma)
        gamma_dot = (motion.gamma - before.gamma) * (1.0 / TICK)
        a_x, a_y = accel[0] + g_x, accel[1] + g_y
        accel = (a_x - ahead * turning * turning, a_y + ahead * gamma_dot)
    applied, drive = plant.applied, plant.drive
    driver, measured = measure_tick(params, motion, accel, applied, state.refs, inputs, variant)
    refs, errors = measured.refs, applied.errors
    end = StepState(motion, drive, loads[2], driver, car, refs, nominal_motion, errors)
    return end, measured
