"""Forecast of an episode before it begins: driver, wind and disturbances, step by step."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.backend.arrays import read
from ...envs.backend.decorators import plain
from ...envs.engine.arrays import Row
from ...envs.engine.layout import Drive, P, Task, Z
from ...envs.engine.step import kind_of, step_vehicle
from ...envs.engine.tick import Kind
from ...envs.engine.window import programmed, window_of
from ...envs.scenarios.roads import NOMINAL_PATH, Lead, laid_by
from ...envs.scenarios.speed import Pace, acceleration_command, wanted_motion
from ...envs.scenarios.wind import wind_at
from ...envs.task.info import REPORT
from ...envs.task.reference import Target
from ...envs.ticks import FOREVER, TICK
from ...envs.vehicle.actuators import Lag, lag_of, lagged
from ...envs.vehicle.dynamics import Car, Road

Array = npt.NDArray[np.float64]


class Known(NamedTuple):
    """Inputs and parameters of one step of the plan that no action changes, or hardly
    (`beta_ref`, `gamma_ref`); `command` and `weight` are of the step's start."""

    steer_start: Any  # rad, front steering angle without the added one
    steer_middle: Any
    steer_end: Any
    command: Any  # rad, the driver's
    F_d: Any  # N, mean over the step, with the wind's
    N_d: Any  # N m
    N_x: Any  # N m
    C_f: Any  # N/rad
    C_r: Any
    mu: Any
    mu_r: Any
    speed: Any  # m/s, the driver's set point
    ahead: Any  # m/s2, the driver's acceleration, fed forward
    turn: Any  # rad/s, of a road that is laid tick by tick
    weight: Any  # s for which the cost rate at the start counts
    beta_ref: Any  # rad, of a reference with a memory; of the step's start
    gamma_ref: Any  # rad/s


class State(NamedTuple):
    """States of a plan: motion, actuators, the driver's integral."""

    v_x: Any
    v_y: Any
    gamma: Any
    psi: Any
    X: Any
    Y: Any
    s: Any
    y: Any
    theta: Any
    phi: Any
    phi_dot: Any
    T_l: Any
    T_r: Any
    integral: Any
    slewing: Any
    added: Any


class Fixed(NamedTuple):
    """Parameters that are constant within an episode; hashable, so that they are a solver's key.

    car: with zeros for the fields of `Known`. motor, steering: of a step; motor_tick,
    steering_tick: of a tick. ticks: of a step, a control period. periods: of the episode. width:
    of the action.
    """

    car: Car
    road: Road
    pace: Pace
    motor: Lag
    steering: Lag
    motor_tick: Lag
    steering_tick: Lag
    target: Target
    task: Task
    kind: Kind
    width: int
    ticks: int
    periods: int


@dataclass(frozen=True)
class Forecast:
    """An episode as a plan sees it.

    known: (len(Known), periods + 1), the last column of the episode's end. start: the state at
    tick 0. driver: (periods, n) rad, the driver's command at every tick.
    """

    fixed: Fixed
    known: Array
    start: State
    driver: Array


def forecast_of(base: Any, actions: Array | None = None) -> Forecast:
    """The rest of an episode that was just reset.

    base: the unwrapped env at tick 0. actions: (K, width), none: zero; a driver who reacts to the
    car steers as in the run of these actions. Raises ValueError for an env that is not at the start
    of an episode.
    """
    n = base.control_period
    snapshot = base.get_state()
    p, z = snapshot["params"], snapshot["state"]
    if z[Z.clock.tick] != 0.0:
        raise ValueError("a forecast starts at an episode's start: call reset() first")
    start = state_of(z)
    fixed = _fixed(base, p, snapshot["config"].start.switches, n)
    ticks = fixed.periods * n
    if actions is None:
        actions = np.zeros((fixed.periods, fixed.width))
    drive, driver, refs = _driven(base, snapshot, actions, n)
    command = driver
    if not fixed.kind.follows and base.scenario.steering != "wander":
        command = np.array([programmed(p, float(k)) for k in range(ticks + 1)])
    known = _known(p, fixed, drive, command, refs)
    return Forecast(fixed, known, start, command[:-1].reshape(-1, n))


def state_of(z: Array) -> State:
    """The State in a packed state vector of the env."""
    motion, drive = read(z, Z.motion), read(z, Z.drive)
    return State._make((*motion, drive.T_l, drive.T_r, drive.integral, drive.slewing, drive.added))


def _fixed(base: Any, p: Array, switches: Any, ticks: int) -> Fixed:
    vehicle, lags = base.vehicle, base.scenario.lags
    motor, steering = (vehicle.motor_lag, vehicle.steering_lag) if lags else (0.0, 0.0)
    task = read(p, P.task)
    return Fixed(
        read(p, P.car)._replace(C_f=0.0, C_r=0.0, mu=0.0, mu_r=0.0),
        read(p, P.road),
        read(p, P.pace)._replace(speed=0.0, acceleration=0.0, start=0.0, end=FOREVER, surge=0.0),
        lag_of(motor, ticks * TICK),
        lag_of(steering, ticks * TICK),
        lag_of(motor, TICK),
        lag_of(steering, TICK),
        read(p, P.target),
        task,
        plain(kind_of)(p, switches),
        base.action_space.shape[0],
        ticks,
        -int(-task.duration // ticks),
    )


def _driven(base: Any, snapshot: Any, actions: Array, n: int) -> tuple[Array, Array, Array]:
    """(K n + 1, len(Drive)), the driver's angle (K n + 1,) and the references (K n + 1, 2): the
    env's own ticks under actions.

    Disturbances, and a programme's front wheels without the added angle, do not depend on them.
    """
    z, window = snapshot["state"], window_of(1)
    bounds = np.array([[entry.low, entry.high] for entry in base.layout]).T.copy()
    row = Row(
        p=snapshot["params"],
        z=z,
        switches=snapshot["switches"],
        obs=np.empty(len(base.layout), np.float32),
        rows=snapshot["rows"],
        packets=snapshot["packets"],
        report=np.zeros(len(REPORT)),
    )
    taken = np.repeat(np.vstack([actions, actions[-1:]]).astype(np.float32), n, axis=0)
    ticks = n * len(actions)
    drive, driver = np.empty((ticks + 1, len(Drive._fields))), np.empty(ticks + 1)
    refs = np.empty((ticks + 1, 2))
    for tick in range(ticks + 1):
        drive[tick] = read(z, Z.drive)
        driver[tick], refs[tick] = z[Z.driver], read(z, Z.refs)
        step_vehicle(*row, taken[tick], 1, bounds, window)
    # a car thrown about may leave the numbers
    return np.nan_to_num(drive), np.nan_to_num(driver), np.nan_to_num(refs)


def _known(p: Array, fixed: Fixed, drive: Array, command: Array, refs: Array) -> Array:
    """(len(Known), steps of the plan + 1)."""
    q, last = fixed.ticks, len(command) - 1
    at = np.arange(0, last, q)
    names = Drive._fields
    angle = drive[:, names.index("delta_f")] - drive[:, names.index("added")]

    def wheels(ticks: Any, rest: float) -> Array:
        """The front wheels without the added angle, once `rest` of a tick's deviation is left."""
        return np.asarray(plain(lagged)(command[ticks], angle[ticks], rest))

    lag, middle = fixed.steering_tick, at + q // 2
    wind = read(p, P.wind)
    blown = np.array([wind_at(float(tick), wind) for tick in range(last)])
    forces = np.column_stack(
        [drive[:last, names.index("F_d")], drive[:last, names.index("N_d")], np.zeros(last)]
    )
    push = (forces + blown).reshape(-1, q, 3).mean(axis=1)
    pace = np.array([_set_point(float(tick), read(p, P.pace)) for tick in at])
    car, change = read(p, P.car), read(p, P.change)
    worn = at >= change.tick
    tyres = [
        np.where(worn, factor * stiffness, stiffness)
        for factor, stiffness in ((change.front, car.C_f), (change.rear, car.C_r))
    ]
    table = (
        wheels(at, lag.start),
        wheels(middle, lag.middle if q % 2 else lag.start),
        wheels(at + q - 1, lag.end),
        command[at],
        *push.T,
        *tyres,
        *(np.full(len(at), value) for value in (car.mu, car.mu_r)),
        *pace.T,
        _turns(p, fixed.kind, command[:last]).reshape(-1, q).mean(axis=1),
        _weights(at, fixed),
        *refs[at].T,
    )
    known = np.array(Known._make(table))
    end = known[:, -1:].copy()  # of the episode's end only command, references and weight count
    end[Known._fields.index("command")] = command[last]
    end[Known._fields.index("beta_ref") :, 0] = refs[last]
    end[Known._fields.index("weight")] = (
        0.5 * (q + 1) * TICK if last == fixed.task.duration else 0.0
    )
    return np.hstack([known, end])


def _turns(p: Array, kind: Kind, command: Array) -> Array:
    """(ticks,) rad/s, by how much the road turns in each tick, where a nominal car lays it."""
    turns, lead = np.zeros(len(command)), Lead(0.0, 0.0)
    if kind.road == NOMINAL_PATH:
        pace, leader = read(p, P.pace), read(p, P.leader)
        wanted, laid = plain(wanted_motion), plain(laid_by)
        for tick, steer in enumerate(command):
            turns[tick], lead = laid(lead, steer, wanted(float(tick), pace)[0], leader)
    return turns


def _set_point(tick: float, pace: Pace) -> tuple[float, float]:
    """The driver's (speed in m/s, acceleration in m/s2 fed forward) at a tick."""
    bare = pace._replace(hold=1.0, k_p=0.0, k_i=0.0)
    ahead = acceleration_command(tick, 0.0, 0.0, bare, np.inf)[0]
    both = acceleration_command(tick, 0.0, 0.0, bare._replace(k_p=1.0), np.inf)[0]
    return both - ahead, ahead


def _weights(at: npt.NDArray[np.int_], fixed: Fixed) -> Array:
    """Seconds for which the cost rate at each step's start stands in the sum over ticks 1 .. T.

    The sum over every q-th tick by the trapezoid rule, its end apart; exact for q = 1.
    """
    q = fixed.ticks
    weights = np.where(at < fixed.task.duration, q * TICK, 0.0)
    weights[0] = 0.5 * (q - 1) * TICK
    return np.asarray(weights)
