"""Late samples before the first tick: the rule and its window, and how many clones it needs."""

import math

from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ..core.delay import BUFFER, CONSTANT, IGNORE, LARSEN, RULES, STORED
from ..core.memory import N_FRAMES, N_RECENT, N_TOTAL, SNAPSHOT_INTERVAL, WINDOW, FilterRecord
from .config import FilterConfig


def _count_frames(sensor: SlowSensor, rule: str) -> int:
    """Count the frames whose capture must be stored at once, by the sensor's longest delay."""
    if rule not in ("clone", "larsen"):
        return 0
    return math.ceil(sensor.longest_delay / sensor.period - 1e-9)


def allocate_clones(f: FilterRecord, config: FilterConfig) -> None:
    """Lay the clones of every sensor behind the states.

    Args:
        f: Memory of the filter, written.
        config: Parsed options of the filter.

    Raises:
        ValueError: There are more clones than the rule or the memory can hold.
    """
    rule, label = config.delay, config.name
    f.late = IGNORE if rule in ("literal", "lag") else RULES.index(rule)  # their models are late
    f.total = f.n
    for name, sensor in config.sensors.items():
        s, frames = SLOW_NAMES.index(name), _count_frames(sensor, rule)
        max_frames = 1 if rule == "larsen" else N_FRAMES
        if frames > max_frames:
            raise ValueError(
                f"{label}: the {name} can be {sensor.longest_delay:g} s late, {frames} of its "
                f"periods of {sensor.period:g} s; delay={rule!r} can hold {max_frames}"
            )
        f.frames[s] = frames
        if rule == "clone":
            f.first_clone[s] = f.total
            f.total += frames * f.rows[s]
    if rule == "larsen" and f.frames.sum() > 1:
        raise ValueError(f"{label}: delay='larsen' is for one late sensor")
    if f.total > N_TOTAL:
        raise ValueError(
            f"{label}: {f.n} states and {f.total - f.n} clones are more than the {N_TOTAL} of "
            f"delay={rule!r}; delay='buffer' needs no clones"
        )


def check_window(f: FilterRecord, config: FilterConfig) -> None:
    """Check that the filter's window holds the longest delay and that its rules go together.

    Args:
        f: Memory of the filter.
        config: Parsed options of the filter.

    Raises:
        ValueError: A sensor can be later than the window, or the rule lacks what an option needs.
    """
    dt, label, sensors = float(f.step / f.stride), config.name, config.sensors
    if f.late == CONSTANT and f.assumed >= WINDOW:
        raise ValueError(
            f"{label}: assumed_delay of {f.assumed * dt:g} s is not within the window of "
            f"{WINDOW * dt:g} s ({WINDOW} ticks)"
        )
    if f.late == LARSEN and (f.gate.any() or f.knots > 0):
        raise ValueError(
            f"{label}: delay='larsen' weighs a sample before it is here, so it takes no gate "
            "and no hdop_table"
        )
    if f.late == BUFFER and f.pace > 1:
        raise ValueError(f"{label}: delay='buffer' is for filters that listen at every tick")
    if f.late == BUFFER and config.accel_time > 0.0:
        raise ValueError(
            f"{label}: delay='buffer' filters stored ticks again and does not store the noise that "
            f"accel_time={config.accel_time:g} finds; use delay='clone'"
        )
    if f.late not in (BUFFER, STORED):
        return
    window = WINDOW - SNAPSHOT_INTERVAL if f.late == BUFFER else WINDOW - 1
    n_samples = 0
    for name, sensor in sensors.items():
        if sensor.longest_delay > (window + 1e-6) * dt:
            raise ValueError(
                f"{label}: the {name} can be {sensor.longest_delay:g} s late; "
                f"delay={RULES[f.late]!r} has a window of {window * dt:g} s ({window} ticks)"
            )
        n_samples += 2 + math.ceil((sensor.longest_delay + SNAPSHOT_INTERVAL * dt) / sensor.period)
    if f.late == BUFFER and n_samples > N_RECENT:
        raise ValueError(
            f"{label}: {n_samples} samples of {' and '.join(sensors)} can come within the "
            f"longest delay; delay='buffer' stores {N_RECENT}"
        )
