"""Views of an episode's packed numbers: vehicle, slow sensors, motion, true state and record."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar, overload

import numpy as np

from ..numerics.jit import jit
from ..numerics.packed import read
from ..numerics.primitives import Matrix, Vector
from ..record import Array, Record
from ..scenarios.driver import compute_wind
from ..sensors.link import SlowSensor
from ..sensors.slow import SLOW_NAMES
from ..ticks import TICK, count_ticks
from ..vehicle.dynamics import Motion, compute_gravity, compute_sideslip_angle
from ..vehicle.parameters import Vehicle
from .config import EpisodeConfig
from .layout import FLAGS, P, Z

T = TypeVar("T")


def get_vehicle(config: EpisodeConfig, params: Array, state: Array) -> Vehicle:
    """Get the true vehicle now, with the seed's draws; friction is the mean of both sides."""
    car, change = read(params, P.car), read(params, P.tyre_change)
    if not car.m > 0.0:  # not reset yet
        return config.vehicle
    is_changed = state[Z.clock.tick] >= change.tick
    return config.vehicle.replace(
        front_stiffness=car.C_f * (change.front if is_changed else 1.0),
        rear_stiffness=car.C_r * (change.rear if is_changed else 1.0),
        friction=0.5 * (car.mu + car.mu_r),
    )


def get_slow_sensors(config: EpisodeConfig, state: Array) -> dict[str, SlowSensor]:
    """Get the slow sensors by name, with the clock phases that the episode drew."""
    sensors = {}
    for name, sensor in config.slow.items():
        if sensor.phase is None:
            column = Z.slow[SLOW_NAMES.index(name)]
            first = state[column.next_capture] - state[column.frames] * count_ticks(sensor.period)
            sensor = dataclasses.replace(sensor, phase=first * TICK)
        sensors[name] = sensor
    return sensors


def get_motion(state: Array) -> Motion:
    """Get the true `Motion` now, in SI units."""
    return read(state, Z.motion)


class TrueState(NamedTuple):
    """True values of the states that estimators may have: columns of an array."""

    beta: int = 0  # rad
    gamma: int = 1  # rad/s
    F_d: int = 2  # N, the whole lateral disturbance, with wind and bank
    N_d: int = 3  # N m, with the wind's
    phi: int = 4  # rad
    phi_rate: int = 5  # rad/s


TRUE_STATE = TrueState()


def compute_true_states(params: Array, states: Array, switches: Any) -> Array:
    """Compute the `TrueState` of N episodes now, shape (N, len(TrueState))."""
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


def make_record(state: Array, rows: Array, packets: Array) -> Record:
    """Make a record from copies of fast rows that end now, and of packets."""
    return Record(rows.copy(), packets.copy(), int(state[Z.clock.tick]) - len(rows) + 1)


class LazyRows(Sequence[T]):
    """Items of a batch's `count` rows, each made by `make_item` when it is read."""

    def __init__(self, count: int, make_item: Callable[[int], T]) -> None:
        self._rows, self._make_item = range(count), make_item

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, i: int) -> T: ...
    @overload
    def __getitem__(self, i: slice) -> tuple[T, ...]: ...
    def __getitem__(self, i: int | slice) -> T | tuple[T, ...]:
        if isinstance(i, slice):
            return tuple(map(self._make_item, self._rows[i]))
        return self._make_item(self._rows[i])

    def __repr__(self) -> str:
        return f"<{len(self)} rows>"
