"""What each slow sensor measures: its rows of C and their noise.

A new slow sensor is an entry of `MEASUREMENTS`: options, states and compiled code follow it.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...envs.record import PACKET
from ...envs.sensors.slow import SLOW, SLOW_NAMES
from ..core.memory import KNOTS
from ..filters import Filter
from .options import Options

COURSE_SPEED = 60.0 / 3.6  # m/s at which the receivers' course noise is quoted


class Row(NamedTuple):
    """One value of a packet as a measurement: a sum of states.

    noise: its standard deviation is the option `<noise>_noise`. sd: that option's default, in the
    unit of the value. angle: the innovation is wrapped. over_speed: the default holds at
    `COURSE_SPEED` and grows as 1/V; the option holds at every speed. ground: it is a direction over
    the ground, where psi is relative to the road.
    """

    states: tuple[str, ...]
    noise: str
    sd: float
    angle: bool = False
    over_speed: bool = False
    ground: bool = False


@dataclass(frozen=True)
class Measurement:
    """A slow sensor as a filter sees it.

    rows: of a bicycle's states, for the packet's first values. velocities: in their place, of a
    second layer. heading_fix: its first sample, where it is far off, sets psi.
    """

    rows: tuple[Row, ...]
    velocities: tuple[Row, ...] = ()
    heading_fix: bool = False


MEASUREMENTS: dict[str, Measurement] = {
    "camera": Measurement(
        (Row(("psi",), "psi", 3.5e-3, angle=True), Row(("y_l",), "y_l", 0.02)),
    ),
    "gps": Measurement(
        (Row(("beta", "psi"), "course", math.radians(0.14), True, True, ground=True),),
        (Row(("v_x",), "gps_speed", 0.05), Row(("v_y",), "gps_speed", 0.05)),  # (41)
        heading_fix=True,
    ),
}
"""By the sensor's name. (41): double-layer-gps."""


_ROWS = [row for sensor in MEASUREMENTS.values() for row in sensor.rows]
_VELOCITIES = [row for sensor in MEASUREMENTS.values() for row in sensor.velocities]
NOISE = {"gyro_noise": 0.005} | {f"{row.noise}_noise": row.sd for row in _ROWS}  # gyro: rad/s
MORE_NOISE = {
    "accel_y_noise": 0.1,  # m/s2
    "roll_rate_noise": 0.005,  # rad/s
    "wheel_noise": 0.015,  # m/s, of the mean of both front wheels
} | {f"{row.noise}_noise": row.sd for row in _VELOCITIES}
DISTURBANCE = {"force_sd": 50.0, "moment_sd": 20.0, "disturbance_time": 0.3}  # N, N m, s


def packet_column(sensor: str, value: str) -> int:
    """The column of a sensor's packets that holds a value; 0 where it sends none of that name."""
    names = [each.name for each in SLOW[SLOW_NAMES.index(sensor)].values]
    return PACKET.value + names.index(value) if value in names else 0


def noise_levels(forces: bool, read: Options) -> tuple[dict[str, float], dict[str, float]]:
    """`FilterConfig.noise` and `noise_over_speed`; forces: whether its disturbances are."""
    growing = [row.noise for row in _ROWS if row.over_speed and f"{row.noise}_noise" not in read]
    levels = NOISE | MORE_NOISE
    noise = {key.removesuffix("_noise"): read.positive(key, sd) for key, sd in levels.items()}
    if forces:
        keys = zip(("force", "moment", "time"), DISTURBANCE.items(), strict=True)
        noise |= {short: read.positive(key, default) for short, (key, default) in keys}
    return noise, {name: noise[name] * COURSE_SPEED for name in growing}


def hdop_table(row: Filter, read: Options) -> tuple[tuple[float, float], ...]:
    """Knots (HDOP, factor), or none."""
    table = read.value("hdop_table", row.hdop)
    if table is None or (isinstance(table, tuple) and not table):
        return ()
    knots = read.numbers("hdop_table", table)
    pairs = knots.ndim == 2 and knots.shape[1] == 2 and 2 <= len(knots) <= KNOTS
    if not (pairs and (np.diff(knots[:, 0]) > 0.0).all() and (knots[:, 1] > 0.0).all()):
        expected = f"is 2 to {KNOTS} pairs (HDOP, factor) with rising HDOP and positive factors"
        raise read.wrong("hdop_table", expected, table)
    return tuple((float(hdop), float(factor)) for hdop, factor in knots)
