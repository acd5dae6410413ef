"""Layout of an episode's two packed vectors, parameters and state, and what is read from them.

`P` and `Z` are `EpisodeParams` and `_EpisodeState` whose leaves are indices: `p[P.car.mu]` and
`z[Z.clock.tick]` are numbers, `read(z, Z.motion)` is a `Motion`. A copy of both is a snapshot.
"""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..numerics.functions import TICK, count_ticks
from ..numerics.jit import jit
from ..numerics.packed import make_offsets, read
from ..numerics.primitives import Matrix, Scalar, Vector
from ..record import FAST, FAST_WIDTH, PACKET_WIDTH, Array, Record
from ..scenarios.driver import STEERING_WIDTH, DriverParams, SpeedProfile, Wind, compute_wind
from ..scenarios.road import NominalMotion, TrackPath
from ..scenarios.scenario import Scenario
from ..sensors.inertial import ErrorState, Noise, SensorErrors
from ..sensors.link import MAX_IN_FLIGHT, Link, SlowSensor
from ..sensors.slow import SLOW, SLOW_NAMES, VALUES, FieldOfView, SatelliteGeometry
from ..task import RATE_TICKS, ReferenceParams
from ..vehicle.actuators import Lag
from ..vehicle.dynamics import (
    CarParams,
    Motion,
    RoadParams,
    compute_gravity,
    compute_sideslip_angle,
)
from ..vehicle.linear import Bicycle
from ..vehicle.parameters import Vehicle
from ..vehicle.tyres import MAGIC_FORMULA, fit_fiala


class Disturbance(NamedTuple):
    """Ornstein-Uhlenbeck lateral force and yaw moment, per tick."""

    force: Scalar  # N, standard deviation
    moment: Scalar  # N m
    decay: Scalar  # fraction that is left after a tick
    noise_gain: Scalar  # sqrt(1 - decay^2)


class TaskParams(NamedTuple):
    """The episode's length and limits."""

    duration: Scalar  # ticks
    half_width: Scalar  # m, half the width of the road or proving ground
    yaw_scale: Scalar  # N m, yaw moment of an action of 1
    yaw_first: Scalar  # 1: yaw moment before acceleration
    spin: Scalar  # rad, sideslip angle beyond which the car spins
    authority: Scalar  # rad, added steering of an action of 1
    slew: Scalar  # rad per tick, rate limit of the added steering
    stop: Scalar  # rad, limit of the whole front steering angle
    torque_slew: Scalar  # N m a tick, rate limit of a motor's command; 0: none; drawn
    lead_in: Scalar  # ticks before the manoeuvre, in which nothing acts and nothing is judged
    moment_rate: Scalar  # s2, weight of the yaw moment's rate in the cost


class TyreChange(NamedTuple):
    """Tyres and road that change in mid-run."""

    tick: Scalar  # at whose start they change
    front: Scalar  # factor on the front cornering stiffness
    rear: Scalar  # factor on the rear cornering stiffness
    friction: Scalar  # factor on the road's friction


class FrictionWave(NamedTuple):
    """Friction that varies along the road about the drawn one."""

    share: Scalar  # amplitude over friction; drawn, as are the others
    rate: Scalar  # rad/m
    phase: Scalar  # rad


class ActuatorState(NamedTuple):
    """Actuators, the driver's integral and the disturbances now acting."""

    T_l: Scalar  # N m, torque of the left motor
    T_r: Scalar  # N m, torque of the right motor
    delta_f: Scalar  # rad, front steering angle
    integral: Scalar  # m/s2, integral part of the driver's acceleration command
    F_d: Scalar  # N, lateral force
    N_d: Scalar  # N m, yaw moment
    slewing: Scalar  # rad, the command of added steering within its rate limit
    added: Scalar  # rad, the added steering that acts
    command_l: Scalar  # N m, command of the left motor within its rate limit
    command_r: Scalar  # N m, of the right motor


class Clock(NamedTuple):
    """Integers of an episode, as floats."""

    key_low: Scalar  # lower 32 bits of the episode's key
    key_high: Scalar  # upper 32 bits
    tick: Scalar
    failure: Scalar  # place in `FAILURES`
    redraws: Scalar  # how often an unstable car was drawn anew
    next_due: Scalar  # arrival tick of the next packet


class _SlowSensorState(NamedTuple):
    """State of a slow sensor, and its newest sample."""

    frames: Any  # captured so far
    next_capture: Scalar  # tick
    captured: Scalar  # tick of the newest delivered sample, NEVER before the first
    values: Annotated[tuple[Scalar, ...], VALUES]
    arrived: Scalar  # tick of the newest sample's delivery
    drift: Scalar  # what the sensor carries from sample to sample


SLOW_STATE, SLOW_WIDTH = make_offsets(_SlowSensorState)


class EpisodeParams(NamedTuple):
    """Parameters, constant within an episode: those of ticks, of errors, of slow sensors."""

    car: CarParams
    road: RoadParams
    motor: Lag
    steering: Lag
    wind: Wind
    speed_profile: SpeedProfile
    noise: Noise
    target: ReferenceParams
    disturbance: Disturbance
    task: TaskParams
    steering_profile: Annotated[tuple[Scalar, ...], STEERING_WIDTH]
    driver: DriverParams
    path: TrackPath
    tyre_change: TyreChange
    nominal_car: Bicycle  # nominal, which lays the road
    errors: SensorErrors  # drawn; ideal worlds have no use for it
    friction_wave: FrictionWave  # likewise
    slow: Annotated[tuple[Link, ...], len(SLOW)]
    sky: SatelliteGeometry  # of the GPS
    field_of_view: FieldOfView  # of the camera


class _EpisodeState(NamedTuple):
    """The state. New parts go at the end, or before `slow` where a plant tick changes them."""

    motion: Motion
    drive: ActuatorState
    clock: Clock
    refs: Annotated[tuple[Scalar, ...], 2]  # rad, rad/s, the references of beta and gamma
    nominal_motion: NominalMotion  # the nominal car where it lays the road
    errors: ErrorState  # of the fast sensors; with what follows, of a world that is not ideal
    # yaw moment as a fraction of full scale, of the last ticks, the oldest first
    past_efforts: Annotated[tuple[Scalar, ...], RATE_TICKS]
    slow: Annotated[tuple[_SlowSensorState, ...], len(SLOW)]
    # packets, columns as in `Packet`
    queue: Annotated[Vector, len(SLOW) * MAX_IN_FLIGHT * PACKET_WIDTH]
    driver: Scalar  # rad, the driver's steering command
    under_way: Scalar  # how many packets are in the queue


P, PARAMS_WIDTH = make_offsets(EpisodeParams)
Z, STATE_WIDTH = make_offsets(_EpisodeState)


class Switches(NamedTuple):
    """Integers that choose variants of the plant and the task, the same for a whole batch."""

    small_angle: int  # 1: the small-angle plant
    law: int  # place in `TYRE_LAWS`
    reference: int  # place in `REFERENCES`
    steering: int  # kind of steering profile, used at reset
    all_samples: int  # the observation holds every fast sample
    with_map: int  # the observation holds the road's curvature
    fail_bad: int  # a non-finite action ends the episode instead of being refused
    roll: int  # the body rolls
    road: int  # place in `scenarios.road.ROADS`
    has_errors: int  # 1: a `World` that is not ideal


FLAGS, _ = make_offsets(Switches)


class StepVariant(NamedTuple):
    """Integers that choose a tick's code, the same for all cars computed together."""

    small_angle: int  # 1: the small-angle plant
    law: int  # place in `TYRE_LAWS`
    reference: int  # place in `REFERENCES`
    roll: int  # 1: the body rolls
    has_driver: int  # the driver reacts to the car
    lag: int  # how many of motors and steering lag
    road: int  # place in `scenarios.road.ROADS`
    has_errors: int  # 1: a `World` that is not ideal


class EpisodeArrays(NamedTuple):
    """One episode's arrays."""

    # (PARAMS_WIDTH,), packed as in `EpisodeParams`; behind it a recorded trace, if there is one
    p: Vector
    z: Vector  # (STATE_WIDTH,), packed as in `_EpisodeState`
    switches: Vector  # (len(Switches),) int64
    obs: Vector  # (k,) float32
    rows: Matrix  # (n, FAST_WIDTH), the fast rows of the newest record
    packets: Matrix  # (max, PACKET_WIDTH), its packets
    report: Vector  # (len(Report),)
    bounds: Matrix  # (2, k), of the observation
    window: Matrix  # (WINDOW_HEIGHT, columns), the step's ticks


class EpisodeStart(NamedTuple):
    """The packed start of an episode; of several, arrays have an axis more, the first."""

    params: Vector  # as in `EpisodeArrays`, but for the draws
    low: Vector  # (len(Draws),), the ranges that it draws from
    high: Vector
    switches: Vector
    motion: Vector  # (len(Motion),), NaN: standing on the road at the drawn speed


@dataclass(frozen=True)
class EpisodeConfig:
    """An episode before its draws."""

    start: EpisodeStart
    vehicle: Vehicle  # with the scenario's replacements
    nominal: Vehicle  # likewise
    scenario: Scenario
    slow: dict[str, SlowSensor]
    held_speed: float | None  # m/s, where it is one number and held exactly


class CarTruth(NamedTuple):
    """What an oracle is told of an episode's constants."""

    vehicle: Vehicle  # the true one
    fiala: Vehicle  # likewise, with Fiala's law fitted to tyres of the Magic Formula
    motor_left: float  # torque over the commanded one, of the left motor
    motor_right: float
    # offset and scale of steering, wheels and torques, (2, FAST_WIDTH); of others 0 and 1
    calibration: Array


class Episode(NamedTuple):
    """An episode now: its config, and views of its packed numbers."""

    params: Array
    state: Array
    switches: npt.NDArray[np.int64]
    report: Array
    config: EpisodeConfig
    rows: Array  # of the newest record, shape (ticks, FAST_WIDTH)
    packets: Array  # shape (delivered, PACKET_WIDTH)

    @property
    def record(self) -> Record:
        """The newest record, a copy."""
        first = int(self.state[Z.clock.tick]) - len(self.rows) + 1
        return Record(self.rows.copy(), self.packets.copy(), first)

    @property
    def vehicle(self) -> Vehicle:
        """The true vehicle now, with the seed's draws; friction is the mean of both sides'."""
        car, change = read(self.params, P.car), read(self.params, P.tyre_change)
        if not car.m > 0.0:  # not reset yet
            return self.config.vehicle
        is_changed, vehicle = self.state[Z.clock.tick] >= change.tick, self.config.vehicle
        return vehicle.replace(
            mass=car.m, yaw_inertia=car.I, roll_inertia=car.I_x, front_arm=car.l_f,
            rear_arm=car.l_r, relaxation=car.relaxation,
            sprung_mass=vehicle.sprung_mass * (car.S / vehicle.roll_moment_arm),
            front_stiffness=car.C_f * (change.front if is_changed else 1.0),
            rear_stiffness=car.C_r * (change.rear if is_changed else 1.0),
            friction=0.5 * (car.mu + car.mu_r) * (change.friction if is_changed else 1.0),
        )  # fmt: skip

    @property
    def car_truth(self) -> CarTruth:
        """What an oracle is told; a calibrated reading is (reading - offset) / scale."""
        car, errors, vehicle = read(self.params, P.car), read(self.params, P.errors), self.vehicle
        calibration = np.array([[0.0], [1.0]]).repeat(FAST_WIDTH, axis=1)
        if not car.m > 0.0:  # not reset yet
            return CarTruth(vehicle, vehicle, 1.0, 1.0, calibration)
        angles, wheels = [FAST.steer, FAST.steer_command], [FAST.wheel_left, FAST.wheel_right]
        calibration[:, angles] = [[errors.steer_offset], [errors.steer_scale]]
        calibration[1, wheels] = errors.wheel_left, errors.wheel_right
        calibration[1, [FAST.torque_left, FAST.torque_right]] = 1.0 / car.k_l, 1.0 / car.k_r
        fiala = fit_fiala(vehicle) if self.switches[FLAGS.law] == MAGIC_FORMULA else vehicle
        return CarTruth(vehicle, fiala, float(car.k_l), float(car.k_r), calibration)

    @property
    def slow_sensors(self) -> dict[str, SlowSensor]:
        """The slow sensors by name, with the clock phases that the episode drew."""
        sensors = {}
        for name, sensor in self.config.slow.items():
            if sensor.phase is None:
                column, period = Z.slow[SLOW_NAMES.index(name)], count_ticks(sensor.period)
                first = self.state[column.next_capture] - self.state[column.frames] * period
                first += self.params[P.slow[SLOW_NAMES.index(name)].stamp]
                sensor = dataclasses.replace(sensor, phase=float(first) * TICK)
            sensors[name] = sensor
        return sensors


class TrueState(NamedTuple):
    """True values of the states that estimators may have: columns of an array."""

    beta: int = 0  # rad
    gamma: int = 1  # rad/s
    F_d: int = 2  # N, the whole lateral disturbance, with wind and bank
    N_d: int = 3  # N m, with the wind's
    phi: int = 4  # rad
    phi_rate: int = 5  # rad/s
    friction_factor: int = 6  # by which a `friction_change` has changed friction


TRUE_STATE = TrueState()


def compute_true_states(params: Array, states: Array, switches: npt.NDArray[np.int64]) -> Array:
    """Compute the `TrueState` of N episodes now, shape (N, len(TrueState)).

    Args:
        params: Packed parameters, a row for each.
        states: Packed states likewise.
        switches: `Switches` likewise.
    """
    out = np.empty((len(params), len(TRUE_STATE)))
    _write_true_states(params, states, switches, out)
    return out


@jit
def _write_true_states(params: Vector, states: Vector, switches: Matrix, out: Matrix) -> None:
    """Write the `TrueState` of N episodes into out (N, len(TrueState))."""
    for i in range(len(params)):
        p, z = params[i], states[i]
        motion, small_angle = read(z, Z.motion), switches[i, FLAGS.small_angle]
        F_w, N_w, _ = compute_wind(z[Z.clock.tick], read(p, P.wind))
        _, lateral_gravity = compute_gravity(motion, read(p, P.road), small_angle)
        out[i, TRUE_STATE.beta] = compute_sideslip_angle(motion.v_x, motion.v_y, small_angle)
        out[i, TRUE_STATE.gamma] = motion.gamma
        out[i, TRUE_STATE.F_d] = z[Z.drive.F_d] + F_w - p[P.car.m] * lateral_gravity
        out[i, TRUE_STATE.N_d] = z[Z.drive.N_d] + N_w
        out[i, TRUE_STATE.phi], out[i, TRUE_STATE.phi_rate] = motion.phi, motion.phi_dot
        change = read(p, P.tyre_change)
        is_changed = z[Z.clock.tick] >= change.tick
        out[i, TRUE_STATE.friction_factor] = change.friction if is_changed else 1.0
