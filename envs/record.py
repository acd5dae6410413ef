"""The record of a drive: fast rows and packets, all that estimators, replay and logs read."""

import dataclasses
import itertools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .numerics.functions import TICK
from .sensors.link import SlowSensor
from .sensors.slow import SLOW_NAMES, VALUES

Array = npt.NDArray[np.float64]
MOVING_SPEED = 4.0  # m/s, below which nothing of a drive is judged


class Fast(NamedTuple):
    """Columns of a fast row; row k holds the inputs that acted from tick k-1 to k."""

    gyro: int = 0  # rad/s
    accel_y: int = 1  # m/s2, specific force
    accel_x: int = 2  # m/s2
    roll_rate: int = 3  # rad/s
    wheel_left: int = 4  # m/s, left front wheel
    wheel_right: int = 5  # m/s
    steer: int = 6  # rad, applied front steering angle
    torque_left: int = 7  # N m, applied
    torque_right: int = 8  # N m, applied
    steer_command: int = 9  # rad, the driver's
    accel_command: int = 10  # m/s2, the driver's
    curvature: int = 11  # 1/m, the road's at the car, from a lane's polynomial or a map


class Packet(NamedTuple):
    """Columns of a slow sensor's packet."""

    sensor: int = 0  # its place in `sensors.slow.SLOW`
    captured: int = 1  # tick
    arrived: int = 2  # tick
    quality: int = 3  # 1 good; 0 unusable: too slow for a course, no lane in view
    sequence: int = 4
    value: int = 5  # the first of VALUES


FAST, PACKET = Fast(), Packet()
FAST_UNITS = (
    "rad/s", "m/s2", "m/s2", "rad/s", "m/s", "m/s", "rad", "N m", "N m", "rad", "m/s2",
    "1/m",
)  # fmt: skip
FAST_WIDTH, PACKET_WIDTH = len(FAST), PACKET.value + VALUES


@dataclass
class Record:
    """Fast rows and packets of consecutive ticks.

    Attributes:
        fast: Fast rows, shape (n, FAST_WIDTH), columns as in `Fast`.
        packets: Packets, shape (count, PACKET_WIDTH), columns as in `Packet`, ordered by arrival,
            then captured tick, then sensor.
        first: Tick of row 0.
        dt: Length of a tick (s).
        present: Names of the fast columns that carry something.
    """

    fast: Array
    packets: Array
    first: int = 0
    dt: float = TICK
    present: tuple[str, ...] = Fast._fields

    @property
    def ticks(self) -> npt.NDArray[np.int64]:
        """The tick of each row."""
        return np.arange(self.first, self.first + len(self.fast))

    def select_packets(self, sensor: str) -> Array:
        """Select the packets of one slow sensor, shape (count, PACKET_WIDTH).

        Args:
            sensor: Name of the sensor, "camera" or "gps".
        """
        is_wanted = self.packets[:, PACKET.sensor] == SLOW_NAMES.index(sensor)
        return np.asarray(self.packets[is_wanted], np.float64)


def concatenate(records: list[Record]) -> Record:
    """Concatenate records of consecutive ticks; ValueError where they do not follow.

    Args:
        records: Records in the order of time; each begins a tick after the one before it.
    """
    for before, after in itertools.pairwise(records):
        end = before.first + len(before.fast)
        if after.first != end:
            text = f"is followed by one that starts at tick {after.first}"
            raise ValueError(f"a record that ends at tick {end - 1} {text}")
    fast = np.concatenate([record.fast for record in records])
    packets = np.concatenate([record.packets for record in records])
    return dataclasses.replace(records[0], fast=fast, packets=packets)


@dataclass
class Log:
    """A recorded drive or episode: a record, its slow sensors, and the truth where it is known.

    Attributes:
        record: Fast rows and packets.
        slow: Slow sensors by name.
        truth: True values by name ("beta", "psi", ...), each of shape (n,), in SI units.
        name: Name of the log.
        origin: Time of tick 0 on the file's clock (s).
    """

    record: Record
    slow: dict[str, SlowSensor]
    truth: dict[str, Array] = field(default_factory=dict)
    name: str = "log"
    origin: float = 0.0

    @property
    def time(self) -> Array:
        """Time of each row (s), shape (n,)."""
        return np.asarray(self.record.ticks * self.record.dt, np.float64)

    @property
    def heading(self) -> Array:
        """The integral of the logged yaw rate (rad), 0 at the first row, shape (n,)."""
        gamma = self.record.fast[:, FAST.gyro]
        steps = 0.5 * (gamma[1:] + gamma[:-1]) * self.record.dt
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def speed(self) -> Array:
        """The mean speed of the front wheels (m/s), shape (n,)."""
        fast = self.record.fast
        return np.asarray(0.5 * (fast[:, FAST.wheel_left] + fast[:, FAST.wheel_right]))

    @property
    def is_moving(self) -> npt.NDArray[np.bool_]:
        """Whether the car is fast enough to judge, shape (n,)."""
        return np.asarray(self.speed > MOVING_SPEED)

    @property
    def is_backward(self) -> npt.NDArray[np.bool_]:
        """Whether it drives backward: the speed is negative, or the truth about half a turn."""
        beta = self.truth.get("beta", np.zeros(len(self.time)))
        turn = np.abs(np.nan_to_num(beta)) / math.pi
        return np.asarray((self.speed < 0.0) | ((turn > 0.75) & (turn < 1.01)))
