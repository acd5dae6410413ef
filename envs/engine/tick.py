"""One tick of the car: what the driver asks, the actuators do, the plant and the fast sensors make
of it, and what it costs.

The text of a tick is the same for one car, abreast in lanes, and tensors of them.
"""

from typing import Any, NamedTuple

from ..backend.decorators import inlined, jit
from ..backend.primitives import absolute, anywhere, select
from ..record import FAST
from ..scenarios.driver import steered
from ..scenarios.speed import acceleration_command
from ..scenarios.tracks import path_offset
from ..scenarios.wind import wind_at
from ..sensors.inertial import Chance, fast_row
from ..task.cost import cost_rate
from ..task.failures import NOT_FINITE, OFF_ROAD, RUNNING, SPIN
from ..task.reference import reference
from ..ticks import TICK
from ..vehicle.actuators import distribute, lagged, slewed, within_stop, yaw_moment
from ..vehicle.dynamics import Car, Push, gravity_at, rk4, sideslip_angle
from ..vehicle.tyres import Inputs, load_of
from ..vehicle.vehicle import GRAVITY
from .layout import Drive

NO_LAG, ONE_LAGS = range(2)  # 2: both lag


class Kind(NamedTuple):
    """Integers that choose a tick's text: the same for all cars that are computed together."""

    small_angle: int
    law: int
    reference: int
    roll: int
    follows: int  # the driver reacts to the car
    lag: int  # how many of motors and steering lag
    shifting: int  # `tyres.shifts`


class Fixed(NamedTuple):
    """What does not change within an env-step; each a tuple of numbers."""

    car: Any
    road: Any
    motor: Any
    steering: Any
    wind: Any
    pace: Any
    target: Any
    disturbance: Any
    task: Any
    noise: Any
    person: Any
    path: Any
    change: Any


class Moving(NamedTuple):
    """What a tick moves on."""

    motion: Any
    drive: Any
    start: Any  # the Load at the tick's start
    driver: Any  # rad, the driver's steering command
    car: Any  # with its tyres as they are now


class Seen(NamedTuple):
    """What a tick shows."""

    row: Any  # the fast sensors, columns as in `Fast`
    cost: Any  # per second
    beta: Any
    refs: Any
    steer: Any  # rad, N m: what acted
    moment: Any
    lost: Any  # whether the numbers are no longer finite,
    spun: Any  # the car spins,
    off: Any  # or has left the road


@inlined
def changed(car: Any, change: Any, now: Any) -> Any:
    """The car, its tyres changed where `now` holds."""
    C_f = select(now, car.C_f * change.front, car.C_f)
    C_r = select(now, car.C_r * change.rear, car.C_r)
    changed_tyres = (C_f, C_r)
    return Car(*(car[:4] + changed_tyres + car[6:]))


@jit
def standing_load(drive: Any, car: Any, kind: Kind) -> Any:
    """The Load of what the actuators do now."""
    return load_of(
        Inputs(drive.delta_f, drive.T_l, drive.T_r), car, kind.small_angle, kind.shifting
    )


@jit
def _load_at(
    command: Any,
    to_l: Any,
    to_r: Any,
    drive: Any,
    steering_rest: Any,
    motor_rest: Any,
    car: Any,
    kind: Kind,
) -> Any:
    """The Load once the given rests of the actuators' deviations from their commands are left."""
    inputs = Inputs(
        lagged(command, drive.delta_f, steering_rest),
        lagged(to_l, drive.T_l, motor_rest),
        lagged(to_r, drive.T_r, motor_rest),
    )
    return load_of(inputs, car, kind.small_angle, kind.shifting)


@inlined
def _specific_force(before: Any, after: Any, road: Any, small_angle: int, roll: int) -> Any:
    """(a_x, a_y) in m/s2, mean over a tick: v', the turning of the axes, and gravity."""
    turn_x = 0.5 * (before.gamma * before.v_y + after.gamma * after.v_y)
    turn_y = 0.5 * (before.gamma * before.v_x + after.gamma * after.v_x)
    turns_x = (small_angle == 0) | (roll == 1)  # tie-vision holds v_x; double-layer-gps (4)
    a_x = (after.v_x - before.v_x) * (1.0 / TICK) - select(turns_x, turn_x, 0.0)
    a_y = (after.v_y - before.v_y) * (1.0 / TICK) + turn_y
    if roll:
        a_y = a_y + 0.5 * GRAVITY * (before.phi + after.phi)  # double-layer-gps (5)
    if anywhere((road.along != 0.0) | (road.across != 0.0)):
        first = gravity_at(before, road, small_angle)
        last = gravity_at(after, road, small_angle)
        a_x, a_y = a_x + 0.5 * (first[0] + last[0]), a_y + 0.5 * (first[1] + last[1])
    return a_x, a_y


@inlined
def advance(
    fixed: Fixed,
    N_z: Any,
    turn: Any,
    now: Moving,
    tick: Any,
    chance: Chance,
    ahead: Any,
    kind: Kind,
) -> tuple[Moving, Seen]:
    """(what moved, what is seen) at the end of the tick that starts at `tick`.

    N_z: N m and turn: rad, the yaw moment and the added steering that are asked for. chance: the
    numbers of the next tick. ahead: rad, the programme's steering at the next tick, which counts
    where no driver reacts to the car.
    """
    small_angle, law, roll = kind.small_angle, kind.law, kind.roll
    road, motor, steering, ou = fixed.road, fixed.motor, fixed.steering, fixed.disturbance
    task = fixed.task
    before, drive, driver, start, car = now.motion, now.drive, now.driver, now.start, now.car
    at_change = tick == fixed.change.tick
    if anywhere(at_change):
        car = changed(car, fixed.change, at_change)
        start = standing_load(drive, car, kind)
    slewing = slewed(drive.slewing, turn, task.slew)
    extra = within_stop(slewing, driver, task.stop)
    command = driver + extra
    limit = 2.0 * car.T_max / (car.m * car.r)
    a_x, integral = acceleration_command(tick, before.v_x, drive.integral, fixed.pace, limit)
    to_l, to_r = distribute(N_z, a_x, car, task.yaw_first)
    if kind.lag == NO_LAG:
        start = load_of(Inputs(command, to_l, to_r), car, small_angle, kind.shifting)
        middle, end = start, start
    else:  # actuators that lag move continuously: a tick starts where the last one ended
        if kind.lag == ONE_LAGS:  # the other one jumps
            start = _load_at(command, to_l, to_r, drive, steering.start, motor.start, car, kind)
        middle = _load_at(command, to_l, to_r, drive, steering.middle, motor.middle, car, kind)
        end = _load_at(command, to_l, to_r, drive, steering.end, motor.end, car, kind)
    F_w, N_w, N_x = wind_at(tick, fixed.wind)
    push = Push(drive.F_d + F_w, drive.N_d + N_w, N_x)
    motion = rk4(before, (start, middle, end), push, car, road, TICK, small_angle, law, roll)
    steer = lagged(command, drive.delta_f, steering.mean)
    added = lagged(extra, drive.added, steering.mean)
    left, right = lagged(to_l, drive.T_l, motor.mean), lagged(to_r, drive.T_r, motor.mean)
    drive = Drive(
        lagged(to_l, drive.T_l, motor.end),
        lagged(to_r, drive.T_r, motor.end),
        lagged(command, drive.delta_f, steering.end),
        integral,
        ou.keep * drive.F_d + ou.fresh * ou.force * chance.wheels[2],
        ou.keep * drive.N_d + ou.fresh * ou.moment * chance.wheels[3],
        slewing,
        lagged(extra, drive.added, steering.end),
    )
    accel = _specific_force(before, motion, road, small_angle, roll)
    acted = (steer, left, right, driver, a_x)
    row = fast_row(motion, accel, acted, car.d_f, fixed.noise, chance)
    v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
    beta = sideslip_angle(motion.v_x, motion.v_y, small_angle)
    if kind.follows:
        driver = steered(driver, motion, fixed.path, road, fixed.target, fixed.person, task.stop)
        aside = motion.y - path_offset(fixed.path, motion.s)
    else:
        driver = ahead
        aside = motion.y - 0.0
    refs = reference(driver, v, fixed.target, kind.reference)
    moment = yaw_moment(left, right, car)
    effort = moment * (1.0 / task.yaw_scale)
    cost = cost_rate(beta - refs[0], motion.gamma - refs[1], effort, added, kind.reference)
    size = motion.v_x * motion.v_x + motion.v_y * motion.v_y + motion.gamma * motion.gamma
    finite = size + motion.psi + motion.Y + motion.phi  # squares: the references take them too
    seen = Seen(
        row,
        cost,
        beta,
        refs,
        steer,
        moment,
        finite - finite != 0.0,
        (absolute(beta) > task.spin) & (motion.v_x > 0.0),  # backing up is no spin
        absolute(aside) > task.half_width,
    )
    return Moving(motion, drive, end, driver, car), seen


@jit
def failure_of(seen: Seen) -> Any:
    """The failure's code, as a float."""
    failure = select(seen.spun, SPIN * 1.0, select(seen.off, OFF_ROAD * 1.0, RUNNING * 1.0))
    return select(seen.lost, NOT_FINITE * 1.0, failure)
