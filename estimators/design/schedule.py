"""The schedule of a slow sensor in steps of a filter: when frames are captured and arrive."""

import math
from dataclasses import dataclass

from ...envs.sensors.link import SlowSensor


def count_ticks(seconds: float, dt: float, label: str) -> int:
    """Convert a time to a number of ticks.

    Args:
        seconds: Time (s).
        dt: Tick (s).
        label: Name of the time for messages.

    Returns:
        Number of ticks.

    Raises:
        ValueError: The time is no whole number of ticks.
    """
    count = round(seconds / dt)
    if abs(seconds / dt - count) > 1e-6 * max(1.0, count):
        raise ValueError(f"{label} of {seconds:g} s is no whole number of ticks of {dt:g} s")
    return count


@dataclass(frozen=True)
class Schedule:
    """Cycle of a slow sensor: frame i is captured at the step i `period`, arrives lags[i] later.

    A schedule without frames has one step.

    Attributes:
        period: Steps between two captures.
        lags: Steps from the capture of each frame of the cycle to its arrival.
    """

    period: int
    lags: tuple[int, ...]

    @property
    def cycle(self) -> int:
        """Steps after which everything repeats, the slots of the clones included."""
        return self.period * max(1, len(self.lags))

    def find_arriving(self, step: int) -> list[int]:
        """Find the frames that arrive in a step of the cycle.

        Args:
            step: Step within the cycle.

        Returns:
            Indices of the frames.
        """
        arrival_steps = ((i * self.period + lag) % self.cycle for i, lag in enumerate(self.lags))
        return [i for i, arrival_step in enumerate(arrival_steps) if arrival_step == step]


NO_SENSOR = Schedule(1, ())


def make_schedules(
    label: str, sensor: SlowSensor, dt: float, stride: int, pace: int, frames: int
) -> tuple[Schedule, ...]:
    """Make the sensor's possible schedules: one where it repeats, else its two extremes.

    Args:
        label: Name of the sensor for messages.
        sensor: Clock and delays of the sensor.
        dt: Tick (s).
        stride: Ticks of a filter's step.
        pace: Ticks between steps that listen; a sample is used in the first of them at or after its
            arrival.
        frames: Number of stored captures, whose slots take turns; 0 for a filter that does not look
            at the lag.

    Returns:
        One schedule, or those of the shortest and the longest delays.
    """
    period = count_ticks(sensor.period, dt, f"{label}'s period") // stride
    late = [count_ticks(delay, dt, f"a delay: {label}'s") for delay in sensor.delays]
    jitter = count_ticks(sensor.jitter, dt, f"{label}'s jitter")

    def make_schedule(extra: int) -> Schedule:
        lags = [math.ceil((lag + extra) / pace) * pace // stride for lag in late]
        if len(set(lags)) == 1:
            lags = lags[:1]
        return Schedule(period, tuple(lags * (math.lcm(len(lags), max(1, frames)) // len(lags))))

    shortest, longest = make_schedule(0), make_schedule(jitter)
    return (longest,) if shortest == longest else (shortest, longest)
