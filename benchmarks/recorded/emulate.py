"""Course, speed and path of a recorded drive, and a GPS course made of its truth and gyro."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...envs.record import FAST, Array, Log
from ...envs.recordings.log_file import make_packet_rows
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import COURSE_SPEED

MIN_SPEED = 4.0  # m/s, below which nothing of a drive is judged
_NOT_NEGATIVE = ("course_noise_deg", "delay")


@dataclass(frozen=True, kw_only=True)
class Emulation:
    """A GPS course and a gyro bias put on top of a recorded drive.

    Attributes:
        course_rate: Rate of the course (Hz), a sample every so many whole rows of the log.
        course_noise_deg: Standard deviation of the course (deg).
        delay: Delay of the course (s).
        bias_deg: Constant error of the course (deg).
        gyro_bias_degps: Bias of the gyro that estimators see (deg/s), not of the emulated heading.

    Raises:
        ValueError: A value that is not finite, a rate that is not positive, a negative noise or
            delay.
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

    def _compute_rows(self, dt: float) -> int:
        """Compute the rows of a log from one sample to the next; ValueError for a slow log."""
        if self.course_rate * dt > 1.0 + 1e-6:
            raise ValueError(
                f"a course at {self.course_rate:g} Hz needs a log at least as fast; "
                f"this one has {1.0 / dt:.4g} rows a second"
            )
        return round(1.0 / (self.course_rate * dt))

    def add_gyro_bias(self, log: Log) -> Log:
        """Return the log with the gyro's bias added.

        Args:
            log: Recorded drive.

        Returns:
            The biased log.
        """
        fast = log.record.fast.copy()
        fast[:, FAST.gyro] += math.radians(self.gyro_bias_degps)
        return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))

    def add_course(self, log: Log, seed: int) -> Log:
        """Return the log with the gyro's bias and a GPS that measures the course, nothing else.

        course = sideslip truth + integral of the logged yaw rate + bias + noise. Samples stand on
        ticks that are whole periods, none where the truth is unknown; quality is 0 below 1 m/s.

        Args:
            log: Recorded drive.
            seed: Seed of the course's noise.

        Returns:
            The log with a GPS.

        Raises:
            ValueError: If the log has no truth.
        """
        if "beta" not in log.truth:
            raise ValueError(f"{log.name}: a course cannot be emulated without sideslip truth")
        record, beta = log.record, log.truth["beta"]
        rows, late = self._compute_rows(record.dt), round(self.delay / record.dt)
        captured = np.arange(-record.first % rows, len(beta), rows)
        noise = np.random.default_rng(seed).standard_normal(len(captured))
        exact = (beta + compute_heading(log))[captured] + math.radians(self.bias_deg)
        course = exact + math.radians(self.course_noise_deg) * noise
        speed = compute_ground_speed(log)[captured]
        sent = np.isfinite(course) & (captured + late < len(beta))
        ticks = (record.first + captured[sent]).astype(np.float64)
        values = np.full((len(ticks), 4), np.nan)
        values[:, 0] = np.arctan2(np.sin(course[sent]), np.cos(course[sent]))
        quality = (speed[sent] >= COURSE_SPEED).astype(np.float64)
        packets = make_packet_rows("gps", ticks, ticks + late, values, quality)
        gps = SlowSensor(period=rows * record.dt, delays=(late * record.dt,))
        quiet = dataclasses.replace(log, record=dataclasses.replace(record, packets=packets))
        return self.add_gyro_bias(dataclasses.replace(quiet, slow={"gps": gps}))


def compute_heading(log: Log) -> Array:
    """Integrate the logged yaw rate to a heading, 0 at the first row.

    Args:
        log: Recorded drive.

    Returns:
        Heading (rad), shape (rows,).
    """
    gamma = log.record.fast[:, FAST.gyro]
    steps = 0.5 * (gamma[1:] + gamma[:-1]) * log.record.dt
    return np.concatenate([[0.0], np.cumsum(steps)])


def compute_ground_speed(log: Log) -> Array:
    """Compute the mean speed of the front wheels.

    Args:
        log: Recorded drive.

    Returns:
        Speed (m/s), shape (rows,).
    """
    fast = log.record.fast
    return np.asarray(0.5 * (fast[:, FAST.wheel_left] + fast[:, FAST.wheel_right]))


def find_moving(log: Log) -> npt.NDArray[np.bool_]:
    """Mark the rows that are fast enough to judge.

    Args:
        log: Recorded drive.

    Returns:
        Mask, shape (rows,).
    """
    return np.asarray(compute_ground_speed(log) > MIN_SPEED)


def find_backward(log: Log) -> npt.NDArray[np.bool_]:
    """Mark the rows driven backward: at a negative speed, or with a truth about half a turn.

    Args:
        log: Recorded drive.

    Returns:
        Mask, shape (rows,).
    """
    turn = np.abs(np.nan_to_num(log.truth.get("beta", np.zeros(len(log.time))))) / math.pi
    return np.asarray((compute_ground_speed(log) < 0.0) | ((turn > 0.75) & (turn < 1.01)))


def compute_path(log: Log, beta: Array) -> tuple[Array, Array]:
    """Compute a drive's path by dead reckoning.

    Args:
        log: Recorded drive.
        beta: Sideslip angle (rad), shape (rows,).

    Returns:
        x and y (m), shape (rows,) each.
    """
    psi, v_x = compute_heading(log), compute_ground_speed(log)
    v_y = v_x * np.tan(np.nan_to_num(beta))
    x_rate = v_x * np.cos(psi) - v_y * np.sin(psi)
    y_rate = v_x * np.sin(psi) + v_y * np.cos(psi)
    return np.cumsum(x_rate) * log.record.dt, np.cumsum(y_rate) * log.record.dt
