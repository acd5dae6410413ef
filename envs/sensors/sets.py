"""The slow sensors of each environment id."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from .record import SlowSensor
from .scenario import Scenario
from .scenario_checks import SHORTEST_GPS_PERIOD
from .sensors import IN_FLIGHT, ticks

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


def in_scenario(sensors: dict[str, SlowSensor], scenario: Scenario) -> dict[str, SlowSensor]:
    """The sensors with the clocks and delays that a scenario sets for those that are there."""
    told = dict(sensors)
    if "camera" in told and scenario.camera_delays is not None:
        told["camera"] = dataclasses.replace(
            told["camera"], delays=scenario.camera_delays, jitter=scenario.camera_jitter
        )
    if "gps" in told and scenario.gps_period is not None:
        told["gps"] = dataclasses.replace(told["gps"], period=scenario.gps_period)
    if "gps" in told and scenario.gps_delays is not None:
        told["gps"] = dataclasses.replace(told["gps"], delays=scenario.gps_delays, jitter=0.0)
    return told


def most_packets(sensor: SlowSensor, n: int) -> int:
    """Room for the worst case: all frames of a step and all that were under way."""
    period = min(sensor.period, SHORTEST_GPS_PERIOD)  # of any scenario
    return 2 * (n // int(ticks(period)) + 1) + IN_FLIGHT
