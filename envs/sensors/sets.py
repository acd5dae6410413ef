"""The slow sensors of each environment id."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from ..record import SlowSensor

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
    sensors: dict[str, SlowSensor], changes: dict[str, Mapping[str, Any] | None]
) -> dict[str, SlowSensor]:
    """The sensors with some of their fields replaced; ValueError for a sensor that is absent."""
    changed = dict(sensors)
    for name, fields in changes.items():
        if fields is None:
            continue
        if name not in sensors:
            raise ValueError(f"this id has no {name}; it has: {', '.join(sensors)}")
        changed[name] = dataclasses.replace(sensors[name], **fields)
    return changed
