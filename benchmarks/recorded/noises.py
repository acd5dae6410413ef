"""Noise of each sensor of a recorded drive, and how late its GPS is, with jackknife intervals."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ...envs.record import FAST, PACKET, Array, Log
from ..harness.stats import margin_of_error
from .emulate import compute_ground_speed, compute_heading

WIDE = "its interval is too wide"
BLOCKS = 20  # of a log, which the intervals take for independent
ALIKE = (0.0, 0.1, 0.25, 0.5, 1.0)  # s, for which rows of a residual may be alike
LATE = (-0.2, 1.2)  # s, of the GPS
_COURSE, _SPEED = range(2)  # places in its values
LATE_WITHIN = 0.05  # s, half of the widest interval of a latency
_FAST = {"gyro": "rad/s", "accel_y": "m/s2", "roll_rate": "rad/s", "wheel_left": "m/s"}
NOISES = {name: f"{name.removesuffix('_left')}_noise" for name in (*_FAST, "course", "gps_speed")}
"""The estimators' options for a standard deviation, by what it is of."""


class Finding(NamedTuple):
    """A number with half of its 95 % interval; told: whether the log determines it."""

    name: str
    stated: float
    value: float = math.nan
    half: float = math.inf
    unit: str = ""
    is_determined: bool = False
    remark: str = ""


def jackknife(blocks: Array, statistic: Callable[[Array], float]) -> tuple[float, float]:
    """(value, half of the 95 % interval) of a statistic of the sum of blocks, (count, ...)."""
    total, count = blocks.sum(axis=0), len(blocks)
    without = np.array([statistic(total - block) for block in blocks])
    return statistic(total), margin_of_error((count - 1.0) * without)


def _compute_root_mean(sums: Array) -> float:
    return math.sqrt(float(sums[0]) / max(float(sums[1]), 1.0))


def estimate_white_noise(parts: Sequence[Array]) -> tuple[float, float]:
    """(standard deviation, half) of a channel's white noise: third differences of samples that are
    new (a slower sensor repeats its last one)."""
    blocks = []
    for values in parts:
        new = np.concatenate([[True], np.diff(values) != 0.0])
        third = np.diff(values if new.mean() > 0.7 else values[new], 3) / math.sqrt(20.0)
        blocks += [np.array([block @ block, len(block)]) for block in np.array_split(third, BLOCKS)]
    return jackknife(np.array(blocks), _compute_root_mean)


def estimate_noise_levels(left: Array, dt: float) -> Array:
    """(channels,): standard deviations of independent rows that would tell as little as those of a
    residual, which are alike for a while: of means over up to 1 s, by the root of their rows."""
    levels = [np.full(left.shape[1], 1e-9)]
    shown = np.maximum(np.mean(left != 0.0, axis=(0, 2)), 1e-9)
    for seconds in ALIKE:
        rows = max(round(seconds / dt), 1)
        trimmed = left[:, :, : left.shape[2] // rows * rows]
        means = trimmed.reshape(*left.shape[:2], -1, rows).mean(axis=3)
        levels.append(np.sqrt(rows * np.mean(means**2, axis=(0, 2)) / shown))
    return np.asarray(np.max(levels, axis=0))


def _collect_fixes(log: Log, value: int, signal: Array, part: Array, times: Array) -> list[Array]:
    """Blocks of sums over the differences d of two fixes' values less the signal's so much earlier,
    and p of `part`, whose size is not known: d^2, d p, p^2 and 1, each (times,)."""
    packets = log.record.select_packets("gps")
    packets = packets[packets[:, PACKET.quality] > 0.0]
    rows, place = packets[:, PACKET.captured] - log.record.first, np.arange(float(len(signal)))
    earlier = rows[:, None] - times / log.record.dt
    d = np.diff(packets[:, PACKET.value + value, None] - np.interp(earlier, place, signal), axis=0)
    if value == _COURSE:
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


def _compute_remainder(sums: Array, share: float | None = None) -> Array:
    """(times,): the mean of squares that a share of the part leaves; None: the best one."""
    square, product, part_square, count = sums
    shares = product / np.maximum(part_square, 1e-12) if share is None else share
    return np.asarray((square - 2.0 * shares * product + shares**2 * part_square) / count)


def _find_minimum(times: Array, sums: Array, share: float | None = None) -> float:
    """The time of the least that is left, between the samples by a parabola."""
    lefts = _compute_remainder(sums, share)
    i = int(np.clip(np.argmin(lefts), 1, len(times) - 2))
    left, middle, right = lefts[i - 1 : i + 2]
    bend = left - 2.0 * middle + right
    beside = 0.5 * (left - right) / bend if bend > 0.0 else 0.0
    return float(times[i] + beside * (times[1] - times[0]))


def make_sensor_findings(
    logs: Sequence[Log], slips: Sequence[Array]
) -> tuple[list[Finding], dict[str, float], dict[str, float]]:
    """Findings of the sensors, noise by the estimators' options, and latency by sensor.

    slips: of each log, a sideslip angle in rad, (rows,), by which the course is predicted.
    """
    findings: list[Finding] = []
    noise: dict[str, float] = {}
    for channel, unit in _FAST.items():
        if all(channel in log.record.present for log in logs):
            sd, half = estimate_white_noise(
                [log.record.fast[:, getattr(FAST, channel)] for log in logs]
            )
            is_determined = half < 0.3 * sd
            remark = "" if is_determined else WIDE if sd > 0.0 else "none is seen"
            findings.append(
                Finding(f"noise of {channel}", math.nan, sd, half, unit, is_determined, remark)
            )
            noise |= {NOISES[channel]: sd} if is_determined else {}
    times = np.arange(*LATE, max(logs[0].record.dt, 0.01))
    pairs = [pair for pair in zip(logs, slips, strict=True) if "gps" in pair[0].slow]
    courses = [
        b
        for log, slip in pairs
        for b in _collect_fixes(log, _COURSE, compute_heading(log), slip, times)
    ]
    speeds = [
        b
        for log, _ in pairs
        for b in _collect_fixes(log, _SPEED, compute_ground_speed(log), 0.0 * log.time, times)
    ]
    if not courses:
        return findings, noise, {}
    late, half = jackknife(np.array(courses), lambda sums: _find_minimum(times, sums))
    half = math.hypot(
        half, late - _find_minimum(times, np.sum(courses, axis=0), 1.0)
    )  # had the slip its size
    is_determined = half < LATE_WITHIN
    pays = is_determined and late > half
    remark = ("applied" if pays else "within its interval of 0") if is_determined else WIDE
    findings.append(Finding("latency of gps", 0.0, late, half, "s", is_determined, remark))
    at = int(np.argmin(np.abs(times - late)))
    for name, unit, scale, blocks in (
        ("course", "deg", math.degrees(1.0), courses), ("gps_speed", "m/s", 1.0, speeds)
    ):  # fmt: skip
        if blocks:  # a difference has twice the variance
            sd, half = jackknife(
                np.array(blocks), lambda sums: math.sqrt(0.5 * _compute_remainder(sums)[at])
            )
            row = Finding(f"noise of {name}", math.nan, scale * sd, scale * half, unit, True)
            findings, noise = [*findings, row], noise | {NOISES[name]: sd}
    return findings, noise, {"gps": late} if pays else {}
