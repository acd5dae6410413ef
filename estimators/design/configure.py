"""From a wish to the numbers in a filter's record that choose what compiled code does."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ..core.delay import CONSTANT, STORED
from ..core.intersample import NONE, PSEUDO, SPREAD
from ..core.transition import KINEMATIC, SLOWEST, VELOCITY_ROLL
from ..filters import Filter
from .kalman import gain
from .models import SMOOTHING_TIME
from .options import Options, gates, hdop_table
from .periodic import measured_rows, slow_index
from .request import Wish
from .schedule import NO_SENSOR, Schedule, schedules, whole_ticks

FASTEST = 80.0  # m/s, of the tables of gains
SPACING = 0.5  # m/s between them
SATELLITES = 4.0  # with fewer, a GPS fix is refused (double-layer-gps 4.3)


def write_clocks(
    name: str, f: Any, row: Filter, slow: Mapping[str, SlowSensor], dt: float, wish: Wish
) -> None:
    """Periods, the filter's own step, and by how much late states follow in it."""
    for sensor, link in slow.items():
        what = f"{name}: the {sensor}'s period"
        f.period[SLOW_NAMES.index(sensor)] = whole_ticks(link.period, dt, what)
    f.pace = int(f.period.max()) if row.intersample == "single-rate" else 1
    f.stride = f.pace if wish.between == "hold" else 1
    f.relax = 1.0
    if wish.late == "lag":  # a first-order lag of the mean delay
        delay = float(np.mean(slow["camera"].delays)) + 0.5 * slow["camera"].jitter
        f.relax = 1.0 - math.exp(-dt / max(delay, dt))


def write_speed(name: str, f: Any, speed: float | None, dt: float) -> None:
    """A held speed in m/s, or how the wheels' is smoothed; ValueError for one that is none."""
    if speed is not None and not (math.isfinite(speed) and speed >= 0.0):
        raise ValueError(f"{name}: speed is in m/s and not negative, got {speed!r}")
    f.measured = int(speed is None)
    f.speed = 0.0 if speed is None else speed
    f.smoothing = 1.0 - math.exp(-dt / SMOOTHING_TIME)


class Common:
    """Options that every record takes alike: what is known about a sample's noise."""

    def __init__(self, name: str, row: Filter, told: Options) -> None:
        self.knots = hdop_table(name, row.hdop, told)
        self.gate = gates(name, told)
        self.satellites = told.number("satellites", SATELLITES)
        self.adapt = told.number("adapt", 0.0)
        if not 0.0 <= self.adapt < 1.0:
            raise ValueError(f"{name}: adapt is a share from 0 to 1, got {self.adapt!r}")

    def write(self, f: Any, gps_speed: float) -> None:
        """Into a filter's record; `layers` applies the table for a second layer."""
        f.knots = 0 if f.kind == VELOCITY_ROLL else len(self.knots)
        f.satellites, f.adapt = self.satellites, self.adapt
        f.r_speed = gps_speed**2
        f.gate[:] = self.gate
        for i, (hdop, factor) in enumerate(self.knots):
            f.hdop[i], f.hdop_factor[i] = hdop, factor


def plans(
    f: Any, row: Filter, slow: Mapping[str, SlowSensor], dt: float, wish: Wish
) -> tuple[Schedule, ...]:
    """The schedules of the first slow sensor: one, or two extremes where delays are random."""
    if not slow:
        return (NO_SENSOR,)
    name, sensor = next(iter(slow.items()))
    if wish.late == "constant":
        f.assumed = whole_ticks(wish.assumed, dt, "assumed_delay")
        sensor = SlowSensor(sensor.period, (wish.assumed,), sensor.phase)
    if row.intersample == "spread":  # knows of no delay
        sensor = SlowSensor(sensor.period, (0.0,), sensor.phase)
    frames = int(f.frames[SLOW_NAMES.index(name)])
    return schedules(name, sensor, dt, int(f.stride), int(f.pace), frames)


def write_rules(
    name: str, f: Any, row: Filter, wish: Wish, used: int, planned: tuple[Schedule, ...]
) -> None:
    """The codes that choose what compiled code does; ValueError for what does not go together."""
    f.cycle, f.pattern = planned[-1].cycle, max(1, len(planned[-1].lags))
    pseudo = row.intersample == "pseudo-residual" and wish.rule != "predict"
    f.between = PSEUDO if pseudo else SPREAD if row.intersample == "spread" else NONE
    f.periodic = int(_periodic(name, f, row, wish, used, len(planned)))
    f.joint = int(row.gains == "placed" or (pseudo and f.periodic == 1))
    f.trailing = int(f.late in (STORED, CONSTANT))
    if f.measured and f.periodic:
        f.low, f.high, f.spacing = SLOWEST, FASTEST, SPACING
    if f.between == PSEUDO:
        C = measured_rows(f, slow_index(f), 0)
        f.inverse[: len(C), : f.total] = gain(np.eye(f.total), C, np.zeros((len(C), len(C)))).T
    exact = f.periodic == 0 and f.between == NONE
    if not exact and (f.gate.any() or f.adapt > 0.0 or wish.late in ("larsen", "buffer")):
        raise ValueError(
            f"{name}: gate, adapt, delay='larsen' and delay='buffer' need gains='covariance' and "
            "no correction between samples"
        )
    if f.adapt > 0.0 and wish.late in ("larsen", "buffer"):
        raise ValueError(f"{name}: adapt needs delay='clone', got delay={wish.late!r}")


def _periodic(name: str, f: Any, row: Filter, wish: Wish, used: int, count: int) -> bool:
    """Whether the gains are precomputed; ValueError where that was asked for and cannot be."""
    if f.between == SPREAD or row.gains == "placed":
        return True
    if f.kind in (KINEMATIC, VELOCITY_ROLL) or row.second:
        if wish.gains == "periodic":
            raise ValueError(f"{name}: no periodic gains, its model changes with the yaw rate")
        return False
    if f.between == PSEUDO:
        if wish.gains == "covariance":
            raise ValueError(f"{name} has one constant gain; gains='covariance' is not for it")
        if f.frames.max() > 1:
            raise ValueError(f"{name}: a sample must arrive before the next one is captured")
        return True
    blind = f.frames.max() == 0  # a filter that does not look at the lag
    if used > 1 or (count > 1 and not blind):
        if wish.gains == "periodic":
            why = "two slow sensors" if used > 1 else "random delay"
            raise ValueError(f"{name}: no periodic gains with {why}; use gains='covariance'")
        return False
    wanted = wish.gains or row.gains
    if not wish.gains and (f.gate.any() or f.adapt > 0.0 or wish.late in ("larsen", "buffer")):
        wanted = "covariance"
    return wanted == "periodic"
