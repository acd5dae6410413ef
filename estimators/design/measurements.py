"""Measurements of the slow sensors: their rows of C and their noise.

A new slow sensor is an entry of `MEASUREMENTS`: options, states and compiled code follow it.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from ...envs.record import PACKET
from ...envs.sensors.slow import SLOW, SLOW_NAMES

COURSE_SPEED = 60.0 / 3.6  # m/s at which the receivers' course noise is quoted


class MeasurementRow(NamedTuple):
    """One value of a packet as a measurement: a sum of states.

    Attributes:
        states: Names of the states.
        noise: Its standard deviation is the option `<noise>_noise`.
        sd: That option's default, in the unit of the value.
        angle: Whether the innovation is wrapped.
        over_speed: Whether the default holds at `COURSE_SPEED` and grows as 1/V; the option holds
            at every speed.
        ground: Whether it is a direction over the ground, where psi is relative to the road.
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

    Attributes:
        rows: Sums of a bicycle's states, for the packet's first values.
        velocities: Rows of a second layer, in their place.
        heading_fix: Whether its first sample, where it is far off, sets psi.
    """

    rows: tuple[MeasurementRow, ...]
    velocities: tuple[MeasurementRow, ...] = ()
    heading_fix: bool = False


MEASUREMENTS: dict[str, Measurement] = {
    "camera": Measurement(
        (
            MeasurementRow(("psi",), "psi", 3.5e-3, angle=True),
            MeasurementRow(("y_l",), "y_l", 0.02),
        ),
    ),
    "gps": Measurement(
        (MeasurementRow(("beta", "psi"), "course", math.radians(0.14), True, True, ground=True),),
        (
            MeasurementRow(("v_x",), "gps_speed", 0.05),
            MeasurementRow(("v_y",), "gps_speed", 0.05),
        ),  # (41)
        heading_fix=True,
    ),
}
"""By the sensor's name. (41): double-layer-gps."""


def find_packet_column(sensor: str, value: str) -> int:
    """Find the column of a sensor's packets that holds a value.

    Args:
        sensor: Name of the slow sensor.
        value: Name of the value.

    Returns:
        Index of the column; 0 where the sensor sends none of that name.
    """
    names = [field.name for field in SLOW[SLOW_NAMES.index(sensor)].values]
    return PACKET.value + names.index(value) if value in names else 0
