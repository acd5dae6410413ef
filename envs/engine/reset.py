"""Reset of an episode: its draws from a key, and tick 0; compiled."""

from ..numerics.functions import (
    CHANNELS,
    FOREVER,
    NEVER,
    PI,
    TICK,
    draw_normals,
    draw_uniforms,
    exp,
    round_to_ticks,
    sincos,
)
from ..numerics.jit import copy_into, jit, noinline
from ..numerics.packed import read, write
from ..numerics.primitives import Scalar, Vector, floor, from_word, maximum, minimum, select
from ..record import FAST
from ..scenarios.driver import (
    DRIVER,
    WANDER,
    compute_target_angle,
    write_gentle_steering,
    write_steering,
)
from ..scenarios.road import add_weave, transform_path
from ..scenarios.world import DRAWS, DRAWS_WIDTH, Draws, draw_car, draw_stable
from ..sensors.inertial import (
    ErrorState,
    NormalDraws,
    SensorErrors,
    apply_sensor_errors,
    compute_fast_row,
)
from ..sensors.slow import GPS, draw_first_drift
from ..vehicle.dynamics import Motion, compute_car_curvature, compute_gravity
from ..vehicle.parameters import GRAVITY, MIN_RELAXATION
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH, EpisodeArrays, EpisodeStart, P, StepVariant, Z
from .outputs import finish_reset
from .step import make_step_params, make_step_variant
from .tick import StepParams
from .window import compute_profile_angle

_GUST_ARM = 0.2  # m ahead of the centre of gravity, as of tie-vision's wind


@jit
def _write_surroundings(p: Vector, d: Draws, s: Scalar, v_x: Scalar) -> None:
    """Write drawn friction, wind, road and path, for a start at s (m) with v_x (m/s)."""
    mirrored, lead_in = d.side < 0.5, p[P.task.lead_in] * TICK
    right = select(d.friction_right > 0.0, d.friction_right, d.friction) * d.friction_across
    p[P.car.mu] = select(mirrored, right, d.friction)
    p[P.car.mu_r] = select(mirrored, d.friction, right)
    p[P.wind.force] = select(d.wind_side < 0.5, -d.wind_force, d.wind_force)
    p[P.wind.arm], p[P.wind.start] = d.wind_arm, round_to_ticks(d.wind_start)
    p[P.wind.end] = p[P.wind.start] + round_to_ticks(d.wind_length)
    p[P.road.curvature] = select(mirrored, 0.0 - d.curvature, d.curvature)
    bank_gravity = GRAVITY * sincos(d.bank)[0]
    p[P.road.lateral] = select(mirrored, 0.0 - bank_gravity, bank_gravity)
    p[P.road.start] = p[P.road.start] + lead_in * v_x
    scaled = d.path_speed > 0.0  # the path begins where the car is at the onset
    scale = select(scaled, d.speed, 1.0) / select(scaled, d.path_speed, 1.0)
    path = transform_path(read(p, P.path), s + d.onset * v_x, scale, select(mirrored, -1.0, 1.0))
    if lead_in > 0.0:
        path = add_weave(path, s, v_x, lead_in)
    write(p, path, P.path)


@jit
def _write_sensors(p: Vector, d: Draws, low: Vector, high: Vector) -> None:
    """Write drawn biases and GPS latency, which was packed as the worst case of low and high."""
    p[P.noise.gyro_bias] = p[P.noise.gyro_bias] + d.gyro_bias
    p[P.noise.accel_y_bias] = p[P.noise.accel_y_bias] + d.accel_y_bias
    link, min_latency = P.slow[GPS], round_to_ticks(low[DRAWS.gps_latency])
    extra_latency = round_to_ticks(d.gps_latency) - min_latency
    for i in (link.delay_0, link.delay_1, link.delay_2, link.delay_3):
        p[i] = p[i] + extra_latency
    p[link.jitter] = p[link.jitter] - (round_to_ticks(high[DRAWS.gps_latency]) - min_latency)


@jit
def _write_errors(p: Vector, z: Vector, d: Draws) -> None:
    """Write what a `World` draws besides the car, and the state of the sensors' errors."""
    turn = 2.0 * PI * d.phase  # of all waves: small multiples of it hardly depend on each other
    lag = select(d.map_lag > 0.0, d.map_lag, 1.0)
    map_rest = select(d.map_lag > 0.0, exp(maximum(0.0 - TICK / lag, -7.5)), 0.0)
    errors = SensorErrors(
        d.camera_yaw, d.camera_pitch, d.camera_height, d.steer_offset, d.steer_scale,
        d.wheel_scale * d.wheel_left, d.wheel_scale, d.gyro_scale,
        d.gyro_drift * TICK, d.accel_scale, d.accel_ahead, d.vibration,
        d.course_error, 2.0 * PI * TICK / d.course_period, turn, d.map_error,
        2.0 * PI / d.map_length, 2.0 * turn, map_rest,
    )  # fmt: skip
    write(p, errors, P.errors)
    write(p, (d.friction_wave, 2.0 * PI / d.friction_length, 3.0 * turn), P.friction_wave)
    p[P.road.wave], rate = GRAVITY * sincos(d.bank_wave)[0], 2.0 * PI / d.bank_length
    # tensors compute a wave of zero amplitude too: far away its sine overflows
    p[P.road.wave_rate], p[P.road.wave_phase] = select(d.bank_wave != 0.0, rate, 0.0), 5.0 * turn
    p[P.task.torque_slew] = d.torque_rate * p[P.car.T_max] * TICK
    relaxation = p[P.car.relaxation] * d.relaxation
    p[P.car.relaxation] = select(relaxation > 0.0, maximum(relaxation, MIN_RELAXATION), 0.0)
    p[P.car.k_l], p[P.car.k_r] = d.torque_scale * d.torque_left, d.torque_scale
    gust = d.gust * p[P.car.m]
    p[P.disturbance.force] = p[P.disturbance.force] + gust
    p[P.disturbance.moment] = p[P.disturbance.moment] + _GUST_ARM * gust
    p[P.noise.accel_y_bias] = p[P.noise.accel_y_bias] + GRAVITY * sincos(d.accel_roll)[0]
    p[P.slow[GPS].stamp] = round_to_ticks(d.gps_stamp)
    z[Z.errors.curvature] = compute_car_curvature(read(z, Z.motion), read(p, P.road))


@jit
def _write_motion(z: Vector, d: Draws, start: Vector, small_angle: int) -> None:
    """Write the drawn motion, or the numbers of `start` (len(Motion),) that are not NaN."""
    mirrored = d.side < 0.5
    beta = select(mirrored, 0.0 - d.initial_beta, d.initial_beta)
    sine, cosine = sincos(beta)
    tangent = beta if small_angle else sine / cosine
    z[Z.motion.v_x], z[Z.motion.v_y] = d.speed, d.speed * tangent
    z[Z.motion.gamma] = select(mirrored, 0.0 - d.initial_gamma, d.initial_gamma)
    for i in range(len(Z.motion)):
        if start[i] == start[i]:
            z[Z.motion[i]] = start[i]


@jit
def compute_first_row(
    motion: Motion, steer: Scalar, params: StepParams, draws: NormalDraws, errors: ErrorState,
    variant: StepVariant,
) -> Vector:  # fmt: skip
    """Compute the fast row at tick 0, shape (FAST_WIDTH,), when only the steering has acted.

    Args:
        motion: Motion of the car.
        steer: Steering angle (rad).
        params: Parameters of a step.
        draws: Random numbers of the tick.
        errors: State of the sensors' errors.
        variant: Variant of the ticks.
    """
    road = params.road
    applied = (steer, 0.0, 0.0, steer, 0.0, compute_car_curvature(motion, road))
    g_x, g_y = compute_gravity(motion, road, variant.small_angle, 0.0)
    accel = (g_x, g_y + GRAVITY * motion.phi)
    row = compute_fast_row(motion, accel, applied, params.car.d_f, params.noise, draws)
    if variant.has_errors:
        row = apply_sensor_errors(row, motion, accel, errors, params.errors)
    return row


@noinline
def reset_vehicle(start: EpisodeStart, key_low: int, key_high: int, row: EpisodeArrays) -> None:
    """Draw the episode from a key and deliver tick 0."""
    p, z = row.p, row.z
    copy_into(start.params, p)
    copy_into(start.switches, row.switches)
    switches = row.switches
    scratch = z[:DRAWS_WIDTH]  # until the state is written
    d, redraws = draw_stable(start.low, start.high, key_low, key_high, read(p, P.car), scratch)
    lead_in = p[P.task.lead_in] * TICK
    if lead_in > 0.0:  # what has a time comes later
        scratch[DRAWS.onset], scratch[DRAWS.wind_start] = d.onset + lead_in, d.wind_start + lead_in
        changes = d.tyre_change_time > 0.0
        scratch[DRAWS.tyre_change_time] = d.tyre_change_time + select(changes, lead_in, 0.0)
        d = read(scratch, DRAWS)
    write(p, draw_car(d, read(p, P.car)), P.car)
    change_tick = select(d.tyre_change_time > 0.0, round_to_ticks(d.tyre_change_time), FOREVER)
    write(p, (change_tick, d.front_change, d.rear_change, d.friction_change), P.tyre_change)
    profile, target = p[P.steering_profile[0] :], read(p, P.target)
    write_steering(switches[FLAGS.steering], d, profile)
    if lead_in > 0.0:
        write_gentle_steering(p[P.task.lead_in], d.speed, target, profile)
    if d.side < 0.5:
        for i in range(PARAMS_WIDTH + 1, len(p)):  # a trace
            p[i] = 0.0 - p[i]
    p[P.speed_profile.speed] = d.speed
    for i in range(STATE_WIDTH):
        z[i] = 0.0
    _write_motion(z, d, start.motion, switches[FLAGS.small_angle])
    _write_sensors(p, d, start.low, start.high)
    motion = read(z, Z.motion)
    _write_surroundings(p, d, motion.s, motion.v_x)
    _write_errors(p, z, d)
    n, steer = draw_normals(key_low, key_high, 0, CHANNELS.initial), compute_profile_angle(p, 0.0)
    if switches[FLAGS.steering] == DRIVER:
        driver, path, road = read(p, P.driver), read(p, P.path), read(p, P.road)
        steer = compute_target_angle(motion, path, road, target, driver, p[P.task.stop])
    elif switches[FLAGS.steering] == WANDER:
        steer = d.amplitude * draw_normals(key_low, key_high, 0, CHANNELS.steering)[0]
    z[Z.drive.delta_f] = z[Z.driver] = steer
    z[Z.drive.F_d], z[Z.drive.N_d] = p[P.disturbance.force] * n[0], p[P.disturbance.moment] * n[1]
    z[Z.clock.key_low], z[Z.clock.key_high] = from_word(key_low), from_word(key_high)
    z[Z.clock.redraws], z[Z.clock.next_due] = redraws, FOREVER
    for sensor in range(len(Z.slow)):
        link, column = read(p, P.slow[sensor]), Z.slow[sensor]
        share = draw_uniforms(key_low, key_high, 0, CHANNELS.initial, 1 + sensor)[0]
        phase = select(link.phase < 0.0, floor(share * link.period), link.phase)
        early = floor((phase + link.stamp) / maximum(link.period, 1.0))  # periods before tick 0
        phase = phase - minimum(early, 0.0) * link.period  # no stamp lies there
        z[column.next_capture], z[column.captured] = select(link.period > 0.0, phase, NEVER), NEVER
        z[column.drift] = draw_first_drift(sensor, read(p, P.sky), key_low, key_high)
    fast = draw_normals(key_low, key_high, 0, CHANNELS.inertial)
    wheels = draw_normals(key_low, key_high, 0, CHANNELS.wheels)
    vibration = draw_normals(key_low, key_high, 0, CHANNELS.errors)[0]
    z[Z.errors.vibration] = p[P.errors.vibration] * vibration
    draws, variant = NormalDraws(fast, wheels, vibration), make_step_variant(p, switches)
    first = compute_first_row(motion, steer, make_step_params(p), draws, read(z, Z.errors), variant)
    write(row.rows[0], first, FAST)
    finish_reset(row)
