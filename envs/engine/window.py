"""The scratch array of an env-step: what its ticks bring that does not depend on the car (noise and
the programme's steering), and where the car went.

Its columns are the ticks of the step. Of vehicles abreast it has a third axis, their lanes.
"""

from typing import Any

import numpy as np

from ..backend.arrays import abreast, at, fixed_tuple, of_lane, put, put_all, put_along, ramp
from ..backend.decorators import jit
from ..backend.primitives import to_float, whole
from ..backend.random import CHANNELS, normals
from ..backend.simd import LANES
from ..record import Array
from ..scenarios.steering import STEERING_WIDTH, steering_at
from ..sensors.inertial import Chance
from ..vehicle.dynamics import Motion
from .layout import P, Z

CHANCE, AHEAD, TRACK = 0, 8, 9  # its rows: two times four normal numbers, rad, a Motion
_ROWS = TRACK + len(Motion._fields)


def scratch_of(n: int, *lanes: int) -> Array:
    """The array for n ticks a step, whose columns are whole lanes."""
    return np.zeros((_ROWS, -(-n // LANES) * LANES, *lanes))


@jit
def foresee(p: Any, z: Any, n: int, follows: int, scratch: Any) -> None:
    """The random numbers and the programme's steering of the next n ticks of one vehicle.

    follows: 1 where the driver reacts to the car, and no programme steers.
    """
    key_low, key_high, first = int(z[Z.clock]), int(z[Z.clock + 1]), int(z[Z.clock + 2]) + 1
    programme = fixed_tuple(p[P.steering :], STEERING_WIDTH)
    for j in range(0, n, abreast()):
        ticks = ramp(first + j)
        inertial = normals(key_low, key_high, ticks, CHANNELS.inertial)
        wheels = normals(key_low, key_high, ticks, CHANNELS.wheels)
        put_along(scratch, inertial[0], CHANCE, j)
        put_along(scratch, inertial[1], CHANCE + 1, j)
        put_along(scratch, inertial[2], CHANCE + 2, j)
        put_along(scratch, inertial[3], CHANCE + 3, j)
        put_along(scratch, wheels[0], CHANCE + 4, j)
        put_along(scratch, wheels[1], CHANCE + 5, j)
        put_along(scratch, wheels[2], CHANCE + 6, j)
        put_along(scratch, wheels[3], CHANCE + 7, j)
        if not follows:
            put_along(scratch, steering_at(to_float(ticks), programme), AHEAD, j)


@jit
def foresee_abreast(p: Any, z: Any, n: int, follows: int, scratch: Any) -> None:
    """The same of vehicles abreast: p, z with a column for each."""
    key_low, key_high = whole(at(z, Z.clock)), whole(at(z, Z.clock + 1))
    programme = fixed_tuple(p[P.steering :], STEERING_WIDTH)
    for j in range(n):
        tick = at(z, Z.clock + 2) + (j + 1)
        inertial = normals(key_low, key_high, whole(tick), CHANNELS.inertial)
        wheels = normals(key_low, key_high, whole(tick), CHANNELS.wheels)
        put_all(scratch, inertial, 0, CHANCE, j)
        put_all(scratch, wheels, 0, CHANCE + 4, j)
        if not follows:
            put(scratch, steering_at(tick, programme), AHEAD, j)


@jit
def chance_at(scratch: Any, j: int) -> Chance:
    """The random numbers of a tick of the step."""
    inertial = (
        at(scratch, CHANCE, j),
        at(scratch, CHANCE + 1, j),
        at(scratch, CHANCE + 2, j),
        at(scratch, CHANCE + 3, j),
    )
    wheels = (
        at(scratch, CHANCE + 4, j),
        at(scratch, CHANCE + 5, j),
        at(scratch, CHANCE + 6, j),
        at(scratch, CHANCE + 7, j),
    )
    return Chance(inertial, wheels)


@jit
def motion_at(scratch: Any, j: int, lane: int) -> Motion:
    """The Motion that `drive_on` left of a tick of the step."""
    return Motion(
        of_lane(scratch, lane, TRACK, j),
        of_lane(scratch, lane, TRACK + 1, j),
        of_lane(scratch, lane, TRACK + 2, j),
        of_lane(scratch, lane, TRACK + 3, j),
        of_lane(scratch, lane, TRACK + 4, j),
        of_lane(scratch, lane, TRACK + 5, j),
        of_lane(scratch, lane, TRACK + 6, j),
        of_lane(scratch, lane, TRACK + 7, j),
        of_lane(scratch, lane, TRACK + 8, j),
        of_lane(scratch, lane, TRACK + 9, j),
        of_lane(scratch, lane, TRACK + 10, j),
    )
