"""An episode's arrays, and views of their numbers: vehicle, slow sensors, true state, record."""

import dataclasses
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..numerics.functions import TICK, count_ticks
from ..numerics.jit import jit
from ..numerics.packed import read
from ..numerics.primitives import Matrix, Vector
from ..record import FAST, FAST_WIDTH, PACKET_WIDTH, Array, Record
from ..scenarios.driver import compute_wind
from ..sensors.link import SlowSensor
from ..sensors.slow import SLOW_NAMES
from ..task import REPORT
from ..vehicle.dynamics import compute_gravity, compute_sideslip_angle
from ..vehicle.parameters import Vehicle
from ..vehicle.tyres import MAGIC_FORMULA, fit_fiala
from .config import EnvConfig, EpisodeConfig
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH, EpisodeArrays, P, Z
from .window import make_window


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


def make_episode_arrays(config: EnvConfig) -> EpisodeArrays:
    """Make the arrays of one car's episode, zeros but for the bounds.

    Args:
        config: Config of the environment.
    """
    n = int(config.control_period)
    return EpisodeArrays(
        p=np.zeros(PARAMS_WIDTH), z=np.zeros(STATE_WIDTH), switches=np.zeros(len(FLAGS), np.int64),
        obs=np.zeros(len(config.layout), np.float32), rows=np.zeros((n, FAST_WIDTH)),
        packets=np.zeros((config.max_packets, PACKET_WIDTH)), report=np.zeros(len(REPORT)),
        bounds=config.bounds, window=make_window(n),
    )  # fmt: skip
