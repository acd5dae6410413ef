"""The motion in a recorded drive, a GPS course made of truth and gyro, a GPS's latency."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.recordings.log_file import make_packet_rows
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import COURSE_SPEED
from ..harness.stats import margin_of_error

BLOCKS = 20  # of a log, which the intervals take for independent
COURSE, SPEED = range(2)  # places in a GPS's values
MIN_SPEED = 4.0  # m/s, below which nothing of a drive is judged
_NOT_NEGATIVE = ("course_noise_deg", "delay")


@dataclass(frozen=True, kw_only=True)
class Emulation:
    """A GPS course and a gyro bias put on top of a recorded drive; ValueError for a bad value."""

    course_rate: float = 10.0  # Hz; a sample every so many whole rows of the log
    course_noise_deg: float = 0.5  # standard deviation of the course (deg)
    delay: float = 0.0  # of the course (s)
    bias_deg: float = 0.0  # constant error of the course (deg)
    gyro_bias_degps: float = 0.0  # of the gyro that estimators see, not of the emulated heading

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(Emulation):
            value = getattr(self, entry.name)
            if not math.isfinite(value):
                raise ValueError(f"{entry.name} must be finite, got {value}")
            if value < 0.0 and entry.name in _NOT_NEGATIVE:
                raise ValueError(f"{entry.name} must not be negative, got {value}")
        if self.course_rate <= 0.0:
            raise ValueError(f"course_rate must be positive, got {self.course_rate} Hz")

    def apply(self, log: Log, seed: int | None) -> Log:
        """Return the log with the gyro's bias, and with a GPS that measures the course alone.

        course = sideslip truth + integral of the logged yaw rate + bias + noise. Samples stand on
        ticks that are whole periods, none where the truth is unknown; quality is 0 below 1 m/s.

        Args:
            log: Recorded drive, with the truth if it gets a GPS.
            seed: Seed of the course's noise, None: its slow sensors stay as they are.

        Raises:
            ValueError: The log is slower than the course.
        """
        record, motion, fast = log.record, LoggedMotion(log), log.record.fast.copy()
        fast[:, FAST.gyro] += math.radians(self.gyro_bias_degps)
        biased = dataclasses.replace(record, fast=fast)
        if seed is None:
            return dataclasses.replace(log, record=biased)
        beta = log.truth["beta"]
        if self.course_rate * record.dt > 1.0 + 1e-6:
            raise ValueError(
                f"a course at {self.course_rate:g} Hz needs a log at least as fast; "
                f"this one has {1.0 / record.dt:.4g} rows a second"
            )
        rows, late = round(1.0 / (self.course_rate * record.dt)), round(self.delay / record.dt)
        captured = np.arange(-record.first % rows, len(beta), rows)
        noise = np.random.default_rng(seed).standard_normal(len(captured))
        exact = (beta + motion.heading)[captured] + math.radians(self.bias_deg)
        course = exact + math.radians(self.course_noise_deg) * noise
        sent = np.isfinite(course) & (captured + late < len(beta))
        ticks = (record.first + captured[sent]).astype(np.float64)
        values = np.full((len(ticks), 4), np.nan)
        values[:, 0] = np.arctan2(np.sin(course[sent]), np.cos(course[sent]))
        quality = (motion.speed[captured][sent] >= COURSE_SPEED).astype(np.float64)
        packets = make_packet_rows("gps", ticks, ticks + late, values, quality)
        gps = SlowSensor(period=rows * record.dt, delays=(late * record.dt,))
        biased = dataclasses.replace(biased, packets=packets)
        return dataclasses.replace(log, record=biased, slow={"gps": gps})


class LoggedMotion(NamedTuple):
    """What a recorded drive says of the car's motion, shape (rows,) each."""

    log: Log

    @property
    def heading(self) -> Array:
        """The integral of the logged yaw rate (rad), 0 at the first row."""
        gamma = self.log.record.fast[:, FAST.gyro]
        steps = 0.5 * (gamma[1:] + gamma[:-1]) * self.log.record.dt
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def speed(self) -> Array:
        """The mean speed of the front wheels (m/s)."""
        fast = self.log.record.fast
        return np.asarray(0.5 * (fast[:, FAST.wheel_left] + fast[:, FAST.wheel_right]))

    @property
    def is_moving(self) -> npt.NDArray[np.bool_]:
        """Whether it is fast enough to judge."""
        return np.asarray(self.speed > MIN_SPEED)

    @property
    def is_backward(self) -> npt.NDArray[np.bool_]:
        """Whether it is driven backward: the speed is negative, or the truth about half a turn."""
        beta = self.log.truth.get("beta", np.zeros(len(self.log.time)))
        turn = np.abs(np.nan_to_num(beta)) / math.pi
        return np.asarray((self.speed < 0.0) | ((turn > 0.75) & (turn < 1.01)))


def jackknife(blocks: Array, statistic: Callable[[Array], float]) -> tuple[float, float]:
    """Compute a statistic of the sum of blocks with its interval.

    Args:
        blocks: Sums of blocks that are taken for independent, shape (count, ...).
        statistic: Function of such sums.

    Returns:
        The statistic and half of its 95 % interval.
    """
    total, count = blocks.sum(axis=0), len(blocks)
    without = np.array([statistic(total - block) for block in blocks])
    return statistic(total), margin_of_error((count - 1.0) * without)


def collect_fixes(
    logs: Sequence[Log], value: int, slips: Sequence[Array] | None, times: Array
) -> list[Array]:
    """Collect the differences of successive fixes, for a latency.

    Args:
        logs: Recorded drives; those without a GPS have no fixes.
        value: Place in a fix's values, `COURSE` or `SPEED`.
        slips: Sideslip angle (rad), shape (rows,), of which the value has a share; None: of none.
        times: Latencies (s), shape (times,).

    Returns:
        Blocks of each log with sums of d^2, d p, p^2 and 1, shape (4, times) each: d of differences
        less the logged motion's so much earlier, p of the slip's; none for too few fixes.
    """
    blocks = []
    for i, log in enumerate(logs):
        if "gps" in log.slow:
            part = np.zeros(len(log.time)) if slips is None else slips[i]
            blocks += _collect_blocks(log, value, part, times)
    return blocks


def _collect_blocks(log: Log, value: int, part: Array, times: Array) -> list[Array]:
    signal = LoggedMotion(log).heading if value == COURSE else LoggedMotion(log).speed
    packets = log.record.select_packets("gps")
    packets = packets[packets[:, PACKET.quality] > 0.0]
    rows, place = packets[:, PACKET.captured] - log.record.first, np.arange(float(len(signal)))
    earlier = rows[:, None] - times / log.record.dt
    d = np.diff(packets[:, PACKET.value + value, None] - np.interp(earlier, place, signal), axis=0)
    if value == COURSE:
        d = (d + math.pi) % (2.0 * math.pi) - math.pi  # within a turn
    p = np.diff(np.interp(earlier, place, part), axis=0)
    usual = np.diff(rows) <= 1.5 * np.median(np.diff(rows))
    inside = (earlier[1:].min(axis=1) > 0.0) & (earlier[1:].max(axis=1) < place[-1])
    used = usual & inside & np.isfinite(d).all(axis=1)
    if np.count_nonzero(used) < BLOCKS:
        return []
    d, p = d[used] - np.median(d[used], axis=0), p[used]  # the median is a gyro's bias
    sums = np.stack([d * d, d * p, p * p, np.ones_like(d)])
    return [block.sum(axis=1) for block in np.array_split(sums, BLOCKS, axis=1)]


def compute_remainder(sums: Array, share: float | None = None) -> Array:
    """Compute the mean squares that are left of the differences of fixes.

    Args:
        sums: Sums of `collect_fixes`, shape (4, times).
        share: Share of the part in the values, None: the best one.

    Returns:
        Mean squares, shape (times,).
    """
    square, product, part_square, count = sums
    shares = product / np.maximum(part_square, 1e-12) if share is None else share
    return np.asarray((square - 2.0 * shares * product + shares**2 * part_square) / count)


def find_latency(
    blocks: Sequence[Array], times: Array, share: float | None = None
) -> tuple[float, float]:
    """Find the latency that leaves least.

    Args:
        blocks: Blocks of `collect_fixes`.
        times: Their latencies (s), shape (times,).
        share: Share of the part in the values, None: the one that leaves least.

    Returns:
        Latency and half of its 95 % interval (s).
    """
    return jackknife(np.array(blocks), lambda sums: _find_minimum(times, sums, share))


def _find_minimum(times: Array, sums: Array, share: float | None) -> float:
    """Find the latency (s) of the smallest remainder, between the samples by a parabola."""
    lefts = compute_remainder(sums, share)
    i = int(np.clip(np.argmin(lefts), 1, len(times) - 2))
    left, middle, right = lefts[i - 1 : i + 2]
    bend = left - 2.0 * middle + right
    beside = 0.5 * (left - right) / bend if bend > 0.0 else 0.0
    return float(times[i] + beside * (times[1] - times[0]))
