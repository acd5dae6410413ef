"""One env-step of one vehicle: n plant ticks, sensors, delivery, cost, observation; compiled.

Order of tick k: sensors sample the state at k; packets with arrival k are delivered, ordered by
(captured tick, sensor). The control of tick k acts until k+1. A step from tick k returns the
ticks k+1 .. k+n; a reset returns tick 0 alone.
"""

from typing import Any

from .actuators import Lag, distribute, lagged, slewed, within_stop, yaw_moment
from .backend import absolute, fixed_tuple, inlined, jit, select
from .delivery import sense, store
from .driver import Driver, steered
from .dynamics import Car, Motion, Push, Road, gravity_at, rk4, sideslip_angle
from .layout import Change, Disturbance, Drive, P, Task, Z
from .noise import CHANNELS, normals
from .pace import Pace, acceleration_command
from .programme import DRIVER, STEERING_WIDTH, Wind, steering_at, wind_at
from .record import FAST, TICK
from .reference import COST_CAP, Target, cost_rate, reference
from .summary import clip, observe, write_report
from .switches import BAD_ACTION, NOT_FINITE, OFF_ROAD, REFUSED, REPORT, RUNNING, SPIN
from .tracks import Path, path_offset
from .tyres import Inputs, load_of
from .vehicle import GRAVITY

_CAR, _MOTION, _ROAD, _LAG = (len(each._fields) for each in (Car, Motion, Road, Lag))
_WIND, _PACE, _TARGET = (len(each._fields) for each in (Wind, Pace, Target))
_OU, _TASK, _DRIVE = (len(each._fields) for each in (Disturbance, Task, Drive))
_DRIVER, _PATH, _CHANGE = (len(each._fields) for each in (Driver, Path, Change))


@inlined
def changed(car: Any, change: Any) -> Any:
    """The car once its tyres have changed."""
    tyres = (car.C_f * change.front, car.C_r * change.rear)
    return Car(*(car[:4] + tyres + car[6:]))


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


@inlined
def _specific_force(before: Any, after: Any, road: Any, small_angle: int, roll: int) -> Any:
    """(a_x, a_y) in m/s2, mean over a tick: v', the turning of the axes, and gravity."""
    turn_x = 0.5 * (before.gamma * before.v_y + after.gamma * after.v_y)
    turn_y = 0.5 * (before.gamma * before.v_x + after.gamma * after.v_x)
    turns_x = (small_angle == 0) | (roll == 1)  # tie-vision holds v_x; double-layer-gps (4)
    a_x = (after.v_x - before.v_x) / TICK - select(turns_x, turn_x, 0.0)
    a_y = (after.v_y - before.v_y) / TICK + turn_y
    if roll:
        a_y = a_y + 0.5 * GRAVITY * (before.phi + after.phi)  # double-layer-gps (5)
    if road.along != 0.0 or road.across != 0.0:
        first = gravity_at(before, road, small_angle)
        last = gravity_at(after, road, small_angle)
        a_x, a_y = a_x + 0.5 * (first[0] + last[0]), a_y + 0.5 * (first[1] + last[1])
    return a_x, a_y


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

    action: the share of the yaw moment and, if there are two, that of the added steering.
    A non-finite action does nothing and returns REFUSED, or fails the episode (`fail_bad`).
    """
    share = float(action[0])  # in plain Python a float32 would make float32 of all that follows
    turn = float(action[1]) if len(action) > 1 else 0.0
    both = share + turn
    if both - both != 0.0:  # NaN or infinite
        if switches[5] == 0:
            return REFUSED
        z[Z.clock + 3] = BAD_ACTION
        report[REPORT.failure] = BAD_ACTION
        report[REPORT.cost] = COST_CAP * (p[P.task] - z[Z.clock + 2]) * TICK
        report[REPORT.reward] = -report[REPORT.cost]
        report[REPORT.packets] = 0.0
        return 0
    share = clip(share, -1.0, 1.0)
    small_angle, law, kind, roll = switches[0], switches[1], switches[2], switches[6]
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
    person = Driver(*fixed_tuple(p[P.driver :], _DRIVER))
    path = Path(*fixed_tuple(p[P.path :], _PATH))
    change = Change(*fixed_tuple(p[P.change :], _CHANGE))
    motion = Motion(*fixed_tuple(z[Z.motion :], _MOTION))
    T_l, T_r, delta, integral, F_d, N_d, slewing, added = fixed_tuple(z[Z.drive :], _DRIVE)
    key_low, key_high, tick = int(z[Z.clock]), int(z[Z.clock + 1]), z[Z.clock + 2]
    limit = 2.0 * car.T_max / (car.m * car.r)
    N_z = share * task.yaw_scale
    wanted = clip(turn, -1.0, 1.0) * task.authority
    cost, count, failure, delivered = 0.0, 0, RUNNING, 0.0
    refs, beta = (0.0, 0.0), 0.0
    left, right, steer_acted = T_l, T_r, delta
    done = 0
    lagging = motor.start + steering.start > 0.0
    both_lag = motor.start * steering.start > 0.0
    if tick > change.tick:
        car = changed(car, change)
    start = load_of(Inputs(delta, T_l, T_r), car, small_angle)
    follows = switches[3] == DRIVER
    driver = z[Z.driver] if follows else steering_at(tick, programme)
    for j in range(n):
        if tick == change.tick:
            car = changed(car, change)
            start = load_of(Inputs(delta, T_l, T_r), car, small_angle)
        slewing = slewed(slewing, wanted, task.slew)
        extra = within_stop(slewing, driver, task.stop)
        command = driver + extra
        a_x, integral = acceleration_command(tick, motion.v_x, integral, pace, limit)
        to_l, to_r = distribute(N_z, a_x, car, task.yaw_first)
        F_w, N_w, N_x = wind_at(tick, wind)
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
        push = Push(F_d + F_w, N_d + N_w, N_x)
        motion = rk4(before, (start, middle, end), push, car, road, TICK, small_angle, law, roll)
        start = end
        steer_acted = lagged(command, delta, steering.mean)
        added_acted = lagged(extra, added, steering.mean)
        left, right = lagged(to_l, T_l, motor.mean), lagged(to_r, T_r, motor.mean)
        delta = lagged(command, delta, steering.end)
        added = lagged(extra, added, steering.end)
        T_l, T_r = lagged(to_l, T_l, motor.end), lagged(to_r, T_r, motor.end)
        tick = tick + 1.0
        z[Z.clock + 2] = tick
        fast = normals(key_low, key_high, int(tick), CHANNELS.inertial)
        wheels = normals(key_low, key_high, int(tick), CHANNELS.wheels)
        accel = _specific_force(before, motion, road, small_angle, roll)
        F_d = ou.keep * F_d + ou.fresh * ou.force * wheels[2]
        N_d = ou.keep * N_d + ou.fresh * ou.moment * wheels[3]
        beta = sideslip_angle(motion.v_x, motion.v_y, small_angle)
        acted = (steer_acted, left, right, driver, a_x)
        count = sense(
            p, z, motion, small_angle, accel, acted, rows, j, packets, count, fast, wheels
        )
        v = 0.5 * (rows[j, FAST.wheel_left] + rows[j, FAST.wheel_right])
        if follows:
            driver = steered(driver, motion, path, road, target, person, task.stop)
        else:
            driver = steering_at(tick, programme)
        refs = reference(driver, v, target, kind)
        delivered = yaw_moment(left, right, car)
        effort = delivered / task.yaw_scale
        c = cost_rate(beta - refs[0], motion.gamma - refs[1], effort, added_acted, kind)
        cost = cost + c * TICK
        done = j + 1
        v_x, v_y, gamma = motion.v_x, motion.v_y, motion.gamma
        finite = v_x * v_x + v_y * v_y + gamma * gamma + motion.psi + motion.Y + motion.phi
        if finite - finite != 0.0:  # squares: the references take them too
            failure = NOT_FINITE
            motion, beta, refs = before, 0.0, (0.0, 0.0)  # the last that is fit for `info`
        elif absolute(beta) > task.spin and v_x > 0.0:  # backing up is no spin
            failure = SPIN
        elif absolute(motion.y - (path_offset(path, motion.s) if follows else 0.0)) > (
            task.half_width
        ):
            failure = OFF_ROAD
        if failure != RUNNING or tick >= task.duration:
            break
    store(z, Z.motion, motion)
    store(z, Z.drive, (T_l, T_r, delta, integral, F_d, N_d, slewing, added))
    z[Z.driver] = driver
    z[Z.clock + 3] = failure
    if failure != RUNNING:  # the rest of the episode is charged: failing never pays
        cost = cost + COST_CAP * (task.duration - tick) * TICK
    if switches[4] and done < n:  # an early end: the last sample stands for the missing ones
        for j in range(done, n):
            rows[j, :] = rows[done - 1, :]
        observe(p, z, switches, rows, n, count, packets, refs, bounds, obs)
    else:
        observe(p, z, switches, rows, done, count, packets, refs, bounds, obs)
    write_report(report, z, motion, beta, refs, steer_acted, delivered)
    report[REPORT.cost] = cost
    report[REPORT.reward] = -cost
    report[REPORT.packets] = count
    report[REPORT.ended] = 1.0 if tick >= task.duration else 0.0
    return done
