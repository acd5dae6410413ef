"""A GPS course for a recorded drive that has none: from its sideslip truth and its gyro."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...envs.record import FAST, Array, Log
from ...envs.recordings.log_file import packet_rows
from ...envs.sensors.gps import COURSE_SPEED
from ...envs.sensors.link import SlowSensor

_NOT_NEGATIVE = ("course_noise_deg", "delay")


@dataclass(frozen=True, kw_only=True)
class Emulation:
    """What is put on top of a recorded drive.

    course_rate: Hz; one sample every so many whole rows of the log. course_noise_deg: standard
    deviation in deg. delay: s the course arrives late. bias_deg: constant error of the course in
    deg. gyro_bias_degps: added to the gyro that estimators see, in deg/s; the emulated heading
    goes without it.

    Raises ValueError for values that are not finite, a rate that is not positive, a negative noise
    or delay.
    """

    course_rate: float = 10.0
    course_noise_deg: float = 0.5
    delay: float = 0.0
    bias_deg: float = 0.0
    gyro_bias_degps: float = 0.0

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(Emulation):
            value = getattr(self, entry.name)
            if not math.isfinite(value):
                raise ValueError(f"{entry.name} must be finite, got {value}")
            if value < 0.0 and entry.name in _NOT_NEGATIVE:
                raise ValueError(f"{entry.name} must not be negative, got {value}")
        if self.course_rate <= 0.0:
            raise ValueError(f"course_rate must be positive, got {self.course_rate} Hz")

    def rows(self, dt: float) -> int:
        """Rows of the log from one sample to the next; ValueError where the log is too slow."""
        if self.course_rate * dt > 1.0 + 1e-6:
            raise ValueError(
                f"a course at {self.course_rate:g} Hz needs a log at least as fast; "
                f"this one has {1.0 / dt:.4g} rows a second"
            )
        return round(1.0 / (self.course_rate * dt))

    def with_gyro_bias(self, log: Log) -> Log:
        """The log with the gyro's bias added."""
        fast = log.record.fast.copy()
        fast[:, FAST.gyro] += math.radians(self.gyro_bias_degps)
        return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))

    def with_course(self, log: Log, seed: int) -> Log:
        """The log with the gyro's bias and a GPS that measures the course, and nothing else.

        course = sideslip truth + integral of the logged yaw rate + bias + noise. Samples stand on
        ticks that are whole periods; there is none where the truth is unknown, quality is 0 below
        1 m/s, and values other than the course are NaN. Raises ValueError without truth.
        """
        if "beta" not in log.truth:
            raise ValueError(f"{log.name}: a course cannot be emulated without sideslip truth")
        record, beta = log.record, log.truth["beta"]
        rows, late = self.rows(record.dt), round(self.delay / record.dt)
        captured = np.arange(-record.first % rows, len(beta), rows)
        noise = np.random.default_rng(seed).standard_normal(len(captured))
        exact = (beta + heading(log))[captured] + math.radians(self.bias_deg)
        course = exact + math.radians(self.course_noise_deg) * noise
        speed = ground_speed(log)[captured]
        sent = np.isfinite(course) & (captured + late < len(beta))
        ticks = (record.first + captured[sent]).astype(np.float64)
        values = np.full((len(ticks), 4), np.nan)
        values[:, 0] = np.arctan2(np.sin(course[sent]), np.cos(course[sent]))
        quality = (speed[sent] >= COURSE_SPEED).astype(np.float64)
        packets = packet_rows("gps", ticks, ticks + late, values, quality)
        gps = SlowSensor(period=rows * record.dt, delays=(late * record.dt,))
        quiet = dataclasses.replace(log, record=dataclasses.replace(record, packets=packets))
        return self.with_gyro_bias(dataclasses.replace(quiet, slow={"gps": gps}))


def heading(log: Log) -> Array:
    """The integral of the logged yaw rate in rad, 0 at the first row; (rows,)."""
    gamma = log.record.fast[:, FAST.gyro]
    steps = 0.5 * (gamma[1:] + gamma[:-1]) * log.record.dt
    return np.concatenate([[0.0], np.cumsum(steps)])


def ground_speed(log: Log) -> Array:
    """The mean speed of the front wheels in m/s; (rows,)."""
    fast = log.record.fast
    return np.asarray(0.5 * (fast[:, FAST.wheel_left] + fast[:, FAST.wheel_right]))


def backward(log: Log) -> npt.NDArray[np.bool_]:
    """The rows that are driven backward: at a negative speed, or with a truth about half a turn."""
    turn = np.abs(np.nan_to_num(log.truth.get("beta", np.zeros(len(log.time))))) / math.pi
    return np.asarray((ground_speed(log) < 0.0) | ((turn > 0.75) & (turn < 1.01)))


def path(log: Log, beta: Array) -> tuple[Array, Array]:
    """Dead reckoning: (x, y) in m from speed, heading and a sideslip angle; (rows,) each."""
    psi = heading(log)
    v_x = ground_speed(log)
    v_y = v_x * np.tan(np.nan_to_num(beta))
    x_rate = v_x * np.cos(psi) - v_y * np.sin(psi)
    y_rate = v_x * np.sin(psi) + v_y * np.cos(psi)
    return np.cumsum(x_rate) * log.record.dt, np.cumsum(y_rate) * log.record.dt
