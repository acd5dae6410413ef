"""The record: what the car's wires carry. Estimators, replay and logs read only this."""

import dataclasses
import itertools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .ticks import TICK

Array = npt.NDArray[np.float64]


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


class Packet(NamedTuple):
    """Columns of a slow sensor's packet."""

    sensor: int = 0  # CAMERA or GPS
    captured: int = 1  # tick
    arrived: int = 2  # tick
    quality: int = 3  # 1 good; 0 do not use the course (too slow)
    sequence: int = 4
    value: int = 5  # the first of six values


FAST, PACKET = Fast(), Packet()
FAST_UNITS = (
    "rad/s", "m/s2", "m/s2", "rad/s", "m/s", "m/s", "rad", "N m", "N m", "rad", "m/s2",
)  # fmt: skip
FAST_WIDTH, VALUES = len(FAST), 6
PACKET_WIDTH = PACKET.value + VALUES

CAMERA, GPS = 0, 1
SLOW_NAMES = ("camera", "gps")
SLOW_VALUES: dict[str, tuple[tuple[str, str], ...]] = {
    "camera": (("psi", "rad"), ("y_l", "m")),
    "gps": (
        ("course", "rad"),
        ("speed", "m/s"),
        ("X", "m"),
        ("Y", "m"),
        ("hdop", "-"),
        ("satellites", "-"),
    ),
}


@dataclass(frozen=True)
class SlowSensor:
    """A slow sensor's clock and link, as estimators are told it; times in seconds.

    A sample is captured every `period` from `phase` on (None: drawn at each reset; the running
    env's `slow_sensors` tells the drawn one). Frame i arrives `delays[i % len(delays)]` plus a
    random share of `jitter` later, unless it is lost (`loss`, a probability) or captured within
    an outage. `duplicate` is the probability that it arrives a second time.
    """

    period: float
    delays: tuple[float, ...] = (0.0,)
    phase: float | None = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "delays", tuple(float(d) for d in self.delays))
        if not TICK <= self.period < math.inf:
            raise ValueError(f"a slow sensor's period must be at least one tick, got {self.period}")
        if not self.delays or len(self.delays) > 4:
            raise ValueError(f"expected one to four delays, got {self.delays}")
        times = (*self.delays, self.jitter, self.phase or 0.0)
        if not all(0.0 <= time < math.inf for time in times):
            raise ValueError(f"{self}: delays, jitter and phase must be finite and not negative")
        for name in ("loss", "duplicate"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is a probability, got {getattr(self, name)}")

    @property
    def longest_delay(self) -> float:
        """The longest delay in seconds, jitter included."""
        return max(self.delays) + self.jitter


@dataclass
class Record:
    """Fast rows and packets of consecutive ticks.

    fast: (n, FAST_WIDTH), columns as in `Fast`. packets: (count, PACKET_WIDTH), columns as in
    `Packet`, ordered by arrival, then captured tick, then sensor. `first` is the tick of row 0,
    `dt` the tick in seconds. `present` names the fast columns that carry something.
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

    def packets_of(self, sensor: str) -> Array:
        """The packets of one slow sensor, (count, PACKET_WIDTH)."""
        wanted = self.packets[:, PACKET.sensor] == SLOW_NAMES.index(sensor)
        return np.asarray(self.packets[wanted], np.float64)


def concatenate(records: list[Record]) -> Record:
    """One record of the given consecutive ones; ValueError where ticks do not follow."""
    for before, after in itertools.pairwise(records):
        if after.first != before.first + len(before.fast):
            raise ValueError(
                f"a record that ends at tick {before.first + len(before.fast) - 1} "
                f"is followed by one that starts at tick {after.first}"
            )
    return dataclasses.replace(
        records[0],
        fast=np.concatenate([record.fast for record in records]),
        packets=np.concatenate([record.packets for record in records]),
    )


@dataclass
class Log:
    """A recorded drive or episode: a record, its slow sensors, and the truth where known.

    truth: columns by name ("beta", "psi", ...), each of one value a row, in SI units.
    """

    record: Record
    slow: dict[str, SlowSensor]
    truth: dict[str, Array] = field(default_factory=dict)
    name: str = "log"

    @property
    def time(self) -> Array:
        """Seconds of each row."""
        return np.asarray(self.record.ticks * self.record.dt, np.float64)
