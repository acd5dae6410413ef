"""Reset of an episode: its draws from a key, and tick 0; compiled."""

from ..numerics.functions import CHANNELS, draw_normals, sincos
from ..numerics.jit import copy_into, jit, noinline
from ..numerics.packed import read, write
from ..numerics.primitives import Matrix, Scalar, Vector, from_word, select
from ..record import FAST
from ..scenarios.draws import DRAWS, DRAWS_WIDTH, Draws, draw_stable
from ..scenarios.driver import compute_target_angle
from ..scenarios.road import transform_path
from ..scenarios.steering import DRIVER, WANDER, write_steering
from ..sensors.inertial import Noise, NormalDraws, compute_fast_row
from ..sensors.link import draw_clock_phase
from ..sensors.slow import GPS, draw_first_drift
from ..task import REPORT, compute_reference
from ..ticks import FOREVER, NEVER, round_to_ticks
from ..vehicle.dynamics import (
    Motion,
    RoadParams,
    compute_car_curvature,
    compute_gravity,
    compute_sideslip_angle,
)
from ..vehicle.parameters import GRAVITY
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH, P, Z
from .outputs import NEVER_DUE, observe, sample_slow_sensors, write_report
from .window import compute_profile_angle
from .workspace import EpisodeArrays, EpisodeStart


@jit
def _write_surroundings(p: Vector, d: Draws, s: Scalar, v_x: Scalar) -> None:
    """Write drawn friction, wind, road and path, for a start at s (m) with v_x (m/s)."""
    mirrored = d.side < 0.5
    right = select(d.friction_right > 0.0, d.friction_right, d.friction)
    p[P.car.mu] = select(mirrored, right, d.friction)
    p[P.car.mu_r] = select(mirrored, d.friction, right)
    p[P.wind.force] = select(d.wind_side < 0.5, -d.wind_force, d.wind_force)
    p[P.wind.arm] = d.wind_arm
    p[P.wind.start] = round_to_ticks(d.wind_start)
    p[P.wind.end] = p[P.wind.start] + round_to_ticks(d.wind_length)
    p[P.road.curvature] = select(mirrored, 0.0 - d.curvature, d.curvature)
    bank_gravity = GRAVITY * sincos(d.bank)[0]
    p[P.road.lateral] = select(mirrored, 0.0 - bank_gravity, bank_gravity)
    scaled = d.path_speed > 0.0  # the path begins where the car is at the onset
    scale = select(scaled, d.speed, 1.0) / select(scaled, d.path_speed, 1.0)
    path = transform_path(read(p, P.path), s + d.onset * v_x, scale, select(mirrored, -1.0, 1.0))
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
    motion: Motion, steer: Scalar, road: RoadParams, d_f: Scalar, noise: Noise, draws: NormalDraws,
    small_angle: int,
) -> Vector:  # fmt: skip
    """Compute the fast sensors at tick 0, when only the steering has acted.

    Args:
        motion: Motion of the car.
        steer: Steering angle (rad).
        road: Curve, bank and grade of the road, `RoadParams`.
        d_f: Front track (m).
        noise: Noise of the sensors.
        draws: Random numbers of the tick.
        small_angle: 1 for the small-angle plant.

    Returns:
        The fast row, FAST_WIDTH numbers.
    """
    applied = (steer, 0.0, 0.0, steer, 0.0, compute_car_curvature(motion, road))
    g_x, g_y = compute_gravity(motion, road, small_angle)
    return compute_fast_row(motion, (g_x, g_y + GRAVITY * motion.phi), applied, d_f, noise, draws)


@noinline
def reset_vehicle(
    start: EpisodeStart, key_low: int, key_high: int, bounds: Matrix, row: EpisodeArrays
) -> None:
    """Draw the episode from a key and deliver tick 0.

    Args:
        start: Packed start of the episode.
        key_low: Lower 32 bits of the key.
        key_high: Upper 32 bits.
        bounds: Bounds of the observation, shape (2, k).
        row: Arrays of the episode, which are written.
    """
    p, z, rows, report = row.p, row.z, row.rows, row.report
    copy_into(start.params, p)
    copy_into(start.switches, row.switches)
    switches = row.switches
    scratch = z[:DRAWS_WIDTH]  # until the state is written
    d, redraws = draw_stable(start.low, start.high, key_low, key_high, read(p, P.car), scratch)
    p[P.car.C_f] = p[P.car.C_f] * d.front_stiffness
    p[P.car.C_r] = p[P.car.C_r] * d.rear_stiffness
    change_tick = select(d.tyre_change_time > 0.0, round_to_ticks(d.tyre_change_time), FOREVER)
    write(p, (change_tick, d.front_change, d.rear_change), P.tyre_change)
    write_steering(switches[FLAGS.steering], d, p[P.steering_profile[0] :])
    if d.side < 0.5:
        for i in range(PARAMS_WIDTH + 1, len(p)):  # a trace
            p[i] = 0.0 - p[i]
    p[P.speed_profile.speed] = d.speed
    for i in range(STATE_WIDTH):
        z[i] = 0.0
    small_angle = switches[FLAGS.small_angle]
    _write_motion(z, d, start.motion, small_angle)
    _write_sensors(p, d, start.low, start.high)
    motion = read(z, Z.motion)
    _write_surroundings(p, d, motion.s, motion.v_x)
    n = draw_normals(key_low, key_high, 0, CHANNELS.initial)
    road, target = read(p, P.road), read(p, P.target)
    steer = compute_profile_angle(p, 0.0)
    if switches[FLAGS.steering] == DRIVER:
        driver, path = read(p, P.driver), read(p, P.path)
        steer = compute_target_angle(motion, path, road, target, driver, p[P.task.stop])
    elif switches[FLAGS.steering] == WANDER:
        steer = d.amplitude * draw_normals(key_low, key_high, 0, CHANNELS.steering)[0]
    z[Z.drive.delta_f] = steer
    z[Z.driver] = steer
    z[Z.drive.F_d] = p[P.disturbance.force] * n[0]
    z[Z.drive.N_d] = p[P.disturbance.moment] * n[1]
    z[Z.clock.key_low], z[Z.clock.key_high] = from_word(key_low), from_word(key_high)
    z[Z.clock.redraws], z[Z.clock.next_due] = redraws, NEVER_DUE
    for sensor in range(len(Z.slow)):
        link, column = read(p, P.slow[sensor]), Z.slow[sensor]
        phase = draw_clock_phase(link, key_low, key_high, sensor)
        z[column.next_capture] = select(link.period > 0.0, phase, NEVER)
        z[column.captured] = NEVER
        z[column.drift] = draw_first_drift(sensor, read(p, P.sky), key_low, key_high)
    beta = compute_sideslip_angle(motion.v_x, motion.v_y, small_angle)
    fast = draw_normals(key_low, key_high, 0, CHANNELS.inertial)
    wheels = draw_normals(key_low, key_high, 0, CHANNELS.wheels)
    draws, noise = NormalDraws(fast, wheels), read(p, P.noise)
    row_0 = compute_first_row(motion, steer, road, p[P.car.d_f], noise, draws, small_angle)
    write(rows[0], row_0, FAST)
    count = sample_slow_sensors(row, motion, 0.0, 0)
    v = 0.5 * (rows[0, FAST.wheel_left] + rows[0, FAST.wheel_right])
    refs = compute_reference(steer, v, target, switches[FLAGS.reference])
    write(z, refs, Z.refs)
    n_rows = 1
    if switches[FLAGS.all_samples]:  # tick 0 stands for all samples of a step
        for j in range(1, len(rows)):
            copy_into(rows[0], rows[j])
        n_rows = len(rows)
    observe(row, n_rows, count, refs, bounds)
    write_report(report, z)
    report[REPORT.beta] = beta
    report[REPORT.beta_ref], report[REPORT.gamma_ref] = refs
    report[REPORT.steer] = steer
    report[REPORT.yaw_moment] = 0.0
    report[REPORT.cost] = 0.0
    report[REPORT.reward] = 0.0
    report[REPORT.packets] = count
    report[REPORT.ended] = 0.0
