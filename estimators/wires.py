"""Calibration of a log's signals from a vehicle's file: steering, latencies, places, noise."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..envs.io import is_document, read_document, write_document
from ..envs.record import FAST, PACKET, Array, Log
from ..envs.sensors.slow import SLOW_NAMES
from ..envs.validation import check_choice, is_finite, short_repr
from ..envs.vehicle.parameters import WIRE_TABLES, Vehicle, VehicleSource
from .design.options import FAST_CHANNELS

_CHANNELS = (*FAST_CHANNELS, *SLOW_NAMES)  # that may be late
_MAX_LATENCY = 5.0  # s
_STANDING = 0.5  # m/s, below which a velocity has no direction
NOISES = {
    name: f"{name.removesuffix('_left')}_noise"
    for name in ("gyro", "accel_y", "roll_rate", "wheel_left", "course", "gps_speed")
}
"""The estimators' options for a standard deviation, by what it is of."""
PLACED = ("gps", "accel", "sideslip")
"""Sensors that sit somewhere: the antenna, both accelerometers, and a slip sensor."""
_REACH = 10.0  # m
_SMOOTHING = 0.1  # s, of the yaw rate from which its slope is taken


class SignalCalibration(NamedTuple):
    """Calibration of a log's signals; the road-wheel angle is sign x logged / ratio + offset."""

    ratio: float = 1.0  # steering ratio
    sign: int = 1  # 1 or -1
    offset: float = 0.0  # angle at the wheels (rad)
    latency: Mapping[str, float] = {}  # latency by channel (s)
    noise: Mapping[str, float] = {}  # standard deviations by the estimators' options
    at: Mapping[str, Sequence[float]] = {}  # place from the centre of gravity by `PLACED` (m)

    @property
    def gain(self) -> float:
        """Gain of the logged steering, sign / ratio."""
        return self.sign / self.ratio

    def check(self) -> "SignalCalibration":
        """Return itself; ValueError for numbers that cannot be and for an unknown channel."""
        if not (0.0 < self.ratio < 1e4 and self.sign in (-1, 1) and abs(self.offset) < 0.5):
            raise ValueError(
                "steering has a ratio above 0, a sign of 1 or -1 and an offset below 28 deg, got "
                f"{self.ratio:g}, {self.sign}, {np.degrees(self.offset):g} deg"
            )
        for channel, late in self.latency.items():
            low = 0.0 if channel in SLOW_NAMES else -_MAX_LATENCY
            is_possible = is_finite(late) and low <= late <= _MAX_LATENCY
            if channel not in _CHANNELS or not is_possible:
                wanted = f"a latency is CHANNEL=S, {low:g} to {_MAX_LATENCY:g} s"
                raise ValueError(f"{wanted}, of {', '.join(_CHANNELS)}; got {channel}={late}")
        for name, value in self.noise.items():
            check_choice("noise", name, NOISES.values())
            if not (is_finite(value) and value >= 0.0):
                wanted = f"noise {name} is a number of zero or more"
                raise ValueError(f"{wanted}, got {short_repr(value)}")
        for sensor, place in self.at.items():
            check_choice("sensor with a place", sensor, PLACED)
            is_place = isinstance(place, list | tuple) and len(place) == 3
            if not (is_place and all(is_finite(x) and abs(x) <= _REACH for x in place)):
                wanted = f"{sensor} sits at [x, y, z] m forward, left, up, within {_REACH:g} m"
                raise ValueError(f"{wanted}, got {short_repr(place)}")
        return self


AS_LOGGED = SignalCalibration()
"""The calibration of a log whose steering is the angle at the wheels, and nothing is late."""


def read_wires(source: VehicleSource | None) -> SignalCalibration:
    """Read the calibration in a vehicle's file, which errors name; that of others is unknown.

    Args:
        source: Vehicle as for `make_vehicle`, or "identify".
    """
    if source is None or source == "identify" or not is_document(source):
        return SignalCalibration()
    path = Path(str(source))
    tables = read_document(path, "vehicle")
    try:
        steering, latency, noise, at = (dict(tables.get(name, {})) for name in WIRE_TABLES)
        return SignalCalibration(**steering, latency=latency, noise=noise, at=at).check()
    except (TypeError, ValueError) as error:
        raise type(error)(f"{path}: {error}") from None


def write_vehicle(path: Path, car: Vehicle, wires: SignalCalibration) -> None:
    """Write a file that `make_vehicle` reads, with the calibration in separate tables.

    Args:
        path: Path of the TOML or JSON file.
        car: Vehicle with the fitted parameters.
        wires: Steering, latencies and noise of the log's signals.
    """
    values = car.to_dict()
    for axle in ("front", "rear"):
        values[f"{axle}_stiffness_axle"] = 2.0 * values.pop(f"{axle}_stiffness")
    steering = {name: getattr(wires, name) for name in ("ratio", "sign", "offset")}
    places = {sensor: list(place) for sensor, place in wires.at.items()}
    tables = (steering, dict(wires.latency), dict(wires.noise), places)
    write_document(path, values | dict(zip(WIRE_TABLES, tables, strict=True)))


def apply_wires(log: Log, wires: SignalCalibration) -> Log:
    """Return the log with calibrated steering, fast channels and captures at the true time.

    Args:
        log: Recorded drive.
        wires: Its calibration.
    """
    record, slow = log.record, dict(log.slow)
    fast, place = record.fast.copy(), np.arange(len(record.fast), dtype=float)
    fast[:, FAST.steer] = wires.gain * fast[:, FAST.steer] + wires.offset
    for channel in wires.latency.keys() & FAST_CHANNELS.keys():
        for column in FAST_CHANNELS[channel]:
            late = wires.latency[channel] / record.dt
            fast[:, column] = np.interp(place + late, place, fast[:, column])
    packets = record.packets.copy()
    for sensor in slow.keys() & wires.latency.keys():
        rows, was = round(wires.latency[sensor] / record.dt), slow[sensor]
        is_sensor = packets[:, PACKET.sensor] == SLOW_NAMES.index(sensor)
        packets[is_sensor, PACKET.captured] -= rows
        period = round(was.period / record.dt)
        phase = (round((was.phase or 0.0) / record.dt) - rows) % period * record.dt
        late = packets[is_sensor, PACKET.arrived] - packets[is_sensor, PACKET.captured]
        low, high = (late.min(), late.max()) if len(late) else (rows, rows)  # what it had too
        delays, jitter = (float(low) * record.dt,), float(high - low) * record.dt
        slow[sensor] = dataclasses.replace(was, delays=delays, jitter=jitter, phase=phase)
    packets = packets[packets[:, PACKET.captured] >= record.first]
    record = dataclasses.replace(record, fast=fast, packets=packets)
    truth = dict(log.truth)
    if wires.at:
        move_course(fast, packets, record.first, wires.at)
        if "accel" in wires.at:
            _move_acceleration(fast, record.dt, wires.at["accel"])
        if "beta" in truth and "sideslip" in wires.at:
            truth["beta"] = truth["beta"] - _turn_velocity(fast, wires.at["sideslip"])
    return dataclasses.replace(log, record=record, slow=slow, truth=truth)


def move_course(fast: Array, packets: Array, first: int, at: Mapping[str, Sequence[float]]) -> None:
    """Move the GPS's course from the antenna to the centre of gravity, in place.

    Args:
        fast: Fast rows, shape (n, FAST_WIDTH).
        packets: Packets captured in these rows, shape (count, PACKET_WIDTH).
        first: Tick of the first row.
        at: Places (m); without "gps" nothing is done.
    """
    if "gps" not in at:
        return
    is_gps = packets[:, PACKET.sensor] == SLOW_NAMES.index("gps")
    rows = packets[is_gps, PACKET.captured].astype(int) - first
    packets[is_gps, PACKET.value] -= _turn_velocity(fast[rows], at["gps"])


def _turn_velocity(fast: Array, place: Sequence[float]) -> Array:
    """Compute by how much the velocity at a place points further to the left (rad).

    There v_y has r x - p z more, with roll rate p; v_x has -r y more. Below 0.5 m/s it is 0.
    """
    x, y, z = place
    speed = 0.5 * (fast[:, FAST.wheel_left] + fast[:, FAST.wheel_right])
    yaw_rate, roll_rate = fast[:, FAST.gyro], fast[:, FAST.roll_rate]
    angle = np.arctan2(yaw_rate * x - roll_rate * z, speed - yaw_rate * y)
    return np.where(speed > _STANDING, angle, 0.0)


def _move_acceleration(fast: Array, dt: float, place: Sequence[float]) -> None:
    """Move both accelerations to the centre of gravity, in place; roll is left out."""
    from scipy.signal import savgol_filter

    x, y, _ = place
    yaw_rate, window = fast[:, FAST.gyro], 2 * max(round(0.5 * _SMOOTHING / dt), 1) + 1
    slope = savgol_filter(yaw_rate, window, 1, deriv=1, delta=dt) if len(fast) >= window else 0.0
    fast[:, FAST.accel_x] += slope * y + yaw_rate**2 * x
    fast[:, FAST.accel_y] -= slope * x - yaw_rate**2 * y
