"""What is known of a log's wires, steering, latencies and noise: from a vehicle's file, applied."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...envs.io import is_document, read_document, write_document
from ...envs.record import FAST, PACKET, Log
from ...envs.sensors.slow import SLOW_NAMES
from ...envs.validation import check_choice, is_finite, short_repr
from ...envs.vehicle.parameters import WIRE_TABLES, Vehicle, VehicleSource
from ...estimators.design.options import FAST_CHANNELS, find_columns
from .quality import NOISES

CHANNELS = (*FAST_CHANNELS, *SLOW_NAMES)
"""What may be late."""
MAX_LATENCY = 5.0  # s


class SignalCalibration(NamedTuple):
    """Road-wheel angle = sign x logged / ratio + offset (rad); s by which each channel is late;
    standard deviations of the noise by the estimators' options."""

    ratio: float = 1.0
    sign: int = 1
    offset: float = 0.0
    latency: Mapping[str, float] = {}
    noise: Mapping[str, float] = {}

    @property
    def gain(self) -> float:
        """Sign / ratio."""
        return self.sign / self.ratio

    def check(self) -> "SignalCalibration":
        """Itself; ValueError for numbers that cannot be and for an unknown channel."""
        if not (0.0 < self.ratio < 1e4 and self.sign in (-1, 1) and abs(self.offset) < 0.5):
            raise ValueError(
                "steering has a ratio above 0, a sign of 1 or -1 and an offset below 28 deg, got "
                f"{self.ratio:g}, {self.sign}, {np.degrees(self.offset):g} deg"
            )
        for channel, late in self.latency.items():
            min_latency = 0.0 if channel in SLOW_NAMES else -MAX_LATENCY
            if channel not in CHANNELS or not (
                is_finite(late) and min_latency <= late <= MAX_LATENCY
            ):
                raise ValueError(
                    f"a latency is CHANNEL=S, {min_latency:g} to {MAX_LATENCY:g} s, of "
                    f"{', '.join(CHANNELS)}; got {channel}={late}"
                )
        for name, value in self.noise.items():
            check_choice("noise", name, NOISES.values())
            if not (is_finite(value) and value >= 0.0):
                raise ValueError(
                    f"noise {name} is a number of zero or more, got {short_repr(value)}"
                )
        return self


def read_wires(source: VehicleSource | None) -> SignalCalibration:
    """The wires in a vehicle's file, with its errors; nothing is known of another source's."""
    if source is None or source == "identify" or not is_document(source):
        return SignalCalibration()
    path = Path(str(source))
    tables: dict[str, Any] = {
        **{name: {} for name in WIRE_TABLES},
        **read_document(path, "vehicle"),
    }
    try:
        steering, latency, noise = (dict(tables[name]) for name in WIRE_TABLES)
        return SignalCalibration(**steering, latency=latency, noise=noise).check()
    except (TypeError, ValueError) as error:
        raise type(error)(f"{path}: {error}") from None


def write_vehicle(path: Path, car: Vehicle, wires: SignalCalibration) -> None:
    """A file that `make_vehicle` reads, with the wires in tables of their own."""
    values = car.to_dict()
    for axle in ("front", "rear"):
        values[f"{axle}_stiffness_axle"] = 2.0 * values.pop(f"{axle}_stiffness")
    steering = {name: getattr(wires, name) for name in ("ratio", "sign", "offset")}
    tables = (steering, dict(wires.latency), dict(wires.noise))
    write_document(path, values | dict(zip(WIRE_TABLES, tables, strict=True)))


def apply_wires(log: Log, wires: SignalCalibration) -> Log:
    """The log with angles of the wheels, fast channels moved to when they were true, and packets
    stamped with when they were captured; the arrival stays."""
    record, slow = log.record, dict(log.slow)
    fast, place = record.fast.copy(), np.arange(len(record.fast), dtype=float)
    fast[:, FAST.steer] = wires.gain * fast[:, FAST.steer] + wires.offset
    for channel in wires.latency.keys() & FAST_CHANNELS.keys():
        for column in find_columns(channel):
            late = wires.latency[channel] / record.dt
            fast[:, column] = np.interp(place + late, place, fast[:, column])
    packets = record.packets.copy()
    for sensor in slow.keys() & wires.latency.keys():
        rows, was = round(wires.latency[sensor] / record.dt), slow[sensor]
        is_sensor = packets[:, PACKET.sensor] == SLOW_NAMES.index(sensor)
        packets[is_sensor, PACKET.captured] -= rows
        period = round(was.period / record.dt)
        phase = (round((was.phase or 0.0) / record.dt) - rows) % period * record.dt
        slow[sensor] = dataclasses.replace(was, delays=(rows * record.dt,), phase=phase)
    packets = packets[packets[:, PACKET.captured] >= record.first]
    return dataclasses.replace(
        log, record=dataclasses.replace(record, fast=fast, packets=packets), slow=slow
    )
