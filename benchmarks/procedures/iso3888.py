"""ISO 3888: double lane change (part 1) and obstacle avoidance (part 2), with a check for cones.

Part 1 is driven at a held speed, part 2 coasting, until one of `DRIVERS` hits no cone: the highest
clean speed is that of car and drivers together, below what test drivers do. A slower car's tracks
are shortened by its own speed over the standards' 80 km/h, but for the widths of the lanes.
"""

import math
from dataclasses import dataclass

import numpy as np

from ...envs.record import Array
from ...envs.scenarios.road import Section, make_sections
from .drive import DriveFunction, Fields, Series, TestCar

TRACKS = ("iso-3888-1", "iso-3888-2")
_STANDARD_SPEED = 80.0 / 3.6  # m/s
ONSET = 1.0  # s, before the first lane
RUN_OUT = 10.0  # m, after the last lane
DRIVERS: tuple[Fields, ...] = tuple(
    {"driver_preview": preview, "driver_gain": gain, "driver_lag": 0.05}
    for preview, gain in ((0.3, 0.6), (0.4, 0.8), (0.5, 1.0), (0.6, 1.0), (0.6, 1.2))
)


@dataclass(frozen=True)
class TrackRun:
    """One run through a track."""

    speed: float  # m/s
    lanes: tuple[Section, ...]  # where the car drives them
    margins: tuple[float, ...]  # m, by lane, to its edge; below 0 a cone falls, NaN: not driven
    series: Series

    @property
    def min_margin(self) -> float:
        """The smallest margin (m); minus infinity where the track was not driven to its end."""
        is_complete = not self.series.failed and all(margin == margin for margin in self.margins)
        return min(self.margins) if is_complete else -math.inf

    @property
    def passed(self) -> bool:
        """Whether no cone falls and the car does not fail."""
        return self.min_margin >= 0.0


def _compute_corners(series: Series, car: TestCar) -> Array:
    """Compute the body's corners on the ground (m), going round it: (n, 4, 2)."""
    front = car.vehicle.front_arm + car.front_overhang
    half = 0.5 * car.vehicle.width
    rear = front - car.length
    body = np.array([[front, half], [front, -half], [rear, -half], [rear, half]])
    sine, cosine = np.sin(series.psi), np.cos(series.psi)
    turned = np.array([[cosine, -sine], [sine, cosine]])
    place = np.stack([series.X, series.Y], axis=1)
    return np.asarray(place[:, None, :] + np.einsum("ijn,kj->nki", turned, body))


def _compute_margin(body: Array, lane: Section) -> float:
    """Compute the smallest distance (m) of a body (n, 4, 2) to the edges of a lane that it crosses.

    The body's sides are cut where the lane begins and ends: a side may touch the first or the
    last cone with all corners outside. NaN where the body does not reach the lane's end.
    """
    start, end = lane.start, lane.start + lane.length
    if body[:, :, 0].max() < end:
        return float("nan")
    corner, next_corner = body, np.roll(body, -1, axis=1)
    dx = next_corner[..., 0] - corner[..., 0]
    safe = np.where(dx == 0.0, 1.0, dx)
    cuts = np.sort([(start - corner[..., 0]) / safe, (end - corner[..., 0]) / safe], axis=0)
    inside = (corner[..., 0] >= start) & (corner[..., 0] <= end)
    first = np.where(dx == 0.0, np.where(inside, 0.0, 2.0), np.maximum(cuts[0], 0.0))
    last = np.where(dx == 0.0, np.where(inside, 1.0, -1.0), np.minimum(cuts[1], 1.0))
    dy = next_corner[..., 1] - corner[..., 1]
    max_offset = -np.inf
    for part in (first, last):
        y = corner[..., 1] + part * dy - lane.offset
        max_offset = max(max_offset, float(np.max(np.abs(y), where=first <= last, initial=-np.inf)))
    return 0.5 * lane.width - max_offset


def _make_lanes(car: TestCar, track: str, speed: float) -> tuple[Section, ...]:
    """Make the lanes where the car drives them, in their order."""
    return make_sections(track, car.vehicle.width, speed * ONSET, _compute_length_share(car))


def _compute_length_share(car: TestCar) -> float:
    """Compute the fraction of the standards' lengths that the car drives."""
    return min(1.0, car.speed / _STANDARD_SPEED)


def _make_lane_change(car: TestCar, track: str, speed: float) -> Fields:
    """Make a run through a track at a speed (m/s)."""
    last = make_sections(track, car.vehicle.width, 0.0, _compute_length_share(car))[-1]
    way = last.start + last.length + RUN_OUT
    return {
        "steering": "driver", "path": track, "path_speed": speed / _compute_length_share(car),
        "onset": ONSET, "speed": speed, "acceleration": None if track == TRACKS[0] else 0.0,
        "duration": ONSET + 1.3 * way / speed,  # a coasting car is slower
    }  # fmt: skip


def _evaluate_run(series: Series, car: TestCar, track: str, speed: float) -> TrackRun:
    body, lanes = _compute_corners(series, car), _make_lanes(car, track, speed)
    return TrackRun(speed, lanes, tuple(_compute_margin(body, lane) for lane in lanes), series)


def run(drive: DriveFunction, car: TestCar, track: str, speed: float) -> TrackRun:
    """Try a speed with each driver until one is clean.

    Args:
        drive: Function that drives the car through a scenario.
        car: Car under test, with speed and steering ratio.
        track: One of `TRACKS`.
        speed: Speed (m/s).

    Returns:
        The clean run, or the one that came closest to it.
    """
    runs, fields = list[TrackRun](), _make_lane_change(car, track, speed)
    for driver in DRIVERS:
        runs.append(_evaluate_run(drive({**fields, **driver}), car, track, speed))
        if runs[-1].passed:
            break
    return max(runs, key=lambda track_run: track_run.min_margin)
