"""One tick of the car: commands, actuators, plant, fast sensors, cost and failures.

The text is the same for one car, for cars in lanes, and for tensors of them. `advance` is a tick of
our plant; `command` and `sense`, before and after the motion, serve a plant of another's too.
"""

from typing import Any, NamedTuple

from ..backend.decorators import inlined
from ..backend.primitives import anywhere, select
from ..record import FAST
from ..scenarios.driver import steered
from ..scenarios.roads import NOMINAL_PATH, Lead, laid_by
from ..scenarios.speed import acceleration_command, wanted_motion
from ..scenarios.wind import wind_at
from ..sensors.inertial import Chance, fast_row, specific_force
from ..task.reference import followed, reference
from ..ticks import TICK
from ..vehicle.actuators import distribute, lagged, slewed, torque_limit, within_stop, yaw_moment
from ..vehicle.dynamics import Car, Push, Road, curvature_beside
from ..vehicle.integration import kutta3
from ..vehicle.tyres import Inputs, load_of
from .layout import Drive
from .window import Past

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
    road: int  # of `scenarios.roads.ROADS`


class Fixed(NamedTuple):
    """Parameters that are constant within an env-step; each a tuple of numbers."""

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
    leader: Any


class Moving(NamedTuple):
    """The state that a tick changes."""

    motion: Any
    drive: Any
    start: Any  # the Load at the tick's start
    driver: Any  # rad, the driver's steering command
    car: Any  # with its tyres as they are now
    refs: Any  # rad, rad/s, the references of beta and gamma
    lead: Any  # the nominal car that lays the road


class Acted(NamedTuple):
    """What acts during a tick, means; the first six are columns of `Fast`, from `steer` on."""

    steer: Any  # rad, front wheels
    T_l: Any  # N m
    T_r: Any
    driver: Any  # rad, the driver's command
    a_x: Any  # m/s2, the driver's command
    curvature: Any  # 1/m, the road's at the car
    added: Any  # rad, the part of steer that was added to the driver's
    moment: Any  # N m, yaw moment of both motors
    effort: Any  # its share of full scale


class Control(NamedTuple):
    """Inputs of the plant during a tick."""

    steer: Any  # rad, command to the front wheels
    T_l: Any  # N m, command to the left motor
    T_r: Any
    push: Any
    acted: Any
    drive: Any  # at the tick's end


class Seen(NamedTuple):
    """Sensors at the end of a tick."""

    row: Any  # the fast sensors, columns as in `Fast`
    refs: Any
    steer: Any  # rad, N m: of `Acted`
    moment: Any
    lost: Any  # whether the numbers are no longer finite
    past: Past


@inlined
def changed(car: Any, change: Any, now: Any) -> Any:
    """The car, its tyres changed where `now` holds."""
    C_f = select(now, car.C_f * change.front, car.C_f)
    C_r = select(now, car.C_r * change.rear, car.C_r)
    changed_tyres = (C_f, C_r)
    return Car(*(car[:4] + changed_tyres + car[6:]))


@inlined
def standing_load(drive: Any, car: Any, kind: Kind) -> Any:
    """The Load of the actuators as they are now."""
    inputs = Inputs(drive.delta_f, drive.T_l, drive.T_r)
    return load_of(inputs, car, kind.small_angle, kind.shifting)


@inlined
def load_at(steer: Any, T_l: Any, T_r: Any, drive: Any, rest: Any, car: Any, kind: Kind) -> Any:
    """The Load at a front angle, `rest` of the motors' deviation from T_l and T_r being left."""
    inputs = Inputs(steer, lagged(T_l, drive.T_l, rest), lagged(T_r, drive.T_r, rest))
    return load_of(inputs, car, kind.small_angle, kind.shifting)


@inlined
def torques(
    N_z: Any, tick: Any, v_x: Any, integral: Any, pace: Any, car: Any, yaw_first: Any
) -> Any:
    """(T_l, T_r, a_x, integral): torques in N m for a yaw moment and the driver's acceleration."""
    most = torque_limit(v_x, car)
    limit = 2.0 * most / (car.m * car.r)
    a_x, integral = acceleration_command(tick, v_x, integral, pace, limit)
    T_l, T_r = distribute(N_z, a_x, car, yaw_first, most)
    return T_l, T_r, a_x, integral


@inlined
def _at_change(fixed: Fixed, now: Moving, tick: Any, kind: Kind) -> Moving:
    """The state once the tyres have changed, if they do so at this tick."""
    here, car, start = tick == fixed.change.tick, now.car, now.start
    if anywhere(here):
        car = changed(car, fixed.change, here)
        start = standing_load(now.drive, car, kind)
    return Moving(now.motion, now.drive, start, now.driver, car, now.refs, now.lead)


@inlined
def _road_laid(fixed: Fixed, now: Moving, tick: Any) -> tuple[Fixed, Lead]:
    """(the parameters with the road as it turns during the tick, the nominal car at its end)."""
    speed, _ = wanted_motion(tick, fixed.pace)
    turn, lead = laid_by(now.lead, now.driver, speed, fixed.leader)
    road, turns = fixed.road, (turn,)
    laid = (Road(*(road[:5] + turns)),)
    return Fixed(*(fixed[:1] + laid + fixed[2:])), lead


@inlined
def command(fixed: Fixed, N_z: Any, turn: Any, now: Moving, tick: Any, chance: Chance) -> Control:
    """The plant's inputs during the tick that starts at `tick`; arguments as in `advance`."""
    motor, steering, task, ou = fixed.motor, fixed.steering, fixed.task, fixed.disturbance
    drive, driver, car = now.drive, now.driver, now.car
    slewing = slewed(drive.slewing, turn, task.slew)
    extra = within_stop(slewing, driver, task.stop)
    steer = driver + extra
    T_l, T_r, a_x, integral = torques(
        N_z, tick, now.motion.v_x, drive.integral, fixed.pace, car, task.yaw_first
    )
    F_w, N_w, N_x = wind_at(tick, fixed.wind)
    left, right = lagged(T_l, drive.T_l, motor.mean), lagged(T_r, drive.T_r, motor.mean)
    moment = yaw_moment(left, right, car)
    acted = Acted(
        lagged(steer, drive.delta_f, steering.mean),
        left,
        right,
        driver,
        a_x,
        curvature_beside(now.motion, fixed.road),
        lagged(extra, drive.added, steering.mean),
        moment,
        moment * (1.0 / task.yaw_scale),
    )
    after = Drive(
        lagged(T_l, drive.T_l, motor.end),
        lagged(T_r, drive.T_r, motor.end),
        lagged(steer, drive.delta_f, steering.end),
        integral,
        ou.keep * drive.F_d + ou.fresh * ou.force * chance.wheels[2],
        ou.keep * drive.N_d + ou.fresh * ou.moment * chance.wheels[3],
        slewing,
        lagged(extra, drive.added, steering.end),
    )
    return Control(steer, T_l, T_r, Push(drive.F_d + F_w, drive.N_d + N_w, N_x), acted, after)


@inlined
def _loads(fixed: Fixed, control: Control, now: Moving, kind: Kind) -> Any:
    """The Load at the start, the middle and the end of a tick."""
    motor, steering, drive, car, start = fixed.motor, fixed.steering, now.drive, now.car, now.start
    steer, T_l, T_r = control.steer, control.T_l, control.T_r
    if kind.lag == NO_LAG:
        start = load_of(Inputs(steer, T_l, T_r), car, kind.small_angle, kind.shifting)
        middle, end = start, start
    else:  # actuators that lag move continuously: a tick starts where the last one ended
        if kind.lag == ONE_LAGS:  # the other one jumps
            angle = lagged(steer, drive.delta_f, steering.start)
            start = load_at(angle, T_l, T_r, drive, motor.start, car, kind)
        angle = lagged(steer, drive.delta_f, steering.middle)
        middle = load_at(angle, T_l, T_r, drive, motor.middle, car, kind)
        angle = lagged(steer, drive.delta_f, steering.end)
        end = load_at(angle, T_l, T_r, drive, motor.end, car, kind)
    return start, middle, end


@inlined
def sense(
    fixed: Fixed,
    motion: Any,
    accel: Any,
    acted: Acted,
    before: Any,
    ahead: Any,
    chance: Chance,
    kind: Kind,
) -> tuple[Any, Seen]:
    """(the driver's command, what is Seen) at the end of a tick that led to a motion.

    accel: (a_x, a_y) in m/s2, specific forces. before: the references at the tick's start. The
    others are as in `advance`.
    """
    task = fixed.task
    row = fast_row(motion, accel, acted, fixed.car.d_f, fixed.noise, chance)
    v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
    driver = ahead
    if kind.follows:
        driver = steered(
            acted.driver, motion, fixed.path, fixed.road, fixed.target, fixed.person, task.stop
        )
    steady = reference(driver, v, fixed.target, kind.reference)
    refs = followed(before, steady, fixed.target, kind.reference)
    size = motion.v_x * motion.v_x + motion.v_y * motion.v_y + motion.gamma * motion.gamma
    finite = size + motion.psi + motion.Y + motion.phi  # squares: the references take them too
    seen = Seen(
        row,
        refs,
        acted.steer,
        acted.moment,
        finite - finite != 0.0,
        Past(refs[0], refs[1], acted.effort, acted.added),
    )
    return driver, seen


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
    """(the state, what is Seen) at the end of the tick that starts at `tick`.

    N_z: N m and turn: rad, the commanded yaw moment and added steering. chance: the numbers of the
    next tick. ahead: rad, the programme's steering at the next tick, which counts where no driver
    reacts to the car.
    """
    small_angle, law, roll = kind.small_angle, kind.law, kind.roll
    now, lead = _at_change(fixed, now, tick, kind), now.lead
    if kind.road == NOMINAL_PATH:
        fixed, lead = _road_laid(fixed, now, tick)
    control = command(fixed, N_z, turn, now, tick, chance)
    loads = _loads(fixed, control, now, kind)
    before, car, road = now.motion, now.car, fixed.road
    motion = kutta3(before, loads, control.push, car, road, TICK, small_angle, law, roll)
    accel = specific_force(before, motion, road, small_angle, roll)
    driver, seen = sense(fixed, motion, accel, control.acted, now.refs, ahead, chance, kind)
    return Moving(motion, control.drive, loads[2], driver, car, seen.refs, lead), seen
