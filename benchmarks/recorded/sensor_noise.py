"""Noise and latency of the sensors in a recorded drive; intervals are jackknives over blocks.

Args:
    value: Place in a fix's values, `COURSE` or `SPEED`.
    slips: Sideslip angle (rad) of each log, shape (rows,), by which the course differs from the
        heading; None: none.
    times: Latencies (s), shape (times,).
    share: Share of the slip in the values, None: the one that leaves least.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.vehicle.parameters import Vehicle
from ...estimators.make import make_estimator
from ...estimators.wires import NOISES, SignalCalibration, apply_wires
from ..harness.stats import margin_of_error

GYRO_ONLY = "bicycle-kf"
BLOCKS = 20  # of a log, which the intervals take for independent
COURSE, SPEED = range(2)  # places in a GPS's values
WIDE = "its interval is too wide"
_LATE = (-0.2, 1.2)  # s, of the GPS
LATE_WITHIN = 0.05  # s, half of the widest interval of a latency
_FAST = {"gyro": "rad/s", "accel_y": "m/s2", "roll_rate": "rad/s", "wheel_left": "m/s"}


def estimate_slips(logs: Sequence[Log], car: Vehicle, wires: SignalCalibration) -> list[Array]:
    """Estimate the sideslip angle (rad) of drives, shape (rows,) each, by the gyro alone."""
    dt = logs[0].record.dt
    estimator = make_estimator(GYRO_ONLY, vehicle=car, dt=dt, q_beta=1e-3, q_gamma=0.1)
    steered = wires._replace(latency={}, at={})
    return [estimator.run(apply_wires(log, steered))["beta"] for log in logs]


def _jackknife(blocks: Array, statistic: Callable[[Array], float]) -> tuple[float, float]:
    """Compute a statistic of the sum of independent blocks, and half of its 95 % interval."""
    total, count = blocks.sum(axis=0), len(blocks)
    without = np.array([statistic(total - block) for block in blocks])
    return statistic(total), margin_of_error((count - 1.0) * without)


class FixDifferences(NamedTuple):
    """Differences of successive fixes, beside those of the logged motion so much earlier."""

    times: Array  # latencies (s), shape (times,)
    # sums of d^2, d p, p^2 and 1, (4, times) each: d of differences less the logged motion's, p of
    # the slip's; none for too few fixes
    blocks: list[Array]

    @classmethod
    def from_logs(
        cls, logs: Sequence[Log], value: int, slips: Sequence[Array] | None, times: Array
    ) -> "FixDifferences":
        """Collect the differences in blocks of each log; those without a GPS have no fixes."""
        blocks = []
        for i, log in enumerate(logs):
            packets = log.record.select_packets("gps")
            signal = log.heading if value == COURSE else log.speed
            part = np.zeros(len(signal)) if slips is None else slips[i]
            packets = packets[packets[:, PACKET.quality] > 0.0]
            if len(packets) <= BLOCKS:
                continue
            rows, place = packets[:, PACKET.captured] - log.record.first, np.arange(1.0 * len(part))
            earlier = rows[:, None] - times / log.record.dt
            known = packets[:, PACKET.value + value, None]
            d = np.diff(known - np.interp(earlier, place, signal), axis=0)
            if value == COURSE:
                d = (d + math.pi) % (2.0 * math.pi) - math.pi  # within a turn
            p = np.diff(np.interp(earlier, place, part), axis=0)
            usual = np.diff(rows) <= 1.5 * np.median(np.diff(rows))
            inside = (earlier[1:].min(axis=1) > 0.0) & (earlier[1:].max(axis=1) < place[-1])
            used = usual & inside & np.isfinite(d).all(axis=1)
            if np.count_nonzero(used) >= BLOCKS:
                d, p = d[used] - np.median(d[used], axis=0), p[used]  # less the gyro's bias
                sums = np.stack([d * d, d * p, p * p, np.ones_like(d)])
                blocks += [x.sum(axis=1) for x in np.array_split(sums, BLOCKS, axis=1)]
        return cls(times, blocks)

    def find_latency(self, share: float | None = None) -> tuple[float, float]:
        """Find the latency that leaves least, and half of its 95 % interval (s)."""

        def find_minimum(sums: Array) -> float:  # between the samples by a parabola
            lefts = _compute_remainder(sums, share)
            i = int(np.clip(np.argmin(lefts), 1, len(lefts) - 2))
            left, middle, right = lefts[i - 1 : i + 2]
            bend = left - 2.0 * middle + right
            beside = 0.5 * (left - right) / bend if bend > 0.0 else 0.0
            return float(self.times[i] + beside * (self.times[1] - self.times[0]))

        return _jackknife(np.array(self.blocks), find_minimum)

    def _estimate_noise(self, late: float) -> tuple[float, float]:
        """Estimate the fixes' standard deviation at a latency, and half of its 95 % interval."""
        at = int(np.argmin(np.abs(self.times - late)))
        blocks = np.array(self.blocks)  # a difference has twice the variance
        return _jackknife(blocks, lambda sums: math.sqrt(0.5 * _compute_remainder(sums, None)[at]))


def _compute_remainder(sums: Array, share: float | None) -> Array:
    """Compute the mean squares that are left of the differences of fixes, shape (times,)."""
    square, product, part_square, count = sums
    shares = product / np.maximum(part_square, 1e-12) if share is None else share
    return np.asarray((square - 2.0 * shares * product + shares**2 * part_square) / count)


class Finding(NamedTuple):
    """A number with half of its 95 % interval, and whether the log determines it."""

    name: str
    stated: float
    value: float = math.nan
    half: float = math.inf
    unit: str = ""
    is_determined: bool = False
    remark: str = ""


def _estimate_white_noise(parts: Sequence[Array]) -> tuple[float, float]:
    """Estimate white noise and half interval by third differences of samples that do not repeat."""
    blocks = []
    for values in parts:
        new = np.concatenate([[True], np.diff(values) != 0.0])
        third = np.diff(values if new.mean() > 0.7 else values[new], 3) / math.sqrt(20.0)
        blocks += [np.array([block @ block, len(block)]) for block in np.array_split(third, BLOCKS)]
    # each block: sum of squares and count
    return _jackknife(np.array(blocks), lambda x: math.sqrt(float(x[0]) / max(float(x[1]), 1.0)))


def make_sensor_findings(
    logs: Sequence[Log], slips: Sequence[Array]
) -> tuple[list[Finding], dict[str, float], dict[str, float]]:
    """Make findings of the sensors, noise by the estimators' options, and latency by sensor (s)."""
    findings: list[Finding] = []
    noise: dict[str, float] = {}
    for channel, unit in _FAST.items():
        if all(channel in log.record.present for log in logs):
            column = getattr(FAST, channel)
            sd, half = _estimate_white_noise([log.record.fast[:, column] for log in logs])
            is_determined = half < 0.3 * sd
            remark = "" if is_determined else WIDE if sd > 0.0 else "none is seen"
            row = Finding(f"noise of {channel}", math.nan, sd, half, unit, is_determined, remark)
            findings.append(row)
            noise |= {NOISES[channel]: sd} if is_determined else {}
    times = np.arange(*_LATE, max(logs[0].record.dt, 0.01))
    courses = FixDifferences.from_logs(logs, COURSE, slips, times)
    speeds = FixDifferences.from_logs(logs, SPEED, None, times)
    if not courses.blocks:
        return findings, noise, {}
    late, half = courses.find_latency()
    with_slip, _ = courses.find_latency(1.0)  # had the slip its size
    half = math.hypot(half, late - with_slip)
    is_determined = half < LATE_WITHIN
    pays = is_determined and late > half
    remark = ("applied" if pays else "within its interval of 0") if is_determined else WIDE
    findings.append(Finding("latency of gps", 0.0, late, half, "s", is_determined, remark))
    for name, unit, scale, fixes in (
        ("course", "deg", math.degrees(1.0), courses), ("gps_speed", "m/s", 1.0, speeds)
    ):  # fmt: skip
        if fixes.blocks:
            noise[NOISES[name]], half = fixes._estimate_noise(late)
            sd = scale * noise[NOISES[name]]
            findings.append(Finding(f"noise of {name}", math.nan, sd, scale * half, unit, True))
    return findings, noise, {"gps": late} if pays else {}
