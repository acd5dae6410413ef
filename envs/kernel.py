"""One env-step of one vehicle: n plant ticks, sensors, delivery, cost, observation; compiled.

Order of tick k: sensors sample the state at k; packets with arrival k are delivered, ordered by
(captured tick, sensor). The control of tick k acts until k+1. A step from tick k returns the
ticks k+1 .. k+n; a reset returns tick 0 alone.
"""

from typing import Any, NamedTuple

from .actuators import Lag, distribute, lagged, yaw_moment
from .backend import absolute, fixed_tuple, floor, jit, maximum, minimum, select
from .dynamics import Car, Inputs, Motion, Push, Road, load_of, rk4, sideslip_angle
from .layout import AGE_CAP, SAMPLED, Clock, Disturbance, Drive, P, Slow, Task, Z
from .noise import CHANNELS, normals
from .programme import (
    STEERING_WIDTH,
    Pace,
    Wind,
    acceleration_command,
    realise,
    steering_at,
    wind_at,
    write_steering,
)
from .record import CAMERA, FAST, GPS, PACKET, PACKET_WIDTH, TICK, VALUES
from .reference import COST_CAP, Target, cost_rate, reference
from .sensors import (
    IN_FLIGHT,
    NEVER,
    Link,
    Noise,
    arrivals,
    camera_sample,
    clock_phase,
    gps_sample,
)

FAR = 1e15
RUNNING, SPIN, OFF_ROAD, NOT_FINITE, BAD_ACTION = range(5)
FAILURES = ("none", "spin", "off-road", "not-finite", "bad-action")
REFUSED = -1


class Switches(NamedTuple):
    """Integers that choose the text of the plant and the task, the same for a whole batch."""

    small_angle: int
    law: int
    reference: int
    steering: int  # kind of steering programme, used at reset
    all_samples: int  # the observation holds every fast sample
    fail_bad: int  # a non-finite action ends the episode instead of being refused


class Report(NamedTuple):
    """Columns of the numbers that go into `info`."""

    t: int = 0
    beta: int = 1
    gamma: int = 2
    psi: int = 3
    beta_ref: int = 4
    gamma_ref: int = 5
    steer: int = 6
    yaw_moment: int = 7
    cost: int = 8
    failure: int = 9
    packets: int = 10
    reward: int = 11
    ended: int = 12  # 1 the time is over


REPORT = Report()
_CAR, _MOTION, _LINK = len(Car._fields), len(Motion._fields), len(Link._fields)
_NOISE, _TARGET, _DRIVE = len(Noise._fields), len(Target._fields), len(Drive._fields)
_ROAD, _LAG, _WIND, _PACE = len(Road._fields), len(Lag._fields), 4, len(Pace._fields)
_OU, _TASK, _CLOCK, _SLOW = 4, len(Task._fields), len(Clock._fields), len(Slow._fields)


@jit
def _store(vector: Any, start: int, values: Any) -> None:
    for i in range(len(values)):
        vector[start + i] = values[i]


@jit
def _push(z: Any, sensor: int, captured: Any, due: Any, quality: Any, frame: Any, v: Any) -> None:
    """Put a captured sample on its way; the arrays' room was checked when the env was built."""
    for slot in range(IN_FLIGHT):
        at = Z.queue + (sensor * IN_FLIGHT + slot) * PACKET_WIDTH
        if z[at + PACKET.arrived] == NEVER:
            z[at + PACKET.sensor] = sensor
            z[at + PACKET.captured] = captured
            z[at + PACKET.arrived] = due
            z[at + PACKET.quality] = quality
            z[at + PACKET.sequence] = frame
            for i in range(VALUES):
                z[at + PACKET.value + i] = v[i]
            break
    z[Z.clock + 5] = minimum(z[Z.clock + 5], due)


@jit
def _capture(z: Any, sensor: int, at: int, link: Any, tick: Any, key: Any, v: Any, q: Any) -> None:
    """A frame of a slow sensor: queue it for its arrivals and set the clock on."""
    frame = z[at]
    block = CHANNELS.camera_link if sensor == CAMERA else CHANNELS.gps_link
    first, second = arrivals(link, frame, tick, key[0], key[1], block)
    if first != NEVER:
        _push(z, sensor, tick, first, q, frame, v)
    if second != NEVER:
        _push(z, sensor, tick, second, q, frame, v)
    z[at] = frame + 1.0
    z[at + 1] = tick + link.period


@jit
def _deliver(z: Any, tick: Any, packets: Any, count: int) -> int:
    """Move the packets that arrive at this tick into `packets`; returns the new count."""
    while True:
        best, best_rank, due = -1, FAR, FAR
        for slot in range(2 * IN_FLIGHT):
            at = Z.queue + slot * PACKET_WIDTH
            arrived = z[at + PACKET.arrived]
            if arrived == tick:
                rank = 2.0 * z[at + PACKET.captured] + z[at + PACKET.sensor]
                if rank < best_rank:
                    best, best_rank = at, rank
            elif arrived != NEVER:
                due = minimum(due, arrived)
        if best < 0:
            z[Z.clock + 5] = due
            return count
        for i in range(PACKET_WIDTH):
            packets[count, i] = z[best + i]
        newest = Z.camera if z[best] == CAMERA else Z.gps
        if z[best + PACKET.captured] > z[newest + 2]:
            z[newest + 2] = z[best + PACKET.captured]
            for i in range(VALUES):
                z[newest + 3 + i] = z[best + PACKET.value + i]
            z[newest + 3 + VALUES] = tick
        z[best + PACKET.arrived] = NEVER
        count += 1


@jit
def _sense(
    p: Any,
    z: Any,
    motion: Any,
    beta: Any,
    accel: Any,
    inputs: Any,
    rows: Any,
    j: int,
    packets: Any,
    count: int,
    n_fast: Any,
    wheels: Any,
) -> int:
    """Sensors sample the state at the current tick and due packets are delivered.

    accel: (a_x, a_y) specific forces. inputs: what acted, in the order of Fast from `steer` on.
    """
    noise = Noise(*fixed_tuple(p[P.noise :], _NOISE))
    half = 0.5 * p[P.car + 6] * motion.gamma
    row = rows[j]
    row[FAST.gyro] = motion.gamma + noise.gyro_bias + noise.gyro * n_fast[0]
    row[FAST.accel_y] = accel[1] + noise.accel_y_bias + noise.accel * n_fast[1]
    row[FAST.accel_x] = accel[0] + noise.accel * n_fast[2]
    row[FAST.wheel_left] = motion.v_x - half + noise.wheel * wheels[0]
    row[FAST.wheel_right] = motion.v_x + half + noise.wheel * wheels[1]
    _store(row, FAST.steer, inputs)
    tick = z[Z.clock + 2]
    key = (int(z[Z.clock]), int(z[Z.clock + 1]))
    if tick == z[Z.camera + 1]:
        link = Link(*fixed_tuple(p[P.camera :], _LINK))
        road = Road(*fixed_tuple(p[P.road :], _ROAD))
        n = normals(key[0], key[1], int(tick), CHANNELS.camera)
        psi, y_l = camera_sample(motion, road, p[P.car + 11], noise, n)
        _capture(z, CAMERA, Z.camera, link, tick, key, (psi, y_l, 0.0, 0.0), 1.0)
    if tick == z[Z.gps + 1]:
        link = Link(*fixed_tuple(p[P.gps :], _LINK))
        n = normals(key[0], key[1], int(tick), CHANNELS.gps)
        course, speed, X, Y, quality = gps_sample(motion, beta, noise, n)
        _capture(z, GPS, Z.gps, link, tick, key, (course, speed, X, Y), quality)
    if tick >= z[Z.clock + 5]:
        count = _deliver(z, tick, packets, count)
    return count


@jit
def _clip(value: Any, low: Any, high: Any) -> Any:
    return minimum(maximum(value, low), high)


@jit
def _observe(
    p: Any,
    z: Any,
    switches: Any,
    rows: Any,
    n: int,
    count: int,
    packets: Any,
    refs: Any,
    bounds: Any,
    obs: Any,
) -> None:
    """Write the float32 summary; every entry clipped at its bounds (layout.observation_layout)."""
    k = 0
    for column in range(SAMPLED):
        if switches[4]:
            for j in range(n):
                obs[k] = _clip(rows[j, column], bounds[0, k], bounds[1, k])
                k += 1
        else:
            total = 0.0
            for j in range(n):
                total = total + rows[j, column]
            obs[k] = _clip(rows[n - 1, column], bounds[0, k], bounds[1, k])
            obs[k + 1] = _clip(total / n, bounds[0, k + 1], bounds[1, k + 1])
            k += 2
    for i in range(4):
        obs[k] = _clip(rows[n - 1, FAST.steer + i], bounds[0, k], bounds[1, k])
        k += 1
    tick = z[Z.clock + 2]
    for sensor in range(2):
        at = Z.camera if sensor == CAMERA else Z.gps
        values = 2 if sensor == CAMERA else VALUES
        if p[P.camera if sensor == CAMERA else P.gps] > 0.0:
            for i in range(values):
                obs[k] = _clip(z[at + 3 + i], bounds[0, k], bounds[1, k])
                k += 1
            seen = z[at + 2] != NEVER
            obs[k] = _clip(select(seen, (tick - z[at + 2]) * TICK, AGE_CAP), 0.0, AGE_CAP)
            fresh = 0.0
            for i in range(count):
                newest = packets[i, PACKET.arrived] == z[at + 3 + VALUES]  # not late, no duplicate
                if packets[i, PACKET.sensor] == sensor and newest:
                    fresh = 1.0
            obs[k + 1] = fresh
            k += 2
    obs[k] = _clip(refs[0], bounds[0, k], bounds[1, k])
    obs[k + 1] = _clip(refs[1], bounds[0, k + 1], bounds[1, k + 1])


@jit
def _report(report: Any, z: Any, motion: Any, beta: Any, refs: Any, steer: Any, N_z: Any) -> None:
    report[REPORT.t] = z[Z.clock + 2] * TICK
    report[REPORT.beta] = beta
    report[REPORT.gamma] = motion.gamma
    report[REPORT.psi] = motion.psi
    report[REPORT.beta_ref] = refs[0]
    report[REPORT.gamma_ref] = refs[1]
    report[REPORT.steer] = steer
    report[REPORT.yaw_moment] = N_z
    report[REPORT.failure] = z[Z.clock + 3]


@jit
def reset_vehicle(
    template: Any,
    low: Any,
    high: Any,
    switches: Any,
    start: Any,
    drawn: Any,
    key_low: int,
    key_high: int,
    bounds: Any,
    p: Any,
    z: Any,
    obs: Any,
    rows: Any,
    packets: Any,
    report: Any,
) -> None:
    """Draw the episode from a key and deliver tick 0.

    template: packed parameters with the vehicle and everything the scenario does not draw.
    start: a Motion whose NaN entries are the default (standing on the road at the drawn speed).
    """
    for i in range(P.end):
        p[i] = template[i]
    d, redraws = realise(low, high, key_low, key_high, Car(*fixed_tuple(p, _CAR)), drawn)
    p[P.car + 4] = p[P.car + 4] * d.front_stiffness
    p[P.car + 5] = p[P.car + 5] * d.rear_stiffness
    p[P.car + 10] = d.friction
    write_steering(switches[3], d, p[P.steering :])
    p[P.wind] = select(d.wind_side < 0.5, -d.wind_force, d.wind_force)
    p[P.wind + 1] = d.wind_arm
    p[P.wind + 2] = floor(d.wind_start / TICK + 0.5)
    p[P.wind + 3] = p[P.wind + 2] + floor(d.wind_length / TICK + 0.5)
    p[P.pace] = d.speed
    for i in range(Z.end):
        z[i] = 0.0
    for slot in range(2 * IN_FLIGHT):
        z[Z.queue + slot * PACKET_WIDTH + PACKET.arrived] = NEVER
    z[Z.motion] = d.speed
    for i in range(_MOTION):
        if start[i] == start[i]:
            z[Z.motion + i] = start[i]
    n = normals(key_low, key_high, 0, CHANNELS.initial)
    z[Z.drive + 2] = steering_at(0.0, fixed_tuple(p[P.steering :], STEERING_WIDTH))
    z[Z.drive + 4] = p[P.disturbance] * n[0]
    z[Z.drive + 5] = p[P.disturbance + 1] * n[1]
    _store(z, Z.clock, (key_low * 1.0, key_high * 1.0, 0.0, 0.0, redraws * 1.0, FAR))
    for sensor in range(2):
        at = Z.camera if sensor == CAMERA else Z.gps
        link = Link(*fixed_tuple(p[P.camera if sensor == CAMERA else P.gps :], _LINK))
        z[at + 1] = select(link.period > 0.0, clock_phase(link, key_low, key_high, sensor), NEVER)
        z[at + 2] = NEVER
    motion = Motion(*fixed_tuple(z[Z.motion :], _MOTION))
    beta = sideslip_angle(motion.v_x, motion.v_y, switches[0])
    steer = z[Z.drive + 2]
    fast = normals(key_low, key_high, 0, CHANNELS.inertial)
    wheels = normals(key_low, key_high, 0, CHANNELS.wheels)
    inputs = (steer, 0.0, 0.0, steer, 0.0)
    accel = (0.0, 0.0)
    count = _sense(p, z, motion, beta, accel, inputs, rows, 0, packets, 0, fast, wheels)
    v = 0.5 * (rows[0, FAST.wheel_left] + rows[0, FAST.wheel_right])
    target = Target(*fixed_tuple(p[P.target :], _TARGET))
    refs = reference(steer, v, target, switches[2])
    if switches[4]:  # every sample of the step is asked for: tick 0 stands for all of them
        for j in range(1, len(rows)):
            rows[j, :] = rows[0, :]
        _observe(p, z, switches, rows, len(rows), count, packets, refs, bounds, obs)
    else:
        _observe(p, z, switches, rows, 1, count, packets, refs, bounds, obs)
    _report(report, z, motion, beta, refs, steer, 0.0)
    report[REPORT.cost] = 0.0
    report[REPORT.reward] = 0.0
    report[REPORT.packets] = count
    report[REPORT.ended] = 0.0


@jit
def _load_at(
    command: Any,
    delta: Any,
    delta_rest: Any,
    to_l: Any,
    T_l: Any,
    to_r: Any,
    T_r: Any,
    torque_rest: Any,
    car: Any,
    small_angle: int,
) -> Any:
    """The Load once the given rests of the actuators' deviations from their commands are left."""
    inputs = Inputs(
        lagged(command, delta, delta_rest),
        lagged(to_l, T_l, torque_rest),
        lagged(to_r, T_r, torque_rest),
    )
    return load_of(inputs, car, small_angle)


@jit
def step_vehicle(
    p: Any,
    z: Any,
    switches: Any,
    action: Any,
    n: int,
    bounds: Any,
    obs: Any,
    rows: Any,
    packets: Any,
    report: Any,
) -> int:
    """n ticks of one vehicle, fewer where the episode ends; returns how many.

    A non-finite action does nothing and returns REFUSED, or fails the episode (`fail_bad`).
    """
    share = float(action[0])  # in plain Python a float32 would make float32 of all that follows
    if share - share != 0.0:  # NaN or infinite
        if switches[5] == 0:
            return REFUSED
        z[Z.clock + 3] = BAD_ACTION
        report[REPORT.failure] = BAD_ACTION
        report[REPORT.cost] = COST_CAP * (p[P.task] - z[Z.clock + 2]) * TICK
        report[REPORT.reward] = -report[REPORT.cost]
        report[REPORT.packets] = 0.0
        return 0
    share = _clip(share, -1.0, 1.0)
    small_angle, law, kind = switches[0], switches[1], switches[2]
    car = Car(*fixed_tuple(p, _CAR))
    road = Road(*fixed_tuple(p[P.road :], _ROAD))
    motor = Lag(*fixed_tuple(p[P.motor :], _LAG))
    steering = Lag(*fixed_tuple(p[P.steer :], _LAG))
    wind = Wind(*fixed_tuple(p[P.wind :], _WIND))
    pace = Pace(*fixed_tuple(p[P.pace :], _PACE))
    target = Target(*fixed_tuple(p[P.target :], _TARGET))
    ou = Disturbance(*fixed_tuple(p[P.disturbance :], _OU))
    task = Task(*fixed_tuple(p[P.task :], _TASK))
    programme = fixed_tuple(p[P.steering :], STEERING_WIDTH)
    motion = Motion(*fixed_tuple(z[Z.motion :], _MOTION))
    T_l, T_r, delta, integral, F_d, N_d = fixed_tuple(z[Z.drive :], _DRIVE)
    key_low, key_high, tick = int(z[Z.clock]), int(z[Z.clock + 1]), z[Z.clock + 2]
    limit = 2.0 * car.T_max / (car.m * car.r)
    N_z = share * task.yaw_scale
    cost, count, failure, delivered = 0.0, 0, RUNNING, 0.0
    refs, beta = (0.0, 0.0), 0.0
    left, right, steer_acted = T_l, T_r, delta
    done = 0
    lagging = motor.start + steering.start > 0.0
    both_lag = motor.start * steering.start > 0.0
    start = load_of(Inputs(delta, T_l, T_r), car, small_angle)
    command = steering_at(tick, programme)
    for j in range(n):
        a_x, integral = acceleration_command(tick, motion.v_x, integral, pace, limit)
        to_l, to_r = distribute(N_z, a_x, car, task.yaw_first)
        F_w, N_w = wind_at(tick, wind)
        if lagging:  # actuators that lag move continuously: a tick starts where the last one ended
            if not both_lag:  # the other one jumps
                start = _load_at(
                    command,
                    delta,
                    steering.start,
                    to_l,
                    T_l,
                    to_r,
                    T_r,
                    motor.start,
                    car,
                    small_angle,
                )
            middle = _load_at(
                command,
                delta,
                steering.middle,
                to_l,
                T_l,
                to_r,
                T_r,
                motor.middle,
                car,
                small_angle,
            )
            end = _load_at(
                command, delta, steering.end, to_l, T_l, to_r, T_r, motor.end, car, small_angle
            )
        else:
            start = load_of(Inputs(command, to_l, to_r), car, small_angle)
            middle, end = start, start
        before = motion
        push = Push(F_d + F_w, N_d + N_w)
        motion = rk4(before, (start, middle, end), push, car, road, TICK, small_angle, law)
        start = end
        steer_acted = lagged(command, delta, steering.mean)
        left, right = lagged(to_l, T_l, motor.mean), lagged(to_r, T_r, motor.mean)
        delta = lagged(command, delta, steering.end)
        T_l, T_r = lagged(to_l, T_l, motor.end), lagged(to_r, T_r, motor.end)
        tick = tick + 1.0
        z[Z.clock + 2] = tick
        fast = normals(key_low, key_high, int(tick), CHANNELS.inertial)
        wheels = normals(key_low, key_high, int(tick), CHANNELS.wheels)
        # specific force, mean over the tick: v' and the turning of the axes
        turn_x = 0.5 * (before.gamma * before.v_y + motion.gamma * motion.v_y)
        turn_y = 0.5 * (before.gamma * before.v_x + motion.gamma * motion.v_x)
        accel = (
            (motion.v_x - before.v_x) / TICK - select(small_angle == 1, 0.0, turn_x),
            (motion.v_y - before.v_y) / TICK + turn_y,
        )
        F_d = ou.keep * F_d + ou.fresh * ou.force * wheels[2]
        N_d = ou.keep * N_d + ou.fresh * ou.moment * wheels[3]
        beta = sideslip_angle(motion.v_x, motion.v_y, small_angle)
        acted = (steer_acted, left, right, command, a_x)
        count = _sense(p, z, motion, beta, accel, acted, rows, j, packets, count, fast, wheels)
        v = 0.5 * (rows[j, FAST.wheel_left] + rows[j, FAST.wheel_right])
        command = steering_at(tick, programme)
        refs = reference(command, v, target, kind)
        delivered = yaw_moment(left, right, car)
        c = cost_rate(beta - refs[0], motion.gamma - refs[1], delivered / task.yaw_scale, 0.0, kind)
        cost = cost + c * TICK
        done = j + 1
        v_x, v_y, gamma = motion.v_x, motion.v_y, motion.gamma
        finite = v_x * v_x + v_y * v_y + gamma * gamma + motion.psi + motion.Y
        if finite - finite != 0.0:  # squares: the references take them too
            failure = NOT_FINITE
            motion, beta, refs = before, 0.0, (0.0, 0.0)  # the last that is fit for `info`
        elif absolute(beta) > task.spin and v_x > 0.0:  # backing up is no spin
            failure = SPIN
        elif absolute(motion.y) > task.half_width:
            failure = OFF_ROAD
        if failure != RUNNING or tick >= task.duration:
            break
    _store(z, Z.motion, motion)
    _store(z, Z.drive, (T_l, T_r, delta, integral, F_d, N_d))
    z[Z.clock + 3] = failure
    if failure != RUNNING:  # the rest of the episode is charged: failing never pays
        cost = cost + COST_CAP * (task.duration - tick) * TICK
    if switches[4] and done < n:  # an early end: the last sample stands for the missing ones
        for j in range(done, n):
            rows[j, :] = rows[done - 1, :]
        _observe(p, z, switches, rows, n, count, packets, refs, bounds, obs)
    else:
        _observe(p, z, switches, rows, done, count, packets, refs, bounds, obs)
    _report(report, z, motion, beta, refs, steer_acted, delivered)
    report[REPORT.cost] = cost
    report[REPORT.reward] = -cost
    report[REPORT.packets] = count
    report[REPORT.ended] = 1.0 if tick >= task.duration else 0.0
    return done
