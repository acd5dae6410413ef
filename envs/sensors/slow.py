"""The slow sensors: the table of them, one sample of any of them, and which each id has.

A new one is a file beside `camera` and `gps`, a row of `SLOW` and a branch of `sample`: packets,
observation, random numbers, reset and the device engine follow from the table.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from ..arguments import mapping_of, unknown_names
from ..backend.decorators import jit
from ..backend.elementary import exp
from ..backend.primitives import whole
from ..backend.random import normals
from .camera import CAMERA_KIND, camera_sample, lane_in_view
from .gps import GPS_KIND, gps_sample, sky_deviation
from .kind import Blocks
from .link import SlowSensor

SLOW = (CAMERA_KIND, GPS_KIND)
CAMERA, GPS = range(len(SLOW))
SLOW_NAMES = tuple(kind.name for kind in SLOW)
WIDTHS = tuple(len(kind.values) for kind in SLOW)  # values of each one's packets
SEES = tuple(kind.sees for kind in SLOW)
VALUES = max(WIDTHS)  # of any packet; those of a sensor with fewer are filled up with zeros

_FIRST_BLOCK, _BLOCKS_EACH = 1000, 10  # of random numbers, clear of `backend.random.CHANNELS`


def blocks_at(place: int) -> Blocks:
    """The random numbers of the sensor at a place of the table, where it names none itself."""
    first = _FIRST_BLOCK + _BLOCKS_EACH * place
    return Blocks(noise=first, link=first + 1, drift=first + 2)


BLOCKS = tuple(kind.blocks or blocks_at(place) for place, kind in enumerate(SLOW))


class Scene(NamedTuple):
    """The truth at a tick, and the noise and random numbers to measure it with."""

    motion: Any
    road: Any
    car: Any
    noise: Any
    sky: Any  # the satellites
    sight: Any  # the camera's View
    small_angle: int
    key_low: Any
    key_high: Any
    tick: Any


class Sample(NamedTuple):
    """One measurement of a slow sensor."""

    values: Any  # VALUES of them
    quality: Any
    drift: Any  # a number that the sensor carries from sample to sample


@jit
def sample(sensor: int, scene: Scene, link: Any, drift: Any) -> Sample:
    """A sample of a slow sensor, from its clock and link and the drift of the sample before."""
    blocks, when = BLOCKS[sensor], whole(scene.tick)
    n = normals(scene.key_low, scene.key_high, when, blocks.noise)
    if sensor == CAMERA:
        psi, y_l = camera_sample(scene.motion, scene.road, scene.car.l_pre, scene.noise, n)
        quality = lane_in_view(scene.motion, scene.sight)
        return Sample((psi, y_l, 0.0, 0.0, 0.0, 0.0), quality, drift)
    sky, car = scene.sky, scene.car
    fresh = normals(scene.key_low, scene.key_high, when, blocks.drift)
    drift = sky_deviation(drift, sky, link, scene.tick, fresh)
    hdop = exp(sky.median + drift)
    course, speed, X, Y, hdop, satellites, quality = gps_sample(
        scene.motion, car.ahead, car.left, hdop, sky.weight, scene.noise, n, scene.small_angle
    )
    return Sample((course, speed, X, Y, hdop, satellites), quality, drift)


@jit
def first_drift(sensor: int, sky: Any, key_low: Any, key_high: Any) -> Any:
    """A slow sensor's drift when an episode begins."""
    if sensor == GPS:
        return sky.spread * normals(key_low, key_high, 0, BLOCKS[sensor].drift)[1]
    return 0.0


CAMERA_33_30 = SlowSensor(period=0.033, delays=(0.030,))
CAMERA_UNEVEN = SlowSensor(period=0.033, delays=(0.010,), jitter=0.020)
GPS_5_HZ = SlowSensor(period=0.2)

SENSOR_SETS: dict[str, dict[str, SlowSensor]] = {
    "vision": {"camera": CAMERA_33_30},
    "vision-uneven": {"camera": CAMERA_UNEVEN},
    "gps": {"gps": GPS_5_HZ},
    "fusion": {"camera": CAMERA_33_30, "gps": GPS_5_HZ},
}


def with_changes(
    sensors: dict[str, SlowSensor], changes: Mapping[str, Mapping[str, Any] | None]
) -> dict[str, SlowSensor]:
    """The sensors with some of their fields replaced; ValueError for a sensor that is absent,
    TypeError for a field that it has not."""
    changed = dict(sensors)
    for name, fields in changes.items():
        if fields is None:
            continue
        if name not in sensors:
            raise ValueError(f"this id has no {name}; it has: {', '.join(sensors)}")
        known = [field.name for field in dataclasses.fields(sensors[name])]
        if unknown := [each for each in mapping_of(name, fields) if each not in known]:
            raise TypeError(unknown_names(f"number of the {name}", unknown, known))
        changed[name] = dataclasses.replace(sensors[name], **fields)
    return changed
