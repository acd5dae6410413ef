"""The slow sensors: their table, a sample of any of them, and the sensors of each id.

A new one is a file beside `camera` and `gps`, a row of `SLOW` and a branch of `sample_sensor`:
packets, observation, random numbers, reset and the gradient engine follow from the table.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from ..numerics.functions import draw_normals, exp
from ..numerics.jit import jit
from ..numerics.primitives import Scalar, Vector, to_int
from ..validation import check_mapping, describe_unknown
from ..vehicle.dynamics import CarParams, Motion, RoadParams
from .camera import CAMERA_KIND, FieldOfView, compute_lane_quality, sample_camera
from .gps import GPS_KIND, SatelliteGeometry, compute_hdop_deviation, sample_gps
from .inertial import Noise
from .link import Blocks, Link, SlowSensor

SLOW = (CAMERA_KIND, GPS_KIND)
CAMERA, GPS = range(len(SLOW))
SLOW_NAMES = tuple(kind.name for kind in SLOW)
WIDTHS = tuple(len(kind.values) for kind in SLOW)  # values of each one's packets
NEEDS_QUALITY = tuple(kind.needs_quality for kind in SLOW)
VALUES = max(WIDTHS)  # of any packet, filled up with zeros

_FIRST_BLOCK, _BLOCKS_PER_SENSOR = 1000, 10  # of random numbers, clear of `CHANNELS`


def make_blocks(place: int) -> Blocks:
    """Make the channels of random numbers of a sensor that names none itself.

    Args:
        place: Place of the sensor in `SLOW`.

    Returns:
        The channels.
    """
    first = _FIRST_BLOCK + _BLOCKS_PER_SENSOR * place
    return Blocks(noise=first, link=first + 1, drift=first + 2)


BLOCKS = tuple(kind.blocks or make_blocks(place) for place, kind in enumerate(SLOW))


class MeasurementContext(NamedTuple):
    """The truth at a tick, and the noise and random numbers to measure it with."""

    motion: Motion
    road: RoadParams
    car: CarParams
    noise: Noise
    sky: SatelliteGeometry
    field_of_view: FieldOfView
    small_angle: int
    key_low: Scalar
    key_high: Scalar
    tick: Scalar


class Sample(NamedTuple):
    """One measurement of a slow sensor."""

    values: Vector  # VALUES numbers
    quality: Scalar
    drift: Scalar  # a number that the sensor carries from sample to sample


@jit
def sample_sensor(sensor: int, context: MeasurementContext, link: Link, drift: Scalar) -> Sample:
    """Sample a slow sensor.

    Args:
        sensor: Place of the sensor in `SLOW`.
        context: Truth, noise and random numbers of the tick.
        link: `Link` of the sensor.
        drift: Drift of the sample before.

    Returns:
        The sample.
    """
    blocks, tick = BLOCKS[sensor], to_int(context.tick)
    n = draw_normals(context.key_low, context.key_high, tick, blocks.noise)
    if sensor == CAMERA:
        psi, y_l = sample_camera(context.motion, context.road, context.car.l_pre, context.noise, n)
        quality = compute_lane_quality(context.motion, context.field_of_view)
        return Sample((psi, y_l, 0.0, 0.0, 0.0, 0.0), quality, drift)
    sky, car = context.sky, context.car
    drift_noise = draw_normals(context.key_low, context.key_high, tick, blocks.drift)
    drift = compute_hdop_deviation(drift, sky, link, context.tick, drift_noise)
    hdop = exp(sky.median + drift)
    course, speed, X, Y, hdop, satellites, quality = sample_gps(
        context.motion, car.forward, car.left, hdop, sky.weight, context.noise, n,
        context.small_angle,
    )  # fmt: skip
    return Sample((course, speed, X, Y, hdop, satellites), quality, drift)


@jit
def draw_first_drift(
    sensor: int, sky: SatelliteGeometry, key_low: Scalar, key_high: Scalar
) -> Scalar:
    """Draw a slow sensor's drift at the start of an episode.

    Args:
        sensor: Place of the sensor in `SLOW`.
        sky: `SatelliteGeometry`.
        key_low: Lower 32 bits of the episode's key.
        key_high: Upper 32 bits of the episode's key.

    Returns:
        The drift: deviation of log HDOP for the GPS, else 0.
    """
    if sensor == GPS:
        return sky.spread * draw_normals(key_low, key_high, 0, BLOCKS[sensor].drift)[1]
    return 0.0


CAMERA_33_30 = SlowSensor(period=0.033, delays=(0.030,))
_CAMERA_UNEVEN = SlowSensor(period=0.033, delays=(0.010,), jitter=0.020)
GPS_5_HZ = SlowSensor(period=0.2)

SENSOR_SETS: dict[str, dict[str, SlowSensor]] = {
    "vision": {"camera": CAMERA_33_30},
    "vision-uneven": {"camera": _CAMERA_UNEVEN},
    "gps": {"gps": GPS_5_HZ},
    "fusion": {"camera": CAMERA_33_30, "gps": GPS_5_HZ},
}


def apply_changes(
    sensors: dict[str, SlowSensor], changes: Mapping[str, Mapping[str, Any] | None]
) -> dict[str, SlowSensor]:
    """Replace some fields of slow sensors.

    Args:
        sensors: Slow sensors by name.
        changes: By sensor, new values by the names of `SlowSensor`'s fields; None for no change.

    Returns:
        Slow sensors by name.

    Raises:
        ValueError: For a sensor that is absent.
        TypeError: For an unknown field.
    """
    changed = dict(sensors)
    for name, fields in changes.items():
        if fields is None:
            continue
        if name not in sensors:
            raise ValueError(f"this id has no {name}; it has: {', '.join(sensors)}")
        known = [field.name for field in dataclasses.fields(sensors[name])]
        if unknown := [key for key in check_mapping(name, fields) if key not in known]:
            raise TypeError(describe_unknown(f"number of the {name}", unknown, known))
        changed[name] = dataclasses.replace(sensors[name], **fields)
    return changed
